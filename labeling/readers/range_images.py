"""Waymo's range images: how pixels look into the world, when, and how images are read from Parquet files."""

import contextlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from labeling.geometry.transforms import transform_points
from labeling.storage.ranges import RangeFile
from labeling.storage.storage import Storage
from schemas.arrays import BoolArray, Float32Array, Float64Array, Int64Array
from schemas.errors import InvalidInput, LabelingError, UnreadableSweep

FRAME: Final = "key.frame_timestamp_micros"
LASER: Final = "key.laser_name"
_BUFFER_BYTES: Final = 8 << 20  # of each column that is read; row groups may be larger than memory
_MAX_MISFIT_S: Final = 0.01


@dataclass(frozen=True, slots=True, eq=False)
class Laser:
    """How the pixels of a lidar look. Source: Waymo's utils/range_image_utils.py."""

    ego_from_lidar: Float64Array  # (4, 4)
    limits_rad: tuple[float, float]  # of inclinations that are evenly spaced between
    inclinations_rad: Float64Array | None  # (H,) of each beam, ascending; None: they are evenly spaced

    def points_ego(self, ranges_m: Float32Array) -> tuple[Float64Array, Int64Array, Int64Array]:
        """Return the (N, 3) returns of an (H, W) image, and row and column of each."""
        height, width = ranges_m.shape
        rows, columns = np.nonzero(ranges_m > 0)
        inclination = self._beams_rad(height)[rows]
        extrinsic_yaw = np.arctan2(self.ego_from_lidar[1, 0], self.ego_from_lidar[0, 0])
        azimuth = (2 * (width - columns - 0.5) / width - 1) * np.pi - extrinsic_yaw
        flat = np.cos(inclination)
        rays = np.column_stack([flat * np.cos(azimuth), flat * np.sin(azimuth), np.sin(inclination)])
        points_lidar = rays * ranges_m[rows, columns, None].astype(np.float64)
        return transform_points(self.ego_from_lidar, points_lidar), rows, columns

    def _beams_rad(self, height: int) -> Float64Array:
        """Return (H,) inclinations from the top row down."""
        if self.inclinations_rad is not None:
            return self.inclinations_rad[::-1]
        low, high = self.limits_rad
        return (low + (np.arange(height) + 0.5) / height * (high - low))[::-1]


@dataclass(frozen=True, slots=True)
class Turn:
    """When the columns of laser TOP are captured, after the instant of the frame's pose."""

    first_s: float = 0.0
    step_s: float = 0.0

    def times_s(self, columns: Int64Array) -> Float64Array:
        """Return (N,) times of columns."""
        return self.first_s + self.step_s * columns.astype(np.float64)


