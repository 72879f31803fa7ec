"""The sensor stands at the world's origin; objects head along x, their model frame is their own frame."""

from dataclasses import replace

import numpy as np
import pytest

from labeling.stages.extent import model_box
from schemas.config import RefinementParams

AHEAD, ABEAM = [(20.0, 0.0)], [(0.0, 10.0)]
ONLY_SEEN = RefinementParams(without="completion")


def ends(box):
    """Return rear, front, right and left of a box that heads along x."""
    return np.array([box[0] - box[3] / 2, box[0] + box[3] / 2, box[1] - box[4] / 2, box[1] + box[4] / 2])


@pytest.mark.parametrize(("side", "place"), [("back", (20.0, 0.0)), ("front", (-20.0, 0.0))])
def test_a_car_seen_from_one_end_gets_its_length_away_from_the_sensor(block_cloud, aligned_at, side, place):
    aligned = aligned_at([block_cloud((4.2, 1.8, 1.5), sides=(side,))], [place])
    box, seen = model_box(aligned, 0.0, RefinementParams()), model_box(aligned, 0.0, ONLY_SEEN)
    assert seen[3] == 0.3
    assert 3.8 <= box[3] <= 4.3
    np.testing.assert_allclose(box[4:6], [1.8, 1.5], atol=0.11)
    nearest, farthest = (0, 1) if side == "back" else (1, 0)
    assert ends(box)[nearest] == pytest.approx(ends(seen)[nearest])
    assert ends(box)[nearest] == pytest.approx(-2.1 if side == "back" else 2.1, abs=0.16)  # half the least thickness
    assert abs(ends(box)[farthest] - ends(seen)[farthest]) > 3.4


@pytest.mark.parametrize(("side", "place"), [("right", (0.0, 10.0)), ("left", (0.0, -10.0))])
@pytest.mark.parametrize(("length_m", "width_m"), [(4.2, 1.7), (9.0, 2.4)], ids=["car", "lorry"])
def test_a_vehicle_seen_from_the_side_gets_its_width_away_from_the_sensor(
    block_cloud, aligned_at, side, place, length_m, width_m
):
    aligned = aligned_at([block_cloud((length_m, 1.8, 1.5), sides=(side,))], [place])
    box, seen = model_box(aligned, 0.0, RefinementParams()), model_box(aligned, 0.0, ONLY_SEEN)
    assert box[4] == pytest.approx(width_m)
    assert box[3] == seen[3]
    assert seen[3] == pytest.approx(length_m, abs=0.2)  # trimmed of noise
    nearest = 2 if side == "right" else 3
    assert ends(box)[nearest] == pytest.approx(ends(seen)[nearest])


def test_the_seen_face_stays_whatever_the_heading(block_cloud, aligned_at):
    """Turned by 0.7 rad with the sensor straight behind: the box grows along its own axis."""
    yaw = 0.7
    ahead = np.array([np.cos(yaw), np.sin(yaw)])
    aligned = aligned_at([block_cloud((4.2, 1.8, 1.5), sides=("back",))], [20 * ahead], yaw)
    box, seen = model_box(aligned, yaw, RefinementParams()), model_box(aligned, yaw, ONLY_SEEN)
    np.testing.assert_allclose(box[:2] - box[3] / 2 * ahead, seen[:2] - seen[3] / 2 * ahead, atol=1e-9)
    assert box[3] >= 3.8


@pytest.mark.parametrize(
    ("size_m", "sides", "place"),
    [
        ((0.7, 0.65, 1.75), ("right", "back"), (6, 6)),
        ((0.5, 0.6, 2.6), ("right", "back"), (6, 6)),
        ((0.5, 0.6, 0.7), ("right", "back"), (6, 6)),
        ((1.8, 0.65, 1.7), ("right", "back"), (0, 8)),
        ((0.6, 4.0, 3.0), ("back",), (20, 0)),
        ((4.2, 1.8, 1.5), ("back", "right"), (15, 8)),
        ((4.2, 1.8, 0.7), ("right",), (0, 8)),
    ],
    ids=[
        "walker",
        "higher than people",
        "lower than people",
        "cyclist",
        "wider than vehicles",
        "a whole car",
        "too low",
    ],
)
def test_what_shows_no_lone_face_of_a_vehicle_is_left_alone(block_cloud, aligned_at, size_m, sides, place):
    aligned = aligned_at([block_cloud(size_m, sides=sides)], [place])
    box = model_box(aligned, 0.0, RefinementParams())
    np.testing.assert_array_equal(box, model_box(aligned, 0.0, ONLY_SEEN))
    assert (box[3:6] <= np.maximum(size_m, 0.3) + 1e-6).all()


