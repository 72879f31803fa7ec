"""What ``motionlabel init-folder`` writes: what the files of a folder tell of it, and how sure each line is.

Widths of rows are told by how columns spread, units by ranges, times by what is possible, up by the ground, forward by
the way that the vehicle takes. How poses are meant is tried: with the right reading, what stands still lies in the
same place in two sweeps.
"""

from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import yaml

from labeling.readers.files import Columns, read_file
from labeling.readers.folder.alignment import Cloud, Sureness, choose_reading
from labeling.readers.folder.columns import bare_rows, columns_there, format_of
from labeling.readers.folder.description import DESCRIPTION, NANOSECONDS, Description, TimeUnit
from labeling.readers.folder.places import CommonFiles, common_names, find_common, sweep_places
from labeling.readers.folder.points import coordinates_of, returns_of
from labeling.readers.folder.poses import parse_poses, poses_of_sweeps
from labeling.readers.folder.segment import read_pose_files, time_sweeps
from labeling.readers.folder.stamps import TimedSweeps, count_of, stamp_in_name
from labeling.storage.storage import Storage
from schemas.arrays import Float64Array
from schemas.errors import InvalidInput, UnreadableSweep

_AXES: Final = (("x", "y", "z"), ("X", "Y", "Z"), ("x_m", "y_m", "z_m"))
_TIMES: Final = (
    "t", "time", "timestamp", "time_stamp", "offset_time", "time_offset", "timestamp_offset", "offset_ns", "offset_us",
    "offset_s", "t_s", "t_us", "t_ns", "timestamp_ns", "timestamps", "gps_time", "GpsTime",
)  # fmt: skip
_LIDARS: Final = ("lidar", "lidar_id", "lidar_index", "sensor", "sensor_id")
_SPAN_S: Final = (0.005, 0.3)  # of the capture times of one sweep
_RANGES_M: Final = (0.5, 100.0)  # in which half of a sweep's points lie
_MAX_LIDARS: Final = 16
_USUAL_RATE_HZ: Final = 10.0


@dataclass(frozen=True, slots=True)
class Line:
    """One line of the YAML."""

    key: str
    value: Any  # as YAML has it
    sureness: Sureness
    why: str

    @property
    def text(self) -> str:
        """The line, with how sure it is and why as a comment."""
        flow = yaml.safe_dump([self.value], default_flow_style=True, width=10**6, sort_keys=False).strip()
        return f"{self.key}: {flow[1:-1]}  # {self.sureness}: {self.why}"


def write_proposal(storage: Storage, *, is_forced: bool = False) -> tuple[Line, ...]:
    """Write ``motionlabel.yaml`` into a folder and return its lines.

    Raises:
        InvalidInput: There is one already, unless forced; or no sweeps, or none that can be read.

    """
    if not is_forced and storage.size(DESCRIPTION) is not None:
        raise InvalidInput(f"{storage.place(DESCRIPTION)} is there already: --force writes it anew")
    lines = propose(storage)
    head = "# How this folder is read. Check what is a guess; all that can be said: docs/your_data.md\n"
    storage.replace(DESCRIPTION, (head + "".join(f"{line.text}\n" for line in lines)).encode())
    return lines


def propose(storage: Storage) -> tuple[Line, ...]:
    """Return the lines of a description for a folder.

    Raises:
        InvalidInput: There are no sweeps, or none that can be read.

    """
    found = _Findings(storage)
    found.look_for_sweeps()
    found.look_at_columns()
    found.look_at_units()
    found.look_at_times()
    found.look_at_poses()
    found.look_at_point_times()
    found.look_at_lidars()
    return tuple(found.lines)


