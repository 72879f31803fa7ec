import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from labeling.stages.trajectory import Trajectory, interpolate_trajectory, smooth_trajectory

TIMES = np.arange(21) * 0.1


def on_line(times_s, velocity=(10.0, -2.0, 0.1)):
    return np.outer(times_s, velocity) + np.array([5, 6, 7])


def flow_of(times_s, velocity=(10.0, -2.0, 0.1)):
    return np.tile(velocity, (len(times_s), 1))


RIGHT, NONSENSE = flow_of(TIMES), flow_of(TIMES, (0.0, 9.0, 0.0))  # this one is not believed: poses alone are left
FLOWS = pytest.mark.parametrize("flows", [RIGHT, NONSENSE], ids=["right flow", "nonsense for flow"])


@pytest.mark.parametrize("is_smoothed", [True, False], ids=["smoothed", "as it is"])
@pytest.mark.parametrize(
    "times_s", [TIMES, TIMES[:2], TIMES[:3], np.array([0, 0.1, 0.9, 1.0, 4.0])], ids=["many", "two", "three", "gaps"]
)
def test_a_straight_line_stays_and_has_its_velocity(times_s, is_smoothed):
    yaws = np.full(len(times_s), 0.3)
    trajectory = smooth_trajectory(times_s, on_line(times_s), yaws, flow_of(times_s), is_smoothed=is_smoothed)
    np.testing.assert_allclose(trajectory.centers, on_line(times_s), atol=1e-6)
    np.testing.assert_allclose(trajectory.velocities, np.tile([10, -2, 0.1], (len(times_s), 1)), atol=1e-6)
    np.testing.assert_allclose(trajectory.yaws, 0.3, atol=1e-6)


def test_braking_is_followed():
    """4 m/s2: a parabola is what the window fits."""
    centers = np.column_stack([10 * TIMES - 2 * TIMES**2, 0 * TIMES, 0 * TIMES])
    flows = np.column_stack([10 - 4 * TIMES, 0 * TIMES, 0 * TIMES])
    trajectory = smooth_trajectory(TIMES, centers, np.zeros(21), flows, is_smoothed=True)
    np.testing.assert_allclose(trajectory.centers, centers, atol=1e-3)
    np.testing.assert_allclose(trajectory.velocities[:, 0], 10 - 4 * TIMES, atol=0.02)


@FLOWS
def test_noise_shrinks(flows):
    rng = np.random.default_rng(0)
    noisy = on_line(TIMES) + rng.normal(0, 0.1, (21, 3))
    trajectory = smooth_trajectory(TIMES, noisy, rng.normal(0, 0.05, 21), flows, is_smoothed=True)
    before, after = (np.linalg.norm(c - on_line(TIMES), axis=1).mean() for c in (noisy, trajectory.centers))
    assert after < 0.6 * before
    assert np.abs(trajectory.velocities[2:-2] - [10, -2, 0.1]).max() < 0.7
    assert trajectory.yaws.std() < 0.03


@FLOWS
def test_one_bad_pose_does_not_bend_the_way(flows):
    centers = on_line(TIMES)
    centers[10] += [0, 3.0, 0]
    trajectory = smooth_trajectory(TIMES, centers, np.zeros(21), flows, is_smoothed=True)
    np.testing.assert_allclose(trajectory.centers, on_line(TIMES), atol=0.15)
    raw = smooth_trajectory(TIMES, centers, np.zeros(21), flows, is_smoothed=False)
    np.testing.assert_array_equal(raw.centers, centers)


def test_flow_tells_the_speed_where_a_track_ends():
    """A parabola through noisy places is loose at its ends: flow halves its error, and adds none in the middle."""
    rng = np.random.default_rng(1)
    errors = []
    for _ in range(40):
        noisy = on_line(TIMES) + rng.normal(0, 0.1, (21, 3))
        for flows in (RIGHT + rng.normal(0, 0.3, (21, 3)), NONSENSE):
            velocity = smooth_trajectory(TIMES, noisy, np.zeros(21), flows, is_smoothed=True).velocities
            errors.append(np.abs(velocity - RIGHT).mean(axis=1))
    with_flow, without = np.mean(errors[::2], axis=0), np.mean(errors[1::2], axis=0)
    assert with_flow[[0, -1]].mean() < 0.5 * without[[0, -1]].mean()
    assert with_flow[8:13].mean() < without[8:13].mean()


