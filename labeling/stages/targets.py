"""Targets: the sweeps that a cluster may have moved to, ready to be asked for nearest neighbours."""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.spatial import cKDTree

from labeling.geometry.neighbors import build_tree
from labeling.geometry.voxels import group_by_voxel, is_near_cells
from schemas.arrays import Float32Array, Float64Array, UInt8Array

RESIDUAL_CUTOFF_M = 0.5  # a point without a neighbour costs this much
LOST_SHARE = 0.8  # of the cut-off: a target that no motion explains better does not show the cluster
STOREY_M = 1000.0  # between the points of two scans
MATCH_NOISE_M = 0.03  # of a cluster's mean displacement
ACCELERATION_MPS2 = 2.0  # of road users that brake or start: what one velocity cannot say over a longer gap


@dataclass(frozen=True, slots=True, eq=False)
class FlowTarget:
    """What a cluster may move to: another sweep, carried to the ref frame."""

    gap_s: float  # its time minus that of the source sweep; negative: earlier
    points_ref: Float32Array  # (K, 3) dynamic points
    standing_points_ref: Float32Array  # (S, 3) points that are not ground, dynamic or static, where something is asked
    is_far: bool = False  # looked at for what seems slow only
    scan: UInt8Array | None = None  # (K,) of which lidar, where they turn out of phase
    standing_scan: UInt8Array | None = None  # (S,)
    origin_ref: Float64Array | None = None  # (3,) where its beams start; None: no surfaces between them

    def asked_from(self, points_ref: Float32Array) -> "FlowTarget":
        """Return the target without the standing points that are in reach of none of (M, 3) points that stand still."""
        kept = is_near_cells(self.standing_points_ref, points_ref, RESIDUAL_CUTOFF_M)
        scan = None if self.standing_scan is None else self.standing_scan[kept]
        return replace(self, standing_points_ref=self.standing_points_ref[kept], standing_scan=scan)


class View:
    """A target with its search trees, ``is_by_scan`` for points that are ``apart_by_scan``."""

    def __init__(self, target: FlowTarget, *, is_by_scan: bool) -> None:
        self.gap_s, self.is_far = target.gap_s, target.is_far
        self._target, self._is_by_scan = target, is_by_scan
        self.points = apart_by_scan(target.points_ref, target.scan if is_by_scan else None)
        self._thinned: dict[tuple[float, float], tuple[Float32Array, cKDTree]] = {}

    @cached_property
    def tree(self) -> cKDTree:
        """Of the dynamic points."""
        return build_tree(self.points)

    @cached_property
    def standing_tree(self) -> cKDTree:
        """Of the standing points."""
        target = self._target
        return build_tree(apart_by_scan(target.standing_points_ref, target.standing_scan if self._is_by_scan else None))

    def thinned(self, cell_m: float, height_m: float) -> tuple[Float32Array, cKDTree]:
        """Return ``thin`` dynamic points and their tree."""
        key = cell_m, height_m
        if key not in self._thinned:
            points = thin(self.points, *key)
            self._thinned[key] = points, build_tree(points)
        return self._thinned[key]


def thin(points: Float32Array, cell_m: float, height_m: float) -> Float32Array:
    """Return one point a cell of that side and height."""
    scale = np.array([1, 1, cell_m / height_m], dtype=np.float32)
    return points[np.sort(group_by_voxel(points * scale, cell_m).first_point)]


def trust_in(gap_s: float) -> float:
    """Return how much a displacement over this time counts beside those over others: its inverse variance, 1 / m^2."""
    return 1 / (MATCH_NOISE_M**2 + (ACCELERATION_MPS2 * gap_s**2 / 2) ** 2)


def apart_by_scan(points: Float32Array, scan: UInt8Array | None) -> Float32Array:
    """Return (N, 3) points with each scan on a storey of its own: what is near a point is then of the same lidar.

    Lidars that turn out of phase show what moves at two places of one sweep. Each by itself meets it once a turn.
    """
    if scan is None:
        return points
    return points + np.array([0, 0, STOREY_M], dtype=np.float32) * scan[:, None]


def split_by_scan(points: Float32Array) -> list[Float32Array]:
    """Return the points of each storey."""
    storey = np.rint(points[:, 2] / STOREY_M)
    return [points[storey == k] for k in np.unique(storey)]
