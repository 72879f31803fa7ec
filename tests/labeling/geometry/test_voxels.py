import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from labeling.geometry.voxels import group_by_voxel, spread_rows

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