class RangeImages:
    """A component of range images. A frame's row groups alone are read, in them a row at a time."""

    def __init__(self, storage: Storage, path: str, fields: Sequence[str], hint: str) -> None:
        self.place = storage.place(path)
        size = storage.size(path)
        if size is None:
            raise InvalidInput(f"{self.place}: no such file{hint}")
        with damaged_is(InvalidInput, self.place):
            source = RangeFile(storage, path, size)
            self._file = pq.ParquetFile(source, pre_buffer=False, buffer_size=_BUFFER_BYTES)
            require_columns(self.place, self._file.schema_arrow.names, [FRAME, LASER, *map("{}.values".format, fields)])
            self._groups: dict[int, list[int]] = {}
            for group in range(self._file.num_row_groups):
                for frame in self._frames_in(group):
                    self._groups.setdefault(frame, []).append(group)

    @property
    def frames(self) -> set[int]:
        """Time stamps of all frames, us."""
        return set(self._groups)

    def read(
        self, frame: int, lasers: Sequence[int], fields: Sequence[str], channels: int
    ) -> dict[int, list[Float32Array]]:
        """Return the (H, W, channels) images of these lasers in a frame: the first field, then others that are there.

        Raises:
            UnreadableSweep: A laser has no row or no first image, or what is there cannot be read.

        """
        images = {}
        for laser, row in self._rows(frame, lasers, fields):
            place = f"{self.place}: frame {frame}, laser {laser}"
            found = [_image_of(row, field, channels, place) for field in fields]
            if found[0] is None:
                raise UnreadableSweep(f"{place}: {fields[0]} is empty")
            images[laser] = [image for image in found if image is not None]
        missing = [str(laser) for laser in lasers if laser not in images]
        if missing:
            raise UnreadableSweep(f"{self.place}: no row of frame {frame}, laser {', '.join(missing)}")
        return images

    def _rows(self, frame: int, lasers: Sequence[int], fields: Sequence[str]) -> Iterator[tuple[int, pa.RecordBatch]]:
        columns = [FRAME, LASER, *(f"{field}.{part}" for field in fields for part in ("values", "shape"))]
        left = set(lasers)
        for group in self._groups.get(frame, ()):
            with damaged_is(UnreadableSweep, f"{self.place}: row group {group} of frame {frame}"):
                batches = self._file.iter_batches(1, row_groups=[group], columns=columns, use_threads=False)
                for row in batches:
                    laser = row.column(LASER)[0].as_py()
                    if row.column(FRAME)[0].as_py() == frame and laser in left:
                        left.remove(laser)
                        yield laser, row
                    if not left:
                        return

    def _frames_in(self, group: int) -> set[int]:
        columns = self._file.metadata.row_group(group)
        named = {columns.column(k).path_in_schema: columns.column(k) for k in range(columns.num_columns)}
        statistics = named[FRAME].statistics
        if statistics is not None and statistics.has_min_max and statistics.min == statistics.max:
            return {int(statistics.min)}
        stamps = self._file.read_row_group(group, columns=[FRAME], use_threads=False).column(0)
        return set(stamps.drop_null().cast(pa.int64()).to_pylist())


def _image_of(row: pa.RecordBatch, field: str, channels: int, place: str) -> Float32Array | None:
    names = row.schema.names
    if f"{field}.values" not in names or not row.column(f"{field}.values")[0].is_valid:
        return None
    values = row.column(f"{field}.values")[0].values
    shape = tuple(row.column(f"{field}.shape")[0].as_py() or ()) if f"{field}.shape" in names else ()
    if len(shape) != 3 or None in shape or min(shape) < 1 or shape[2] != channels or np.prod(shape) != len(values):
        raise UnreadableSweep(
            f"{place}: {field} has {len(values)} values and shape {list(shape)}, expected [H, W, {channels}]"
        )
    if values.null_count:
        raise UnreadableSweep(f"{place}: {field} is empty in {values.null_count} of {len(values)} values")
    image: Float32Array = values.cast(pa.float32()).to_numpy().reshape(shape)
    return image


def fit_turn(poses: Float64Array, world_from_ego: Float64Array, velocity_mps: Float64Array) -> Turn:
    """Return the line that tells best how far on its way the vehicle was at each column; none where no line does."""
    is_known: BoolArray = np.asarray(poses.any(axis=2) & np.isfinite(poses).all(axis=2))
    moved_m = np.where(is_known[..., None], poses[..., 3:] - world_from_ego[:3, 3], np.nan)
    along_s = moved_m @ velocity_mps / (velocity_mps @ velocity_mps)  # (H, W)
    columns = np.flatnonzero(is_known.any(axis=0))
    if len(columns) < 2:
        return Turn()
    times_s = np.nanmedian(along_s[:, columns], axis=0)
    step_s, first_s = np.polyfit(columns, times_s, 1)
    if np.abs(first_s + step_s * columns - times_s).max() > _MAX_MISFIT_S:
        return Turn()
    return Turn(float(first_s), float(step_s))


def require_columns(place: str, names: Sequence[str], wanted: Sequence[str]) -> None:
    """Raise InvalidInput unless all that are wanted are there."""
    missing = [name for name in wanted if name not in names]
    if missing:
        raise InvalidInput(f"{place}: no column {', '.join(missing)}; it has {', '.join(names)}")


@contextlib.contextmanager
def damaged_is(error: type[LabelingError], place: str) -> Iterator[None]:
    """Raise ``error`` for what Parquet cannot be read from."""
    try:
        yield
    except (pa.ArrowException, OSError, UnicodeDecodeError, KeyError) as problem:  # the latter two: of a damaged schema
        line = (str(problem) or type(problem).__name__).splitlines()[0]
        raise error(f"{place}: not readable as Parquet, damaged? ({line})") from None
