"""Nearest neighbours behind few functions, so that the search can be replaced in one place."""

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components as graph_components
from scipy.spatial import cKDTree

from labeling.geometry.voxels import group_by_voxel
from schemas.arrays import Float64Array, FloatArray, Int64Array


def build_tree(points: FloatArray) -> cKDTree:
    """Return a k-d tree of (N, D) points; unbalanced, which is faster to build and as fast to ask here."""
    return cKDTree(points, balanced_tree=False, compact_nodes=False)


def nearest_distance_m(tree: cKDTree, points: FloatArray, cutoff_m: float) -> Float64Array:
    """Return the (...) distances of (..., D) points to the nearest tree point, inf where it is beyond the cut-off."""
    if tree.n == 0 or len(points) == 0:
        return np.full(points.shape[:-1], np.inf)
    distance, _ = tree.query(points, distance_upper_bound=cutoff_m)
    return np.asarray(distance, dtype=np.float64)


def residuals_m(tree: cKDTree, points: FloatArray, cutoff_m: float) -> Float64Array:
    """Return the (...) truncated distances of (..., D) points to the nearest tree point: at most ``cutoff_m``."""
    return np.minimum(nearest_distance_m(tree, points, cutoff_m), cutoff_m)


def connected_components(points: FloatArray, radius_m: FloatArray | float) -> Int64Array:
    """Return (N,) component numbers: points closer than ``radius_m`` (up to a merge grid of a quarter) hang together.

    ``radius_m`` may be (N,): of two points the smaller one counts. Points are merged on the grid first, so that 100,000
    equal points cost no more memory than one.
    """
    radius_m = np.broadcast_to(np.asarray(radius_m, dtype=np.float64), len(points))
    groups = group_by_voxel(points, float(radius_m.min(initial=np.inf)) / 4)
    num_voxels = len(groups.first_point)
    if num_voxels == 0:
        return np.empty(0, dtype=np.int64)
    merged, reach_m = points[groups.first_point].astype(np.float64), radius_m[groups.first_point]
    pairs = cKDTree(merged).query_pairs(float(reach_m.max()), output_type="ndarray")
    if reach_m.min() < reach_m.max():
        distance_m = np.linalg.norm(merged[pairs[:, 0]] - merged[pairs[:, 1]], axis=1)
        pairs = pairs[distance_m <= reach_m[pairs].min(axis=1)]
    edges = coo_array((np.ones(len(pairs), dtype=bool), (pairs[:, 0], pairs[:, 1])), shape=(num_voxels, num_voxels))
    _, component_of_voxel = graph_components(edges, directed=False)
    return np.asarray(component_of_voxel, dtype=np.int64)[groups.voxel_of_point]
