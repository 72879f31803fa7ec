"""Ground: which points are road, pavement or grass, and how high the others stand above it."""

import numpy as np
from scipy.ndimage import map_coordinates, minimum_filter

from schemas.arrays import BoolArray, Float32Array, Float64Array, FloatArray, Int64Array, require
from schemas.config import GroundParams
from schemas.frames import GroundMask

GRID_REACH_M = 100.0  # the height map's half side; points beyond take the height of its border
COARSE_CELL_M = 4.0  # of the map that grows outward: wider than a car's side, so a cell of only roofs is rare
LOW_QUANTILE = 0.1  # of a cell's heights: the ground under grass and noise, robust to single ghosts below it
MAX_KERB_M = 0.2  # between a fine cell and the lowest one within ROOF_REACH_CELLS
ROOF_REACH_CELLS = 2
MAX_STEP_M = 0.4  # between neighbouring coarse cells beyond what the slope explains: a kerb, a crest


def segment_ground(
    points_ego: Float32Array,  # (N, 3) ego, m
    params: GroundParams,
    rng: np.random.Generator,
) -> GroundMask:
    """Mark the points of the ground and measure the height of all points above it.

    A close-to-horizontal plane is found by RANSAC among the lowest points of each cell, so that a house front, however
    many points it has, votes no louder than the strip of road it stands on. The plane is then refined twice: a coarse
    height map grows from the vehicle outward, each cell predicted by its finished neighbours (slopes, crests), and a
    fine one follows kerbs. Nothing is assumed but z roughly up.

    Returns:
        ``is_ground`` for points less than ``params.max_height_m`` above the ground, or below it.

    Source: paper section 3.1, "Identifying Static Points". We differ: votes by cell, constrained normal in the
    proposal itself, local refinement (off in profile ``paper``, where ``inlier_distance_m`` is the vicinity).

    """
    require("points_ego", points_ego, (None, 3), np.float32)
    if len(points_ego) < 3:
        return GroundMask(np.zeros(len(points_ego), dtype=bool), np.zeros(len(points_ego), dtype=np.float32))
    plane = _fit_plane(_lowest_of_cells(points_ego, params.cell_m), params, rng)
    height_m = points_ego[:, 2] - _plane_height(plane, points_ego)
    if not params.has("local_surface"):
        return GroundMask(height_m < params.inlier_distance_m, height_m.astype(np.float32))
    height_m -= _coarse_surface(points_ego, height_m)
    height_m -= _fine_surface(points_ego, height_m, params)
    return GroundMask(height_m < params.max_height_m, height_m.astype(np.float32))


def _cell_of(points: FloatArray, cell_m: float) -> tuple[Int64Array, int]:
    side = round(2 * GRID_REACH_M / cell_m)
    column = np.clip(np.floor((points[:, :2] + GRID_REACH_M) / cell_m).astype(np.int64), 0, side - 1)
    return column[:, 0] * side + column[:, 1], side


def _low_value_of_cells(
    cell: Int64Array, value: FloatArray, quantile: float
) -> tuple[Int64Array, Float64Array, Int64Array]:
    """Return the occupied cells, a low quantile of the values in each, and the number of values."""
    order = np.lexsort((value, cell))
    occupied, start, count = np.unique(cell[order], return_index=True, return_counts=True)
    return occupied, value[order][start + (count * quantile).astype(np.int64)].astype(np.float64), count


def _lowest_of_cells(points: FloatArray, cell_m: float) -> Float64Array:
    cell, _ = _cell_of(points, cell_m)
    order = np.lexsort((points[:, 2], cell))
    _, start, count = np.unique(cell[order], return_index=True, return_counts=True)
    return points[order][start + (count * LOW_QUANTILE).astype(np.int64)].astype(np.float64)


