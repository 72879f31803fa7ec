"""Grids: keys of cells, down-sampling, and statistics of the points of each cell."""

from dataclasses import dataclass

import numpy as np

from labeling.geometry.axes import depth_along
from schemas.arrays import FloatArray, Int64Array

END_SHARE = 0.05  # of the length of a dense cloud
MAX_END_ROWS = 64


@dataclass(frozen=True, slots=True, eq=False)
class VoxelGroups:
    """Points grouped by voxel: point i lies in voxel ``voxel_of_point[i]``."""

    voxel_of_point: Int64Array  # (N,) in [0, V)
    first_point: Int64Array  # (V,) one point of each voxel
    num_points: Int64Array  # (V,)


def group_by_voxel(points: FloatArray, size: float) -> VoxelGroups:
    """Group (N, D) points by cells of edge ``size``, in the unit of the points.

    Exact while the extent holds fewer than 2^63 cells, 200 km cubed at 0.1 m.
    """
    if len(points) == 0:
        empty = np.empty(0, dtype=np.int64)
        return VoxelGroups(empty, empty, empty)
    cells = np.floor(points.astype(np.float64) / size).astype(np.int64)
    cells -= cells.min(axis=0)
    key = np.zeros(len(points), dtype=np.int64)
    for column, span in zip(cells.T, cells.max(axis=0) + 1, strict=True):
        key = key * span + column
    _, first, inverse, counts = np.unique(key, return_index=True, return_inverse=True, return_counts=True)
    return VoxelGroups(inverse.astype(np.int64), first.astype(np.int64), counts.astype(np.int64))


def spread_rows(num_rows: int, max_rows: int) -> Int64Array:
    """Return at most ``max_rows`` evenly spread row numbers: sub-sampling without a random number."""
    if num_rows <= max_rows:
        return np.arange(num_rows)
    return np.floor(np.arange(max_rows) * (num_rows / max_rows)).astype(np.int64)


def spread_points(points: FloatArray, max_rows: int, *, dense_from: int) -> Int64Array:
    """Return rows of (N, 3) points that speak for them: ``max_rows`` spread evenly, as their density is.

    From ``dense_from`` points besides MAX_END_ROWS at each end of their long axis, seen from above. A bus abreast has
    tens of thousands of points, nearly all on the side that slides along itself: what shows its motion are the few at
    its ends. Ascending, distinct.
    """
    spread = spread_rows(len(points), max_rows)
    if len(points) < dense_from:
        return spread
    depth_m = depth_along(points)
    length_m = depth_m.max()
    ends = [np.flatnonzero(depth <= END_SHARE * length_m) for depth in (depth_m, length_m - depth_m)]
    return np.unique(np.concatenate([spread, *(end[spread_rows(len(end), MAX_END_ROWS)] for end in ends)]))
