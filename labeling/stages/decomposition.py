"""Decomposition: dynamic points -> connected components, each to be given its own flow."""

import numpy as np

from labeling.geometry.neighbors import connected_components
from schemas.arrays import BoolArray, Float32Array, require
from schemas.config import DecompositionParams
from schemas.lidars import Beams
from schemas.objects import Clusters


def decompose(
    points_ref: Float32Array,  # (N, 3) ref frame, m
    beams: Beams,  # (N,)
    is_dynamic: BoolArray,  # (N,) neither ground nor static
    params: DecompositionParams,
) -> Clusters:
    """Split the dynamic points of a sweep into connected components, largest first, ties by first row.

    Every dynamic point is in exactly one component; which are too small to be fitted is the flow stage's business.

    Source: paper section 3.1, "Estimate Local Flow via Scene Decomposition". The radius is not in the paper.
    """
    require("points_ref", points_ref, (None, 3), np.float32)
    require("is_dynamic", is_dynamic, (len(points_ref),), np.bool_)
    rows = np.flatnonzero(is_dynamic)
    if len(rows) == 0:
        return Clusters(rows, np.zeros(1, dtype=np.int64))
    points = points_ref[rows]
    resolution_m = beams.of(rows).resolution_m(points)
    radius_m = np.clip(params.resolution_factor * resolution_m, params.min_radius_m, params.radius_m)
    component = connected_components(points, radius_m)
    _, first, inverse, counts = np.unique(component, return_index=True, return_inverse=True, return_counts=True)
    rank = np.empty(len(counts), dtype=np.int64)
    rank[np.lexsort((first, -counts))] = np.arange(len(counts))
    order = np.argsort(rank[inverse], kind="stable")
    return Clusters(rows[order], np.concatenate([[0], np.cumsum(np.sort(counts)[::-1])]).astype(np.int64))
