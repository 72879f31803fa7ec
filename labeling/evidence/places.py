"""Places: was something there when another sweep looked, or did its rays pass through? Asked once for each sweep."""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from labeling.geometry.neighbors import build_tree, nearest_distance_m
from labeling.geometry.times import seconds_between
from labeling.geometry.transforms import invert, transform_points
from labeling.geometry.visibility import RangeImage, Sight, make_range_image
from schemas.arrays import BoolArray, Float32Array, Float64Array
from schemas.config import StaticParams
from schemas.frames import GroundMask, Sweep

MIN_TARGET_HEIGHT_M = 0.1  # lower points of other sweeps are road: they prove nothing about what stands on it


@dataclass(frozen=True, slots=True, eq=False)
class GroundedSweep:
    """A sweep, its ground and what its rays passed through: what other sweeps ask."""

    sweep: Sweep
    ground: GroundMask
    is_vehicle: BoolArray = field(default_factory=lambda: np.zeros(1, dtype=bool))  # (N,) of the recording one itself
    image: RangeImage = field(init=False)  # ego frame

    def __post_init__(self) -> None:
        """Make the range image, without the vehicle: rays beside its parts go on."""
        object.__setattr__(self, "is_vehicle", np.broadcast_to(self.is_vehicle, self.sweep.num_points))
        seen, origin = ~self.is_vehicle, self.sweep.sensor_origins_ego.mean(axis=0)
        image = make_range_image(self.sweep.points_ego[seen], origin, self.ground.is_ground[seen])
        object.__setattr__(self, "image", image)

    @property
    def is_standing(self) -> BoolArray:
        """(N,) neither ground nor the recording vehicle: what may stand or move by itself."""
        return ~(self.ground.is_ground | self.is_vehicle)

    def sight_from(self, sweep: Sweep) -> Sight:
        """Return what this sweep says of places in the ego frame of another."""
        return Sight(self.image, invert(self.sweep.world_from_ego) @ sweep.world_from_ego)

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
    points: Float32Array,  # (N, 3) ego frame of ``sweep``
    sweep: Sweep,
    others: Sequence[GroundedSweep],
    params: StaticParams,
) -> PlaceEvidence:
    """Ask other sweeps about the places of points.

    Occupied: a neighbour nearer than what may have moved in between, than the floor, or than the beams are apart there.
    """
    shape = (len(others), len(points))
    gap_s = np.array([seconds_between(other.sweep.timestamp_ns, sweep.timestamp_ns) for other in others])
    is_occupied, is_through = np.zeros(shape, dtype=bool), np.zeros(shape, dtype=bool)
    for k, other in enumerate(others):
        is_occupied[k] = _is_near(points, other.obstacles_from(sweep), float(gap_s[k]), params)
        if params.method == "visibility":
            is_through[k] = other.sight_from(sweep).is_through(points, params.clear_margin_m)
    return PlaceEvidence(gap_s, is_occupied, is_through)


def _is_near(points: Float32Array, target: Float32Array, gap_s: float, params: StaticParams) -> BoolArray:
    range_m = np.linalg.norm(points, axis=1)
    moved_m = max(params.floor_m, params.max_speed_mps * abs(gap_s))
    threshold_m = np.maximum(moved_m, params.resolution_rad * range_m).astype(np.float32)
    distance_m = nearest_distance_m(build_tree(target), points, float(threshold_m.max(initial=0)))
    return np.asarray(distance_m < threshold_m)
