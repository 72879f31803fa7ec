import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from labeling.geometry.voxels import MAX_END_ROWS, group_by_voxel, spread_points, spread_rows

CLOUDS = hnp.arrays(np.float32, st.tuples(st.integers(1, 40), st.just(3)), elements=st.floats(-50, 50, width=32))


@given(CLOUDS, st.sampled_from([0.05, 0.6, 7.0]))
def test_points_share_a_voxel_exactly_when_they_share_a_cell(points, size):
    groups = group_by_voxel(points, size)
    cell = np.floor(points.astype(np.float64) / size)
    is_same_cell = (cell[:, None] == cell[None]).all(axis=2)
    np.testing.assert_array_equal(groups.voxel_of_point[:, None] == groups.voxel_of_point[None], is_same_cell)
    np.testing.assert_array_equal(groups.num_points, np.bincount(groups.voxel_of_point))
    np.testing.assert_array_equal(groups.voxel_of_point[groups.first_point], np.arange(len(groups.first_point)))


@pytest.mark.parametrize("num_columns", [1, 2, 3])
def test_any_number_of_columns_and_far_corners_stay_apart(num_columns):
    corners = np.array(np.meshgrid(*[[-5e4, 5e4]] * num_columns)).reshape(num_columns, -1).T  # 100 km on millimetres
    groups = group_by_voxel(corners, 0.05)
    assert len(set(groups.voxel_of_point)) == 2**num_columns


def test_cells_left_and_right_of_zero_are_two():
    groups = group_by_voxel(np.array([[-0.01, 0, 0], [0.01, 0, 0]], dtype=np.float32), 1.0)
    assert groups.voxel_of_point[0] != groups.voxel_of_point[1]


def test_no_points_have_no_voxels():
    groups = group_by_voxel(np.empty((0, 3), dtype=np.float32), 0.1)
    assert [len(groups.voxel_of_point), len(groups.first_point), len(groups.num_points)] == [0, 0, 0]


@given(st.integers(0, 5000), st.integers(1, 300))
def test_spread_rows_are_distinct_ascending_and_even(num_rows, max_rows):
    rows = spread_rows(num_rows, max_rows)
    assert len(rows) == min(num_rows, max_rows)
    if num_rows <= max_rows:
        np.testing.assert_array_equal(rows, np.arange(num_rows))
    else:
        gaps = np.diff(np.append(rows, num_rows))
        assert rows[0] == 0
        assert gaps.min() >= 1
        assert gaps.max() - gaps.min() <= 1


def test_few_points_are_spread_by_row():
    points = np.random.default_rng(0).normal(size=(999, 3))
    np.testing.assert_array_equal(spread_points(points, 96, dense_from=1000), spread_rows(999, 96))


@given(st.integers(1, 600), st.integers(1, 80), st.integers(0, 2**32 - 1))
def test_dense_points_speak_by_distinct_ascending_and_few_rows(num_points, max_rows, seed):
    points = np.random.default_rng(seed).normal(0, 5, (num_points, 3))
    rows = spread_points(points, max_rows, dense_from=0)
    assert np.isin(spread_rows(num_points, max_rows), rows).all()
    assert len(rows) <= min(num_points, max_rows + 2 * MAX_END_ROWS)
    assert (np.diff(rows) > 0).all()


@pytest.mark.parametrize("yaw", [0.0, 1.0, 2.5])
def test_both_ends_of_a_bus_abreast_are_heard(yaw):
    """Twelve metres of side with 20,000 points, most of them in its middle; a hundred at either end."""
    rng = np.random.default_rng(0)
    along = np.concatenate([np.clip(rng.normal(0, 1.2, 20_000), -5, 5), np.full(100, -6.0), np.full(100, 6.0)])
    points = np.column_stack([along * np.cos(yaw), along * np.sin(yaw), rng.uniform(0, 3, len(along))])
    rows = spread_points(points, 96, dense_from=1536)
    assert (along[rows] == -6).sum() >= MAX_END_ROWS
    assert (along[rows] == 6).sum() >= MAX_END_ROWS
    assert (np.abs(along[spread_rows(len(points), 96)]) == 6).sum() <= 2


def test_a_hundred_thousand_identical_points_are_as_few_as_any():
    assert len(spread_points(np.ones((100_000, 3)), 96, dense_from=1536)) <= 96 + 2 * MAX_END_ROWS
