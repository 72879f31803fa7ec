"""Bodies: two road users that pass so close that they are one cluster -> the part and the velocity of the second."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from labeling.geometry.neighbors import build_tree, residuals_m
from labeling.stages.targets import RESIDUAL_CUTOFF_M, View
from schemas.arrays import Float32Array, Float64Array, Int64Array

MIN_POINTS = 20  # of a body
MIN_SHARE = 0.15  # of a cluster's points, in either body
MIN_PARTING_MPS = 3.0  # between their velocities
UNEXPLAINED_M = 0.2  # mean distance that the first one's velocity must leave to the points of the second
EXPLAINED_SHARE = 0.5  # of it, which their own may leave
NUM_NEIGHBORS = 8  # nearest points that say with which body a point goes
MIN_COHERENCE = 0.9  # share of points that go with most of their neighbours


@dataclass(frozen=True, slots=True, eq=False)
class Body:
    """A second road user in a cluster, that moves otherwise than the first."""

    rows: Int64Array  # (B,) of the points, ascending
    velocity_mps: Float64Array  # (3,) ref axes


def find_second_body(
    cluster: Float32Array,  # (P, 3)
    speakers: Float32Array,  # (n, 3) those of its points that vote
    first_mps: Float64Array,  # (3,) velocity that the cluster was given
    tried_mps: Float64Array,  # (H, 3) others that had votes
    views: Sequence[View],
    vote: Callable[[Float32Array], Float64Array],  # points that speak for one body -> its (3,) velocity
) -> Body | None:
    """Return the part of a cluster that has a motion of its own, rows counted in the cluster; None where all is one.

    Any cluster is explained better by two velocities than by one. It is two bodies when the points that go with the
    second lie together and the first one's velocity leaves them without a place to go to: a flat side that slides along
    itself (aperture) has one.

    Source: ours; the paper's nets see one object a cluster.
    """
    candidates = [v for v in (np.zeros(3), *tried_mps) if np.linalg.norm(v - first_mps) >= MIN_PARTING_MPS]
    if len(cluster) < 2 * MIN_POINTS or not candidates:
        return None
    own_m = _distances(speakers, first_mps, views)
    other_m = min((_distances(speakers, v, views) for v in candidates), key=lambda m: np.minimum(own_m, m).mean())
    goes_otherwise = other_m < own_m
    if goes_otherwise.mean() < MIN_SHARE:
        return None
    second_mps = vote(speakers[goes_otherwise])
    own_m, other_m = (_distances(cluster, velocity, views) for velocity in (first_mps, second_mps))
    _, neighbors = build_tree(cluster).query(cluster, k=NUM_NEIGHBORS)
    is_second = (other_m < own_m)[neighbors].mean(axis=1) > 0.5
    if is_second.sum() < MIN_POINTS or not MIN_SHARE <= is_second.mean() <= 1 - MIN_SHARE:
        return None
    is_apart = np.linalg.norm(second_mps - first_mps) >= MIN_PARTING_MPS
    is_coherent = (is_second == (other_m < own_m)).mean() >= MIN_COHERENCE
    left_m, explained_m = own_m[is_second].mean(), other_m[is_second].mean()
    is_needed = left_m >= UNEXPLAINED_M and explained_m <= EXPLAINED_SHARE * left_m
    return Body(np.flatnonzero(is_second), second_mps) if is_apart and is_coherent and is_needed else None


def _distances(points: Float32Array, velocity_mps: Float64Array, views: Sequence[View]) -> Float64Array:
    """Return (N,) mean truncated distances of moved points to the dynamic points of the views; to all, if unmoved."""
    is_moved = velocity_mps.any()
    found = [
        residuals_m(
            view.tree if is_moved else view.standing_tree, points + velocity_mps * view.gap_s, RESIDUAL_CUTOFF_M
        )
        for view in views
    ]
    return np.asarray(np.mean(found, axis=0))
