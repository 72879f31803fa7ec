import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from labeling.geometry.transforms import transform_points, yaw_translation
from labeling.stages.walkers import part_walkers

RESOLUTION_M, SPEED_MPS = 0.08, 1.4  # at 20 m


def walker(place=(0.0, 0.0), num_points=40, seed=0, height_m=1.75):
    """Return points on a trunk that is half a metre wide, 0.2 m deep and faces along x."""
    points = np.random.default_rng(seed).uniform([-0.1, -0.25, 0.2], [0.1, 0.25, height_m], (num_points, 3))
    return (points + np.append(place, 0.0)).astype(np.float32)


def sizes(points, resolution_m=RESOLUTION_M, speed_mps=SPEED_MPS):
    return [len(rows) for rows in part_walkers(points, resolution_m, speed_mps)]


PAIR = np.concatenate([walker((0, 0.5)), walker((0.1, -0.5), 30, seed=1)])


def test_two_people_side_by_side_are_two_and_three_are_three():
    groups = part_walkers(PAIR, RESOLUTION_M, SPEED_MPS)
    assert [sorted(rows) for rows in groups] in (
        [list(range(40)), list(range(40, 70))],
        [list(range(40, 70)), list(range(40))],
    )
    assert sorted(sizes(np.concatenate([PAIR, walker((0, 1.5), 20)]))) == [20, 30, 40]


@pytest.mark.parametrize(
    ("points", "speed_mps"),
    [
        (walker(), SPEED_MPS),
        (np.concatenate([walker((0, 0.3)), walker((0, -0.3))]), SPEED_MPS),
        (PAIR, 3.5),
        (PAIR * np.float32([1, 1, 2]), SPEED_MPS),
        (PAIR * np.float32([1, 4, 1]), SPEED_MPS),
        (np.concatenate([walker(), walker((0, 1), 4)]), SPEED_MPS),
        (np.zeros((100, 3), dtype=np.float32), SPEED_MPS),
        (walker(num_points=1), SPEED_MPS),
        (np.concatenate([walker(), walker((0, 1)) * np.float32([0.5, 0, 1])]), SPEED_MPS),
    ],
    ids=[
        "one",
        "arm in arm",
        "faster than walkers",
        "higher",
        "larger",
        "and a few points",
        "all equal",
        "one point",
        "and a sliver",
    ],
)
def test_anything_else_stays_one(points, speed_mps):
    assert sizes(points, speed_mps=speed_mps) == [len(points)]


def test_only_heads_and_shoulders_over_a_parked_car_are_enough():
    assert sorted(sizes(PAIR[PAIR[:, 2] > 1.2])) == sorted([(PAIR[:40, 2] > 1.2).sum(), (PAIR[40:, 2] > 1.2).sum()])


def test_far_away_a_gap_must_be_wider_than_the_beams_are_apart():
    gap_m = 0.34
    pair = np.concatenate([walker((0, 0.25 + gap_m / 2), 400), walker((0, -0.25 - gap_m / 2), 400)])
    assert sizes(pair, resolution_m=RESOLUTION_M) == [400, 400]
    assert sizes(pair, resolution_m=3 * RESOLUTION_M) == [800]


def test_points_between_two_people_go_to_the_nearer_one():
    stray = np.float32([[0.9, 0.45, 1.0], [-0.9, -0.4, 1.0]])
    groups = part_walkers(np.concatenate([PAIR, stray]), RESOLUTION_M, SPEED_MPS)
    of_row = {row: k for k, rows in enumerate(groups) for row in rows.tolist()}
    assert len(groups) == 2
    assert of_row[70] == of_row[0]
    assert of_row[71] == of_row[40]


@given(st.floats(-3.1, 3.1), st.integers(0, 1000))
def test_each_row_is_in_one_group_whatever_the_order_and_the_direction(yaw, seed):
    order = np.random.default_rng(seed).permutation(len(PAIR))
    moved = transform_points(yaw_translation(yaw, np.array([7.0, -3.0, 0.5])), PAIR.astype(np.float64))[order]
    groups = part_walkers(moved, RESOLUTION_M, SPEED_MPS)
    assert sorted(np.concatenate(groups).tolist()) == list(range(len(PAIR)))
    assert {frozenset(order[rows].tolist()) for rows in groups} == {frozenset(range(40)), frozenset(range(40, 70))}
