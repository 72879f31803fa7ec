import numpy as np
import pytest

from labeling.stages.pieces import find_leaders
from schemas.lidars import Beams, Lidar
from schemas.objects import Clusters

FAST = np.array([8.0, 0.0, 0.0])
LIDAR = Lidar((0.0, 0.0, 0.0), 0.0035, 0.0046, 0.02)


def beams_of(points):
    return Beams((LIDAR,), np.zeros(len(points), np.uint8))


def cluster_up(*clouds):
    sizes = [len(cloud) for cloud in clouds]
    return np.concatenate(clouds).astype(np.float32), Clusters(np.arange(sum(sizes)), np.cumsum([0, *sizes]))


def blob(center, num_points, seed=0):
    return np.random.default_rng(seed).uniform(-0.5, 0.5, (num_points, 3)) * 0.4 + center


def leaders(clouds, velocities, explained, is_still=None):
    """``explained[c][k]``: how well the velocity of cluster k explains cluster c, in each other sweep or in all."""
    points, clusters = cluster_up(*clouds)
    velocities = np.array(velocities, dtype=np.float64)

    def judge(which, velocity_mps):
        motion = [int(np.flatnonzero((velocities == v).all(axis=1))[0]) for v in velocity_mps]
        return np.array([np.atleast_1d(explained[c][k]) for c, k in zip(which.tolist(), motion, strict=True)])

    is_still = np.zeros(len(clouds), dtype=bool) if is_still is None else np.array(is_still)
    return find_leaders(points, beams_of(points), clusters, velocities, is_still, judge).tolist()


CAR, SHRED, OTHER = blob((0, 0, 1), 400), blob((0.9, 0, 1), 12), blob((-0.9, 0, 1), 300)


@pytest.mark.parametrize(("by_its_own", "by_the_car", "leader"), [(0.02, 0.12, 0), (0.02, 0.3, 1), (0.3, 0.31, 0)])
def test_a_shred_goes_with_the_car_where_that_explains_it(by_its_own, by_the_car, leader):
    explained = [[0.03, 0.4], [by_the_car, by_its_own]]
    assert leaders([CAR, SHRED], [FAST, (-20, 5, 1)], explained) == [0, leader]


def test_what_has_points_enough_to_tell_keeps_a_motion_that_explains_it_better():
    beside = blob((0.9, 0, 1), 100)
    assert leaders([CAR, beside], [FAST, (1.4, 0, 0)], [[0.03, 0.4], [0.12, 0.02]]) == [0, 1]
    assert leaders([CAR, beside], [FAST, (7.6, 0, 0)], [[0.03, 0.04], [0.03, 0.02]]) == [0, 0]


def test_of_two_the_one_that_explains_it_better_leads():
    clouds, velocities = [CAR, OTHER, blob((0, 0.4, 1), 12)], [FAST, (-6, 0, 0), (3, 3, 3)]
    assert leaders(clouds, velocities, [[0, 1, 1], [1, 0, 1], [0.1, 0.05, 0.01]]) == [0, 1, 1]
    assert leaders(clouds, velocities, [[0, 1, 1], [1, 0, 1], [0.05, 0.1, 0.01]]) == [0, 1, 0]


def test_a_leader_is_judged_in_the_sweeps_that_show_the_piece():
    """A cyclist 60 m ahead beside a car: in half of the sweeps the car's motion leaves him without a place."""
    rider = blob((60.9, 0, 1), 12)
    alone, by_the_car = [0.1, 0.1, 0.1, 0.1], [0.35, 0.5, 0.35, 0.5]
    far_car = CAR + np.array([60, 0, 0])
    assert leaders([far_car, rider], [FAST, (5, 0, 0)], [[[0.1] * 4] * 2, [by_the_car, alone]]) == [0, 1]
    nowhere = [0.5, 0.5, 0.5, 0.5]  # seen in two sweeps only, whatever it does
    twice = [0.1, 0.5, 0.1, 0.5]
    assert leaders([CAR, SHRED], [FAST, (5, 0, 0)], [[twice, nowhere], [twice, twice]]) == [0, 0]


def test_a_leader_that_is_led_passes_its_leader_on():
    clouds = [CAR, blob((0.9, 0, 1), 60), blob((1.8, 0, 1), 12)]
    explained = [[0.02, 0.4, 0.4], [0.02, 0.02, 0.4], [0.4, 0.05, 0.02]]
    assert leaders(clouds, [FAST, (3, 0, 0), (-9, 9, 0)], explained) == [0, 0, 0]


def test_what_stands_neither_leads_nor_is_led():
    explained = [[0.0, 0.0], [0.0, 0.0]]
    assert leaders([CAR, SHRED], [FAST, (0, 0, 0)], explained, [False, True]) == [0, 1]
    assert leaders([CAR, SHRED], [(0, 0, 0), FAST], explained, [True, False]) == [0, 1]


def test_what_is_apart_or_about_as_large_is_not_led():
    far = blob((3, 0, 1), 12)
    assert leaders([CAR, far], [FAST, (3, 3, 0)], np.zeros((2, 2))) == [0, 1]
    assert leaders([CAR, OTHER], [FAST, (-8, 0, 0)], np.zeros((2, 2))) == [0, 1]
    assert leaders([SHRED, SHRED + np.array([0.5, 0, 0])], [FAST, (3, 3, 0)], np.zeros((2, 2))) == [0, 1]


def test_no_clusters_have_no_leaders():
    nobody = Clusters(np.empty(0, np.int64), np.zeros(1, np.int64))
    nothing, empty = np.empty((0, 3)), np.empty((0, 3), dtype=np.float32)
    found = find_leaders(empty, beams_of(empty), nobody, nothing, np.empty(0, bool), lambda c, v: np.zeros((len(c), 1)))
    assert len(found) == 0