@pytest.mark.parametrize(
    ("speed_mps", "length_m"), [(1.4, 0.6), (3.4, 0.6), (3.6, 1.7), (7.0, 1.7)], ids=lambda value: f"{value}"
)
def test_a_trunk_is_completed_to_a_walker_or_to_a_cycle_about_its_middle(block_cloud, aligned_at, speed_mps, length_m):
    """Of a cycle a few beams show the rider, who sits between the wheels."""
    aligned = aligned_at([block_cloud((0.3, 0.45, 1.7))] * 3, [(8, 0)] * 3, velocity_mps=(speed_mps, 0.0))
    box, seen = model_box(aligned, 0.0, RefinementParams()), model_box(aligned, 0.0, ONLY_SEEN)
    np.testing.assert_allclose(box[3:5], [length_m, 0.6])
    np.testing.assert_array_equal(box[[0, 1, 2, 5, 6]], seen[[0, 1, 2, 5, 6]])


@pytest.mark.parametrize(
    ("size_m", "sides", "place"),
    [
        ((0.5, 0.6, 1.75), ("back",), (8, 0)),
        ((0.5, 0.6, 1.75), ("right", "back"), (6, 6)),
        ((1.8, 0.6, 1.7), ("right",), (0, 8)),
    ],
    ids=["walker", "walker aslant", "cyclist"],
)
def test_a_walker_and_a_cyclist_get_no_more_than_a_persons_width(block_cloud, aligned_at, size_m, sides, place):
    aligned = aligned_at([block_cloud(size_m, sides=sides)], [place])
    box, seen = model_box(aligned, 0.0, RefinementParams()), model_box(aligned, 0.0, ONLY_SEEN)
    np.testing.assert_array_equal(box[[0, 1, 2, 5, 6]], seen[[0, 1, 2, 5, 6]])
    np.testing.assert_array_equal(box[3:5], np.maximum(seen[3:5], 0.6))
    assert (box[3:6] <= np.maximum(size_m, [0.6, 0.6, 0.3]) + 1e-6).all()


def test_a_high_face_is_a_lorrys_and_a_car_under_a_branch_is_a_car(block_cloud, aligned_at):
    lorry, car = (block_cloud((6.0, 2.4, height_m), sides=("back",)) for height_m in (3.2, 1.5))
    branch = np.float32([-3.0, 0.3, 3.0]) + block_cloud((0.3, 0.3, 0.2))
    high, low = (model_box(aligned_at([c], AHEAD), 0.0, RefinementParams()) for c in (lorry, np.vstack([car, branch])))
    assert high[3] == 7.5
    assert 3.8 < low[3] < 6.0
    np.testing.assert_allclose([high[5], low[5]], [3.2, 3.2], atol=0.2)


def test_two_walkers_side_by_side_are_no_rear(block_cloud, aligned_at):
    """Together as wide as a car; what tells them from one is the gap between them."""
    walker = block_cloud((0.3, 0.5, 1.75), sides=("back",))
    pair = np.concatenate([walker - np.float32([0, 0.65, 0]), walker + np.float32([0, 0.65, 0])])
    filled = np.concatenate([pair, walker])
    apart, together = (model_box(aligned_at([c], AHEAD), 0.0, RefinementParams()) for c in (pair, filled))
    assert apart[3] == 0.3
    np.testing.assert_allclose([apart[4], together[4]], 1.8, atol=0.1)
    assert together[3] > 3.8


