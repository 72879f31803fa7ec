"""A vehicle heads along x; its box is what was seen of it, completed."""

import numpy as np
import pytest

from labeling.stages.parts import parts_of_vehicles
from schemas.objects import LabeledTrack

LORRY_M, CAR_M, WHEELS_M = (7.5, 2.4, 3.2), (4.2, 1.8, 1.5), (0.6, 2.0, 0.7)


def track(start_m, size_m, speed_mps=8.0, sweeps=range(10), yaw=0.0):
    """Return the label of an object of ``size_m`` that goes along ``yaw``; ``start_m`` is in its own direction."""
    sweeps = np.array(sweeps)
    along, across = start_m[0] + speed_mps * 0.1 * sweeps, np.full(len(sweeps), float(start_m[1]))
    x, y = along * np.cos(yaw) - across * np.sin(yaw), along * np.sin(yaw) + across * np.cos(yaw)
    box = [np.full(len(sweeps), value) for value in (size_m[2] / 2, *size_m, yaw)]
    boxes = np.column_stack([x, y, *box])
    count = len(sweeps)
    return LabeledTrack(
        track_id="track",
        sweep_index=sweeps,
        timestamp_ns=sweeps * 100_000_000,
        boxes=boxes,
        velocity_mps=np.tile([speed_mps * np.cos(yaw), speed_mps * np.sin(yaw), 0.0], (count, 1)),
        score=np.ones(count),
        num_points=np.full(count, 60),
        is_observed=np.ones(count, dtype=bool),
        boxes_visible=boxes,
        registration_error_m=np.zeros(count),
        point_rows=(np.arange(60, dtype=np.int32),) * count,
    )


@pytest.mark.parametrize("yaw", [0.0, 2.0])
@pytest.mark.parametrize("place", [(8.0, 0.0), (-8.0, 0.9), (0.0, 0.0)], ids=["ahead", "behind", "beneath"])
def test_wheels_far_from_the_seen_rear_of_a_lorry_are_a_part_of_it(place, yaw):
    assert parts_of_vehicles([track((0, 0), LORRY_M, yaw=yaw), track(place, WHEELS_M, yaw=yaw)]) == [(1, 0)]


@pytest.mark.parametrize(
    ("other", "why"),
    [
        (track((8, 0), CAR_M), "a car is high enough to be one"),
        (track((8, 2.5), WHEELS_M), "in the next lane"),
        (track((15, 0), WHEELS_M), "too far ahead"),
        (track((8, 0), WHEELS_M, 10.0), "faster"),
        (track((8, 0), WHEELS_M, sweeps=range(8, 20)), "two common sweeps"),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_what_is_no_part_is_left_alone(other, why):
    assert parts_of_vehicles([track((0, 0), LORRY_M), other]) == []


def test_of_two_cars_in_a_queue_the_nearer_has_a_part_and_what_lies_between_them_is_nobodys():
    queue = [track((0, 0), CAR_M, 1.3), track((6.0, 0), CAR_M, 1.3)]
    assert parts_of_vehicles([*queue, track((2.0, 0.8), WHEELS_M, 1.3)]) == [(2, 0)]
    assert parts_of_vehicles([*queue, track((4.1, 0.8), WHEELS_M, 1.3)]) == [(2, 1)]
    assert parts_of_vehicles([*queue, track((3.0, 0.8), WHEELS_M, 1.3)]) == []


def test_low_things_are_no_vehicles_to_each_other():
    assert parts_of_vehicles([track((0, 0), WHEELS_M), track((0.5, 0), (3.5, 1.5, 0.8))]) == []
    assert parts_of_vehicles([]) == []
