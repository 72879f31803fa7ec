from dataclasses import replace

import numpy as np
import pytest

from labeling.geometry.transforms import invert, yaw_translation
from labeling.stages.heading import model_heading
from labeling.stages.registration import model_to_world
from schemas.config import RefinementParams

TIMES_S = np.arange(11) * 0.1


@pytest.fixture
def heading_deg(block_cloud, aligned_at):
    """Return a function: a block turned by ``face_deg`` travels along x, ``slide_m`` to the left unnoticed -> degrees.

    The face is ``slide_m`` off at the end of the travel: the path points to the left of where the face looks.
    """

    def measure(
        travel_m,
        *,
        face_deg=0.0,
        slide_m=0.0,
        size_m=(4.2, 1.8, 1.5),
        sides=("back",),
        without=(),
    ):
        clouds = [block_cloud(size_m, 200, seed=seed, sides=sides) for seed in range(11)]
        places_m = np.column_stack([20 + travel_m * TIMES_S, 0 * TIMES_S])
        slides_m = np.column_stack([0 * TIMES_S, slide_m * TIMES_S])
        aligned = aligned_at(clouds, places_m, np.deg2rad(face_deg), slides_m)
        params = RefinementParams(without=without)
        return np.rad2deg(model_heading(aligned, model_to_world(aligned.model_from_world), TIMES_S, params))

    return measure


@pytest.mark.parametrize("slide_m", [-0.5, 0.5])
def test_a_flat_rear_that_slid_sideways_turns_the_heading_towards_its_normal(heading_deg, slide_m):
    """Points within 0.03 m of an edge lie on it: a face of 1.8 m is as flat up to 2 degrees off, and travel decides."""
    of_travel = np.rad2deg(np.arctan2(slide_m, 3.0))
    assert abs(of_travel) > 9
    assert abs(heading_deg(3.0, slide_m=slide_m)) < 2.5


@pytest.mark.parametrize("period_s", [0.1, 0.5, 0.53, 1.0])
def test_the_heading_is_the_travel_however_rare_sweeps_are(aligned_at, block_cloud, period_s):
    """Half a second apart, or a little more: the next views are what tells."""
    times_s = np.arange(6) * period_s
    clouds = [block_cloud((0.6, 0.6, 1.7), 60, seed=seed) for seed in range(6)]
    aligned = aligned_at(clouds, np.column_stack([1.2 * times_s, 0.9 * times_s]), yaw=2.0)
    yaw = model_heading(aligned, model_to_world(aligned.model_from_world), times_s, RefinementParams())
    assert yaw == pytest.approx(np.arctan2(0.9, 1.2), abs=0.01)


def test_without_shape_the_heading_is_the_travel(heading_deg):
    of_travel = np.rad2deg(np.arctan2(0.5, 3.0))
    assert heading_deg(3.0, slide_m=0.5, without="shape_heading") == pytest.approx(of_travel, abs=0.01)


def test_without_travel_and_shape_the_heading_is_that_of_the_densest_view(heading_deg):
    of_view = heading_deg(3.0, slide_m=0.5, without=("shape_heading", "travel_heading"))
    assert of_view == pytest.approx(0.0, abs=0.01)


@pytest.mark.parametrize(("travel_m", "most_deg"), [(10.0, 6.0), (40.0, 1.5), (80.0, 0.8)])
def test_the_longer_the_travel_the_less_the_shape_may_turn_it(heading_deg, travel_m, most_deg):
    """The end of a travel may be 1 m off: 5.7, 1.4 and 0.7 degrees."""
    assert abs(heading_deg(travel_m, face_deg=15)) < most_deg


@pytest.mark.parametrize("size_m", [(0.5, 0.6, 1.75), (0.3, 1.1, 1.7)], ids=["walker", "cyclist from behind"])
def test_small_things_keep_their_travel(heading_deg, size_m):
    assert heading_deg(2.0, face_deg=15, size_m=size_m) == pytest.approx(0, abs=1e-6)


def test_a_vehicle_of_which_a_long_side_is_seen_is_turned_farther_by_its_shape(heading_deg):
    """After 30 m a face alone may turn it by 1.9 degrees, a long side by 5.7."""
    assert abs(heading_deg(30.0, face_deg=4)) < 2.0
    assert heading_deg(30.0, face_deg=4, sides=("left", "back")) == pytest.approx(4, abs=0.5)


def test_in_a_turn_a_vehicle_points_where_its_rear_axle_goes(block_cloud, aligned_at):
    yaws, radius_m = 0.05 * np.arange(11), 10.0
    axles_m = radius_m * np.column_stack([np.sin(yaws), 1 - np.cos(yaws), 0 * yaws])
    poses = np.stack([yaw_translation(yaw, axle) for yaw, axle in zip(yaws, axles_m, strict=True)])
    cloud = block_cloud((4.2, 1.8, 1.5), sides=("front",)) + np.array([1.2, 0, 0], dtype=np.float32)
    aligned = replace(aligned_at([cloud] * 11, axles_m[:, :2]), model_from_world=np.stack([invert(p) for p in poses]))
    args = aligned, poses, TIMES_S, RefinementParams(without="shape_heading")
    assert model_heading(*args, center=np.zeros(3)) == pytest.approx(0, abs=0.002)
    of_face = np.arctan2(3.3, radius_m)  # it is so far ahead of the axle, and goes where it does not look
    assert model_heading(*args) == pytest.approx(of_face, abs=0.02)


def test_what_does_not_travel_goes_by_its_model_heading_and_its_sides(heading_deg):
    assert heading_deg(0.0, face_deg=70) == pytest.approx(70, abs=1.5)
