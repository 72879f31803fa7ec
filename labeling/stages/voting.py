"""Rigid motion of clusters by voting and ICP: no learning, milliseconds a cluster.

Method ``rigid`` of the flow stage, and the start of its nets. One velocity a cluster is sought that carries it onto
the next sweep AND, since we are offline, back onto earlier ones: what two sweeps leave open, four decide.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import pairwise

import numpy as np
from scipy.ndimage import convolve1d

from labeling.geometry.axes import long_axes
from labeling.geometry.neighbors import residuals_m
from labeling.geometry.voxels import spread_points, spread_rows
from labeling.stages.bodies import Body, find_second_body
from labeling.stages.pieces import find_leaders
from labeling.stages.surfaces import follow_surfaces
from labeling.stages.targets import (
    ACCELERATION_MPS2,
    LOST_SHARE,
    RESIDUAL_CUTOFF_M,
    FlowTarget,
    View,
    apart_by_scan,
    split_by_scan,
    thin,
)
from schemas.arrays import BoolArray, Float32Array, Float64Array, Int64Array
from schemas.config import FlowParams
from schemas.lidars import Beams
from schemas.objects import Clusters

VOTE_BIN_M = 0.1  # displacement at the nearest target: the beam spacing at 30 m; and what acceleration makes of it
MAX_HEIGHT_CHANGE_M = 0.4  # between points that may vote together
NUM_PEAKS, MAX_PEAKS = 6, 24  # of the histogram that are tried out
CHANCE_M, CHANCE_REACH_M = 0.04, 4.0  # of residual; that near hardly anything else is met: 0.1 s at 40 m/s
BLUR = np.array([0.5, 1.0, 0.5])  # of the histogram along either axis: a vote may be off by a bin
VOTE_GAIN = 3.0  # a third of the votes that a cluster has for itself say most of it: the rest may be hidden
MAX_VOTING_POINTS = 96  # of a cluster
DENSE_CLUSTER = 1536  # points: from here their density says more about the lidar than about the object
MAX_VOTED_POINTS = 768  # of the targets in reach
ICP_ITERATIONS = 6
APERTURE_MARGIN_M = 0.003  # a motion along the cluster's long axis must explain the points better by this much
LONG_RATIO = 3.0  # of length to width (standard deviations): a flat side
MIN_SPLIT_RESIDUAL_M = 0.06  # of a cluster that may be two bodies
APERTURE_SHARES = (0.75, 0.5, 0.25, 0.0)  # of that motion that are tried, shortest last


@dataclass(frozen=True, slots=True, eq=False)
class VotedMotion:
    """One velocity a cluster, and those of second bodies."""

    velocity_mps: Float64Array  # (C, 3) ref axes; zero where the cluster stands still
    residual_m: Float64Array  # (C,) mean truncated distance after the motion, from surfaces where it follows them
    still_residual_m: Float64Array  # (C,) the same without motion
    is_still: BoolArray  # (C,) explained as well by standing still; none without step ``standstill``
    is_led: BoolArray  # (C,) takes the velocity of a larger one beside it
    bodies: tuple[Body, ...] = ()

    @classmethod
    def unknown(cls, num_clusters: int, *, is_still: BoolArray) -> "VotedMotion":
        """Return zero velocities, for clusters that stand still or whose motion is not asked for."""
        zeros = np.zeros(num_clusters)
        return cls(np.zeros((num_clusters, 3)), zeros, zeros, is_still, np.zeros(num_clusters, dtype=bool))

    def put(self, clusters: Int64Array, again: "VotedMotion") -> "VotedMotion":
        """Return the motions with those of (A,) some clusters, and their bodies, in place of their own."""
        names = ("velocity_mps", "residual_m", "still_residual_m", "is_still", "is_led")
        arrays = {name: getattr(self, name).copy() for name in names}
        for name, values in arrays.items():
            values[clusters] = getattr(again, name)
        return replace(self, **arrays, bodies=(*self.bodies, *again.bodies))


@dataclass(frozen=True, slots=True, eq=False)
class _Sample:
    """The points that speak for each of C clusters."""

    clouds: Sequence[Float32Array]  # C arrays (n, 3)
    source: Float64Array  # (M, 3) all of them
    owner: Int64Array  # (M,) cluster of each

    @classmethod
    def of(cls, clouds: Sequence[Float32Array]) -> "_Sample":
        owner = np.repeat(np.arange(len(clouds)), [len(cloud) for cloud in clouds])
        return cls(clouds, np.concatenate(clouds).astype(np.float64), owner)


def vote_motion(
    points_ref: Float32Array,  # (M, 3) dynamic points, grouped by cluster
    beams: Beams,  # (M,)
    clusters: Clusters,
    targets: Sequence[FlowTarget],
    params: FlowParams,
) -> VotedMotion:
    """Find the velocity of each cluster by voting and refine it by translation-only ICP.

    Each pair of a cluster point and a target point in reach votes for a velocity. The peaks, and standing still, are
    tried out on the targets; the best is refined. In a tenth of a second a walker moves less than a beam's width: what
    seems slower than ``slow_speed_mps`` votes again on far targets, and all targets decide. Clusters below
    ``min_points`` of the decomposition also get a vote: whether to trust it is the caller's business. What passes close
    by another road user is one cluster with it, and becomes a body with a velocity of its own. Rows of points lie where
    the beams are: a velocity that lays surfaces onto surfaces better replaces that of the points.

    What a cluster votes for does not depend on which others are asked with it, to the last bit.

    Source: ours, after ICP-Flow's translation histogram; joint over several targets.
    """
    num_clusters = clusters.num_clusters
    views = [View(target) for target in targets]
    near, far = [view for view in views if not view.is_far], [view for view in views if view.is_far]
    if num_clusters == 0 or not near:
        return VotedMotion.unknown(num_clusters, is_still=np.ones(num_clusters, dtype=bool))
    grouped = _group(apart_by_scan(points_ref, beams), clusters)
    clouds = [_speakers(cloud) for cloud in grouped]
    peaks_mps = _peaks(clouds, grouped, near, params.max_speed_mps)
    voted = _explain(_Sample.of(clouds), peaks_mps, near, params)
    bodies: tuple[Body, ...] = ()
    if params.has("bodies"):
        bodies = tuple(_find_bodies(clusters.offsets[:-1], grouped, clouds, voted, peaks_mps, near, params))
    slow = np.flatnonzero(np.linalg.norm(voted.velocity_mps, axis=1) < params.slow_speed_mps)
    if far and len(slow):
        slow_clouds = [clouds[c] for c in slow]
        far_peaks = _peaks(slow_clouds, [grouped[c] for c in slow], far, params.slow_speed_mps)
        peaks = np.concatenate([voted.velocity_mps[slow, None], far_peaks], axis=1)
        voted = voted.put(slow, _explain(_Sample.of(slow_clouds), peaks, views, params))
    voted = replace(voted, bodies=bodies)
    if params.has("surfaces"):
        voted = _follow_surfaces(points_ref, beams, clusters, targets, params, voted)
    return voted


def lead_pieces(
    voted: VotedMotion,
    points_ref: Float32Array,
    beams: Beams,
    clusters: Clusters,
    targets: Sequence[FlowTarget],
) -> VotedMotion:
    """Return the motions with what is too small to tell its own going with the larger cluster beside it."""
    near = [View(target) for target in targets if not target.is_far]
    grouped = _group(apart_by_scan(points_ref, beams), clusters)

    def judge(asked: Int64Array, velocity_mps: Float64Array) -> Float64Array:
        return _residuals(_Sample.of([_speakers(grouped[c]) for c in asked]), velocity_mps, near)

    leader = find_leaders(points_ref, beams, clusters, voted.velocity_mps, voted.is_still, judge)
    is_led = leader != np.arange(clusters.num_clusters)
    return replace(voted, velocity_mps=voted.velocity_mps[leader], is_led=is_led)


def _group(points: Float32Array, clusters: Clusters) -> list[Float32Array]:
    return [points[start:stop] for start, stop in pairwise(clusters.offsets)]


def _speakers(cloud: Float32Array) -> Float32Array:
    """Return those of a cluster's points that vote."""
    return cloud[spread_points(cloud, MAX_VOTING_POINTS, dense_from=DENSE_CLUSTER)]


