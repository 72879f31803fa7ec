"""Flow: how far each dynamic point moves to the next sweep."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from labeling.geometry.voxels import spread_rows
from labeling.stages.nsfp import FitProblem, FitResult, fit_nets
from labeling.stages.targets import FlowTarget
from labeling.stages.voting import MAX_VOTING_POINTS, VotedMotion, lead_pieces, vote_motion
from schemas.arrays import BoolArray, Float32Array, Float64Array, Int64Array, require
from schemas.config import FlowParams
from schemas.lidars import Beams
from schemas.objects import Clusters, SweepFlow

MAX_BATCH_PAIRS = 4_000_000  # point pairs of a padded batch: 16 MB a distance matrix
MAX_BATCH_FITS = 64
MAX_BATCH_VOTES = 2048  # voting points of a batch: half a second

RngOfCluster = Callable[[int], np.random.Generator]
"""Cluster number -> its own generator, seeded by (segment, sweep, cluster)."""


@dataclass(frozen=True, slots=True, eq=False)
class FlowScene:
    """What the flow of a sweep is estimated from: its dynamic points, and where they may be in other sweeps."""

    points_ref: Float32Array  # (M, 3) dynamic points, grouped by cluster
    beams: Beams  # (M,)
    clusters: Clusters
    targets: tuple[FlowTarget, ...]  # flow leads to the first; the others help the vote
    is_vacated: BoolArray | None = None  # (M,) another sweep's rays passed through the place; None: not known

    def __post_init__(self) -> None:
        """Check the points."""
        require("points_ref", self.points_ref, (len(self.clusters.point_rows), 3), np.float32)

    def may_move(self, params: FlowParams) -> BoolArray:
        """Return (C,) which clusters left their places: what no ray passed through before or after stands."""
        if self.is_vacated is None or not params.has("vacated"):
            return np.ones(self.clusters.num_clusters, dtype=bool)
        clusters, weights = self.clusters, self.is_vacated
        count = np.bincount(clusters.cluster_of_point, weights=weights, minlength=clusters.num_clusters)
        return count / np.maximum(np.diff(clusters.offsets), 1) >= params.min_vacated_share


@dataclass(frozen=True, slots=True, eq=False)
class Vote:
    """What some clusters voted for."""

    clusters: Int64Array  # (A,)
    motion: VotedMotion | None  # rows of its bodies are those of the scene; None: every worker died that asked them


@dataclass(frozen=True, slots=True, eq=False)
class FlowPlan:
    """What is known before any net is fitted, and the fits to do. Batches follow from the sweep alone."""

    start_flow_ref_m: Float32Array  # (M, 3) voted displacement; zero where a cluster stands still or is too small
    gap_s: float
    is_failed: BoolArray  # (C,) it could not be asked for its motion
    batches: tuple[tuple[FitProblem, ...], ...] = ()
    max_grade: float | None = None  # of a displacement; None: any


def estimate_flow(
    points_ref: Float32Array,
    beams: Beams,
    clusters: Clusters,
    targets: Sequence[FlowTarget],
    params: FlowParams,
    rng_of_cluster: RngOfCluster,
    is_vacated: BoolArray | None = None,
) -> SweepFlow:
    """Estimate the displacement of each dynamic point of a ``FlowScene`` to its first target.

    ``nsfp++``: one net a cluster, fitted to the points that a box query finds near it. ``nsfp``: one net for all
    points, whatever their cluster. ``rigid``: the voted velocity. Clusters that are explained as well by standing
    still get zero flow and no fit, as do those smaller than ``min_points``, and those whose place no ray ever passed
    through: a wall that comes into view behind an edge seems to move along with the edge.

    Returns:
        Flow in ref axes and row order of ``points_ref``. A fit that does not stay finite gives zero flow and is
        marked failed.

    Source: paper section 3.1, eq. 2 and "Box Query Strategy". We differ in the start from a voted velocity, in pruning
    about the moved centroid, in the standstill test, in splitting clusters of two bodies, in surfaces between rows, in
    shreds that go with the cluster beside them and in the limit to a road's grade; each is a step that profile
    ``paper``.

    """
    scene = FlowScene(points_ref, beams, clusters, tuple(targets), is_vacated)
    votes = [vote_flow(scene, batch, params) for batch in cut_votes(scene, params)]
    plan = plan_flow(scene, votes, params, rng_of_cluster)
    return finish_flow(plan, [fit_nets(batch, params) for batch in plan.batches])


def cut_votes(scene: FlowScene, params: FlowParams) -> tuple[Int64Array, ...]:
    """Return the clusters to be asked for their motion, in batches of bounded cost. Follows from the sweep alone."""
    uses_vote = params.has("voted_start") or params.has("standstill")
    if params.method != "rigid" and not (params.method == "nsfp++" and uses_vote):
        return ()
    asked = np.flatnonzero(scene.may_move(params))
    cost = np.minimum(np.diff(scene.clusters.offsets)[asked], MAX_VOTING_POINTS)
    batch = np.cumsum(cost) // MAX_BATCH_VOTES
    return tuple(np.split(asked, np.flatnonzero(np.diff(batch)) + 1)) if len(asked) else ()


def vote_flow(scene: FlowScene, asked: Int64Array, params: FlowParams) -> Vote:
    """Ask (A,) clusters, ascending, for their motion. Whatever the batch, a cluster says the same."""
    clusters = scene.clusters
    rows = np.flatnonzero(np.isin(clusters.cluster_of_point, asked))
    part = Clusters(clusters.point_rows[rows], np.cumsum([0, *np.diff(clusters.offsets)[asked]]))
    motion = vote_motion(scene.points_ref[rows], scene.beams.of(rows), part, scene.targets, params)
    bodies = tuple(replace(body, rows=rows[body.rows]) for body in motion.bodies)
    return Vote(asked, replace(motion, bodies=bodies))


def plan_flow(scene: FlowScene, votes: Sequence[Vote], params: FlowParams, rng_of_cluster: RngOfCluster) -> FlowPlan:
    """Say what is known from all votes, and cut the fits that remain into batches."""
    points_ref, clusters, target = scene.points_ref, scene.clusters, scene.targets[0]
    is_failed = np.zeros(clusters.num_clusters, dtype=bool)
    is_asked = bool(cut_votes(scene, params))
    voted = VotedMotion.unknown(clusters.num_clusters, is_still=~scene.may_move(params) | is_asked)
    for vote in votes:
        if vote.motion is None:
            is_failed[vote.clusters] = True
        else:
            voted = voted.put(vote.clusters, vote.motion)
    if is_asked and params.has("pieces"):
        voted = lead_pieces(voted, points_ref, scene.beams, clusters, scene.targets)
    is_moving = ~voted.is_still & ((np.diff(clusters.offsets) >= params.min_points) | voted.is_led)
    start_m = np.where(is_moving[:, None], voted.velocity_mps * target.gap_s, 0.0)
    problems: list[FitProblem] = []
    if params.method == "nsfp" and len(points_ref) and len(target.points_ref):
        problems = [_whole_problem(points_ref, clusters, target, rng_of_cluster(0))]
    elif params.method == "nsfp++":
        needs_net = is_moving & ~voted.is_led & (voted.residual_m >= _sampling_m(scene, params))
        needs_net[[clusters.cluster_of_point[body.rows[0]] for body in voted.bodies]] = False  # a field is of one body
        problems = _cluster_problems(points_ref, clusters, start_m, needs_net, target, params, rng_of_cluster)
    start_flow = start_m[clusters.cluster_of_point].astype(np.float32)
    for body in voted.bodies:
        has_left = scene.is_vacated is None or scene.is_vacated[body.rows].mean() >= params.min_vacated_share
        if has_left or not params.has("vacated"):
            start_flow[body.rows] = body.velocity_mps * target.gap_s
    max_grade = params.max_grade if params.has("grade") else None
    return FlowPlan(start_flow, target.gap_s, is_failed, make_batches(problems), max_grade)


def finish_flow(plan: FlowPlan, results_of_batches: Sequence[Sequence[FitResult]]) -> SweepFlow:
    """Put the fitted fields in place: ``estimate_flow`` after the nets."""
    flow = plan.start_flow_ref_m.copy()
    is_failed = plan.is_failed.copy()
    num_iterations = np.zeros(len(is_failed), dtype=np.int64)
    final_loss_m2 = np.zeros(len(is_failed), dtype=np.float32)
    for batch, results in zip(plan.batches, results_of_batches, strict=True):
        for problem, result in zip(batch, results, strict=True):
            flow[problem.rows] = result.flow_m if result.is_finite else 0.0
            is_failed[problem.clusters] = not result.is_finite
            num_iterations[problem.clusters] = result.num_iterations
            final_loss_m2[problem.clusters] = result.final_loss_m2
    if plan.max_grade is not None:
        highest_m = plan.max_grade * np.linalg.norm(flow[:, :2], axis=1)
        flow[:, 2] = np.clip(flow[:, 2], -highest_m, highest_m)
    return SweepFlow(flow, plan.gap_s, is_failed, num_iterations, final_loss_m2)


def _sampling_m(scene: FlowScene, params: FlowParams) -> Float64Array:
    """Return (C,) how far samples of a rigid body lie from those of another sweep: noise, and the way between rays."""
    if not params.has("sparse_nets"):
        return np.zeros(scene.clusters.num_clusters)
    first = scene.clusters.offsets[:-1]
    beams = scene.beams.of(first)
    resolution_m = beams.resolution_m(scene.points_ref[first])
    return np.maximum(params.fit_noise_factor * beams.noise_m, params.fit_resolution_factor * resolution_m)


def _whole_problem(
    points: Float32Array, clusters: Clusters, target: FlowTarget, rng: np.random.Generator
) -> FitProblem:
    rows = np.arange(len(points))
    all_target = np.arange(len(target.points_ref))
    return FitProblem(
        np.arange(clusters.num_clusters), rows, points, rows, target.points_ref, all_target, np.zeros(3), rng
    )


def _cluster_problems(
    points: Float32Array,
    clusters: Clusters,
    start_m: Float64Array,
    needs_net: BoolArray,
    target: FlowTarget,
    params: FlowParams,
    rng_of_cluster: RngOfCluster,
) -> list[FitProblem]:
    problems = []
    for c in np.flatnonzero(needs_net):
        rows = np.arange(clusters.offsets[c], clusters.offsets[c + 1])
        found = query_target(points[rows], target.points_ref, start_m[c], params)
        if len(found) == 0:
            continue  # nothing to fit to: the voted start, or zero, stands
        fit_rows = spread_rows(len(rows), params.max_points)
        target_rows = spread_rows(len(found), 2 * params.max_points)
        start = start_m[c] if params.has("voted_start") else np.zeros(3)
        problems.append(
            FitProblem(
                np.array([c]),
                rows,
                points[rows],
                fit_rows,
                target.points_ref[found],
                target_rows,
                start,
                rng_of_cluster(int(c)),
            )
        )
    return problems


def query_target(
    cluster: Float32Array,  # (P, 3)
    target: Float32Array,  # (K, 3)
    start_m: Float64Array,  # (3,) expected displacement; used when pruning about the voted place
    params: FlowParams,
) -> Int64Array:
    """Return the target rows a cluster is fitted to: box query with expansion, then pruning, ascending.

    The axis-aligned box seen from above grows by buffers in the ratio of its sides, the larger one
    ``max_buffer_m``; of the points inside, the ``min(found, P)`` nearest to the first moment of the cluster stay.

    Source: paper section 3.1, "Box Query Strategy".
    """
    shift = start_m if params.has("voted_start") else np.zeros(3)
    low, high = (cluster[:, :2].min(axis=0) + shift[:2], cluster[:, :2].max(axis=0) + shift[:2])
    if params.has("expansion"):
        sides = np.maximum(high - low, 1e-3)
        buffer_m = params.max_buffer_m * sides / sides.max()
        low, high = low - buffer_m, high + buffer_m
    found = np.flatnonzero(((target[:, :2] >= low) & (target[:, :2] <= high)).all(axis=1))
    if params.has("pruning") and len(found) > len(cluster):
        moment = cluster.mean(axis=0, dtype=np.float64) + shift
        distance = np.linalg.norm(target[found] - moment, axis=1)
        found = np.sort(found[np.argsort(distance, kind="stable")[: len(cluster)]])
    return found


def make_batches(problems: list[FitProblem]) -> tuple[tuple[FitProblem, ...], ...]:
    """Group fits of similar size into padded batches of bounded memory. Follows from the sweep alone."""
    ordered = sorted(problems, key=lambda p: (-len(p.fit_rows), -len(p.target_rows), int(p.clusters[0])))
    batches: list[list[FitProblem]] = []
    num_pairs = 0  # of the largest problem of the open batch
    for problem in ordered:
        own_pairs = len(problem.fit_rows) * max(len(problem.target_rows), len(problem.fit_rows))
        num_pairs = max(num_pairs, own_pairs)
        is_full = bool(batches) and (
            len(batches[-1]) == MAX_BATCH_FITS or num_pairs * (len(batches[-1]) + 1) > MAX_BATCH_PAIRS
        )
        if not batches or is_full:
            batches.append([])
            num_pairs = own_pairs
        batches[-1].append(problem)
    return tuple(tuple(batch) for batch in batches)
