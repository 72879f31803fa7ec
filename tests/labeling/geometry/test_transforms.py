import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from scipy.spatial.transform import Rotation

from labeling.geometry.transforms import (
    invert,
    rotate_vectors,
    rotation_from_quaternion,
    transform_points,
    wrap_angle,
    yaw_of,
    yaw_translation,
)

COORDINATES = st.floats(-1000, 1000)
ANGLES = st.floats(-100, 100)
VECTORS = hnp.arrays(np.float64, 3, elements=COORDINATES)
QUATERNIONS = hnp.arrays(np.float64, 4, elements=st.floats(-1, 1)).filter(lambda q: np.linalg.norm(q) > 1e-3)


@st.composite
def rigid_transforms(draw):
    transform = np.eye(4)
    transform[:3, :3] = Rotation.from_quat(draw(QUATERNIONS)).as_matrix()
    transform[:3, 3] = draw(VECTORS)
    return transform


@given(rigid_transforms())
def test_invert_undoes_and_leaves_its_input_alone(transform):
    before = transform.copy()
    np.testing.assert_allclose(invert(transform) @ transform, np.eye(4), atol=1e-9)  # 1e3 m times float64 rounding
    np.testing.assert_allclose(transform @ invert(transform), np.eye(4), atol=1e-9)
    np.testing.assert_array_equal(transform, before)


@given(rigid_transforms(), rigid_transforms(), hnp.arrays(np.float64, (5, 3), elements=COORDINATES))
def test_names_cancel_transforming_twice_is_transforming_by_the_product(world_from_ego, ego_from_object, points):
    there = transform_points(world_from_ego, transform_points(ego_from_object, points))
    np.testing.assert_allclose(there, transform_points(world_from_ego @ ego_from_object, points), atol=1e-8)


@given(rigid_transforms(), hnp.arrays(np.float64, (2, 3), elements=COORDINATES))
def test_a_vector_is_the_difference_of_two_points(transform, points):
    moved = transform_points(transform, points)
    np.testing.assert_allclose(rotate_vectors(transform, points[1] - points[0]), moved[1] - moved[0], atol=1e-8)


def test_known_quarter_turn_with_shift():
    transform = yaw_translation(np.pi / 2, np.array([10.0, 0.0, 1.0]))
    np.testing.assert_allclose(transform_points(transform, np.array([[1.0, 0.0, 0.0]])), [[10, 1, 1]], atol=1e-12)
    np.testing.assert_allclose(rotate_vectors(transform, np.array([1.0, 0.0, 5.0])), [0, 1, 5], atol=1e-12)


def test_float32_points_far_from_the_origin_keep_float64_precision():
    transform = yaw_translation(0.0, np.array([1e6, -1e6, 0.0]))
    points = np.array([[0.125, 0.0625, 1.5]], dtype=np.float32)
    np.testing.assert_array_equal(transform_points(transform, points), [[1e6 + 0.125, -1e6 + 0.0625, 1.5]])


def test_no_points_come_back_as_no_points():
    assert transform_points(np.eye(4), np.zeros((0, 3))).shape == (0, 3)


@given(ANGLES)
@example(-np.pi)
@example(np.pi)
@example(3 * np.pi)
@example(-3 * np.pi)
@example(0.0)
@example(-1e-300)
@example(np.nextafter(-np.pi, -4.0))
def test_wrap_angle_lands_in_the_half_open_interval_on_the_same_direction(angle):
    wrapped = float(wrap_angle(angle))
    assert -np.pi < wrapped <= np.pi
    assert np.cos(wrapped) == pytest.approx(np.cos(angle), abs=1e-9)
    assert np.sin(wrapped) == pytest.approx(np.sin(angle), abs=1e-9)


def test_wrap_angle_of_minus_pi_is_pi_also_in_arrays():
    np.testing.assert_array_equal(wrap_angle(np.array([-np.pi, np.pi, 0.0])), [np.pi, np.pi, 0.0])


@given(st.floats(-3.1, 3.1), VECTORS)
def test_yaw_of_reads_back_what_yaw_translation_wrote(yaw, translation):
    assert yaw_of(yaw_translation(yaw, translation)) == pytest.approx(yaw, abs=1e-12)


@given(QUATERNIONS, st.floats(0.1, 10))
def test_a_quaternion_of_any_length_turns_about_its_axis(quaternion, scale):
    rotation = rotation_from_quaternion(*(np.array([part]) for part in scale * quaternion))[0]
    w, *axis = quaternion / np.linalg.norm(quaternion)
    np.testing.assert_allclose(rotation @ axis, axis, atol=1e-9)
    assert np.trace(rotation) == pytest.approx(4 * w**2 - 1, abs=1e-9)  # 1 + 2 cos of the angle, whose half w tells
    twist = rotation - rotation.T
    np.testing.assert_allclose([twist[2, 1], twist[0, 2], twist[1, 0]], 4 * w * np.array(axis), atol=1e-9)


@pytest.mark.parametrize("parts", [(0, 0, 0, 0), (np.nan, 0, 0, 1), (np.inf, 0, 0, 1)], ids=["zero", "NaN", "infinite"])
def test_a_quaternion_without_a_direction_is_no_rotation_and_leaves_others_alone(parts):
    rotations = rotation_from_quaternion(*np.array([parts, (2.0, 0, 0, 0)]).T)
    assert np.isnan(rotations[0]).all()
    np.testing.assert_array_equal(rotations[1], np.eye(3))


def test_rotation_from_quaternion_of_a_batch_and_of_none():
    half = np.sqrt(0.5)
    w, z, zero = np.array([1.0, half]), np.array([0.0, half]), np.zeros(2)
    expected = [np.eye(3), [[0, -1, 0], [1, 0, 0], [0, 0, 1]]]
    np.testing.assert_allclose(rotation_from_quaternion(w, zero, zero, z), expected, atol=1e-12)
    assert rotation_from_quaternion(*np.zeros((4, 0))).shape == (0, 3, 3)
