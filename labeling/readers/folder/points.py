"""The columns of one sweep as points in the ego frame, their capture times and their lidars."""

from collections.abc import Mapping
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from labeling.geometry.transforms import transform_points
from labeling.readers.files import require_finite_points
from labeling.readers.folder.description import NANOSECONDS, Description
from schemas.arrays import Float32Array, UInt8Array
from schemas.errors import UnreadableSweep

MAX_OFFSET_S: Final = 1.0  # of a point from its sweep's stamp; a turn takes a tenth of that
MAX_COORDINATE_M: Final = 1e6
MAX_MEDIAN_RANGE_M: Final = 500.0  # no lidar of a vehicle sees so far


def points_ego_of(columns: Mapping[str, NDArray[Any]], description: Description, place: str) -> Float32Array:
    """Return (N, 3) points in the ego frame at the sweep's stamp, m; raise UnreadableSweep for what can be none."""
    with np.errstate(invalid="ignore"):  # of NaN that signals
        raw = np.stack([columns[name] for name in description.coordinates], axis=1).astype(np.float64)
    require_finite_points(raw, place)
    points = transform_points(description.ego_from_points, raw)
    num_far = int((np.abs(points) > MAX_COORDINATE_M).any(axis=1).sum())
    if num_far:
        raise UnreadableSweep(f"{place}: {num_far} of {len(points)} points lie over 1,000 km away: other `columns`?")
    range_m = float(np.median(np.abs(points - description.sensor.ego_from_sensor[:3, 3]).max(axis=1)))
    if range_m > MAX_MEDIAN_RANGE_M:
        raise UnreadableSweep(
            f"{place}: half of the points lie more than {range_m:.3g} m away: other `units`, other `columns`, "
            "or points in the frame of a map?"
        )
    return points.astype(np.float32)


def capture_offsets_of(
    columns: Mapping[str, NDArray[Any]], description: Description, timestamp_ns: int, place: str
) -> Float32Array:
    """Return (N,) s from the sweep's stamp to the capture of each point; zeros where no column tells."""
    time = description.time
    if time is None:
        return np.zeros(len(columns[description.coordinates[0]]), dtype=np.float32)
    column = columns[time.column]
    offset_s: NDArray[Any]
    scale, start = NANOSECONDS[time.unit], timestamp_ns if time.since == "epoch" else 0
    if column.dtype.kind == "f":
        offset_s = (column.astype(np.float64) - start / scale) * (scale * 1e-9)
    else:  # exactly: nanoseconds since 1970 are no float64
        offset_s = (column.astype(np.int64) - start // scale) * (scale * 1e-9)
    worst_s = float(np.abs(offset_s).max(initial=0.0)) if np.isfinite(offset_s).all() else np.inf
    if worst_s > MAX_OFFSET_S:
        raise UnreadableSweep(
            f"{place}: column {time.column} puts a point {worst_s:.3g} s from its sweep's stamp: another `unit`, or "
            f"`since: {'stamp' if time.since == 'epoch' else 'epoch'}`?"
        )
    return offset_s.astype(np.float32)


def lidar_of_point(columns: Mapping[str, NDArray[Any]], description: Description, place: str) -> UInt8Array:
    """Return (N,) numbers of lidars."""
    num_lidars = len(description.origins)
    if description.lidar is None:
        return np.zeros(len(columns[description.coordinates[0]]), dtype=np.uint8)
    column = columns[description.lidar.column]
    number = np.floor_divide(column.astype(np.float64), description.lidar.lasers)
    is_known = (number >= 0) & (number < num_lidars)
    if not is_known.all():
        worst = column[~is_known][0]
        raise UnreadableSweep(
            f"{place}: column {description.lidar.column} holds {worst:g}: motionlabel.yaml has {num_lidars} `origins`, "
            f"with {description.lidar.lasers} lasers each"
        )
    return number.astype(np.uint8)