def _follow_surfaces(
    points_ref: Float32Array,
    beams: Beams,
    clusters: Clusters,
    targets: Sequence[FlowTarget],
    params: FlowParams,
    voted: VotedMotion,
) -> VotedMotion:
    """Return the motions with those of moving clusters of one body laid onto surfaces."""
    velocity_mps, residual_m = voted.velocity_mps.copy(), voted.residual_m.copy()
    of_two = {int(clusters.cluster_of_point[body.rows[0]]) for body in voted.bodies}
    for c in np.flatnonzero(~voted.is_still).tolist():
        if c in of_two:
            continue
        rows = slice(clusters.offsets[c], clusters.offsets[c + 1])
        is_slow = np.linalg.norm(velocity_mps[c]) < params.slow_speed_mps
        seen = [target for target in targets if is_slow or not target.is_far]
        fit = follow_surfaces(points_ref[rows], beams.of(rows), velocity_mps[c], seen)
        if fit is not None:
            velocity_mps[c], residual_m[c] = fit.velocity_mps, fit.residual_m
    return replace(voted, velocity_mps=velocity_mps, residual_m=residual_m)


def _find_bodies(
    starts: Int64Array,  # (C,) first row of each cluster
    grouped: Sequence[Float32Array],  # C arrays (P, 3): the clusters
    clouds: Sequence[Float32Array],  # C arrays (n, 3): those of their points that vote
    voted: VotedMotion,
    peaks_mps: Float64Array,  # (C, H, 3)
    views: Sequence[View],
    params: FlowParams,
) -> Iterator[Body]:
    """Yield the second bodies of the clusters that one velocity does not explain well."""

    def vote(cluster: int, cloud: Float32Array) -> Float64Array:
        peaks = _peaks([cloud], [grouped[cluster]], views, params.max_speed_mps)
        velocity_mps: Float64Array = _explain(_Sample.of([cloud]), peaks, views, params).velocity_mps[0]
        return velocity_mps

    residual_m = np.where(voted.is_still, voted.still_residual_m, voted.residual_m)
    for c in np.flatnonzero(residual_m >= MIN_SPLIT_RESIDUAL_M).tolist():
        body = find_second_body(grouped[c], clouds[c], voted.velocity_mps[c], peaks_mps[c], views, partial(vote, c))
        if body is not None:
            yield replace(body, rows=starts[c] + body.rows)