def test_one_noisy_view_among_ten_hardly_widens_the_box(block_cloud, aligned_at):
    """Outliers 1 m off: of them remain 0.1 at either end, nothing at the sides, 0.55 at the top."""
    size_m = (4.2, 1.8, 1.5)
    clouds = [block_cloud(size_m, seed=seed) for seed in range(10)]
    outliers = np.array([[3.1, 0, 1], [-3.1, 0, 1], [0, 1.9, 1], [0, -1.9, 1], [0, 0, 2.5]], dtype=np.float32)
    noisy = [*clouds[:9], np.concatenate([clouds[9], np.repeat(outliers, 10, axis=0)])]
    clean, widened = (model_box(aligned_at(c, AHEAD * 10), 0.0, RefinementParams()) for c in (clouds, noisy))
    np.testing.assert_array_less(widened[3:6] - clean[3:6], [0.21, 0.01, 0.56])
    extreme = model_box(aligned_at(noisy, AHEAD * 10), 0.0, RefinementParams(without="robust_extent"))
    np.testing.assert_allclose(extreme[3:6], [6.2, 3.8, 2.5], atol=0.02)


@pytest.mark.parametrize("noise_m", [0.01, 0.03])
def test_range_noise_moves_no_flat_face(block_cloud, aligned_at, noise_m):
    """Of a bus the lidar sees the front and a side; a thousand points reach three times the noise too far."""
    rng, size_m = np.random.default_rng(0), (9.5, 2.7, 3.0)
    clouds = [block_cloud(size_m, 2000, seed=seed, sides=("front", "left")) for seed in range(6)]
    noisy = [cloud + rng.normal(0, noise_m, cloud.shape).astype(np.float32) for cloud in clouds]
    box = model_box(aligned_at(noisy, AHEAD * 6), 0.0, RefinementParams(without="completion"))
    front, left = (box[:2] + box[3:5] / 2) - np.divide(size_m[:2], 2)
    assert max(abs(front), abs(left)) < 0.01


@pytest.mark.parametrize(("size_m", "is_vehicle"), [((4.2, 1.8, 1.5), True), ((0.6, 0.6, 1.75), False)])
def test_views_that_lie_a_little_off_do_not_widen_a_vehicle(block_cloud, aligned_at, size_m, is_vehicle):
    """Forty views 8 cm off on average: nine in ten reach less than 10 cm too far on either side."""
    slides_m = np.random.default_rng(0).normal(0, 0.08, (40, 2))
    clouds = [block_cloud(size_m, seed=seed) for seed in range(40)]
    box = model_box(aligned_at(clouds, AHEAD * 40, slides_m=slides_m), 0.0, RefinementParams())
    exact = model_box(aligned_at(clouds, AHEAD * 40), 0.0, RefinementParams())
    wider = box[3:5] - exact[3:5]
    assert (wider < 0.06).all() if is_vehicle else (wider > 0.1).all()


def test_few_views_that_see_the_end_of_a_vehicle_decide_where_it_is(block_cloud, aligned_at):
    """Of twenty views three show the whole length."""
    whole, front_half = block_cloud((8.0, 2.5, 3.0)), block_cloud((8.0, 2.5, 3.0))
    front_half = front_half[front_half[:, 0] > 0]
    aligned = aligned_at([whole] * 3 + [front_half] * 17, AHEAD * 20)
    assert model_box(aligned, 0.0, RefinementParams())[3] == pytest.approx(8.0, abs=0.15)


def test_a_view_that_was_aligned_tilted_far_from_the_origin_has_its_ground_beneath_it(block_cloud, aligned_at):
    """A kilometre away a tilt of one degree about the world's origin is 17 m; about the view it is nothing."""
    aligned = aligned_at([block_cloud()], [(1000.0, 500.0)])
    tilt = np.eye(4)
    angle = np.deg2rad(1.0)
    tilt[0, [0, 2]], tilt[2, [0, 2]] = [np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]
    tilted = replace(aligned, model_from_world=tilt @ aligned.model_from_world)
    box, upright = (model_box(each, 0.0, RefinementParams()) for each in (tilted, aligned))
    np.testing.assert_allclose(box, upright, atol=0.05)
