"""KITTI raw drives (``{date}/{date}_drive_{number}_sync``): Velodyne sweeps with OXTS poses.

The ego frame is the Velodyne's. The world has east, north and up axes and its origin at the first OXTS packet of the
drive, whose latitude sets the scale of the Mercator projection (with scale 1, distances are 1.5 times too long). A
sweep's index is its file number: a number without a file is a sweep that cannot be read.

The poses are those of the packets, and GPS drifts: on drive 2011_09_26/0005, against scan matching, 0.1-0.2 m a second
sideways and 0.15 m a second in height, while headings agree within 0.1 degrees.
"""

import re
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Final

import numpy as np
from scipy.spatial.transform import Rotation

from labeling.geometry.transforms import invert
from labeling.readers.files import Columns, cuboids_of, read_cuboids, require_finite_points, require_folder
from labeling.readers.reader import segment_id_of
from schemas.arrays import Float32Array, Float64Array, Int64Array
from schemas.errors import InvalidInput, LabelingError, UnreadableSweep
from schemas.frames import Annotations, PointTruth, Sweep

DATASET: Final = "kitti_raw"
_EARTH_RADIUS_M: Final = 6378137.0  # of KITTI's own projection
_BYTES_PER_POINT: Final = 16  # float32 x, y, z, reflectance
_TIMESTAMP: Final = re.compile(r"\d{4}-\d\d-\d\d \d\d:\d\d:\d\d(\.\d{1,9})?")


def open_segment(uri: str) -> "KittiRawSegment":
    """Open one drive folder; the calibration is read from the folder above. Reads no points.

    Raises:
        InvalidInput: Not a drive folder, no sweeps, time stamps that do not fit or do not ascend, or no poses.

    """
    folder = Path(uri)
    require_folder(folder, DATASET)
    timestamps_ns = _read_timestamps(folder / "velodyne_points" / "timestamps.txt")
    sweep_numbers = _check_sweeps(folder / "velodyne_points" / "data", len(timestamps_ns))
    first_packet = _check_packets(folder / "oxts" / "data", sweep_numbers)
    lat, lon, alt, *_ = _read_packet(first_packet, InvalidInput)
    scale = np.cos(np.deg2rad(lat))
    return KittiRawSegment(
        uri=uri,
        segment_id=segment_id_of(DATASET, uri),
        timestamps_ns=timestamps_ns,
        folder=folder,
        mercator_scale=scale,
        origin_m=_mercator(lat, lon, alt, scale),
        imu_from_velodyne=invert(_read_rigid(folder.parent / "calib_imu_to_velo.txt")),
    )


@dataclass(eq=False)
class KittiRawSegment:
    """One drive behind the SegmentReader protocol."""

    uri: str
    segment_id: str
    timestamps_ns: Int64Array  # (T,)
    folder: Path
    mercator_scale: float
    origin_m: Float64Array  # (3,) of the first packet, Mercator
    imu_from_velodyne: Float64Array  # (4, 4)
    dataset: str = DATASET

    def read_sweep(self, index: int) -> Sweep:
        """Read one sweep; raises UnreadableSweep. Capture times are unknown: offsets are zero."""
        path = self.folder / "velodyne_points" / "data" / f"{index:010d}.bin"
        points = _read_points(path)
        return Sweep(
            index=index,
            timestamp_ns=int(self.timestamps_ns[index]),
            points_ego=points,
            capture_offset_s=np.zeros(len(points), dtype=np.float32),
            world_from_ego=self._read_pose(index),
            sensor_origins_ego=np.zeros((1, 3), dtype=np.float32),
        )

    def read_annotations(self, index: int) -> Annotations | None:
        """Return the cuboids of ``annotations.feather`` (Velodyne frame) whose ``frame`` is this index.

        The file speaks for all sweeps from its first frame to its last: one without rows holds no objects.
        """
        if self._cuboids is None:
            return None
        frame = self._cuboids["frame"]
        if not len(frame) or not frame.min() <= index <= frame.max():
            return None
        return cuboids_of(self._cuboids, frame == index)

    def read_point_truth(self, index: int) -> PointTruth | None:
        """Return None: KITTI has no point-wise truth."""
        return None

    def _read_pose(self, index: int) -> Float64Array:
        packet = _read_packet(self.folder / "oxts" / "data" / f"{index:010d}.txt", UnreadableSweep)
        lat, lon, alt, roll, pitch, yaw = packet
        world_from_imu = np.eye(4)
        world_from_imu[:3, :3] = _rotation_zyx(roll, pitch, yaw)
        world_from_imu[:3, 3] = _mercator(lat, lon, alt, self.mercator_scale) - self.origin_m
        return world_from_imu @ self.imu_from_velodyne

    @cached_property
    def _cuboids(self) -> Columns | None:
        return read_cuboids(self.folder / "annotations.feather", "frame")


