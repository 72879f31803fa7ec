from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from labeling.stages.decomposition import decompose
from schemas.config import DecompositionParams
from schemas.errors import InvalidInput
from schemas.lidars import Beams, Lidar

PARAMS = DecompositionParams(radius_m=0.6, min_radius_m=0.6)
LIDAR = Lidar((0.0, 0.0, 0.0), 0.0035, 0.0046, 0.02)


def decompose_all(points, is_dynamic, params=PARAMS):
    return decompose(points, Beams((LIDAR,), np.zeros(len(points), np.uint8)), is_dynamic, params)


def heap(center, num_points, seed=0):
    return (np.random.default_rng(seed).uniform(-0.2, 0.2, (num_points, 3)) + center).astype(np.float32)


def rows_of_clusters(clusters):
    return [clusters.point_rows[a:b].tolist() for a, b in pairwise(clusters.offsets)]


def test_known_components_largest_first_equal_ones_by_first_row():
    points = np.concatenate([heap((0, 0, 0), 5), heap((9, 0, 0), 12), heap((0, 9, 0), 5), heap((0, 0, 9), 1)])
    clusters = decompose_all(points, np.ones(len(points), dtype=bool))
    assert rows_of_clusters(clusters) == [list(range(5, 17)), list(range(5)), list(range(17, 22)), [22]]
    np.testing.assert_array_equal(clusters.cluster_of_point, [0] * 12 + [1] * 5 + [2] * 5 + [3])


def test_what_lies_close_together_near_by_is_two_where_beams_are_dense():
    """Two sheets half a metre apart: at 5 m from the sensor a gap, at 30 m the spacing of the beams."""
    sheet = np.stack(np.meshgrid([0.0, 0.5], np.arange(8) * 0.1, np.arange(8) * 0.1), axis=-1).reshape(-1, 3)
    for range_m, num_clusters in ((5.0, 2), (30.0, 1)):
        points = np.add(sheet, (range_m, 0, 0)).astype(np.float32)
        clusters = decompose_all(points, np.ones(len(points), dtype=bool), DecompositionParams())
        assert clusters.num_clusters == num_clusters


def test_only_dynamic_points_count_they_do_not_bridge():
    points = np.zeros((21, 3), dtype=np.float32)
    points[:, 0] = np.arange(21) * 0.25
    is_dynamic = np.ones(21, dtype=bool)
    assert decompose_all(points, is_dynamic).num_clusters == 1
    is_dynamic[8:12] = False
    clusters = decompose_all(points, is_dynamic)
    assert rows_of_clusters(clusters) == [list(range(12, 21)), list(range(8))]


@given(st.integers(0, 2**32 - 1), st.integers(1, 40))
def test_each_dynamic_point_is_in_one_cluster_and_a_permutation_permutes(seed, num_points):
    rng = np.random.default_rng(seed)
    points = (rng.integers(0, 4, (num_points, 3)) * 2.0 + rng.uniform(-0.2, 0.2, (num_points, 3))).astype(np.float32)
    is_dynamic = rng.random(num_points) < 0.8
    order = rng.permutation(num_points)

    clusters, permuted = decompose_all(points, is_dynamic), decompose_all(points[order], is_dynamic[order])
    np.testing.assert_array_equal(np.sort(clusters.point_rows), np.flatnonzero(is_dynamic))
    assert (np.diff(np.diff(clusters.offsets)) <= 0).all()
    same = {frozenset(rows) for rows in rows_of_clusters(clusters)}
    assert same == {frozenset(order[rows].tolist()) for rows in rows_of_clusters(permuted)}


@pytest.mark.parametrize("num_points", [0, 7])
def test_nothing_dynamic_gives_no_cluster(num_points):
    clusters = decompose_all(np.zeros((num_points, 3), dtype=np.float32), np.zeros(num_points, dtype=bool))
    assert clusters.num_clusters == 0
    assert len(clusters.point_rows) == len(clusters.cluster_of_point) == 0


def test_a_hundred_thousand_equal_points_cost_little(peak_growth_mb):
    points = np.ones((100_000, 3), dtype=np.float32)
    is_dynamic = np.ones(len(points), dtype=bool)
    assert decompose_all(points, is_dynamic).num_clusters == 1
    assert peak_growth_mb(lambda: decompose_all(points, is_dynamic)) < 100  # all pairs would be 80 GB


def test_what_does_not_fit_is_named():
    with pytest.raises(InvalidInput, match="is_dynamic"):
        decompose_all(np.zeros((3, 3), dtype=np.float32), np.ones(2, dtype=bool))
    with pytest.raises(InvalidInput, match="points_ref"):
        decompose_all(np.zeros((3, 3)), np.ones(3, dtype=bool))
