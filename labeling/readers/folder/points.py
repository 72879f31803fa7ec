"""The columns of one sweep as points in the ego frame, their capture times and their lidars.

A row that is not finite, or all zeros, is a ray that met nothing. As readers drop no row, its point is put where its
ray began, at no distance from its lidar.
"""

from collections.abc import Mapping
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from labeling.geometry.transforms import transform_points
from labeling.readers.folder.description import NANOSECONDS, Description, axes_matrix
from schemas.arrays import BoolArray, Float32Array, Float64Array, UInt8Array
from schemas.errors import UnreadableSweep

MAX_OFFSET_S: Final = 1.0  # of a point from its sweep's stamp; a turn takes a tenth of that
MAX_COORDINATE_M: Final = 1e6
MAX_MEDIAN_RANGE_M: Final = 500.0  # no lidar of a vehicle sees so far

RawColumns = Mapping[str, NDArray[Any]]


def coordinates_of(columns: RawColumns, description: Description) -> Float64Array:
    """Return (N, 3) coordinates as the file has them."""
    with np.errstate(invalid="ignore"):  # of NaN that signals
        return np.stack([columns[name] for name in description.coordinates], axis=1).astype(np.float64)


def returns_of(coordinates: Float64Array, place: str) -> BoolArray:
    """Return (N,) which rows are points; raise UnreadableSweep when none is."""
    is_return = np.asarray(np.isfinite(coordinates).all(axis=1) & coordinates.any(axis=1))
    if not is_return.any():
        raise UnreadableSweep(f"{place}: no points in the sweep, of {len(coordinates)} rows")
    return is_return


def origins_ego_of(description: Description) -> Float32Array:
    """Return (L, 3) where the rays of each lidar start, m; they are said in the axes of the points, but in metres."""
    ego_from_points = description.sensor.ego_from_sensor @ axes_matrix(description.axes)
    return transform_points(ego_from_points, np.array(description.origins, dtype=np.float64)).astype(np.float32)


def points_ego_of(
    coordinates: Float64Array, is_return: BoolArray, lidar_of_point: UInt8Array, description: Description, place: str
) -> Float32Array:
    """Return (N, 3) points in the ego frame at the sweep's stamp, m; raise UnreadableSweep for what can be none."""
    points = origins_ego_of(description)[lidar_of_point]
    seen = transform_points(description.ego_from_points, coordinates[is_return])
    num_far = int((np.abs(seen) > MAX_COORDINATE_M).any(axis=1).sum())
    if num_far:
        raise UnreadableSweep(f"{place}: {num_far} of {len(points)} points lie over 1,000 km away: other `columns`?")
    range_m = float(np.median(np.linalg.norm(seen - points[is_return], axis=1)))
    if range_m > MAX_MEDIAN_RANGE_M:
        raise UnreadableSweep(
            f"{place}: half of the points lie more than {range_m:.3g} m away: other `units`, other `columns`, "
            "or points in the frame of a map?"
        )
    points[is_return] = seen
    return points


def capture_offsets_of(
    columns: RawColumns, is_return: BoolArray, description: Description, timestamp_ns: int, place: str
) -> Float32Array:
    """Return (N,) s from the sweep's stamp to the capture of each point; zeros where no column tells."""
    offsets_s = np.zeros(len(is_return), dtype=np.float32)
    time = description.time
    if time is None:
        return offsets_s
    column = columns[time.column][is_return]
    scale, start = NANOSECONDS[time.unit], timestamp_ns if time.since == "epoch" else 0
    seen_s: NDArray[Any]
    if column.dtype.kind == "f":
        with np.errstate(invalid="ignore"):
            seen_s = (column.astype(np.float64) - start / scale) * (scale * 1e-9)
    else:  # exactly: nanoseconds since 1970 are no float64
        seen_s = (column.astype(np.int64) - start // scale) * (scale * 1e-9)
    worst_s = float(np.abs(seen_s).max()) if np.isfinite(seen_s).all() else np.inf
    if worst_s > MAX_OFFSET_S:
        raise UnreadableSweep(
            f"{place}: column {time.column} puts a point {worst_s:.3g} s from its sweep's stamp: another `unit`, or "
            f"`since: {'stamp' if time.since == 'epoch' else 'epoch'}`?"
        )
    offsets_s[is_return] = seen_s
    return offsets_s


def lidars_of(columns: RawColumns, is_return: BoolArray, description: Description, place: str) -> UInt8Array:
    """Return (N,) numbers of lidars; 0 for rows that are no points."""
    numbers = np.zeros(len(is_return), dtype=np.uint8)
    said = description.lidar
    if said is None:
        return numbers
    column, num_lidars = columns[said.column][is_return], len(description.origins)
    with np.errstate(invalid="ignore"):
        seen = np.floor_divide(column.astype(np.float64), said.lasers)
    is_known = (seen >= 0) & (seen < num_lidars)
    if not is_known.all():
        raise UnreadableSweep(
            f"{place}: column {said.column} holds {column[~is_known][0]:g}: motionlabel.yaml has {num_lidars} "
            f"`origins`, with {said.lasers} lasers each"
        )
    numbers[is_return] = seen
    return numbers
