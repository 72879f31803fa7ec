import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from labeling.geometry.boxes import (
    bev_corners,
    bev_intersection_m2,
    bev_iou,
    iou_3d,
    overlap_of_smaller,
    points_in_box,
    tight_box,
    to_box_frame,
    transform_boxes,
)
from labeling.geometry.transforms import yaw_translation

YAWS = st.floats(-np.pi, np.pi)


@st.composite
def box_arrays(draw, max_boxes=4):
    number = draw(st.integers(1, max_boxes))
    center = hnp.arrays(np.float64, (number, 3), elements=st.floats(-5, 5))
    size = hnp.arrays(np.float64, (number, 3), elements=st.floats(0.3, 8))
    yaw = hnp.arrays(np.float64, (number, 1), elements=YAWS)
    return np.hstack([draw(center), draw(size), draw(yaw)])


def box(x=0.0, y=0.0, z=0.0, length=4.0, width=2.0, height=1.5, yaw=0.0):
    return np.array([[x, y, z, length, width, height, yaw]])


SQUARE = box(length=1.0, width=1.0, height=1.0)


def test_corners_come_in_the_order_that_is_drawn():
    front_left, rear_left, rear_right, front_right = [2, 1], [-2, 1], [-2, -1], [2, -1]
    np.testing.assert_allclose(bev_corners(box())[0], [front_left, rear_left, rear_right, front_right])
    turned = bev_corners(box(x=10.0, yaw=np.pi / 2))[0]  # heading +y: front left is at -x
    np.testing.assert_allclose(turned, [[9, 2], [9, -2], [11, -2], [11, 2]], atol=1e-12)


@given(box_arrays())
def test_corners_run_anticlockwise_around_the_centre(boxes):
    corners = bev_corners(boxes)
    following = np.roll(corners, -1, axis=1)
    area = (corners[..., 0] * following[..., 1] - corners[..., 1] * following[..., 0]).sum(axis=1) / 2  # shoelace
    np.testing.assert_allclose(area, boxes[:, 3] * boxes[:, 4], rtol=1e-9)
    np.testing.assert_allclose(corners.mean(axis=1), boxes[:, :2], atol=1e-9)


def test_points_in_box_known_answers():
    car = box(x=10.0, y=5.0, z=1.0, yaw=np.pi / 2)[0]  # 4 m along y, 2 m along x, z from 0.25 to 1.75
    points = np.array([[10, 5, 1], [10, 6.99, 1], [10, 7.01, 1], [10.99, 5, 1], [11.01, 5, 1], [10, 5, 1.8]])
    np.testing.assert_array_equal(points_in_box(points, car), [True, True, False, True, False, False])


def test_points_in_box_with_margin_grows_every_side():
    points = np.array([[2.04, 0, 0], [2.06, 0, 0], [0, -1.04, 0], [0, -1.06, 0], [0, 0, 0.79], [0, 0, -0.81]])
    np.testing.assert_array_equal(points_in_box(points, box()[0], 0.05), [True, False, True, False, True, False])
    assert not points_in_box(points, box()[0]).any()


def test_a_corner_of_a_diagonal_box_with_margin_is_inside():
    diagonal = box(yaw=np.pi / 4)[0]
    corner_xy = bev_corners(diagonal[None])[0] * 1.0001
    corners = np.column_stack([corner_xy, np.zeros(4)])
    assert points_in_box(corners, diagonal, 0.01).all()
    assert not points_in_box(corners, diagonal).any()


def test_no_points_are_in_no_box():
    assert points_in_box(np.zeros((0, 3), dtype=np.float32), box()[0]).shape == (0,)


@given(box_arrays(max_boxes=1), hnp.arrays(np.float64, (30, 3), elements=st.floats(-8, 8)), st.floats(0, 1))
def test_points_in_box_equals_the_plain_definition(boxes, points, margin_m):
    local = to_box_frame(points, boxes[0])
    expected = (np.abs(local) <= boxes[0, 3:6] / 2 + margin_m).all(axis=1)
    np.testing.assert_array_equal(points_in_box(points, boxes[0], margin_m), expected)


