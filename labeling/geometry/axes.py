"""Axes: along which way points are longest, seen from above."""

from dataclasses import dataclass

import numpy as np

from schemas.arrays import BoolArray, Float64Array, FloatArray, Int64Array


@dataclass(frozen=True, slots=True, eq=False)
class LongAxes:
    """The principal axes of G groups of points, seen from above."""

    direction: Float64Array  # (G, 2) unit vectors, of the longer one
    along_m2: Float64Array  # (G,) sums of squared offsets along it
    across_m2: Float64Array  # (G,) and across it

    def is_long(self, ratio: float) -> BoolArray:
        """Return (G,) True where a group is longer than ``ratio`` times its width (standard deviations)."""
        is_long: BoolArray = self.along_m2 > ratio**2 * self.across_m2
        return is_long


def long_axes(
    points: FloatArray,  # (N, 2) or (N, 3), z up
    group_of_point: Int64Array | None = None,  # (N,) in [0, G), none of them empty; None: all are one
) -> LongAxes:
    """Return the principal axes of each group of points."""
    group = np.zeros(len(points), dtype=np.int64) if group_of_point is None else group_of_point
    count = np.bincount(group)
    x, y = (axis - (np.bincount(group, weights=axis) / count)[group] for axis in points[:, :2].T.astype(np.float64))
    xx, yy, xy = (np.bincount(group, weights=values) for values in (x * x, y * y, x * y))
    angle = np.arctan2(2 * xy, xx - yy) / 2
    parting = np.hypot(xx - yy, 2 * xy)
    along, across = (xx + yy + parting) / 2, np.maximum(xx + yy - parting, 0.0) / 2
    return LongAxes(np.stack([np.cos(angle), np.sin(angle)], axis=1), along, across)


def depth_along(points: FloatArray) -> Float64Array:
    """Return (N,) how far (N, 2) or (N, 3) points, N >= 1, lie along their long axis from the first of them, m."""
    along = points[:, :2].astype(np.float64) @ long_axes(points).direction[0]
    depth: Float64Array = along - along.min()
    return depth
