"""Range images: what a sweep's rays passed through. A ray that went on proves that a place was empty."""

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import maximum_filter, minimum_filter

from labeling.geometry.transforms import transform_points
from schemas.arrays import BoolArray, Float32Array, Float64Array, FloatArray, Int64Array

AZIMUTH_STEP_RAD = np.deg2rad(0.5)  # two columns of a usual spinning lidar
ELEVATION_STEP_RAD = np.deg2rad(0.8)  # two of its 64 beams
MIN_ELEVATION_RAD = np.deg2rad(-40.0)
NUM_COLUMNS = round(2 * np.pi / AZIMUTH_STEP_RAD)
NUM_ROWS = round(np.deg2rad(80.0) / ELEVATION_STEP_RAD)


@dataclass(frozen=True, slots=True, eq=False)
class RangeImage:
    """Nearest obstacle and farthest return of each direction and its neighbours, as seen from ``origin``."""

    origin: Float64Array  # (3,)
    nearest_m: Float32Array  # (rows, columns) over 3 x 3 directions; inf where no obstacle came back
    farthest_m: Float32Array  # (rows, columns) over 3 x 3 directions; 0 where nothing came back


def _direction_cell(points: FloatArray, origin: FloatArray) -> tuple[Int64Array, Int64Array, Float64Array]:
    offset = points - origin
    horizontal = np.hypot(offset[:, 0], offset[:, 1])
    column = (
        np.floor((np.arctan2(offset[:, 1], offset[:, 0]) + np.pi) / AZIMUTH_STEP_RAD).astype(np.int64) % NUM_COLUMNS
    )
    row = np.floor((np.arctan2(offset[:, 2], horizontal) - MIN_ELEVATION_RAD) / ELEVATION_STEP_RAD).astype(np.int64)
    return np.clip(row, 0, NUM_ROWS - 1), column, np.hypot(horizontal, offset[:, 2])


def make_range_image(points: FloatArray, origin: FloatArray, is_ground: BoolArray) -> RangeImage:
    """Return the range image of all returns of a sweep: (N, 3) points and (3,) origin, one frame; (N,) ground or not.

    Ground hides nothing: the beam below one that goes on meets the road a little nearer.
    """
    row, column, range_m = _direction_cell(points, origin)
    nearest = np.full((NUM_ROWS, NUM_COLUMNS), np.inf, dtype=np.float32)
    farthest = np.zeros((NUM_ROWS, NUM_COLUMNS), dtype=np.float32)
    stands = ~is_ground
    np.minimum.at(nearest, (row[stands], column[stands]), range_m[stands].astype(np.float32))
    np.maximum.at(farthest, (row, column), range_m.astype(np.float32))
    mode = ("nearest", "wrap")
    return RangeImage(
        np.asarray(origin, dtype=np.float64),
        minimum_filter(nearest, size=3, mode=mode),
        maximum_filter(farthest, size=3, mode=mode),
    )


@dataclass(frozen=True, slots=True, eq=False)
class Sight:
    """What another sweep's rays passed through, asked in the frame of ``ref``."""

    image: RangeImage
    image_from_ref: Float64Array  # (4, 4)

    def is_through(self, points_ref: FloatArray, margin_m: FloatArray | float) -> BoolArray:
        """Return (N,) True where a ray about a point's direction went ``margin_m`` beyond it: see is_seen_through."""
        return is_seen_through(self.image, transform_points(self.image_from_ref, points_ref), margin_m)


def is_seen_through(image: RangeImage, points: FloatArray, margin_m: FloatArray | float) -> BoolArray:
    """Return (N,) True where a ray about a point went ``margin_m`` beyond it and none met an obstacle nearer."""
    row, column, range_m = _direction_cell(points, image.origin)
    return np.minimum(image.nearest_m[row, column], image.farthest_m[row, column]) > range_m + margin_m