def _explain(
    sample: _Sample,
    peaks_mps: Float64Array,  # (C, H, 3) velocities to try, beside zero
    views: Sequence[View],
    params: FlowParams,
) -> VotedMotion:
    """Take the velocity that explains each cluster best in the views that show it, refine it, or find it still."""
    num_clusters = len(sample.clouds)
    velocity = np.concatenate([np.zeros((num_clusters, 1, 3)), peaks_mps], axis=1)
    residual = np.stack([_residuals(sample, velocity[:, h], views) for h in range(velocity.shape[1])], axis=1)
    is_seen = residual.min(axis=1) < LOST_SHARE * RESIDUAL_CUTOFF_M  # (C, L)
    is_seen |= ~is_seen.any(axis=1, keepdims=True)
    cost_m = _mean_over(residual, is_seen[:, None]) + _chance_m(velocity, views)
    best = velocity[np.arange(num_clusters), cost_m.argmin(axis=1)]

    def judge(velocity_mps: Float64Array) -> Float64Array:
        return _mean_over(_residuals(sample, velocity_mps, views), is_seen)

    refined = _refine(sample, best, views)
    moved_residual = judge(refined)
    refined, moved_residual = _take_shortest(sample, refined, moved_residual, judge)
    standing = _residuals(sample, np.zeros_like(refined), views, is_standing=True)
    still_residual = _mean_over(standing, is_seen)
    is_still = np.full(num_clusters, params.has("standstill"))
    is_still &= still_residual <= moved_residual + params.standstill_margin_m
    velocity_mps = np.where(is_still[:, None], 0.0, refined)
    return VotedMotion(velocity_mps, moved_residual, still_residual, is_still, np.zeros(num_clusters, dtype=bool))


