"""Iterative closest point from many starts at once, rotation about z only or free."""

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from labeling.geometry.neighbors import build_tree
from schemas.arrays import BoolArray, Float64Array, FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class Alignment:
    """The best of several ICP runs."""

    target_from_source: Float64Array  # (4, 4)
    error_m: (
        float  # mean distance to the nearest target point; a point without one within the cut-off costs the cut-off
    )


def align(
    source: FloatArray,  # (S, 3)
    target: FloatArray,  # (Q, 3)
    starts: Float64Array,  # (J, 4, 4) target_from_source
    *,
    iterations: int,
    cutoff_m: float,
    is_constrained: bool,
    num_refined: int,
) -> Alignment:
    """Run ICP from the ``num_refined`` most promising starts and return the one with least error.

    Source: paper Algorithm 2 and appendix. We differ in the error: the paper averages over matched points only, which
    favours alignments that match few; starts are ranked by their error before ICP.
    """
    tree = build_tree(target)
    points = np.asarray(source, dtype=np.float64)
    transforms = starts
    error = _errors(points, transforms, tree, cutoff_m)
    transforms = transforms[np.argsort(error, kind="stable")[:num_refined]]
    best_error = np.full(len(transforms), np.inf)
    best = transforms.copy()
    for _ in range(iterations):
        moved = _apply(transforms, points)
        distance, nearest = tree.query(moved, distance_upper_bound=cutoff_m)
        is_matched = np.isfinite(distance)
        error = np.where(is_matched, distance, cutoff_m).mean(axis=1)
        is_better = error < best_error - 1e-4
        best[is_better], best_error[is_better] = transforms[is_better], error[is_better]
        if not is_better.any():
            break
        matched = target[np.where(is_matched, nearest, 0)].astype(np.float64)
        transforms = _fit_rigid(moved, matched, is_matched, is_constrained) @ transforms
    winner = int(best_error.argmin())
    return Alignment(best[winner], float(best_error[winner]))


def _apply(transforms: Float64Array, points: Float64Array) -> Float64Array:
    return np.einsum("jab,sb->jsa", transforms[:, :3, :3], points) + transforms[:, None, :3, 3]


def alignment_errors(source: FloatArray, target: FloatArray, transforms: Float64Array, cutoff_m: float) -> Float64Array:
    """Return the (J,) errors of (J, 4, 4) alignments as they are."""
    return _errors(np.asarray(source, dtype=np.float64), transforms, build_tree(target), cutoff_m)


def _errors(source: Float64Array, transforms: Float64Array, tree: cKDTree, cutoff_m: float) -> Float64Array:
    distance, _ = tree.query(_apply(transforms, source), distance_upper_bound=cutoff_m)
    return np.minimum(distance, cutoff_m).mean(axis=1)


def _fit_rigid(moved: Float64Array, matched: Float64Array, weight: BoolArray, is_constrained: bool) -> Float64Array:
    """Return (J, 4, 4) least-squares motions of matched pairs; the identity where nothing matched."""
    total = np.maximum(weight.sum(axis=1), 1)[:, None]
    mean_a = (moved * weight[..., None]).sum(axis=1) / total
    mean_b = (matched * weight[..., None]).sum(axis=1) / total
    a, b = (moved - mean_a[:, None]) * weight[..., None], matched - mean_b[:, None]
    covariance = np.einsum("jsa,jsb->jab", a, b)
    motion = np.tile(np.eye(4), (len(moved), 1, 1))
    if is_constrained:
        yaw = np.arctan2(covariance[:, 0, 1] - covariance[:, 1, 0], covariance[:, 0, 0] + covariance[:, 1, 1])
        motion[:, 0, 0] = motion[:, 1, 1] = np.cos(yaw)
        motion[:, 1, 0], motion[:, 0, 1] = np.sin(yaw), -np.sin(yaw)
    else:
        u, _, vt = np.linalg.svd(covariance)
        sign = np.sign(np.linalg.det(np.einsum("jab,jbc->jac", u, vt)))
        u[:, :, 2] *= sign[:, None]
        motion[:, :3, :3] = np.einsum("jba,jcb->jac", vt, u)
    motion[:, :3, 3] = mean_b - np.einsum("jab,jb->ja", motion[:, :3, :3], mean_a)
    motion[weight.sum(axis=1) == 0] = np.eye(4)
    return motion