def _fit_plane(points: Float64Array, params: GroundParams, rng: np.random.Generator) -> Float64Array:
    """Return (a, b, c) of z = a x + b y + c with most points nearby, among planes no steeper than allowed."""
    near = points[np.linalg.norm(points[:, :2], axis=1) < GRID_REACH_M / 2]
    points = near if len(near) >= 3 else points
    samples = points[rng.integers(0, len(points), size=(params.ransac_iterations, 3))]
    design = np.concatenate([samples[..., :2], np.ones((*samples.shape[:2], 1))], axis=2)
    is_solvable = np.abs(np.linalg.det(design)) > 1e-3
    flat = np.array([0.0, 0.0, np.quantile(points[:, 2], 0.2)])
    planes = np.concatenate([np.linalg.solve(design[is_solvable], samples[is_solvable, :, 2:])[..., 0], flat[None]])
    planes = planes[np.hypot(planes[:, 0], planes[:, 1]) <= np.tan(params.max_slope_rad)]
    residual = points[None, :, 2] - (planes[:, :2] @ points[:, :2].T + planes[:, 2:])
    best = planes[(np.abs(residual) < params.inlier_distance_m).sum(axis=1).argmax()]
    inliers = points[np.abs(points[:, 2] - _plane_height(best, points)) < params.inlier_distance_m]
    if len(inliers) < 3:
        return best
    refit, *_ = np.linalg.lstsq(np.column_stack([inliers[:, :2], np.ones(len(inliers))]), inliers[:, 2], rcond=None)
    return refit if np.hypot(*refit[:2]) <= np.tan(params.max_slope_rad) else best


def _plane_height(plane: Float64Array, points: FloatArray) -> Float64Array:
    height: Float64Array = points[:, :2] @ plane[:2] + plane[2]
    return height


def _coarse_surface(points: FloatArray, height_m: FloatArray) -> Float64Array:
    """Return (N,) offsets of the ground from the plane, from a map grown outward from the vehicle."""
    cell, side = _cell_of(points, COARSE_CELL_M)
    order = np.lexsort((height_m, cell))
    occupied, start, count = np.unique(cell[order], return_index=True, return_counts=True)
    sorted_height = height_m[order]
    row, column = np.divmod(occupied, side)
    center = (side - 1) / 2
    surface = np.zeros((side + 2, side + 2))
    is_known = np.zeros((side + 2, side + 2), dtype=bool)
    for k in np.argsort(np.hypot(row - center, column - center), kind="stable"):
        i, j = row[k] + 1, column[k] + 1
        window = (slice(i - 1, i + 2), slice(j - 1, j + 2))
        known = is_known[window]
        predicted = surface[window][known].mean() if known.any() else _nearest_known(surface, is_known, i, j)
        heights = sorted_height[start[k] : start[k] + count[k]]
        step_m = MAX_STEP_M if known.any() else 2 * MAX_STEP_M
        low, high = np.searchsorted(heights, [predicted - step_m, predicted + step_m])
        surface[i, j] = heights[low + int((high - low) * LOW_QUANTILE)] if high > low else predicted
        is_known[i, j] = True
    return _interpolate(surface[1:-1, 1:-1], is_known[1:-1, 1:-1], points, COARSE_CELL_M)


def _nearest_known(surface: Float64Array, is_known: BoolArray, i: int, j: int) -> float:
    rows, columns = np.nonzero(is_known)
    if len(rows) == 0:
        return 0.0
    nearest = np.argmin((rows - i) ** 2 + (columns - j) ** 2)
    return float(surface[rows[nearest], columns[nearest]])


def _fine_surface(points: FloatArray, height_m: FloatArray, params: GroundParams) -> Float64Array:
    """Return (N,) offsets of the ground from the coarse map, following kerbs."""
    is_near_ground = np.abs(height_m) < MAX_STEP_M
    cell, side = _cell_of(points[is_near_ground], params.cell_m)
    occupied, low, _ = _low_value_of_cells(cell, height_m[is_near_ground], LOW_QUANTILE)
    surface = np.zeros((side, side))
    is_known = np.zeros((side, side), dtype=bool)
    surface.flat[occupied], is_known.flat[occupied] = low, True
    lowest_around = minimum_filter(np.where(is_known, surface, np.inf), size=2 * ROOF_REACH_CELLS + 1)
    is_known &= surface <= lowest_around + MAX_KERB_M  # a cell that saw only a car's side is no ground
    return _interpolate(surface, is_known, points, params.cell_m)


def _interpolate(surface: Float64Array, is_known: BoolArray, points: FloatArray, cell_m: float) -> Float64Array:
    """Return (N,) bilinear values of a cell map at points; unknown cells weigh nothing, all unknown gives zero."""
    position = ((points[:, :2] + GRID_REACH_M) / cell_m - 0.5).T
    total, weight = (
        map_coordinates(values, position, order=1, mode="nearest")
        for values in (surface * is_known, is_known.astype(np.float64))
    )
    return np.asarray(total / (weight + 1e-9))
