import dataclasses

import numpy as np
import pytest

from labeling.geometry.boxes import transform_boxes
from labeling.geometry.transforms import rotate_vectors, wrap_angle, yaw_translation
from labeling.trajectories.windows import Horizon, cut_windows
from schemas.errors import InvalidInput

START_NS = 1_700_000_000_000_000_000
TIMES_S = np.arange(121) / 10


def test_a_car_on_a_circle_keeps_speed_and_curvature_in_its_own_frame(circling):
    windows = cut_windows(circling(TIMES_S), START_NS, Horizon(), max_gap_s=0.55)
    assert windows.is_valid.shape == (25, 91)
    whole = windows.is_valid.all(axis=1)
    assert whole.sum() == 7  # 1 s to 4 s
    arc = 8.0 / 20.0 * np.arange(-10, 81) / 10
    for window in np.flatnonzero(whole):
        x, y, z = windows.center_m[window].T
        np.testing.assert_allclose(x, 20 * np.sin(arc), atol=1e-9)
        np.testing.assert_allclose(y, 20 - 20 * np.cos(arc), atol=1e-9)
        np.testing.assert_allclose(z, 0, atol=1e-9)
        np.testing.assert_allclose(windows.yaw_rad[window], wrap_angle(arc), atol=1e-9)
        speed = np.linalg.norm(windows.velocity_mps[window], axis=1)
        np.testing.assert_allclose(speed, 8, atol=1e-9)
        turn = wrap_angle(np.diff(windows.yaw_rad[window]))
        np.testing.assert_allclose(turn / 0.1 / speed[1:], 1 / 20, atol=1e-9)


def test_at_its_anchor_an_object_is_at_the_origin_and_looks_ahead(circling):
    windows = cut_windows(circling(TIMES_S + 0.03), START_NS, Horizon(), max_gap_s=0.55)
    assert windows.anchor_timestamp_ns[0] == START_NS + 500_000_000
    now = windows.num_history
    np.testing.assert_allclose(windows.center_m[:, now], 0, atol=1e-9)
    np.testing.assert_allclose(windows.yaw_rad[:, now], 0, atol=1e-9)
    assert windows.is_valid[:, now].all()


def test_a_window_is_carried_back_by_its_anchor(circling):
    rows = circling(TIMES_S)
    windows = cut_windows(rows, START_NS, Horizon(), max_gap_s=0.55)
    for window, anchor_ns in enumerate(windows.anchor_timestamp_ns.tolist()):
        world_from_agent = yaw_translation(windows.anchor_yaw_rad[window], windows.anchor_center_m[window])
        first = (anchor_ns - START_NS) // 100_000_000 - 10
        for step in np.flatnonzero(windows.is_valid[window]):
            place = world_from_agent @ [*windows.center_m[window, step], 1]
            np.testing.assert_allclose(place[:3], rows.boxes[first + step, :3], atol=1e-8)
            velocity = rotate_vectors(world_from_agent, windows.velocity_mps[window, step])
            np.testing.assert_allclose(velocity, rows.velocity_mps[first + step], atol=1e-9)


@pytest.mark.parametrize("seed", range(3))
def test_where_the_world_lies_makes_no_difference(circling, seed):
    rng = np.random.default_rng(seed)
    rows = circling(np.sort(rng.uniform(0, 6, 60)))
    moved = yaw_translation(rng.uniform(-np.pi, np.pi), rng.uniform(-1000, 1000, 3))
    elsewhere = dataclasses.replace(
        rows, boxes=transform_boxes(moved, rows.boxes), velocity_mps=rotate_vectors(moved, rows.velocity_mps)
    )
    here, there = (cut_windows(each, START_NS, Horizon(), max_gap_s=0.55) for each in (rows, elsewhere))
    for name in ("is_valid", "is_observed", "score", "anchor_timestamp_ns"):
        np.testing.assert_array_equal(getattr(here, name), getattr(there, name))
    for name in ("center_m", "velocity_mps"):
        np.testing.assert_allclose(getattr(here, name), getattr(there, name), atol=1e-8)
    np.testing.assert_allclose(wrap_angle(here.yaw_rad - there.yaw_rad), 0, atol=1e-9)


def test_the_last_anchor_has_a_past_and_no_future(driving):
    windows = cut_windows(driving(np.arange(21) / 10), START_NS, Horizon(), max_gap_s=0.55)
    assert ((windows.anchor_timestamp_ns - START_NS) / 1e9).tolist() == [0.0, 0.5, 1.0, 1.5, 2.0]
    assert windows.is_valid[:, :10].sum(axis=1).tolist() == [0, 5, 10, 10, 10]
    assert windows.is_valid[:, 11:].sum(axis=1).tolist() == [20, 15, 10, 5, 0]


def test_a_gap_has_no_anchor_and_no_steps(driving):
    times_s = [time_s for time_s in np.arange(41) / 10 if not 1.05 < time_s < 2.05]
    windows = cut_windows(driving(times_s), START_NS, Horizon(), max_gap_s=0.55)
    assert ((windows.anchor_timestamp_ns - START_NS) / 1e9).tolist() == [0, 0.5, 1.0, 2.5, 3.0, 3.5, 4.0]
    at_start = windows.is_valid[0, 10:51]
    assert np.flatnonzero(~at_start).tolist() == list(range(11, 21))  # 1.1 s to 2.0 s
    np.testing.assert_allclose(windows.center_m[0, 10:51, 0][at_start], np.arange(41)[at_start], atol=1e-9)


def test_steps_and_anchors_are_asked_for(driving):
    horizon = Horizon(hz=5, step_s=1, history_s=2, future_s=3)
    windows = cut_windows(driving(np.arange(51) / 10), START_NS, horizon, max_gap_s=0.55)
    assert windows.is_valid.shape == (6, 26)
    np.testing.assert_allclose(windows.center_m[2, :, 0], 2 * np.arange(-10, 16), atol=1e-9)


def test_anchors_stand_on_one_clock_of_all_tracks(driving):
    horizon = Horizon()
    early, late = driving(np.arange(30) / 10), driving(np.arange(17, 60) / 10)
    anchors = [cut_windows(rows, START_NS, horizon, max_gap_s=0.55).anchor_timestamp_ns for rows in (early, late)]
    assert set(anchors[1].tolist()) & set(anchors[0].tolist()) == {START_NS + 2_000_000_000, START_NS + 2_500_000_000}
    # the clock may have begun after the track did: a lidar meets an object before its sweep's time stamp
    (before, *_) = cut_windows(early, START_NS + 700_000_000, horizon, max_gap_s=0.55).anchor_timestamp_ns
    assert before == START_NS + 200_000_000


def test_a_track_between_two_anchors_has_no_window(driving):
    windows = cut_windows(driving([0.1, 0.2, 0.3]), START_NS, Horizon(), max_gap_s=0.55)
    assert len(windows) == 0
    assert windows.is_valid.shape == (0, 91)


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"hz": 0.0}, "--hz 0: expected 0.1 to 100"),
        ({"hz": float("nan")}, "--hz nan: expected"),
        ({"step_s": -1.0}, "--step-s -1: expected"),
        ({"history_s": 0.15}, "--history-s 0.15: expected a whole number of steps of 1/10 s"),
        ({"future_s": 100.0}, "--future-s 100: expected 0 to 60"),
    ],
)
def test_values_out_of_range_are_refused(values, message):
    with pytest.raises(InvalidInput, match=f"^{message}"):
        Horizon(**values)
