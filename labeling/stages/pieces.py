"""Pieces: clusters too small to tell their own motion that go with the moving one beside them."""

from collections.abc import Callable

import numpy as np
from scipy.spatial import cKDTree

from labeling.geometry.neighbors import build_tree
from labeling.geometry.voxels import spread_rows
from labeling.stages.targets import LOST_SHARE, RESIDUAL_CUTOFF_M
from schemas.arrays import BoolArray, Float32Array, Float64Array, Int64Array
from schemas.lidars import Beams
from schemas.objects import Clusters

MIN_LEADER_POINTS = 30
LEADER_RATIO = 2.0  # of its number of points to those of a piece
REACH_M = 1.0  # between the two
FOUND_M = LOST_SHARE * RESIDUAL_CUTOFF_M
MARGIN_M = 0.02  # by which a piece's own motion must explain it better to be kept
MIN_MISS_M = 0.15  # of another's motion; shreds bend
RESOLUTION_FACTOR = 1.5  # of what the lidar tells there, that it may miss by as well
MAX_ASKED = 256  # points of a cluster

Judge = Callable[[Int64Array, Float64Array], Float64Array]
"""(K,) cluster numbers and (K, 3) velocities -> (K, L) how far the moved clusters lie from each other sweep, m."""


def find_leaders(
    points: Float32Array,  # (M, 3) grouped by cluster
    beams: Beams,  # (M,)
    clusters: Clusters,
    velocity_mps: Float64Array,  # (C, 3)
    is_still: BoolArray,  # (C,)
    judge: Judge,
) -> Int64Array:
    """Return (C,) the cluster whose velocity each one takes; its own number where it keeps its own.

    A shred fits in many places. Of the motions that explain it about as well as its own, or as well as the lidar tells,
    that of the larger cluster beside it is the likely one. Both are asked in the sweeps that either finds the piece in.
    What stands keeps standing.

    Source: ours.
    """
    size = np.diff(clusters.offsets)
    leader = np.arange(clusters.num_clusters)
    leads = ~is_still & (size >= MIN_LEADER_POINTS)
    rows = [clusters.offsets[c] + spread_rows(size[c], MAX_ASKED) for c in range(clusters.num_clusters)]
    asked = np.concatenate([np.empty(0, dtype=np.int64), *(rows[c] for c in np.flatnonzero(leads))])
    tree, owner = build_tree(points[asked]), clusters.cluster_of_point[asked]
    largest = size[leads].max(initial=0)
    pairs = [
        (c, other)
        for c in np.flatnonzero(~is_still & (LEADER_RATIO * size <= largest)).tolist()
        for other in _beside(points[rows[c]], tree, owner)
        if size[other] >= LEADER_RATIO * size[c]
    ]
    if not pairs:
        return leader
    piece, other = np.array(pairs, dtype=np.int64).T
    residuals_m = np.stack([judge(piece, velocity_mps[piece]), judge(piece, velocity_mps[other])])  # (2, K, L)
    is_found = residuals_m.min(axis=0) < FOUND_M
    is_found |= ~is_found.any(axis=1, keepdims=True)
    own_m, led_m = np.where(is_found, residuals_m, 0.0).sum(axis=2) / is_found.sum(axis=1)
    first = clusters.offsets[piece]
    resolution_m = beams.of(first).resolution_m(points[first])
    miss_m = np.where(leads[piece], 0.0, np.maximum(MIN_MISS_M, RESOLUTION_FACTOR * resolution_m))
    is_explained = led_m <= np.maximum(own_m + MARGIN_M, miss_m)
    worst_first = np.argsort(-led_m, kind="stable")
    worst_first = worst_first[is_explained[worst_first]]
    leader[piece[worst_first]] = other[worst_first]  # the last one stays: the one that explains it best
    while (leader != leader[leader]).any():  # a leader may be led: each is twice the size of the one before
        leader = leader[leader]
    return leader


def _beside(piece: Float32Array, tree: cKDTree, owner: Int64Array) -> list[int]:
    """Return the clusters with a point within reach."""
    near = tree.query_ball_point(piece, REACH_M)
    return np.unique(owner[[row for rows in near for row in rows]]).tolist()
