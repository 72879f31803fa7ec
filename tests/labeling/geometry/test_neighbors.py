import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from scipy.sparse.csgraph import connected_components as graph_components

from labeling.geometry.neighbors import build_tree, connected_components, nearest_distance_m, residuals_m

CLOUDS = hnp.arrays(np.float32, st.tuples(st.integers(1, 30), st.just(3)), elements=st.floats(-3, 3, width=32))
MERGED_M = np.sqrt(3) / 4  # of the radius: how far apart two points of one cell of the merge grid may be


def distances(a, b):
    return np.linalg.norm(a[:, None].astype(np.float64) - b[None], axis=2)


@given(CLOUDS, CLOUDS, st.floats(0.1, 5))
def test_nearest_distance_is_that_of_comparing_all_pairs(tree_points, points, cutoff_m):
    found = nearest_distance_m(build_tree(tree_points), points, cutoff_m)
    expected = distances(points, tree_points).min(axis=1)
    is_clear = np.abs(expected - cutoff_m) > 1e-6
    expected[expected > cutoff_m] = np.inf
    np.testing.assert_allclose(found[is_clear], expected[is_clear], atol=1e-6)


@pytest.mark.parametrize(("num_tree", "num_points"), [(0, 3), (3, 0), (0, 0)])
def test_nearest_distance_without_points(num_tree, num_points):
    tree = build_tree(np.zeros((num_tree, 3), dtype=np.float32))
    np.testing.assert_array_equal(
        nearest_distance_m(tree, np.zeros((num_points, 3), dtype=np.float32), 1.0), np.full(num_points, np.inf)
    )


@pytest.mark.parametrize("num_tree", [0, 2])
def test_residuals_are_distances_of_at_most_the_cutoff(num_tree):
    tree = build_tree(np.array([[0, 0, 0], [9, 0, 0]], dtype=np.float32)[:num_tree])
    asked = np.array([[[0.2, 0, 0], [0, 0, 0.7]], [[9, 3, 0], [4, 0, 0]]])
    expected = np.array([[0.2, 0.5], [0.5, 0.5]]) if num_tree else np.full((2, 2), 0.5)
    np.testing.assert_allclose(residuals_m(tree, asked, 0.5), expected)


@given(CLOUDS, st.floats(0.2, 2))
def test_components_lie_between_the_graphs_of_a_lesser_and_of_the_full_radius(points, radius_m):
    same = connected_components(points, radius_m)
    same = same[:, None] == same[None]
    distance = distances(points, points)
    surely, maybe = (
        graph_components(distance < limit, directed=False)[1]
        for limit in (radius_m * (1 - 2 * MERGED_M) - 1e-6, radius_m + 1e-6)
    )
    assert same[surely[:, None] == surely[None]].all()
    assert not same[maybe[:, None] != maybe[None]].any()


def test_a_chain_hangs_together_and_a_gap_parts_it():
    chain = np.zeros((40, 3), dtype=np.float32)
    chain[:, 0] = np.arange(40) * 0.4
    chain[20:, 0] += 0.5
    component = connected_components(chain, 1.0)
    assert len(set(component[:20])) == len(set(component[20:])) == 1
    assert component[0] == component[39]
    component = connected_components(chain, 0.6)
    assert set(component[:20]).isdisjoint(component[20:])


def test_of_two_points_the_smaller_radius_counts():
    points = np.array([[0, 0, 0], [0.5, 0, 0], [1.0, 0, 0], [1.5, 0, 0]], dtype=np.float32)
    component = connected_components(points, np.array([0.6, 0.6, 0.6, 0.3]))
    assert component[0] == component[1] == component[2] != component[3]


def test_no_points_no_components():
    assert connected_components(np.empty((0, 3), dtype=np.float32), 0.5).shape == (0,)
