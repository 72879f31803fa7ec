import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from labeling.geometry.axes import depth_along, long_axes

CLOUDS = hnp.arrays(np.float64, st.tuples(st.integers(1, 30), st.just(3)), elements=st.floats(-30, 30, width=32))


@given(CLOUDS, CLOUDS)
def test_each_group_has_the_axes_of_its_own_points(first, second):
    points = np.concatenate([first, second])
    axes = long_axes(points, np.repeat([0, 1], [len(first), len(second)]))
    for k, cloud in enumerate((first, second)):
        offset = cloud[:, :2] - cloud[:, :2].mean(axis=0)
        across_m2, along_m2 = np.linalg.eigvalsh(offset.T @ offset)
        np.testing.assert_allclose([axes.across_m2[k], axes.along_m2[k]], [across_m2, along_m2], atol=1e-6)
        np.testing.assert_allclose(((offset @ axes.direction[k]) ** 2).sum(), along_m2, atol=1e-6)


@pytest.mark.parametrize("yaw", [0.0, 0.7, 1.5, 3.0])
def test_a_stick_is_long_along_itself(yaw):
    heading = np.array([np.cos(yaw), np.sin(yaw)])
    rng = np.random.default_rng(0)
    stick = np.outer(rng.uniform(-2, 2, 200), heading) + np.outer(
        rng.uniform(-0.2, 0.2, 200), [-heading[1], heading[0]]
    )
    axes = long_axes(np.column_stack([stick + 5e4, rng.uniform(0, 9, 200)]))
    assert abs(axes.direction[0] @ heading) == pytest.approx(1, abs=1e-3)
    assert axes.is_long(9.0)
    assert not axes.is_long(11.0)


@pytest.mark.parametrize("cloud", [np.ones((1, 3)), np.ones((9, 3)), np.outer(np.ones(3), [5e4, 1, 1])])
def test_one_place_is_not_long(cloud):
    axes = long_axes(cloud)
    assert not axes.is_long(3.0)
    np.testing.assert_allclose(np.linalg.norm(axes.direction), 1)


def test_depth_counts_from_one_end_to_the_other():
    points = np.outer([3.0, 0.0, 1.0, 5.0], [0.6, 0.8, 0.0]).astype(np.float32)
    depth_m = depth_along(points)
    assert depth_m.tolist() == pytest.approx([3, 0, 1, 5]) or depth_m.tolist() == pytest.approx([2, 5, 4, 0])
