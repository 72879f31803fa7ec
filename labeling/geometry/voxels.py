"""Grids: keys of cells, down-sampling, and statistics of the points of each cell."""

from dataclasses import dataclass

import numpy as np

from labeling.geometry.axes import depth_along
from schemas.arrays import BoolArray, FloatArray, Int64Array

END_SHARE = 0.05  # of the length of a dense cloud
MAX_END_ROWS = 64
MAX_GRID_CELLS = 2048  # along a side, however far points lie apart


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


def is_near_cells(points: FloatArray, places: FloatArray, radius: float) -> BoolArray:
    """Return (N,) which points may lie within ``radius`` of some of (M, 2 or more) places, seen from above.

    All that do are among them, for they are in the cell of a place or in one beside it; and some others.
    """
    if len(points) == 0 or len(places) == 0:
        return np.zeros(len(points), dtype=bool)
    low = places[:, :2].min(axis=0).astype(np.float64) - radius
    size = max(radius, float((places[:, :2].max(axis=0) - low).max()) / MAX_GRID_CELLS)
    cells = np.floor((places[:, :2] - low) / size).astype(np.int64)
    num_cells = cells.max(axis=0) + 2
    is_near = np.zeros(num_cells, dtype=bool)
    for step in np.ndindex(3, 3):
        is_near[tuple(np.maximum(cells + np.array(step) - 1, 0).T)] = True
    asked = np.floor((points[:, :2] - low) / size).astype(np.int64)
    is_inside = ((asked >= 0) & (asked < num_cells)).all(axis=1)
    found = np.zeros(len(points), dtype=bool)
    found[is_inside] = is_near[tuple(asked[is_inside].T)]
    return found


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
