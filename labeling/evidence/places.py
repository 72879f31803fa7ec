"""Places: was something there when another sweep looked, or did its rays pass through? Asked once for each sweep."""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from labeling.geometry.neighbors import build_tree, nearest_distance_m
from labeling.geometry.times import seconds_between
from labeling.geometry.transforms import invert, transform_points
from labeling.geometry.visibility import RangeImage, Sight, make_range_image
from schemas.arrays import BoolArray, Float32Array, Float64Array, Int64Array
from schemas.config import StaticParams
from schemas.frames import GroundMask, Sweep
from schemas.lidars import Beams, Lidar

MIN_TARGET_HEIGHT_M = 0.1  # lower points of other sweeps are road: they prove nothing about what stands on it


@dataclass(frozen=True, slots=True, eq=False)
class GroundedSweep:
    """A sweep, its ground and what its rays passed through: what other sweeps ask."""

    sweep: Sweep
    ground: GroundMask
    lidars: tuple[Lidar, ...]  # one a number in ``sweep.lidar_of_point``
    is_vehicle: BoolArray = field(default_factory=lambda: np.zeros(1, dtype=bool))  # (N,) of the recording one itself
    beams: Beams = field(init=False)  # (N,)
    images: tuple[RangeImage, ...] = field(init=False)  # one a lidar, ego frame, without the vehicle: rays go on

    def __post_init__(self) -> None:
        """Tell the lidars of the points apart, and make their range images."""
        object.__setattr__(self, "is_vehicle", np.broadcast_to(self.is_vehicle, self.sweep.num_points))
        first_equal = np.array([self.lidars.index(lidar) for lidar in self.lidars], dtype=np.uint8)
        object.__setattr__(self, "beams", Beams(self.lidars, first_equal[self.sweep.lidar_of_point]))
        images = [self._image_of(k) for k in np.unique(first_equal).tolist()]
        object.__setattr__(self, "images", tuple(images))

    def _image_of(self, lidar: int) -> RangeImage:
        rows = np.flatnonzero((self.beams.of_point == lidar) & ~self.is_vehicle)
        return make_range_image(self.sweep.points_ego[rows], self.lidars[lidar], self.ground.is_ground[rows])

    @property
    def is_standing(self) -> BoolArray:
        """(N,) neither ground nor the recording vehicle: what may stand or move by itself."""
        return ~(self.ground.is_ground | self.is_vehicle)

    def sight_from(self, sweep: Sweep) -> Sight:
        """Return what this sweep says of places in the ego frame of another."""
        return Sight(self.images, invert(self.sweep.world_from_ego) @ sweep.world_from_ego)

    def obstacles_from(self, sweep: Sweep) -> Float32Array:
        """Return the (K, 3) points well above the ground, in the ego frame of another sweep."""
        ref_from_ego = invert(sweep.world_from_ego) @ self.sweep.world_from_ego
        points = transform_points(ref_from_ego, self.sweep.points_ego).astype(np.float32)
        return points[(self.ground.height_m > MIN_TARGET_HEIGHT_M) & ~self.is_vehicle]


@dataclass(frozen=True, slots=True, eq=False)
class PlaceEvidence:
    """What each of L other sweeps says of the places of N points. A place may be neither: hidden, or out of view."""

    gap_s: Float64Array  # (L,) time of the other sweep minus that of the points
    is_occupied: BoolArray  # (L, N) something was there
    is_through: BoolArray  # (L, N) rays went through

    @property
    def is_empty(self) -> BoolArray:
        """(L, N) rays went through and nothing was there."""
        return self.is_through & ~self.is_occupied


def look_at_places(
    current: GroundedSweep,
    rows: Int64Array,  # (N,) of its points
    others: Sequence[GroundedSweep],
    params: StaticParams,
) -> PlaceEvidence:
    """Ask other sweeps about the places of points.

    Occupied: a neighbour nearer than what may have moved in between, than the ranges' noise, or than the rays of its
    lidar are apart there.
    """
    sweep, points, beams = current.sweep, current.sweep.points_ego[rows], current.beams.of(rows)
    shape = (len(others), len(rows))
    gap_s = np.array([seconds_between(other.sweep.timestamp_ns, sweep.timestamp_ns) for other in others])
    is_occupied, is_through = np.zeros(shape, dtype=bool), np.zeros(shape, dtype=bool)
    blur_m = np.maximum(params.noise_factor * beams.noise_m, params.resolution_factor * beams.resolution_m(points))
    for k, other in enumerate(others):
        threshold_m = np.maximum(params.max_speed_mps * abs(gap_s[k]), blur_m).astype(np.float32)
        is_occupied[k] = _is_near(points, other.obstacles_from(sweep), threshold_m)
        if params.method == "visibility":
            is_through[k] = other.sight_from(sweep).is_through(points, params.clear_margin_m)
    return PlaceEvidence(gap_s, is_occupied, is_through)


def _is_near(points: Float32Array, target: Float32Array, threshold_m: Float32Array) -> BoolArray:
    distance_m = nearest_distance_m(build_tree(target), points, float(threshold_m.max(initial=0)))
    return np.asarray(distance_m < threshold_m)