@pytest.mark.parametrize(
    ("other", "expected_bev", "expected_3d"),
    [
        pytest.param(box(), 1.0, 1.0, id="identical"),
        pytest.param(box(yaw=np.pi), 1.0, 1.0, id="turned-round"),
        pytest.param(box(x=2.0), 1 / 3, 1 / 3, id="half-overlap"),
        pytest.param(box(y=2.0), 0.0, 0.0, id="side-by-side"),
        pytest.param(box(x=50.0), 0.0, 0.0, id="far"),
        pytest.param(box(yaw=np.pi / 2), 4 / 12, 4 / 12, id="crossed"),  # shared 2 x 2 of 8 + 8 - 4
        pytest.param(box(z=0.75), 1.0, 1 / 3, id="half-higher"),
        pytest.param(box(z=1.5), 1.0, 0.0, id="on-top"),
        pytest.param(box(z=9.0), 1.0, 0.0, id="above"),
        pytest.param(box(length=2.0, width=1.0, height=0.75), 1 / 4, 1 / 8, id="inside"),
    ],
)
def test_iou_known_answers(other, expected_bev, expected_3d):
    assert bev_iou(box(), other)[0, 0] == pytest.approx(expected_bev, abs=1e-12)
    assert iou_3d(box(), other)[0, 0] == pytest.approx(expected_3d, abs=1e-12)


@pytest.mark.parametrize("yaw", [np.pi / 2, -np.pi / 2, np.pi], ids=["left", "right", "back"])
def test_a_square_turned_by_right_angles_is_itself(yaw):
    turned = box(length=1.0, width=1.0, height=1.0, yaw=yaw)
    assert bev_iou(SQUARE, turned)[0, 0] == pytest.approx(1.0)
    assert iou_3d(SQUARE, turned)[0, 0] == pytest.approx(1.0)


def test_a_square_turned_by_45_degrees_shares_a_regular_octagon():
    octagon_m2 = 2 * (np.sqrt(2) - 1)  # of inner diameter 1
    turned = box(length=1.0, width=1.0, height=1.0, yaw=np.pi / 4)
    assert bev_intersection_m2(SQUARE, turned)[0, 0] == pytest.approx(octagon_m2)
    assert bev_iou(SQUARE, turned)[0, 0] == pytest.approx(octagon_m2 / (2 - octagon_m2))


@pytest.mark.parametrize("iou", [bev_iou, iou_3d])
def test_iou_of_nothing_and_of_flat_boxes(iou):
    assert iou(np.zeros((0, 7)), box()).shape == (0, 1)
    assert iou(box(), np.zeros((0, 7))).shape == (1, 0)
    flat = box(length=0.0, width=0.0, height=0.0)
    assert iou(flat, flat)[0, 0] == 0.0


@given(box_arrays(), box_arrays())
@pytest.mark.parametrize("iou", [bev_iou, iou_3d])
def test_iou_is_symmetric_bounded_and_one_with_itself(iou, boxes_a, boxes_b):
    overlap = iou(boxes_a, boxes_b)
    np.testing.assert_allclose(overlap, iou(boxes_b, boxes_a).T, atol=1e-9)
    assert ((overlap >= 0) & (overlap <= 1 + 1e-9)).all()
    np.testing.assert_allclose(np.diag(iou(boxes_a, boxes_a)), 1.0, rtol=1e-9)


@given(box_arrays(), box_arrays(), YAWS, hnp.arrays(np.float64, 3, elements=st.floats(-100, 100)))
@pytest.mark.parametrize("iou", [bev_iou, iou_3d])
def test_iou_does_not_care_where_the_world_is(iou, boxes_a, boxes_b, yaw, translation):
    motion = yaw_translation(yaw, translation)
    moved = iou(transform_boxes(motion, boxes_a), transform_boxes(motion, boxes_b))
    np.testing.assert_allclose(moved, iou(boxes_a, boxes_b), atol=1e-8)


