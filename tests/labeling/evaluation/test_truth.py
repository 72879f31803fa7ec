import numpy as np
import pytest

from labeling.evaluation.truth import (
    horizontal_speed_mps,
    is_ground_by_height,
    is_in_view,
    points_in_boxes,
    read_truth,
    sweep_point_truth,
)
from labeling.geometry.boxes import points_in_box
from schemas.frames import PointTruth

STEP_NS = 100_000_000


def test_points_in_boxes_equal_brute_force_with_the_margin():
    rng = np.random.default_rng(0)
    points = rng.uniform(-10, 10, (5000, 3)).astype(np.float32)
    boxes = np.column_stack([rng.uniform(-9, 9, (20, 3)), rng.uniform(0.3, 8, (20, 3)), rng.uniform(-3, 3, 20)])
    for rows, box in zip(points_in_boxes(points, boxes), boxes, strict=True):
        assert rows.tolist() == np.flatnonzero(points_in_box(points, box, 0.05)).tolist()


def test_a_box_is_grown_by_five_centimetres():
    box = np.array([[0, 0, 0, 2, 2, 2, 0.0]])
    rows = points_in_boxes(np.array([[1.04, 0, 0], [1.06, 0, 0]], dtype=np.float32), box)
    assert rows[0].tolist() == [0]


@pytest.mark.parametrize(
    ("times_s", "x_m", "expected"),
    [
        pytest.param([0, 0.1, 0.2, 0.3, 0.4], [0, 1, 2, 3, 4], [10] * 5, id="constant"),
        pytest.param([0, 0.1, 0.2, 0.3], [0, 0, 1, 3], [5, 10, 10, 15], id="one-sided at the ends"),
        pytest.param([0, 0.5, 1.0], [0, 1, 3], [2, 3, 4], id="sparser than the window"),
        pytest.param([0, 0.1, 0.35, 0.45], [0, 1, 3.5, 4.5], [10] * 4, id="uneven stamps"),
        pytest.param([7.0], [1], [0], id="seen once"),
    ],
)
def test_speed_is_the_central_difference_over_a_quarter_second(times_s, x_m, expected):
    centers = np.column_stack([x_m, np.zeros(len(x_m)), 7.0 * np.arange(len(x_m))])  # height does not count
    stamps = np.round(np.array(times_s) * 1e9).astype(np.int64)
    speed = horizontal_speed_mps(stamps, np.full(len(stamps), np.nan), centers)
    np.testing.assert_allclose(speed, expected, rtol=1e-9)


def test_speed_divides_by_the_time_between_captures():
    # The second view was caught 50 ms later in its turn: 1.5 m in 0.15 s.
    stamps = np.array([0, STEP_NS])
    centers = np.array([[0, 0, 0], [1.5, 0, 0.0]])
    np.testing.assert_allclose(horizontal_speed_mps(stamps, np.array([0.01, 0.06]), centers), 10)
    np.testing.assert_allclose(horizontal_speed_mps(stamps, np.array([np.nan, 0.06]), centers), 15)


def test_a_mover_needs_three_consecutive_fast_sweeps(kit):
    def stop_and_go(num_fast):  # runs from 1.0 s on for some sweeps; the difference spreads it by two each way
        return lambda t: 5.0 * float(np.clip(t - 1.0, 0, 0.1 * num_fast))

    log = kit.log(
        [kit.thing("hop", (5, 0), moves=stop_and_go(1)), kit.thing("car", (5, 5), speed_mps=5)], num_sweeps=20
    )
    truth = read_truth(log)
    assert dict(zip(truth.object_ids, truth.is_mover, strict=True)) == {"hop": True, "car": True}
    hop = truth.is_moving[truth.object_index == 0]
    assert np.flatnonzero(hop).tolist() == [9, 10, 11, 12]  # 0.5 m within +-0.2 s; paused before and after
    slow = kit.log([kit.thing("creeper", (5, 0), speed_mps=0.99)], num_sweeps=20)
    assert not read_truth(slow).is_mover.any()


def test_movers_of_a_pair_of_sweeps_are_fast_in_both(kit):
    log = kit.log([kit.thing("car", (5, 0), speed_mps=5), kit.thing("parked", (5, 5))], num_sweeps=2)
    assert read_truth(log).is_mover.tolist() == [True, False]


