"""Sweeps and what the first stages say of their points.

Frames: ``ego`` (x forward, y left, z up), ``world`` (fixed in one segment), ``ref`` (the ego frame of the sweep
being processed). A transform is (4, 4) float64, named target first: ``world_from_ego``.
"""

from dataclasses import dataclass

import numpy as np

from schemas.arrays import BoolArray, Float32Array, Float64Array, UInt8Array, read_only, require
from schemas.errors import InvalidInput


@dataclass(frozen=True, slots=True, eq=False)
class Sweep:
    """One turn of the lidar, ego motion within the turn compensated to ``timestamp_ns``.

    Row i of ``points_ego`` is row i of the source file: readers drop no points.
    """

    index: int  # position in the segment's sorted list of sweeps
    timestamp_ns: int
    points_ego: Float32Array  # (N, 3) ego frame at timestamp_ns, m
    capture_offset_s: Float32Array  # (N,) capture time of each point minus timestamp_ns; zeros when unknown
    world_from_ego: Float64Array  # (4, 4)
    sensor_origins_ego: Float32Array  # (L, 3) where the rays of each lidar start, m; L >= 1
    lidar_of_point: UInt8Array  # (N,) of which lidar: row of ``sensor_origins_ego``

    def __post_init__(self) -> None:
        """Check shapes and make all arrays read-only."""
        require("points_ego", self.points_ego, (None, 3), np.float32)
        require("capture_offset_s", self.capture_offset_s, (len(self.points_ego),), np.float32)
        require("world_from_ego", self.world_from_ego, (4, 4), np.float64)
        require("sensor_origins_ego", self.sensor_origins_ego, (None, 3), np.float32)
        require("lidar_of_point", self.lidar_of_point, (len(self.points_ego),), np.uint8)
        if self.num_points and int(self.lidar_of_point.max()) >= len(self.sensor_origins_ego):
            raise InvalidInput(
                f"lidar_of_point names lidar {self.lidar_of_point.max()}: sensor_origins_ego has "
                f"{len(self.sensor_origins_ego)} rows"
            )
        for name in ("points_ego", "capture_offset_s", "world_from_ego", "sensor_origins_ego", "lidar_of_point"):
            object.__setattr__(self, name, read_only(getattr(self, name)))

    @property
    def num_points(self) -> int:
        """Number of points in the source sweep."""
        return len(self.points_ego)


@dataclass(frozen=True, slots=True, eq=False)
class GroundMask:
    """Which points of a sweep are road, pavement or grass."""

    is_ground: BoolArray  # (N,)
    height_m: Float32Array  # (N,) above the local ground

    def __post_init__(self) -> None:
        """Check shapes and make all arrays read-only."""
        require("is_ground", self.is_ground, (None,), np.bool_)
        require("height_m", self.height_m, (len(self.is_ground),), np.float32)
        object.__setattr__(self, "is_ground", read_only(self.is_ground))
        object.__setattr__(self, "height_m", read_only(self.height_m))


@dataclass(frozen=True, slots=True, eq=False)
class MotionMask:
    """Which points stand still, and which are left to be explained by motion. Ground is neither."""

    is_static: BoolArray  # (N,)
    is_dynamic: BoolArray  # (N,)
    is_vacated: BoolArray  # (N,) rays of a sweep that was asked passed through the place

    def __post_init__(self) -> None:
        """Check shapes and make all arrays read-only."""
        for name in ("is_static", "is_dynamic", "is_vacated"):
            require(name, getattr(self, name), (len(self.is_static),), np.bool_)
            object.__setattr__(self, name, read_only(getattr(self, name)))


@dataclass(frozen=True, slots=True, eq=False)
class Annotations:
    """Human (or simulated) cuboids of one sweep. For evaluation only: no stage ever sees them."""

    track_ids: tuple[str, ...]
    categories: tuple[str, ...]
    boxes_ego: Float64Array  # (B, 7) ego frame at the sweep's timestamp, see schemas.objects

    def __post_init__(self) -> None:
        """Check shapes and make the boxes read-only."""
        if not len(self.track_ids) == len(self.categories) == len(self.boxes_ego):
            raise InvalidInput(
                f"annotations must have one track id and category a box, got {len(self.track_ids)}, "
                f"{len(self.categories)} and {len(self.boxes_ego)}"
            )
        require("boxes_ego", self.boxes_ego, (len(self.track_ids), 7), np.float64)
        object.__setattr__(self, "boxes_ego", read_only(self.boxes_ego))


@dataclass(frozen=True, slots=True, eq=False)
class PointTruth:
    """Point-wise truth of one sweep, where a data set has it. NaN rows of ``flow_ref_m`` mean unknown."""

    flow_ref_m: Float32Array  # (N, 3) displacement to the next sweep, ego axes of this sweep, ego motion REMOVED
    is_ground: BoolArray  # (N,)
