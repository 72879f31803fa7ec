"""Targets: the sweeps that a cluster may have moved to, ready to be asked for nearest neighbours."""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.spatial import cKDTree

from labeling.geometry.neighbors import build_tree
from labeling.geometry.voxels import group_by_voxel, is_near_cells
from schemas.arrays import Float32Array
from schemas.lidars import Beams

RESIDUAL_CUTOFF_M = 0.5  # a point without a neighbour costs this much
LOST_SHARE = 0.8  # of the cut-off: a target that no motion explains better does not show the cluster
STOREY_M = 1000.0  # between the points of two scans, where lidars are not in step
MATCH_NOISE = 1.5  # range noises: of a cluster's mean displacement
ACCELERATION_MPS2 = 2.0  # of road users that brake or start: what one velocity cannot say over a longer gap


@dataclass(frozen=True, slots=True, eq=False)
class FlowTarget:
    """What a cluster may move to: another sweep, carried to the ref frame."""

    gap_s: float  # its time minus that of the source sweep; negative: earlier
    points_ref: Float32Array  # (K, 3) dynamic points
    standing_points_ref: Float32Array  # (S, 3) points that are not ground, dynamic or static, where something is asked
    beams: Beams  # (K,) of points_ref
    standing_beams: Beams  # (S,)
    is_far: bool = False  # looked at for what seems slow only

    @property
    def trust(self) -> float:
        """How much a displacement to it counts beside those to others: its inverse variance, 1 / m^2."""
        noise_m = float(np.mean([lidar.noise_m for lidar in self.beams.lidars]))
        return 1 / ((MATCH_NOISE * noise_m) ** 2 + (ACCELERATION_MPS2 * self.gap_s**2 / 2) ** 2)

    def asked_from(self, points_ref: Float32Array) -> "FlowTarget":
        """Return the target without the standing points that are in reach of none of (M, 3) points that stand still."""
        kept = is_near_cells(self.standing_points_ref, points_ref, RESIDUAL_CUTOFF_M)
        return replace(
            self, standing_points_ref=self.standing_points_ref[kept], standing_beams=self.standing_beams.of(kept)
        )


class View:
    """A target with its search trees, for points that are ``apart_by_scan``."""

    def __init__(self, target: FlowTarget) -> None:
        self.gap_s, self.is_far, self.trust = target.gap_s, target.is_far, target.trust
        self._target = target
        self.points = apart_by_scan(target.points_ref, target.beams)
        self._thinned: dict[tuple[float, float], tuple[Float32Array, cKDTree]] = {}

    @cached_property
    def tree(self) -> cKDTree:
        """Of the dynamic points."""
        return build_tree(self.points)

    @cached_property
    def standing_tree(self) -> cKDTree:
        """Of the standing points."""
        return build_tree(apart_by_scan(self._target.standing_points_ref, self._target.standing_beams))

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


def apart_by_scan(points: Float32Array, beams: Beams) -> Float32Array:
    """Return (N, 3) points with each scan on a storey of its own: what is near a point is then of the same scan.

    Lidars that turn out of phase show what moves at two places of one sweep. Each by itself meets it once a turn.
    """
    return points + np.array([0, 0, STOREY_M], dtype=np.float32) * beams.scan_of_point[:, None]


def split_by_scan(points: Float32Array) -> list[Float32Array]:
    """Return the points of each storey."""
    storey = np.rint(points[:, 2] / STOREY_M)
    return [points[storey == k] for k in np.unique(storey)]