def test_annotations_between_the_sweeps_tell_who_moves(kit):
    # Two sweeps half a second apart show 0.5 m: 1 m/s at most. What lies between shows the burst.
    def dash(time_s):
        return 2.5 * float(np.clip(time_s - 0.1, 0, 0.2))

    whole = kit.log([kit.thing("walker", (5, 0), moves=dash)], num_sweeps=6)
    assert not read_truth(kit.pair_of(whole)).is_mover.any()
    between = kit.pair_of(whole, has_annotations_between=True)
    truth = read_truth(between)
    assert truth.is_mover.all()
    np.testing.assert_allclose(truth.speed_mps, read_truth(whole).speed_mps[[0, 5]])
    assert len(truth.num_points) == 2


def test_a_gap_in_the_annotations_breaks_no_run_but_an_absence_does(kit):
    log = kit.log([kit.thing("car", (5, 0), speed_mps=5)], num_sweeps=4, unannotated=(1,))
    assert read_truth(log).is_mover.all()  # three annotated sweeps, one after the other


def test_an_unreadable_sweep_borrows_from_its_neighbour(kit):
    log = kit.log([kit.thing("car", (5, 0), speed_mps=5)], num_sweeps=6, unreadable=(3,))
    truth = read_truth(log)
    assert truth.num_points.tolist() == [40] * 6
    assert truth.is_moving.all()
    np.testing.assert_allclose(truth.speed_mps, 5, rtol=1e-6)


def test_ground_is_low_above_the_cell_and_its_neighbours():
    points = np.array(
        [
            [0.5, 0.5, 0],
            [0.6, 0.5, 0.29],
            [0.6, 0.5, 0.31],
            [1.5, 0.5, 0.2],
            [2.5, 0.5, 1.0],
            [-0.5, -0.5, 0.5],
            [90, 0, 0],
        ],
        dtype=np.float32,
    )
    # The fifth has the fourth (0.2 m) beside it; the sixth touches the first cell's corner; the last is out of reach.
    assert is_ground_by_height(points).tolist() == [True, True, False, True, False, False, False]


def test_azimuth_is_measured_from_straight_ahead():
    points = np.array([[1, 0.8, 0], [1, 0.9, 0], [-1, 0, 0]])
    assert is_in_view(points, 40).tolist() == [True, False, False]
    assert is_in_view(points, None).all()


def test_points_of_a_turning_mover_flow_with_its_box(kit):
    log = kit.log([kit.thing("car", (10, 2), speed_mps=6, yaw=0.7)], ego_speed_mps=9)
    point_truth = sweep_point_truth(read_truth(log), log.read_sweep(3), None, None)
    expected = 0.6 * np.array([np.cos(0.7), np.sin(0.7), 0])
    np.testing.assert_allclose(point_truth.flow_ego_m[point_truth.is_moving], np.tile(expected, (40, 1)), atol=1e-5)
    assert point_truth.is_moving.sum() == point_truth.is_domain.sum() == 40  # the road under it is road


def test_the_last_sweep_has_no_flow_but_knows_who_moves(kit):
    log = kit.log([kit.thing("car", (10, 2), speed_mps=6)])
    point_truth = sweep_point_truth(read_truth(log), log.read_sweep(log.num_sweeps - 1), None, None)
    assert point_truth.flow_ego_m is None
    assert point_truth.is_moving.sum() == 40


def test_pointwise_truth_wins_where_it_is_finite(kit):
    log = kit.log([kit.thing("car", (10, 2), speed_mps=6)])
    sweep = log.read_sweep(0)
    flow = np.full((sweep.num_points, 3), np.nan, dtype=np.float32)
    flow[:10] = [0.02, 0, 0]  # a door that stays behind: 0.2 m/s
    told = PointTruth(flow_ref_m=flow, is_ground=np.zeros(sweep.num_points, dtype=bool))
    point_truth = sweep_point_truth(read_truth(log), sweep, told, None)
    np.testing.assert_allclose(point_truth.flow_ego_m[:10], flow[:10])
    np.testing.assert_allclose(point_truth.flow_ego_m[10:40], np.tile([0.6, 0, 0], (30, 1)), atol=1e-5)
    assert not point_truth.is_moving[:10].any()
    assert point_truth.is_moving[10:40].all()
    assert point_truth.is_domain.all()  # its ground flags win as well


def test_without_boxes_only_told_points_count(kit):
    log = kit.log([kit.thing("car", (10, 2), speed_mps=6)], unannotated=tuple(range(8)))
    sweep = log.read_sweep(0)
    flow = np.zeros((sweep.num_points, 3), dtype=np.float32)
    flow[5:] = np.nan
    told = PointTruth(flow_ref_m=flow, is_ground=np.zeros(sweep.num_points, dtype=bool))
    truth = read_truth(log)
    assert sweep_point_truth(truth, sweep, None, None) is None
    assert sweep_point_truth(truth, sweep, told, None).is_domain.sum() == 5