def _read_timestamps(path: Path) -> Int64Array:
    """Return (T,) int64 ns, UTC. Parsed as integers: float64 seconds would be off by 100 ns."""
    if not path.is_file():
        raise InvalidInput(f"{path}: no such file, expected one line a sweep")
    timestamps_ns: list[int] = []
    for number, line in enumerate(path.read_text(errors="replace").rstrip().splitlines(), start=1):
        try:
            if not _TIMESTAMP.fullmatch(line.strip()):
                raise ValueError
            timestamp_ns = int(np.datetime64(line.strip(), "ns").astype(np.int64))
        except ValueError:
            raise InvalidInput(
                f"{path}: line {number}: expected a time as 2011-09-26 13:04:32.348999000, got {line.strip()[:40]!r}"
            ) from None
        if timestamps_ns and timestamp_ns <= timestamps_ns[-1]:
            raise InvalidInput(f"{path}: line {number}: time stamps must ascend, got {line.strip()} after a later one")
        timestamps_ns.append(timestamp_ns)
    if not timestamps_ns:
        raise InvalidInput(f"{path}: no time stamps, expected one line a sweep")
    return np.array(timestamps_ns, dtype=np.int64)


def _numbers(folder: Path, suffix: str) -> list[int]:
    """Return the ascending numbers of the files of a drive's data folder."""
    return sorted(int(path.stem) for path in folder.glob(f"*{suffix}") if re.fullmatch(r"\d{10}", path.stem))


def _check_sweeps(folder: Path, num_timestamps: int) -> list[int]:
    numbers = _numbers(folder, ".bin")
    if not numbers:
        raise InvalidInput(f"{folder}: no sweeps, expected files as 0000000000.bin")
    if numbers[-1] >= num_timestamps:
        raise InvalidInput(
            f"{folder / f'{numbers[-1]:010d}.bin'}: no time stamp: velodyne_points/timestamps.txt has {num_timestamps} "
            "lines, expected one for each number from 0 on, gaps included"
        )
    return numbers


def _check_packets(folder: Path, sweep_numbers: list[int]) -> Path:
    """Return the first packet's path, once at least one sweep has a packet."""
    numbers = _numbers(folder, ".txt")
    if not numbers:
        raise InvalidInput(f"{folder}: no poses, expected OXTS packets as 0000000000.txt")
    if not set(numbers) & set(sweep_numbers):
        raise InvalidInput(
            f"{folder}: poses do not cover the sweeps: packets are numbered {numbers[0]} to {numbers[-1]}, "
            f"sweeps {sweep_numbers[0]} to {sweep_numbers[-1]}"
        )
    return folder / f"{numbers[0]:010d}.txt"


def _read_points(path: Path) -> Float32Array:
    if not path.is_file():
        raise UnreadableSweep(f"{path}: no such file, a gap in the drive")
    size = path.stat().st_size
    if size % _BYTES_PER_POINT:
        raise UnreadableSweep(f"{path}: {size} bytes are not whole points of {_BYTES_PER_POINT} bytes, truncated?")
    points = np.fromfile(path, dtype="<f4").reshape(-1, 4)[:, :3].astype(np.float32)
    require_finite_points(points, path)
    return points


def _read_packet(path: Path, error: type[LabelingError]) -> list[float]:
    """Return lat, lon, alt (degrees, degrees, m), roll, pitch, yaw (rad) of an OXTS packet."""
    if not path.is_file():
        raise error(f"{path}: no such file, so the sweep has no pose")
    values = path.read_text(errors="replace").split()[:6]
    try:
        packet = [float(value) for value in values]
    except ValueError:
        packet = []
    if len(packet) < 6 or not np.isfinite(packet).all() or abs(packet[0]) > 85:
        raise error(f"{path}: expected numbers lat lon alt roll pitch yaw ..., got {' '.join(values)[:60]!r}")
    return packet


def _mercator(lat: float, lon: float, alt: float, scale: float) -> Float64Array:
    """Return (3,) east, north, up in metres of a position in degrees. Source: KITTI raw devkit, latlonToMercator."""
    east = scale * _EARTH_RADIUS_M * np.deg2rad(lon)
    north = scale * _EARTH_RADIUS_M * np.log(np.tan(np.deg2rad(90 + lat) / 2))
    return np.array([east, north, alt])


def _rotation_zyx(roll: float, pitch: float, yaw: float) -> Float64Array:
    """Return (3, 3) Rz(yaw) Ry(pitch) Rx(roll), yaw 0 facing east. Source: KITTI raw devkit, convertOxtsToPose."""
    rotation: Float64Array = Rotation.from_euler("ZYX", [yaw, pitch, roll]).as_matrix()
    return rotation


def _read_rigid(path: Path) -> Float64Array:
    """Return the (4, 4) of a KITTI calibration file with lines ``R: 9 numbers`` and ``T: 3 numbers``."""
    if not path.is_file():
        raise InvalidInput(f"{path}: no such file; KITTI keeps the calibration in the folder of the date")
    lines = dict(line.split(":", 1) for line in path.read_text(errors="replace").splitlines() if ":" in line)
    transform = np.eye(4)
    try:
        transform[:3, :3] = np.array(lines["R"].split(), dtype=np.float64).reshape(3, 3)
        transform[:3, 3] = np.array(lines["T"].split(), dtype=np.float64).reshape(3)
    except (KeyError, ValueError):
        raise InvalidInput(f"{path}: expected lines R: with 9 numbers and T: with 3") from None
    if not np.allclose(transform[:3, :3] @ transform[:3, :3].T, np.eye(3), atol=1e-3):
        raise InvalidInput(f"{path}: R is not a rotation")
    return transform
