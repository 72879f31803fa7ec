import numpy as np
import pytest

from labeling.trajectories.states import count_gaps, interpolate_track
from schemas.errors import InvalidInput
from schemas.objects import BOX_YAW

START_NS = 1_700_000_000_000_000_000


def at(*times_s):
    return START_NS + np.rint(np.array(times_s) * 1e9).astype(np.int64)


def test_at_its_own_time_stamps_a_track_is_its_rows(circling):
    times_s = np.sort(np.random.default_rng(0).uniform(0, 6, 40))  # no rate at all
    rows = circling(times_s)
    states = interpolate_track(rows, rows.timestamp_ns, max_gap_s=10)
    assert states.is_valid.all()
    np.testing.assert_array_equal(states.center_m, rows.boxes[:, :3])
    np.testing.assert_array_equal(states.velocity_mps, rows.velocity_mps)
    np.testing.assert_array_equal(states.score, rows.score)
    np.testing.assert_allclose(states.yaw_rad, rows.boxes[:, BOX_YAW], atol=1e-12)


def test_between_rows_places_are_linear_in_time(driving):
    rows = driving([0.0, 0.07, 0.2, 0.3], score=[0.8, 0.6, 1.0, 1.0])
    states = interpolate_track(rows, at(0.035, 0.1, 0.25), max_gap_s=0.5)
    np.testing.assert_allclose(states.center_m[:, 0], [0.35, 1.0, 2.5], atol=1e-9)
    np.testing.assert_allclose(states.velocity_mps, [[10, 0, 0]] * 3)
    np.testing.assert_allclose(states.score, [0.7, 0.6 + 0.4 * 3 / 13, 1.0])


def test_a_time_stamp_is_kept_to_the_nanosecond(make_rows):
    """As a float64 of today's nanoseconds it would be off by up to 128."""
    rows = make_rows([0, 1e-6], [[0, 0, 0], [1000, 0, 0]], [0, 0], np.zeros((2, 3)))
    states = interpolate_track(rows, START_NS + np.array([1, 999]), max_gap_s=1)
    np.testing.assert_allclose(states.center_m[:, 0], [1, 999], atol=1e-6)


@pytest.mark.parametrize(
    ("before", "after", "middle"), [(3.0, -3.0, np.pi), (-3.1, 3.0, -3.1 - 0.0915926536 + 2 * np.pi)]
)
def test_yaw_goes_the_shorter_way_across_the_seam(make_rows, before, after, middle):
    rows = make_rows([0, 0.1], np.zeros((2, 3)), [before, after], np.zeros((2, 3)))
    (yaw,) = interpolate_track(rows, at(0.05), max_gap_s=1).yaw_rad
    assert np.exp(1j * yaw) == pytest.approx(np.exp(1j * middle), abs=1e-9)
    assert -np.pi < yaw <= np.pi


def test_nothing_is_said_outside_of_a_track_and_in_a_gap(driving):
    rows = driving([0.0, 0.1, 1.1, 1.2])
    times_s = [-0.001, 0.0, 0.1, 0.101, 0.6, 1.099, 1.1, 1.15, 1.2, 1.201]
    states = interpolate_track(rows, at(*times_s), max_gap_s=0.55)
    assert states.is_valid.tolist() == [False, True, True, False, False, False, True, True, True, False]
    for values in (states.center_m, states.yaw_rad, states.velocity_mps, states.score, states.is_observed):
        assert not values[~states.is_valid].any()
    assert interpolate_track(rows, at(0.6), max_gap_s=1.0).is_valid.all()
    assert (count_gaps(rows, 0.55), count_gaps(rows, 1.0)) == (1, 0)


def test_a_state_is_observed_when_all_boxes_are_that_it_rests_on(driving):
    rows = driving([0.0, 0.1, 0.2, 0.3], is_observed=[True, True, False, True])
    states = interpolate_track(rows, at(0.05, 0.1, 0.15, 0.2, 0.25, 0.3), max_gap_s=1)
    assert states.is_observed.tolist() == [True, True, False, False, False, True]


def test_a_track_of_one_row_is_known_at_one_instant(driving):
    states = interpolate_track(driving([0.2]), at(0.1, 0.2, 0.3), max_gap_s=1)
    assert states.is_valid.tolist() == [False, True, False]


def test_a_track_in_two_places_at_once_is_refused(driving):
    with pytest.raises(InvalidInput, match="track car is in two places at one instant"):
        interpolate_track(driving([0.0, 0.1, 0.1]), at(0.0), max_gap_s=1)