@pytest.mark.parametrize(
    ("other", "expected"),
    [
        ([0, 0, 0, 4, 2, 2, 0], 1.0),
        ([2, 0, 0, 4, 2, 2, 0], 0.5),
        ([1, 0.5, 0, 1, 1, 2, 0], 1.0),  # a part of it
        ([0, 0, 1.5, 4, 2, 2, 0], 1.0),  # it is seen from above
        ([0, 0, 2.1, 4, 2, 2, 0], 0.0),  # but what is higher does not touch it
        ([9, 0, 0, 4, 2, 2, 0], 0.0),
        ([0, 0, 0, 0, 0, 2, 0], 0.0),
    ],
)
def test_overlap_of_smaller_known_answers(other, expected):
    box, others = np.array([[0, 0, 0, 4, 2, 2, 0.0]]), np.array([other], dtype=np.float64)
    assert overlap_of_smaller(box, others)[0, 0] == pytest.approx(expected)
    assert overlap_of_smaller(others, box)[0, 0] == pytest.approx(expected)


@given(box_arrays(), YAWS, hnp.arrays(np.float64, 3, elements=st.floats(-100, 100)))
def test_transform_boxes_carries_corners_along_and_keeps_yaw_in_range(boxes, yaw, translation):
    motion = yaw_translation(yaw, translation)
    moved = transform_boxes(motion, boxes)
    expected = bev_corners(boxes) @ motion[:2, :2].T + motion[:2, 3]
    np.testing.assert_allclose(bev_corners(moved), expected, atol=1e-9)
    np.testing.assert_array_equal(moved[:, 3:6], boxes[:, 3:6])
    assert ((moved[:, 6] > -np.pi) & (moved[:, 6] <= np.pi)).all()


@given(hnp.arrays(np.float64, st.tuples(st.integers(1, 20), st.just(3)), elements=st.floats(-50, 50)), YAWS)
def test_tight_box_holds_all_points_and_touches_them_on_every_side(points, yaw):
    tight = tight_box(points, yaw)
    assert points_in_box(points, tight, 1e-9).all()
    local = to_box_frame(points, tight)
    np.testing.assert_allclose(local.max(axis=0), tight[3:6] / 2, atol=1e-9)
    np.testing.assert_allclose(local.min(axis=0), -tight[3:6] / 2, atol=1e-9)
    assert -np.pi < tight[6] <= np.pi


@given(box_arrays(max_boxes=1))
def test_tight_box_of_a_boxs_corners_is_that_box(boxes):
    bev = bev_corners(boxes)[0]
    z, half = boxes[0, 2], boxes[0, 5] / 2
    corners = np.vstack([np.column_stack([bev, np.full(4, z + sign * half)]) for sign in (-1, 1)])
    np.testing.assert_allclose(tight_box(corners, boxes[0, 6])[:6], boxes[0, :6], atol=1e-9)


def test_tight_box_of_one_point_is_that_point():
    np.testing.assert_allclose(tight_box(np.array([[1.0, 2.0, 3.0]]), 0.5), [1, 2, 3, 0, 0, 0, 0.5], atol=1e-12)


@pytest.mark.parametrize(
    "box",
    [[25.8, 1.3, 0, 10.9, 1.2, 1, -1.4], [-6.8, 1.2, 0, 11.1, 2.2, 1, 3.0], [-49.6, 1.7, 0, 4.4, 0.5, 1, 1.3]],
    ids=str,
)
def test_boxes_equal_but_for_the_last_bit_overlap_wholly(box):
    # Exact overlay of such pairs may collapse to two points.
    boxes = np.array([box], dtype=np.float64)
    other = boxes.copy()
    other[0, 1] = np.nextafter(other[0, 1], 99)
    assert bev_iou(boxes, other)[0, 0] == pytest.approx(1, abs=1e-5)
    assert iou_3d(boxes, other)[0, 0] == pytest.approx(1, abs=1e-5)