def _peaks(
    clouds: Sequence[Float32Array],  # those points of clusters that vote
    wholes: Sequence[Float32Array],  # all points of the same clusters
    views: Sequence[View],
    max_speed_mps: float,
) -> Float64Array:
    """Return (C, H, 3) horizontal velocities with most votes; repeats zero when there are fewer."""
    peaks = [_vote(cloud, whole, views, max_speed_mps) for cloud, whole in zip(clouds, wholes, strict=True)]
    return np.pad(np.stack(peaks), ((0, 0), (0, 0), (0, 1)))


def _vote(points: Float32Array, whole: Float32Array, views: Sequence[View], max_speed_mps: float) -> Float64Array:
    """Return (H, 2) velocities."""
    shortest_s = min(abs(view.gap_s) for view in views)
    bin_mps = np.hypot(VOTE_BIN_M, ACCELERATION_MPS2 * shortest_s**2 / 2) / shortest_s
    half = int(np.ceil(max_speed_mps / bin_mps))
    side = 2 * half + 1
    votes = np.zeros((side, side))
    scans = split_by_scan(points)
    for view in views:
        bin_m = bin_mps * abs(view.gap_s)
        pairs = np.concatenate([_displacements(scan, view, max_speed_mps, bin_m) for scan in scans])
        cell = np.rint(pairs / (view.gap_s * bin_mps)).astype(np.int64)
        cell = cell[(np.abs(cell) <= half).all(axis=1)] + half
        count = np.bincount(cell[:, 0] * side + cell[:, 1], minlength=side * side).reshape(side, side)
        around = convolve1d(
            convolve1d(count.astype(np.float64), BLUR, axis=0, mode="constant"), BLUR, axis=1, mode="constant"
        )
        votes -= np.expm1(-VOTE_GAIN * around / _own_votes(points, whole, bin_m))
    peaks = np.zeros((_num_peaks(max_speed_mps * shortest_s), 2))
    for k in range(len(peaks)):
        i, j = np.unravel_index(int(votes.argmax()), votes.shape)
        if votes[i, j] <= 0:
            break
        peaks[k] = (np.array([i, j]) - half) * bin_mps
        votes[max(0, i - 2) : i + 3, max(0, j - 2) : j + 3] = 0
    return peaks


def _num_peaks(reach_m: float) -> int:
    """Return how many peaks to try: the farther a cluster may have moved, the more else is in its reach."""
    return int(np.clip(round(NUM_PEAKS * reach_m / CHANCE_REACH_M), NUM_PEAKS, MAX_PEAKS))


def _chance_m(velocity_mps: Float64Array, views: Sequence[View]) -> Float64Array:
    """Return by how much (C, H, 3) velocities must explain a cluster better: far away something else fits by chance."""
    moved_m = np.linalg.norm(velocity_mps, axis=2) * min(abs(view.gap_s) for view in views)
    return CHANCE_M * np.log1p((moved_m / CHANCE_REACH_M) ** 2)


def _own_votes(points: Float32Array, whole: Float32Array, bin_m: float) -> float:
    """Return the votes of a cluster for itself where it is: what is denser does not speak for a place more."""
    difference = thin(whole, bin_m, MAX_HEIGHT_CHANGE_M)[None] - points[:, None]
    bins = np.abs(np.rint(difference[np.abs(difference[..., 2]) < MAX_HEIGHT_CHANGE_M][:, :2] / bin_m)).astype(np.int64)
    return float(BLUR[1 + bins[(bins <= 1).all(axis=1)]].prod(axis=1).sum())