class _Findings:
    """What was found so far: each look rests on the ones before."""

    def __init__(self, storage: Storage) -> None:
        self.storage = storage
        self.lines: list[Line] = []
        self.names: list[str] = []
        self.sweeps: TimedSweeps | None = None

    @property
    def description(self) -> Description:
        """What the lines say."""
        return Description.model_validate({line.key: line.value for line in self.lines})

    def say(self, key: str, value: Any, sureness: Sureness, why: str) -> None:
        """Add a line."""
        self.lines.append(Line(key, value, sureness, why))

    def columns_of(self, name: str, wanted: tuple[str, ...]) -> Columns:
        """Return those of some columns that a sweep has; raise UnreadableSweep."""
        columns = next((line.value for line in self.lines if line.key == "columns"), None)
        try:
            return columns_there(read_file(self.storage, name, UnreadableSweep), name, wanted, columns)
        except ValueError as error:
            raise UnreadableSweep(f"{self.storage.place(name)}: {error}") from None

    def points_of(self, name: str) -> Cloud:
        """Return (N, 3) points as a sweep has them, without rays that met nothing; raise UnreadableSweep."""
        description = self.description
        coordinates = coordinates_of(self.columns_of(name, description.coordinates), description)
        return coordinates[returns_of(coordinates, self.storage.place(name))]

    def look_for_sweeps(self) -> None:
        """Take the pattern of the most files."""
        places = sweep_places(self.storage)
        if not places:
            raise InvalidInput(f"{self.storage.root}: no sweeps, here or one folder below")
        pattern = max(places, key=lambda pattern: len(places[pattern]))
        self.names = places[pattern]
        others = ", ".join(f"{len(names)} {other}" for other, names in places.items() if other != pattern)
        why = f"{len(self.names)} of them" + (f", but there are {others}" if others else ", no other place has any")
        self.say("sweeps", pattern, "likely" if others else "sure", why)

    def look_at_columns(self) -> None:
        """Tell the width of rows without names, or which of the names are coordinates."""
        name = self._readable()
        try:
            table = bare_rows(read_file(self.storage, name, UnreadableSweep), name)
        except ValueError as error:
            raise InvalidInput(f"{self.storage.place(name)}: {error}") from None
        if table is not None:
            names = self._named_extras(table)
            why = f"rows of {len(names)}"
            if format_of(name) == "bin":
                why += ": with this width, columns differ most from each other"
            self.say("columns", names, "sure" if len(names) <= 4 else "likely", why)
            return
        there = self.columns_of(name, tuple(axis for axes in _AXES for axis in axes))
        axes = next((axes for axes in _AXES if set(axes) <= there.keys()), None)
        if axes is None:
            raise InvalidInput(f"{self.storage.place(name)}: no columns x, y, z: say `coordinates` yourself")
        if axes != _AXES[0]:
            self.say("coordinates", list(axes), "sure", "columns of the files")

    def _readable(self) -> str:
        """Return the first sweep that holds something."""
        return next((name for name in self.names if self.storage.size(name)), self.names[0])

    def _named_extras(self, table: np.ndarray[Any, Any]) -> list[str]:
        names = ["x", "y", "z", "intensity"][: table.shape[1]]
        for column in range(4, table.shape[1]):
            values = table[:, column]
            is_whole = bool((values == np.round(values)).all())
            is_ring = is_whole and values.min() >= 0 and values.max() < 256 and "ring" not in names
            is_time = not is_whole and "t" not in names and _SPAN_S[0] < float(np.ptp(values)) < _SPAN_S[1]
            names.append("ring" if is_ring else "t" if is_time else f"column_{column}")
        return names

    def look_at_units(self) -> None:
        """Tell by how far half of the points are."""
        range_raw = float(np.median(np.linalg.norm(self.points_of(self._readable()), axis=1)))
        why = f"half of the points are within {range_raw:.3g}"
        if _RANGES_M[0] < range_raw < _RANGES_M[1]:
            self.say("units", "m", "sure", why)
        elif range_raw > 10 * _RANGES_M[1]:
            self.say("units", "mm", "likely", why)
        else:
            self.say("units", "m" if range_raw <= _RANGES_M[0] else "cm", "a guess", why)

    def look_at_times(self) -> None:
        """Tell whether names or a file give time stamps, or only count."""
        files = self._common(self.description)
        if files is not None and files.stamps is not None:
            self.say("stamps", {"file": files.stamps}, "sure", "its rows are the sweeps' time stamps")
        elif any(stamp_in_name(name) is None for name in self.names):
            if any(count_of(name) is None for name in self.names):
                raise InvalidInput(f"{self.storage.root}: names tell no times: put a file timestamps.txt beside")
            self.say("rate_hz", _USUAL_RATE_HZ, "a guess", "names only count, and no file tells times")
        self.sweeps = time_sweeps(self.storage, self.description, files, self.names)

    def _common(self, description: Description) -> CommonFiles | None:
        try:
            names = common_names(self.storage, description)
            return find_common(description, names, self.storage.root, needs_poses=False)
        except InvalidInput:
            return None

    def look_at_poses(self) -> None:
        """Tell which file has poses, and try how they are meant."""
        assert self.sweeps is not None
        file = self._pose_file()
        if file is None:
            self.say("poses", {}, "a guess", "NO POSES were found: name their file, as poses: {file: poses.txt}")
            return
        self.say("poses", {"file": file}, "sure", "rows of poses")
        description = self.description
        files = find_common(description, common_names(self.storage, description), self.storage.root)
        rows, camera_from_sensor = read_pose_files(self.storage, description, files)

        def poses_of(reading: Description) -> Float64Array:
            return poses_of_sweeps(rows, sweeps, reading, camera_from_sensor, file).world_from_ego

        sweeps = self.sweeps
        reading = choose_reading(description, poses_of, lambda index: self.points_of(sweeps.names[index]))
        self.lines.pop()
        self.say("axes", list(reading.axes), reading.sureness, reading.why_axes)
        self.say("poses", {"file": file, **reading.poses}, reading.sureness, reading.why)

    def _pose_file(self) -> str | None:
        """Return the file with a usual name, or the only other one whose rows are poses of the sweeps."""
        assert self.sweeps is not None
        files = self._common(self.description)
        if files is not None and files.poses is not None:
            return files.poses
        taken = {DESCRIPTION, *self.names, files.stamps if files else None}
        for name in sorted(self.storage.list_files()):
            if name not in taken and name.endswith((".txt", ".csv", ".npy", ".tum")):
                try:
                    rows = parse_poses(self.storage.read(name), name, name, self.description)
                except InvalidInput:
                    continue
                if np.isfinite(rows.transforms).all(axis=(1, 2)).any():
                    return name
        return None

    def look_at_point_times(self) -> None:
        """Tell the column of capture times, and its unit by what is possible."""
        assert self.sweeps is not None
        index = next((k for k, name in enumerate(self.sweeps.names) if self.storage.size(name)), 0)
        there = self.columns_of(self.sweeps.names[index], _TIMES)
        for name in (name for name in _TIMES if name in there):
            fitting = _possible_times(name, there[name], int(self.sweeps.timestamps_ns[index]))
            if fitting:
                unit, since, span_s = fitting[0]
                others = f", as would {', '.join(other for other, _, _ in fitting[1:])}" if fitting[1:] else ""
                why = f"its points then take {span_s:.3g} s{others}"
                value = {"column": name, "unit": unit, "since": since}
                self.say("time", value, "likely" if others else "sure", why)
                return

    def look_at_lidars(self) -> None:
        """Tell a column of few whole numbers that says which lidar."""
        there = self.columns_of(self._readable(), _LIDARS)
        for name in (name for name in _LIDARS if name in there):
            values = np.unique(there[name])
            if 1 < len(values) <= _MAX_LIDARS and (values == np.round(values)).all() and values.min() >= 0:
                number = int(values.max()) + 1
                if number <= _MAX_LIDARS:
                    self.say("lidar", {"column": name}, "likely", f"it holds {len(values)} numbers")
                    self.say("origins", [[0.0, 0.0, 0.0]] * number, "a guess", "WRITE where each lidar's rays start")
                return


def _possible_times(name: str, column: np.ndarray[Any, Any], stamp_ns: int) -> list[tuple[TimeUnit, str, float]]:
    """Return the units, and since when, with which a sweep takes a possible time, near its stamp."""
    suffix = name.rpartition("_")[2]
    units: list[TimeUnit] = [suffix] if suffix in NANOSECONDS else ["s", "ms", "us", "ns"]  # type: ignore[list-item]
    values = column.astype(np.float64)
    values = values[np.isfinite(values)]
    fitting: list[tuple[TimeUnit, str, float]] = []
    for unit in units:
        for since in ("stamp", "epoch"):
            start = stamp_ns / NANOSECONDS[unit] if since == "epoch" else 0
            with np.errstate(over="ignore"):  # of what is no time
                offset_s = (values - start) * (NANOSECONDS[unit] * 1e-9)
                span_s = float(np.ptp(offset_s)) if len(offset_s) else 0.0
            if _SPAN_S[0] < span_s < _SPAN_S[1] and np.abs(offset_s).max() < _SPAN_S[1]:
                fitting.append((unit, since, span_s))
    return fitting
