"""Flow: how far each dynamic point moves to the next sweep."""

from collections.abc import Callable, Sequence

import numpy as np

from labeling.geometry.voxels import spread_rows
from labeling.stages.nsfp import FitProblem, FitResult, fit_nets
from labeling.stages.voting import FlowTarget, VotedMotion, vote_motion
from schemas.arrays import BoolArray, Float32Array, Float64Array, Int64Array, require
from schemas.config import FlowParams
from schemas.objects import Clusters, SweepFlow

MAX_BATCH_PAIRS = 4_000_000  # point pairs of a padded batch: 16 MB a distance matrix

RngOfCluster = Callable[[int], np.random.Generator]
"""Cluster number -> its own generator, seeded by (segment, sweep, cluster)."""


def estimate_flow(
    points_ref: Float32Array,  # (M, 3) dynamic points, grouped by cluster
    clusters: Clusters,
    targets: Sequence[FlowTarget],
    params: FlowParams,
    rng_of_cluster: RngOfCluster,
) -> SweepFlow:
    """Estimate the displacement of each dynamic point to ``targets[0]``; the other targets only help the vote.

    ``nsfp++``: one net a cluster, fitted to the points that a box query finds near it. ``nsfp``: one net for all
    points, whatever their cluster. ``rigid``: the voted velocity. Clusters that are explained as well by standing
    still get zero flow and no fit, as do those smaller than ``min_points``.

    Returns:
        Flow in ref axes and row order of ``points_ref``. A fit that does not stay finite gives zero flow and is
        marked failed.

    Source: paper section 3.1, eq. 2 and "Box Query Strategy". We differ in the start from a voted velocity, in pruning
    about the moved centroid and in the standstill test; each is a parameter, off in profile ``paper``.

    """
    require("points_ref", points_ref, (len(clusters.point_rows), 3), np.float32)
    sizes = np.diff(clusters.offsets)
    gap_s = targets[0].gap_s
    needs_vote = params.method == "rigid" or (
        params.method == "nsfp++"
        and (params.start == "voted" or params.prune_about == "voted" or params.has_standstill_test)
    )
    voted = vote_motion(points_ref, clusters, targets, params) if needs_vote else _no_vote(clusters.num_clusters)
    is_moving = ~voted.is_still if params.has_standstill_test and needs_vote else np.ones(len(sizes), dtype=bool)
    is_moving &= sizes >= params.min_points
    start_m = np.where(is_moving[:, None], voted.velocity_mps * gap_s, 0.0)

    flow = start_m[clusters.cluster_of_point].astype(np.float32)
    is_failed = np.zeros(len(sizes), dtype=bool)
    num_iterations = np.zeros(len(sizes), dtype=np.int64)
    final_loss_m2 = np.zeros(len(sizes), dtype=np.float32)
    if params.method in ("nsfp", "nsfp++") and len(points_ref):
        whole = params.method == "nsfp"
        problems = (
            [_whole_problem(points_ref, targets[0], rng_of_cluster(0))]
            if whole
            else _cluster_problems(points_ref, clusters, start_m, is_moving, targets[0], params, rng_of_cluster)
        )
        for batch in make_batches(problems):
            for problem, result in zip(batch, fit_nets(batch, params), strict=True):
                flow[problem.rows] = _checked_flow(result)
                owners = slice(None) if whole else problem.cluster
                is_failed[owners] = not result.is_finite
                num_iterations[owners] = result.num_iterations
                final_loss_m2[owners] = result.final_loss_m2
    return SweepFlow(flow, gap_s, is_failed, num_iterations, final_loss_m2)


def _no_vote(num_clusters: int) -> VotedMotion:
    zeros = np.zeros(num_clusters)
    return VotedMotion(np.zeros((num_clusters, 3)), zeros, zeros, np.zeros(num_clusters, dtype=bool))


def _checked_flow(result: FitResult) -> Float32Array:
    return result.flow_m if result.is_finite else np.zeros_like(result.flow_m)


def _whole_problem(points: Float32Array, target: FlowTarget, rng: np.random.Generator) -> FitProblem:
    rows = np.arange(len(points))
    return FitProblem(0, rows, points, rows, target.points_ref, np.zeros(3), rng)


def _cluster_problems(
    points: Float32Array,
    clusters: Clusters,
    start_m: Float64Array,
    is_moving: BoolArray,
    target: FlowTarget,
    params: FlowParams,
    rng_of_cluster: RngOfCluster,
) -> list[FitProblem]:
    problems = []
    for c in np.flatnonzero(is_moving):
        rows = np.arange(clusters.offsets[c], clusters.offsets[c + 1])
        found = query_target(points[rows], target.points_ref, start_m[c], params)
        if len(found) == 0:
            continue  # nothing to fit to: the voted start, or zero, stands
        fit_rows = spread_rows(len(rows), params.max_points)
        kept = found[spread_rows(len(found), 2 * params.max_points)]
        start = start_m[c] if params.start == "voted" else np.zeros(3)
        problems.append(
            FitProblem(int(c), rows, points[rows], fit_rows, target.points_ref[kept], start, rng_of_cluster(int(c)))
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
    shift = start_m if params.prune_about == "voted" else np.zeros(3)
    low, high = (cluster[:, :2].min(axis=0) + shift[:2], cluster[:, :2].max(axis=0) + shift[:2])
    if params.has_expansion:
        sides = np.maximum(high - low, 1e-3)
        buffer_m = params.max_buffer_m * sides / sides.max()
        low, high = low - buffer_m, high + buffer_m
    found = np.flatnonzero(((target[:, :2] >= low) & (target[:, :2] <= high)).all(axis=1))
    if params.has_pruning and len(found) > len(cluster):
        moment = cluster.mean(axis=0, dtype=np.float64) + shift
        distance = np.linalg.norm(target[found] - moment, axis=1)
        found = np.sort(found[np.argsort(distance, kind="stable")[: len(cluster)]])
    return found


def make_batches(problems: list[FitProblem]) -> list[list[FitProblem]]:
    """Group fits of similar size into padded batches of bounded memory. Follows from the sweep alone."""
    ordered = sorted(problems, key=lambda p: (-len(p.fit_rows), -len(p.target), p.cluster))
    batches: list[list[FitProblem]] = []
    pairs = 0
    for problem in ordered:
        pairs = max(pairs, len(problem.fit_rows) * max(len(problem.target), len(problem.fit_rows)))
        if not batches or pairs * (len(batches[-1]) + 1) > MAX_BATCH_PAIRS or len(batches[-1]) >= 64:
            batches.append([])
            pairs = len(problem.fit_rows) * max(len(problem.target), len(problem.fit_rows))
        batches[-1].append(problem)
    return batches
