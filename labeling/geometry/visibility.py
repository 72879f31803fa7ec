"""Range images: what a lidar's rays passed through. A ray that went on proves that a place was empty."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.ndimage import maximum_filter, minimum_filter

from labeling.geometry.transforms import transform_points
from schemas.arrays import BoolArray, Float32Array, Float64Array, FloatArray, Int64Array
from schemas.lidars import Lidar

CELLS = (2.2, 3.5)  # of what the lidar tells in azimuth and elevation: rays get lost, rows lie wider near by
MAX_CELL_RAD = np.deg2rad(10.0)


@dataclass(frozen=True, slots=True, eq=False)
class RangeImage:
    """How far the rays of one lidar went on in each direction and about it."""

    origin: Float64Array  # (3,)
    cell_rad: tuple[float, float]  # azimuth, elevation
    lowest_rad: float  # elevation of the lower edge
    clear_m: Float32Array  # (rows, columns) over 3 x 3 directions: the farthest return, or the nearest obstacle


def directions(points: FloatArray, origin: FloatArray) -> tuple[Float64Array, Float64Array, Float64Array]:
    """Return (N,) azimuths in [-pi, pi], elevations and ranges of points as seen from (3,) ``origin``."""
    x, y, z = (points - np.asarray(origin, dtype=np.float64)).T
    horizontal = np.hypot(x, y)
    return np.arctan2(y, x), np.arctan2(z, horizontal), np.hypot(horizontal, z)


def make_range_image(points: FloatArray, lidar: Lidar, is_ground: BoolArray) -> RangeImage:
    """Return the range image of all returns of a lidar in a sweep: (N, 3) points, (N,) of them ground or not.

    Ground hides nothing: the beam below one that goes on meets the road a little nearer.
    """
    azimuth, elevation, range_m = directions(points, np.array(lidar.origin_m))
    num_columns = int(np.ceil(2 * np.pi / min(CELLS[0] * lidar.azimuth_resolution_rad, MAX_CELL_RAD)))
    cell_rad = (2 * np.pi / num_columns, min(CELLS[1] * lidar.elevation_resolution_rad, MAX_CELL_RAD))
    lowest, highest = (elevation.min(), elevation.max()) if len(points) else (0.0, 0.0)
    lowest_rad = float(lowest - 2.5 * cell_rad[1])  # a row that has rays beside it, and one that has none
    shape = (int((highest - lowest_rad) / cell_rad[1]) + 3, num_columns)
    cell = _cell(azimuth, elevation, cell_rad, lowest_rad, shape)
    nearest, farthest = np.full(shape, np.inf, dtype=np.float32), np.zeros(shape, dtype=np.float32)
    stands = ~is_ground
    np.minimum.at(nearest.reshape(-1), cell[stands], range_m[stands].astype(np.float32))
    np.maximum.at(farthest.reshape(-1), cell, range_m.astype(np.float32))
    mode = ("nearest", "wrap")
    clear_m = np.minimum(minimum_filter(nearest, size=3, mode=mode), maximum_filter(farthest, size=3, mode=mode))
    return RangeImage(np.array(lidar.origin_m), cell_rad, lowest_rad, clear_m)


def _cell(
    azimuth: Float64Array,
    elevation: Float64Array,
    cell_rad: tuple[float, float],
    lowest_rad: float,
    shape: tuple[int, int],
) -> Int64Array:
    """Return (N,) flat cell numbers; what lies above or below is in the first or last row, which no ray is near."""
    column = np.floor((azimuth + np.pi) / cell_rad[0]).astype(np.int64) % shape[1]
    row = np.floor((elevation - lowest_rad) / cell_rad[1]).astype(np.int64)
    return np.clip(row, 0, shape[0] - 1) * shape[1] + column


@dataclass(frozen=True, slots=True, eq=False)
class Sight:
    """What the rays of another sweep's lidars passed through, asked in the frame of ``ref``."""

    images: Sequence[RangeImage]
    image_from_ref: Float64Array  # (4, 4)

    def is_through(self, points_ref: FloatArray, margin_m: float) -> BoolArray:
        """Return (N,) True where some lidar's ray about a point's direction went ``margin_m`` beyond it."""
        points = transform_points(self.image_from_ref, points_ref)
        is_through = np.zeros(len(points), dtype=bool)
        for image in self.images:
            rows = np.flatnonzero(~is_through)
            is_through[rows] = is_seen_through(image, points[rows], margin_m)
        return is_through


def is_seen_through(image: RangeImage, points: FloatArray, margin_m: FloatArray | float) -> BoolArray:
    """Return (N,) True where a ray about a point went ``margin_m`` beyond it and none met an obstacle nearer."""
    azimuth, elevation, range_m = directions(points, image.origin)
    cell = _cell(azimuth, elevation, image.cell_rad, image.lowest_rad, image.clear_m.shape)
    return np.asarray(image.clear_m.reshape(-1)[cell] > range_m + margin_m)
