"""Points of a sweep in few bytes: on a grid of 2 cm, thinned where nothing moves, as differences, deflated.

A sweep is one block: the columns x, y, z of all points, those that stand still first, and then the columns of the
moving ones alone, velocity along x and y of the world and track. Each column is int16, holds differences from row to
row (modulo 2^16), and is stored as all its low bytes and then all its high bytes, which deflate finds alike.
"""

import zlib
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from labeling.geometry.voxels import group_by_voxel
from schemas.arrays import Float64Array, FloatArray, Int64Array, read_only

GRID_M: Final = 0.02  # of places: no coordinate is more than half of it away
REACH_M: Final = 650.0  # int16 ends at 655 m
GRID_MPS: Final = 0.02  # of velocities
NO_FLOW: Final = -32768
NO_TRACK: Final = -1
MIN_STATIC: Final = 1000  # points that stand still and are kept, however many move

FINEST_VOXEL_M: Final = 0.05
VOXEL_STEP: Final = 2**0.25  # from one size that is tried to the next

Int16Array = NDArray[np.int16]


@dataclass(frozen=True, slots=True, eq=False)
class ReplayPoints:
    """Points of one sweep as the page shows them. Ego frame of the sweep; rows that move are last."""

    places: Int16Array  # (N, 3) in steps of GRID_M
    velocities: Int16Array  # (M, 2) of the last M rows, world axes, in steps of GRID_MPS; NO_FLOW where unknown
    tracks: Int16Array  # (M,) number of the track; NO_TRACK where none

    def __post_init__(self) -> None:
        """Make all arrays read-only."""
        for name in self.__slots__:
            object.__setattr__(self, name, read_only(getattr(self, name)))

    @property
    def num_static(self) -> int:
        """Number of rows that stand still, the first ones."""
        return len(self.places) - len(self.tracks)

    @property
    def points_ego(self) -> Float64Array:
        """(N, 3) the places in m."""
        return self.places.astype(np.float64) * GRID_M

    @property
    def velocity_mps(self) -> Float64Array:
        """(M, 2) of the rows that move; NaN where unknown."""
        return np.where(self.velocities == NO_FLOW, np.nan, self.velocities * GRID_MPS)


def quantize(
    points_ego: FloatArray,  # (S, 3) that stand still
    moving_ego: FloatArray,  # (M, 3)
    velocity_mps: Float64Array,  # (M, 2) NaN where unknown
    track: Int64Array,  # (M,) NO_TRACK where none
) -> ReplayPoints:
    """Put points on the grid, in an order in which neighbours in space are neighbours in the block.

    All must lie within REACH_M of the vehicle along each axis.
    """
    of_static, of_moving = (np.rint(points / GRID_M).astype(np.int16) for points in (points_ego, moving_ego))
    order = _along_curve(of_moving)
    limit = np.iinfo(np.int16).max
    velocities = np.clip(np.rint(velocity_mps / GRID_MPS), -limit, limit)
    velocities = np.where(np.isnan(velocities), NO_FLOW, velocities).astype(np.int16)
    return ReplayPoints(
        places=np.concatenate([of_static[_along_curve(of_static)], of_moving[order]]),
        velocities=velocities[order],
        tracks=track[order].astype(np.int16),
    )


def thin(points: FloatArray, max_points: int) -> tuple[Int64Array, float]:
    """Keep one point a voxel, of the smallest voxels with which ``max_points`` suffice: rows, and the edge in m.

    All are kept, and the edge is 0, where they are few enough.
    """
    rows, voxel_m = np.arange(len(points)), 0.0
    while len(rows) > max(max_points, MIN_STATIC):
        voxel_m = voxel_m * VOXEL_STEP or FINEST_VOXEL_M
        rows = np.sort(group_by_voxel(points, voxel_m).first_point)
    return rows, voxel_m


def encode(points: ReplayPoints) -> bytes:
    """Return the block of a sweep."""
    columns = [*points.places.T, *points.velocities.T, points.tracks]
    return zlib.compress(b"".join(map(_encode_column, columns)), 9)


def decode(block: bytes, num_static: int, num_moving: int) -> ReplayPoints:
    """Return what is in the block of a sweep, as the page does."""
    content = np.frombuffer(zlib.decompress(block), dtype=np.uint8)
    columns: list[Int16Array] = []
    for rows in (*[num_static + num_moving] * 3, *[num_moving] * 3):
        planes, content = content[: 2 * rows].reshape(2, rows), content[2 * rows :]
        steps = planes[0] | planes[1].astype(np.uint16) << 8
        columns.append(np.cumsum(steps, dtype=np.uint16).view(np.int16))
    return ReplayPoints(np.stack(columns[:3], axis=1), np.stack(columns[3:5], axis=1), columns[5])


def _encode_column(column: Int16Array) -> bytes:
    steps = np.diff(column.astype(np.uint16), prepend=np.uint16(0)).astype("<u2")
    return steps.view(np.uint8).reshape(-1, 2).T.tobytes()


def _along_curve(places: Int16Array) -> Int64Array:
    """Return the order of (N, 3) grid places along Morton's curve: the bits of x, y and z take turns."""
    key = np.zeros(len(places), dtype=np.uint64)
    for axis, column in enumerate(places.T):
        bits = (column.astype(np.int64) + (1 << 15)).astype(np.uint64)
        for shift, mask in _SPREAD:
            bits = (bits | bits << np.uint64(shift)) & np.uint64(mask)
        key |= bits << np.uint64(axis)
    return np.argsort(key, kind="stable")


# of 16 bits, two zeros between any two
_SPREAD: Final = (
    (16, 0x0000FF0000FF), (8, 0x00F00F00F00F), (4, 0x0C30C30C30C3), (2, 0x249249249249),
)  # fmt: skip
