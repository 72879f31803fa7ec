import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from labeling.evaluation.flow import FlowSums, flow_figures, static_figures, sum_flow, sum_static
from labeling.evaluation.truth import SweepPointTruth
from labeling.geometry.transforms import rotate_vectors, yaw_translation

GAP_S = 0.1


def make_truth(flow, is_moving=None, is_domain=None, is_in_box=None):
    flow = np.asarray(flow, dtype=np.float64).reshape(-1, 3)
    size = len(flow)
    return SweepPointTruth(
        is_domain=np.ones(size, bool) if is_domain is None else np.asarray(is_domain, bool),
        is_in_box=np.zeros(size, bool) if is_in_box is None else np.asarray(is_in_box, bool),
        is_moving=np.linalg.norm(flow, axis=1) > 0.1 if is_moving is None else np.asarray(is_moving, bool),
        flow_ego_m=flow,
    )


def figures(truth, predicted):
    return flow_figures(sum_flow(truth, np.asarray(predicted, dtype=np.float64).reshape(-1, 3), GAP_S))


def test_flow_of_five_metres_in_a_standing_scene_is_five_metres_wrong():
    result = figures(make_truth(np.zeros((50, 3))), np.tile([3, 4, 0], (50, 1)))
    assert result.epe3d_m == result.standing_epe_m == 5
    assert result.acc5 == result.acc10 == 0
    assert result.false_motion == 1
    assert result.moving_epe_m is result.theta_rad is None


def test_zero_flow_scores_the_truth_displacement():
    result = figures(make_truth([[1, 0, 0], [0, 3, 0], [0, 0, 0]]), np.zeros((3, 3)))
    assert result.moving_epe_m == 2
    assert result.normalised_moving_epe == 1
    assert result.theta_rad == pytest.approx(np.pi / 2)
    assert result.standing_epe_m == 0


@pytest.mark.parametrize(
    ("true_m", "error_m", "acc5", "acc10"),
    [
        pytest.param(0, 0.049, 1, 1, id="absolute 5 cm"),
        pytest.param(0, 0.051, 0, 1, id="absolute 10 cm"),
        pytest.param(2, 0.09, 1, 1, id="relative 5 %"),
        pytest.param(2, 0.19, 0, 1, id="relative 10 %"),
        pytest.param(2, 0.21, 0, 0, id="beyond"),
    ],
)
def test_accuracy_is_absolute_or_relative(true_m, error_m, acc5, acc10):
    result = figures(make_truth([[true_m, 0, 0]]), [[true_m + error_m, 0, 0]])
    assert (result.acc5, result.acc10) == (acc5, acc10)


def test_angle_errors_are_averaged_over_moving_points():
    truth = make_truth([[1, 0, 0], [1, 0, 0], [1, 0, 0], [0, 0, 0]])
    result = figures(truth, [[2, 0, 0], [0, 1, 0], [-1, 0, 0], [0, 5, 0]])
    assert result.theta_rad == pytest.approx((0 + np.pi / 2 + np.pi) / 3)


def test_speed_classes_by_hand_and_rare_ones_stay_out_of_the_mean():
    true = np.zeros((1700, 3))
    true[1000:1500, 0] = 0.5  # 5 m/s
    true[1500:, 0] = 2.0  # 20 m/s
    predicted = true.copy()
    predicted[:250, 0] = 0.5
    result = figures(make_truth(true), predicted)
    assert result.speed_num_points == (1000, 500, 0, 0, 0, 200)
    assert result.speed_iou == (0.75, 500 / 750, None, None, None, 1.0)
    assert result.mean_speed_iou == 0.75  # only the first class has 1,000 truth points


def test_points_outside_the_domain_and_of_unknown_flow_do_not_count():
    truth = make_truth([[0, 0, 0], [np.nan] * 3, [0, 0, 0]], is_moving=[0, 1, 0], is_domain=[1, 1, 0])
    result = figures(truth, [[0, 0, 0], [9, 9, 9], [9, 9, 9]])
    assert result.num_points == 1
    assert result.epe3d_m == 0


def test_static_removal_by_hand():
    #         in box: standing called, standing kept, moving called, moving kept; elsewhere: standing called, called
    moving, called, in_box = [0, 0, 1, 1, 0, 0], [1, 0, 1, 0, 1, 1], [1, 1, 1, 1, 0, 0]
    truth = make_truth(np.zeros((6, 3)), is_moving=moving, is_in_box=in_box)
    result = static_figures(sum_static(truth, np.array(called, dtype=bool)))
    assert (result.in_box_precision, result.in_box_recall) == (0.5, 0.5)
    assert (result.scene_precision, result.scene_recall) == (0.75, 0.75)
    assert result.moving_lost == 0.5


flows = arrays(np.float64, (6, 3), elements=st.floats(-3, 3, width=32))


@given(true=flows, predicted=flows, yaw=st.floats(-3, 3))
def test_turning_the_world_changes_nothing(true, predicted, yaw):
    turn = yaw_translation(yaw, np.zeros(3))
    moving = [True] * 3 + [False] * 3
    plain = sum_flow(make_truth(true, moving), predicted, GAP_S)
    turned = sum_flow(make_truth(rotate_vectors(turn, true), moving), rotate_vectors(turn, predicted), GAP_S)
    assert turned.error_m == pytest.approx(plain.error_m)
    assert turned.moving_displacement_m == pytest.approx(plain.moving_displacement_m)
    assert turned.standing_error_m == pytest.approx(plain.standing_error_m)


@given(true=flows, predicted=flows, split=st.integers(0, 6))
def test_pooling_parts_is_scoring_the_whole(true, predicted, split):
    whole = sum_flow(make_truth(true), predicted, GAP_S)
    parts = FlowSums() + sum_flow(make_truth(true[:split]), predicted[:split], GAP_S)
    parts += sum_flow(make_truth(true[split:]), predicted[split:], GAP_S)
    assert parts.num_points == whole.num_points
    assert parts.error_m == pytest.approx(whole.error_m)
    assert (np.asarray(parts.confusion) == whole.confusion).all()
    assert parts.num_acc5 == whole.num_acc5


def test_nothing_to_average_is_none_not_a_division_by_zero():
    result = flow_figures(FlowSums())
    assert result.epe3d_m is result.mean_speed_iou is result.false_motion is None