def _displacements(points: Float32Array, view: View, max_speed_mps: float, bin_m: float) -> Float64Array:
    """Return (V, 2) horizontal differences of target points in reach from cluster points of about their height."""
    target, tree = view.thinned(bin_m, MAX_HEIGHT_CHANGE_M)
    center = points.mean(axis=0)
    radius = float(np.linalg.norm(points - center, axis=1).max()) + max_speed_mps * abs(view.gap_s)
    rows = np.array(sorted(tree.query_ball_point(center, radius)), dtype=np.int64) if tree.n else np.empty(0, np.int64)
    reached = target[rows[spread_rows(len(rows), MAX_VOTED_POINTS)]].astype(np.float64)
    difference = reached[None] - points[:, None].astype(np.float64)
    return difference[np.abs(difference[..., 2]) < MAX_HEIGHT_CHANGE_M][:, :2]


def _residuals(
    sample: _Sample, velocity_mps: Float64Array, views: Sequence[View], *, is_standing: bool = False
) -> Float64Array:
    """Return (C, L) mean truncated distances of the moved clusters to each view's dynamic, or all, points."""
    num_clusters = len(velocity_mps)
    count = np.bincount(sample.owner, minlength=num_clusters)
    residuals = np.empty((num_clusters, len(views)))
    for k, view in enumerate(views):
        moved = sample.source + velocity_mps[sample.owner] * view.gap_s
        distance = residuals_m(view.standing_tree if is_standing else view.tree, moved, RESIDUAL_CUTOFF_M)
        residuals[:, k] = np.bincount(sample.owner, weights=distance, minlength=num_clusters) / count
    return residuals


def _mean_over(residuals: Float64Array, is_seen: BoolArray) -> Float64Array:
    """Return the mean over the last axis, the targets, where the cluster is seen."""
    return np.where(is_seen, residuals, 0.0).sum(axis=-1) / is_seen.sum(axis=-1)


def _take_shortest(
    sample: _Sample,
    velocity_mps: Float64Array,
    residual_m: Float64Array,
    judge: Callable[[Float64Array], Float64Array],
) -> tuple[Float64Array, Float64Array]:
    """Return (C, 3) velocities and (C,) residuals, motion along a cluster's long axis cut to what the points show.

    A flat side slides along itself without a trace (aperture): of the motions that explain the points about as well,
    the one with the least of it is taken.
    """
    axes = long_axes(sample.source, sample.owner)
    axis = np.pad(axes.direction, ((0, 0), (0, 1))) * axes.is_long(LONG_RATIO)[:, None]  # zero: a compact cluster
    along = (velocity_mps * axis).sum(axis=1, keepdims=True) * axis
    chosen, chosen_residual = velocity_mps.copy(), residual_m.copy()
    for share in APERTURE_SHARES:
        shorter = velocity_mps - (1 - share) * along
        residual = judge(shorter)
        is_as_good = residual <= residual_m + APERTURE_MARGIN_M
        chosen[is_as_good], chosen_residual[is_as_good] = shorter[is_as_good], residual[is_as_good]
    return chosen, chosen_residual


def _refine(sample: _Sample, velocity_mps: Float64Array, views: Sequence[View]) -> Float64Array:
    """Return (C, 3) velocities after translation-only ICP, least squares over all views at once.

    A view counts by how well it tells a velocity: near ones are coarse, far ones average what speeds up or slows down.
    """
    source, owner, num_clusters = sample.source, sample.owner, len(velocity_mps)
    for _ in range(ICP_ITERATIONS):
        numerator, denominator = np.zeros((num_clusters, 3)), np.full(num_clusters, 1e-12)
        for view in views:
            if view.tree.n == 0:
                continue
            moved = source + velocity_mps[owner] * view.gap_s
            distance, nearest = view.tree.query(moved, distance_upper_bound=RESIDUAL_CUTOFF_M)
            is_matched = np.isfinite(distance)
            step = view.points[nearest[is_matched]] - moved[is_matched]
            trust = view.gap_s * view.trust
            for axis in range(3):
                sums = np.bincount(owner[is_matched], weights=step[:, axis], minlength=num_clusters)
                numerator[:, axis] += trust * sums
            denominator += trust * view.gap_s * np.bincount(owner[is_matched], minlength=num_clusters)
        velocity_mps = velocity_mps + numerator / denominator[:, None]
    return velocity_mps