def test_wrong_flow_does_not_bend_the_way():
    flows = flow_of(TIMES)
    flows[15:] = [2.0, 5.0, 0.0]
    trajectory = smooth_trajectory(TIMES, on_line(TIMES), np.zeros(21), flows, is_smoothed=True)
    np.testing.assert_allclose(trajectory.centers, on_line(TIMES), atol=0.05)
    np.testing.assert_allclose(trajectory.velocities, flow_of(TIMES), atol=0.6)


def test_headings_are_unwrapped_across_the_seam():
    yaws = np.pi - 0.2 + 0.4 * TIMES
    wrapped = (yaws + np.pi) % (2 * np.pi) - np.pi
    trajectory = smooth_trajectory(TIMES, on_line(TIMES), wrapped, flow_of(TIMES), is_smoothed=True)
    np.testing.assert_allclose(trajectory.yaws, yaws, atol=1e-6)
    between = interpolate_trajectory(trajectory, TIMES[:-1] + 0.05)
    np.testing.assert_allclose(between.yaws, yaws[:-1] + 0.02, atol=1e-6)


def test_one_pose_stands_still():
    trajectory = smooth_trajectory(
        np.zeros(1), np.array([[1.0, 2, 3]]), np.array([0.5]), np.zeros((1, 3)), is_smoothed=True
    )
    at = interpolate_trajectory(trajectory, np.array([-1.0, 0.0, 2.0]))
    np.testing.assert_array_equal(at.centers, np.tile([1.0, 2, 3], (3, 1)))
    np.testing.assert_array_equal(at.velocities, np.zeros((3, 3)))
    np.testing.assert_array_equal(at.yaws, [0.5] * 3)


@given(st.lists(st.floats(0.05, 5.0), min_size=1, max_size=8), st.integers(0, 2**32 - 1))
def test_at_its_own_times_a_trajectory_is_itself(gaps_s, seed):
    rng = np.random.default_rng(seed)
    times_s = np.cumsum([0.0, *gaps_s])
    size = len(times_s)
    own = Trajectory(times_s, rng.normal(0, 9, (size, 3)), rng.normal(0, 1, size), rng.normal(0, 9, (size, 3)))
    again = interpolate_trajectory(own, times_s)
    np.testing.assert_allclose(again.centers, own.centers, atol=1e-9)
    np.testing.assert_allclose(again.yaws, own.yaws, atol=1e-9)
    np.testing.assert_allclose(again.velocities, own.velocities, atol=1e-9)


def test_between_the_way_is_the_cubic_that_fits_both_ends():
    times_s = np.array([0.0, 0.4])
    centers = np.column_stack([10 * times_s - 2 * times_s**2, 3 * times_s, 0 * times_s])
    velocities = np.column_stack([10 - 4 * times_s, np.full(2, 3.0), np.zeros(2)])
    at = np.array([0.1, 0.2, 0.3])
    between = interpolate_trajectory(Trajectory(times_s, centers, np.zeros(2), velocities), at)
    np.testing.assert_allclose(between.centers, np.column_stack([10 * at - 2 * at**2, 3 * at, 0 * at]), atol=1e-9)
    np.testing.assert_allclose(between.velocities, np.column_stack([10 - 4 * at, 0 * at + 3, 0 * at]), atol=1e-9)


def test_over_a_long_silence_the_way_is_straight():
    ends = Trajectory(np.array([0.0, 8.0]), np.array([[0.0, 0, 0], [4.0, 0, 0]]), np.zeros(2), np.full((2, 3), 5.0))
    between = interpolate_trajectory(ends, np.array([2.0, 6.0]))
    np.testing.assert_allclose(between.centers, [[1, 0, 0], [3, 0, 0]], atol=1e-9)
    np.testing.assert_allclose(between.velocities, [[0.5, 0, 0]] * 2, atol=1e-9)


def test_ends_are_held():
    trajectory = smooth_trajectory(TIMES, on_line(TIMES), np.zeros(21), flow_of(TIMES), is_smoothed=False)
    outside = interpolate_trajectory(trajectory, np.array([-1.0, 5.0]))
    np.testing.assert_allclose(outside.centers, on_line(TIMES[[0, -1]]), atol=1e-9)
