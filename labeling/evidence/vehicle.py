"""The recording vehicle as its own lidars see it: bonnet, mirrors, roof rack, cab, trailer.

Known by what no other thing does: it keeps its place in the ego frame through the whole drive, in the strip of road
that the vehicle drives in, and no road is in sight between it and the rest of the vehicle. Who keeps the pace beside
the vehicle is outside of the strip; who keeps it ahead or behind leaves road in between.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from labeling.geometry.neighbors import build_tree, nearest_distance_m
from labeling.geometry.times import seconds_between
from labeling.geometry.transforms import invert, yaw_of
from labeling.geometry.voxels import group_by_voxel
from schemas.arrays import BoolArray, Float32Array, Float64Array, read_only, require
from schemas.frames import GroundMask, Sweep

NUM_LOOKS = 9
MIN_TRAVEL_M = 1.0  # between any two looks; with less, what rides along cannot be told from what stands still
STRIP_HALF_WIDTH_M = 1.6  # about the way of the frame's origin: a lorry with mirrors; lanes keep others farther away
ROAD_HALF_WIDTH_M = 0.75  # of the middle of the strip: where road is in sight there, no vehicle stands
MAX_REACH_M = 25.0  # of a vehicle from its lidars
MIN_REACH_M = 2.5  # nearer to them, on its way, is nobody else
MAX_GAP_M = 1.5  # of road in sight between pieces of one vehicle: a drawbar
STEP_M = 0.25  # in which road is counted
FIXED_M = 0.2  # how well a piece keeps its place: as far apart as the few points on a mirror lie
MIN_FIXED_SHARE = 0.8  # of the other looks: rays get lost, trailers swing
MERGE_M = 0.05
TOLERANCE_M = 0.1  # about the points of all looks, which hold the noise of the lidar themselves


@dataclass(frozen=True, slots=True, eq=False)
class VehicleBody:
    """The recording vehicle, as far as its lidars see it."""

    points_ego: Float32Array  # (K, 3) ego frame at capture; K = 0: nothing of it is seen, or it cannot be told

    def __post_init__(self) -> None:
        """Check the shape and make the points read-only."""
        require("points_ego", self.points_ego, (None, 3), np.float32)
        object.__setattr__(self, "points_ego", read_only(self.points_ego))

    @property
    def is_seen(self) -> bool:
        """True when there is something to be marked."""
        return len(self.points_ego) > 0

    def covers(self, points_ego: Float32Array) -> BoolArray:
        """Return (N,) which points, in the ego frame when they were seen, lie on the vehicle."""
        is_covered = np.zeros(len(points_ego), dtype=bool)
        if self.is_seen:
            low, high = self.points_ego.min(axis=0) - TOLERANCE_M, self.points_ego.max(axis=0) + TOLERANCE_M
            near = np.flatnonzero(((points_ego >= low) & (points_ego <= high)).all(axis=1))
            distance_m = nearest_distance_m(build_tree(self.points_ego), points_ego[near], TOLERANCE_M)
            is_covered[near] = np.isfinite(distance_m)
        return is_covered


def points_when_seen(sweep: Sweep, beside: Sweep | None) -> Float32Array:
    """Return (N, 3) points in the ego frame at the time at which each was seen.

    A sweep's points are carried to its stamp as if all the world stood still. That puts what rides along as far off as
    the vehicle drives meanwhile: a metre at 10 m/s. How it drives, the pose of a sweep ``beside`` tells.
    """
    if beside is None or not sweep.capture_offset_s.any():
        return sweep.points_ego
    ego_from_beside = invert(sweep.world_from_ego) @ beside.world_from_ego
    share = sweep.capture_offset_s.astype(np.float64) / seconds_between(beside.timestamp_ns, sweep.timestamp_ns)
    offset = sweep.points_ego - share[:, None] * ego_from_beside[:3, 3]
    cos, sin = np.cos(share * yaw_of(ego_from_beside)), np.sin(share * yaw_of(ego_from_beside))
    x, y, z = offset.T
    return np.column_stack([cos * x + sin * y, cos * y - sin * x, z]).astype(np.float32)


def find_vehicle(
    num_sweeps: int,
    read: Callable[[int], Sweep | None],
    ground_of: Callable[[Sweep], GroundMask],
    beside: Callable[[Sweep], Sweep | None],
) -> VehicleBody:
    """Find the vehicle in sweeps of the whole segment that lie far apart on its way.

    Which they are follows from the segment alone, so that whoever labels a part of it knows the same vehicle. Where the
    vehicle hardly moves it cannot be told from what stands, and stands itself.

    Args:
        num_sweeps: Of the segment.
        read: Returns a sweep; None: it cannot be used.
        ground_of: Returns the ground of a sweep.
        beside: Returns a sweep close in time to another; None: there is none.

    Source: ours.

    """
    sweeps: list[Sweep] = []
    for index in _spread_over(num_sweeps):
        sweep = read(index) if len(sweeps) < NUM_LOOKS else None
        if sweep is not None and all(_travel_m(sweep, other) >= MIN_TRAVEL_M for other in sweeps):
            sweeps.append(sweep)
    if len(sweeps) < 2:
        return VehicleBody(np.empty((0, 3), dtype=np.float32))
    sweeps_beside = [beside(sweep) for sweep in sweeps]
    ahead = _direction_of_travel(sweeps, sweeps_beside)
    looks = [_look(s, ground_of(s), other, ahead) for s, other in zip(sweeps, sweeps_beside, strict=True)]
    return VehicleBody(_hold_together(looks, [look.standing[_is_fixed(look, looks)] for look in looks], ahead))


def _spread_over(num_sweeps: int) -> Iterator[int]:
    """Yield the ends of a segment, its middle, its quarters, and so on to its 16ths."""
    yielded: set[int] = set()
    for num_parts in (1, 2, 4, 8, 16):
        for index in np.linspace(0, num_sweeps - 1, num_parts + 1).round().astype(int).tolist():
            if index not in yielded:
                yielded.add(index)
                yield index


def _travel_m(sweep: Sweep, other: Sweep) -> float:
    return float(np.linalg.norm((sweep.world_from_ego - other.world_from_ego)[:3, 3]))


def _direction_of_travel(sweeps: Sequence[Sweep], sweeps_beside: Sequence[Sweep | None]) -> Float64Array:
    """Return the (2,) unit vector of the ego frame along which the vehicle drives, forwards or backwards.

    A lidar's frame may look anywhere: x forward is what most have.
    """
    steps = [
        (invert(sweep.world_from_ego) @ other.world_from_ego)[:2, 3]
        for sweep, other in zip(sweeps, sweeps_beside, strict=True)
        if other is not None
    ]
    along: Float64Array = np.linalg.eigh(np.transpose(steps) @ np.array(steps))[1][:, 1]
    return along


@dataclass(frozen=True, slots=True, eq=False)
class _Look:
    """What a sweep shows of the strip of road that the vehicle drives in."""

    standing: Float32Array  # (K, 3) what is not ground, thinned; ego frame when it was seen
    road_m: Float64Array  # (R,) of the ground in the middle of the strip, along the way, in steps of STEP_M
    lidar_m: Float64Array  # (S,) along the way


def _look(sweep: Sweep, ground: GroundMask, beside: Sweep | None, ahead: Float64Array) -> _Look:
    points = points_when_seen(sweep, beside)
    along_m, aside_m = points[:, :2] @ ahead, np.abs(points[:, :2] @ [-ahead[1], ahead[0]])
    is_near = np.abs(along_m) < MAX_REACH_M
    standing = points[is_near & (aside_m < STRIP_HALF_WIDTH_M) & ~ground.is_ground]
    road_m = along_m[is_near & (aside_m < ROAD_HALF_WIDTH_M) & ground.is_ground]
    return _Look(
        standing[group_by_voxel(standing, MERGE_M).first_point],
        np.unique(np.floor(road_m / STEP_M)) * STEP_M,
        sweep.sensor_origins_ego[:, :2] @ ahead,
    )


def _is_fixed(look: _Look, looks: Sequence[_Look]) -> BoolArray:
    """Return (K,) which points of a look find something in their place in the others."""
    others = [other for other in looks if other is not look]
    num_there = np.zeros(len(look.standing))
    for other in others:
        num_there += np.isfinite(nearest_distance_m(build_tree(other.standing), look.standing, FIXED_M))
    return num_there >= MIN_FIXED_SHARE * len(others)


def _hold_together(looks: Sequence[_Look], fixed: Sequence[Float32Array], ahead: Float64Array) -> Float32Array:
    """Return the (K, 3) fixed points of all looks between which and the lidars no road is in sight."""
    points = np.concatenate(fixed)
    points = points[group_by_voxel(points, MERGE_M).first_point]
    road_m, num_seen = np.unique(np.concatenate([look.road_m for look in looks]), return_counts=True)
    road_m, along_m = road_m[2 * num_seen >= len(looks)], points[:, :2] @ ahead
    lidar_m = np.concatenate([look.lidar_m for look in looks])
    front_m, rear_m = float(lidar_m.max()), float(lidar_m.min())
    front_m += _reach_m(road_m - front_m, along_m - front_m)
    rear_m -= _reach_m(rear_m - road_m, rear_m - along_m)
    return points[(along_m >= rear_m) & (along_m <= front_m)]


def _reach_m(road_m: Float64Array, pieces_m: Float64Array) -> float:
    """Return how far the vehicle goes on from its lidars in one direction.

    Args:
        road_m: (R,) distances from them at which road is in sight.
        pieces_m: (P,) of what keeps its place.

    """
    reach_m = MIN_REACH_M
    while True:
        road_begins_m = road_m[road_m > reach_m].min(initial=np.inf)
        more_m = pieces_m[(pieces_m > reach_m) & (pieces_m <= road_begins_m + MAX_GAP_M)]
        if not len(more_m):
            return reach_m
        reach_m = float(more_m.max())
