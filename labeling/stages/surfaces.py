"""Surfaces: the velocity that lays a cluster's surfaces onto those of other sweeps, and theirs onto its own."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from labeling.geometry.meshes import SensorMesh
from labeling.geometry.voxels import spread_rows
from labeling.stages.targets import RESIDUAL_CUTOFF_M, FlowTarget
from schemas.arrays import Float32Array, Float64Array
from schemas.lidars import Beams

MIN_POINTS = 30  # of a cluster that has surfaces
MAX_POINTS = 256  # of either side that are laid onto the other
MAX_CORNERS = 1024  # of a mesh
REACH_M = 0.5  # about the moved cluster, where its points of another sweep are
OUTLIER_M = 0.15  # height that counts half
MIN_SHOWN_SHARE = 0.02  # of the surfaces must face a direction: a side slides along itself without a trace
MIN_COVERED_SHARE = 0.5  # of a cluster's points that have a surface of another sweep before or behind them
MIN_GAIN_SHARE = 0.1  # of the heights; less may be the surfaces' own noise
ITERATIONS = 12
SMALLEST_STEP_M = 1e-3  # between the nearest sweeps; less ends the fit


@dataclass(frozen=True, slots=True, eq=False)
class SurfaceFit:
    """A velocity, and how well it explains the surfaces."""

    velocity_mps: Float64Array  # (3,) ref axes
    residual_m: float  # mean height of points over the surfaces of the other sweep, both ways


@dataclass(frozen=True, slots=True, eq=False)
class _Cloud:
    """Some points of a sweep and the surfaces between them."""

    points: Float32Array  # (P, 3)
    beams: Beams  # (P,)
    mesh: SensorMesh

    @classmethod
    def of(cls, points: Float32Array, beams: Beams) -> "_Cloud":
        corners, rows = spread_rows(len(points), MAX_CORNERS), spread_rows(len(points), MAX_POINTS)
        return cls(points[rows], beams.of(rows), SensorMesh(points[corners], beams.of(corners)))


@dataclass(frozen=True, slots=True, eq=False)
class _Pair:
    """Another sweep's part."""

    gap_s: float  # its time minus that of the cluster
    trust: float  # in a displacement over it, 1 / m^2
    cloud: _Cloud


def follow_surfaces(
    cluster: Float32Array,  # (P, 3)
    beams: Beams,  # (P,)
    start_mps: Float64Array,  # (3,)
    targets: Sequence[FlowTarget],
) -> SurfaceFit | None:
    """Refine the velocity of a cluster; None where too little of it has surfaces, or they agree no better.

    The lidar samples what curves by chords, which lie inside of it: points laid onto another sweep's surfaces alone
    pull a convex front backward, and its points laid onto the cluster's pull it forward. Both together do not.

    Source: ours; point-to-plane ICP, projective and symmetric, translation only.
    """
    if len(cluster) < MIN_POINTS:
        return None
    own = _Cloud.of(cluster, beams)
    pairs = [_Pair(t.gap_s, t.trust, _cut_out(cluster, start_mps, t)) for t in targets]
    before_m = _residual_m(own, pairs, start_mps)
    if not np.isfinite(before_m):
        return None
    velocity_mps = start_mps
    for _ in range(ITERATIONS):
        step_mps = _improve(own, pairs, velocity_mps)
        velocity_mps = velocity_mps + step_mps
        if np.linalg.norm(step_mps) * abs(pairs[0].gap_s) < SMALLEST_STEP_M:
            break
    after_m = _residual_m(own, pairs, velocity_mps)
    return SurfaceFit(velocity_mps, after_m) if after_m < (1 - MIN_GAIN_SHARE) * before_m else None


def _improve(own: _Cloud, pairs: Sequence[_Pair], velocity_mps: Float64Array) -> Float64Array:
    """Return the (3,) change of velocity that least squares asks for, in the directions that surfaces face."""
    matrix, right = np.zeros((3, 3)), np.zeros(3)
    for pair in pairs:
        normal, miss_m = _misses(own, pair.cloud, velocity_mps * pair.gap_s)
        weight = pair.trust * (np.abs(miss_m) < RESIDUAL_CUTOFF_M) / (1 + (miss_m / OUTLIER_M) ** 2)
        matrix += pair.gap_s**2 * (normal * weight[:, None]).T @ normal
        right += pair.gap_s * (weight * miss_m) @ normal
    weight_of_axis, axes = np.linalg.eigh(matrix)
    is_shown = weight_of_axis > MIN_SHOWN_SHARE * weight_of_axis.sum()
    return np.asarray(axes[:, is_shown] @ ((axes[:, is_shown].T @ right) / weight_of_axis[is_shown]))


def _cut_out(cluster: Float32Array, velocity_mps: Float64Array, target: FlowTarget) -> _Cloud:
    """Return what another sweep has about the place that the cluster moved to."""
    moved_m = velocity_mps * target.gap_s
    low, high = cluster.min(axis=0) + moved_m - REACH_M, cluster.max(axis=0) + moved_m + REACH_M
    x, y, z = target.points_ref.T
    rows = np.flatnonzero((x > low[0]) & (x < high[0]) & (y > low[1]) & (y < high[1]) & (z > low[2]) & (z < high[2]))
    return _Cloud.of(target.points_ref[rows], target.beams.of(rows))


def _misses(own: _Cloud, other: _Cloud, moved_m: Float64Array) -> tuple[Float64Array, Float64Array]:
    """Return (Q, 3) normals and (Q,) how far along them the motion falls short; zero normals where nothing is met.

    The first rows are the points of ``own`` over surfaces of the other, the rest its points over those of ``own``.
    """
    onto, height_m = other.mesh.heights(own.points + moved_m, own.beams.of_point)
    back, height_back_m = own.mesh.heights(other.points - moved_m, other.beams.of_point)
    return np.concatenate([onto, back]), np.concatenate([-height_m, height_back_m])


def _residual_m(own: _Cloud, pairs: Sequence[_Pair], velocity_mps: Float64Array) -> float:
    """Return the mean truncated height, both ways alike; inf where too few points of the cluster meet a surface."""
    onto, back = [], []
    for pair in pairs:
        normal, miss_m = _misses(own, pair.cloud, velocity_mps * pair.gap_s)
        height_m = np.where(normal.any(axis=1), np.minimum(np.abs(miss_m), RESIDUAL_CUTOFF_M), np.nan)
        onto.append(height_m[: len(own.points)])
        back.append(height_m[len(own.points) :])
    heights = [both[np.isfinite(both)] for both in (np.concatenate(onto), np.concatenate(back))]
    if len(heights[0]) < MIN_COVERED_SHARE * len(own.points) * len(pairs) or len(heights[1]) == 0:
        return np.inf
    return float(np.mean([of_way.mean() for of_way in heights]))
