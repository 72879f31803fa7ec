"""Iterative closest point from many starts at once, rotation about z only or free."""

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from labeling.geometry.neighbors import build_tree, residuals_m
from labeling.geometry.voxels import spread_rows
from schemas.arrays import Float64Array, FloatArray, Int64Array

RANKING_POINTS = 64  # of the source
MIN_GAIN_M = 1e-4  # of the error in one iteration; when no start gains as much, all are done


@dataclass(frozen=True, slots=True, eq=False)
class Target:
    """Points to align with, and their tree."""

    points: Float64Array  # (Q, 3)
    tree: cKDTree

    @classmethod
    def of(cls, points: FloatArray) -> "Target":
        """Build the tree of (Q, 3) points."""
        return cls(points.astype(np.float64), build_tree(points))

    def errors_m(self, source: Float64Array, transforms: Float64Array, cutoff_m: float) -> Float64Array:
        """Return the (J,) errors of (S, 3) points under (J, 4, 4) target_from_source: see ``Alignment.error_m``."""
        errors: Float64Array = residuals_m(self.tree, _apply(transforms, source), cutoff_m).mean(axis=1)
        return errors


@dataclass(frozen=True, slots=True, eq=False)
class Alignment:
    """The best of several ICP runs."""

    target_from_source: Float64Array  # (4, 4)
    error_m: float  # mean distance to the nearest target point, at most the cut-off each


def align(
    source: Float64Array,  # (S, 3)
    target: Target,
    starts: Float64Array,  # (J, 4, 4) target_from_source
    *,
    iterations: int,
    cutoff_m: float,
    is_constrained: bool,
    num_refined: int,
) -> Alignment:
    """Run ICP from the ``num_refined`` most promising starts and return the one with least error.

    Source: paper Algorithm 2 and appendix. We differ in the error: the paper averages over matched points only, which
    favours alignments that match few. A few of the points rank the starts before ICP.
    """
    if num_refined < len(starts):
        few = source[spread_rows(len(source), RANKING_POINTS)]
        starts = starts[np.argsort(target.errors_m(few, starts, cutoff_m), kind="stable")[:num_refined]]
    transforms, best, best_error = starts, starts.copy(), np.full(len(starts), np.inf)
    for _ in range(iterations):
        moved = _apply(transforms, source)
        distance, nearest = target.tree.query(moved, distance_upper_bound=cutoff_m)
        error = np.minimum(distance, cutoff_m).mean(axis=1)
        gains = error < best_error - MIN_GAIN_M
        if not gains.any():
            break
        best[gains], best_error[gains] = transforms[gains], error[gains]
        transforms = _fit_rigid(moved, target, nearest, is_constrained) @ transforms
    winner = int(best_error.argmin())
    return Alignment(best[winner], float(best_error[winner]))


def _apply(transforms: Float64Array, points: Float64Array) -> Float64Array:
    moved: Float64Array = points @ transforms[:, :3, :3].transpose(0, 2, 1) + transforms[:, None, :3, 3]
    return moved


def _fit_rigid(moved: Float64Array, target: Target, nearest: Int64Array, is_constrained: bool) -> Float64Array:
    """Return (J, 4, 4) least-squares motions of (J, S, 3) points onto the nearest of the target, where there is one."""
    is_matched = nearest < len(target.points)
    matched = target.points[np.where(is_matched, nearest, 0)]
    weight = is_matched[:, None] / np.maximum(is_matched.sum(axis=1), 1)[:, None, None]  # (J, 1, S)
    mean_a, mean_b = (weight @ moved)[:, 0], (weight @ matched)[:, 0]
    covariance = (moved.transpose(0, 2, 1) * weight) @ (matched - mean_b[:, None])  # (J, 3, 3)
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
    motion[:, :3, 3] = mean_b - (motion[:, :3, :3] @ mean_a[..., None])[..., 0]
    motion[~is_matched.any(axis=1)] = np.eye(4)
    return motion
