import numpy as np
import pytest

from labeling.geometry.transforms import transform_points, yaw_translation
from labeling.geometry.visibility import Sight, is_seen_through, make_range_image
from schemas.lidars import Lidar

ORIGIN = np.array([0.0, 0.0, 1.5])
STEP_RAD = (np.deg2rad(0.2), np.deg2rad(0.27))


def image_of(points, origin=ORIGIN, num_ground=0, steps_rad=STEP_RAD):
    """Return the image of a cloud whose last points are ground."""
    lidar = Lidar(tuple(origin.tolist()), *steps_rad, 0.02)
    return make_range_image(points, lidar, np.arange(len(points)) >= len(points) - num_ground)


def make_wall(distance_m, azimuth_deg=0.0, half_width_deg=20.0):
    """Return a round wall around the origin, finer than a range image's cells."""
    azimuth, elevation = np.meshgrid(
        np.deg2rad(azimuth_deg + np.arange(-half_width_deg, half_width_deg, 0.1)), np.deg2rad(np.arange(-8, 8, 0.1))
    )
    direction = [np.cos(azimuth) * np.cos(elevation), np.sin(azimuth) * np.cos(elevation), np.sin(elevation)]
    return (ORIGIN + distance_m * np.stack(direction, axis=-1).reshape(-1, 3)).astype(np.float32)


@pytest.mark.parametrize("azimuth_deg", [0.0, 90.0, 180.0, -135.0])
@pytest.mark.parametrize(
    ("range_m", "is_empty"), [(2.0, True), (9.4, True), (9.6, False), (10.5, False), (30.0, False)]
)
def test_places_well_before_a_wall_are_empty(azimuth_deg, range_m, is_empty):
    image = image_of(make_wall(10.0, azimuth_deg))
    ways = np.deg2rad(azimuth_deg + np.array([-10.0, 0.0, 10.0]))  # across the seam at 180 degrees too
    points = ORIGIN + range_m * np.stack([np.cos(ways), np.sin(ways), np.zeros(3)], axis=1)
    np.testing.assert_array_equal(is_seen_through(image, points, 0.5), [is_empty] * 3)


def test_where_no_ray_came_back_nothing_is_proved():
    image = image_of(make_wall(10.0))
    places = ORIGIN + np.array([[-5.0, 0, 0], [0, 5.0, 0], [5.0, 0, 4.0]])  # behind, beside, above the wall
    assert not is_seen_through(image, places, 0.5).any()
    assert not is_seen_through(image_of(np.empty((0, 3))), places, 0.5).any()


def test_beside_an_edge_the_nearer_neighbour_decides():
    pole = make_wall(5.0, azimuth_deg=0.0, half_width_deg=0.3)
    image = image_of(np.concatenate([make_wall(20.0), pole]))
    ways = np.deg2rad([0.0, 0.7, 3.0])
    points = ORIGIN + 8.0 * np.stack([np.cos(ways), np.sin(ways), np.zeros(3)], axis=1)
    np.testing.assert_array_equal(is_seen_through(image, points, 0.5), [False, False, True])


def test_only_the_place_relative_to_the_origin_matters():
    rng = np.random.default_rng(0)
    cloud, points = make_wall(12.0), ORIGIN + rng.uniform([1, -4, -1], [14, 4, 1], (200, 3))
    shift = np.array([1000.0, -500.0, 30.0])
    here = is_seen_through(image_of(cloud), points, 0.5)
    there = is_seen_through(image_of(cloud + shift, ORIGIN + shift), points + shift, 0.5)
    assert 20 < here.sum() < 180
    np.testing.assert_array_equal(here, there)


def test_margin_may_differ_from_point_to_point_and_no_point_is_fine():
    image = image_of(make_wall(10.0))
    points = ORIGIN + np.array([[8.0, 0, 0], [8.0, 0, 0]])
    np.testing.assert_array_equal(is_seen_through(image, points, np.array([1.0, 3.0])), [True, False])
    assert is_seen_through(image, np.empty((0, 3)), 0.5).shape == (0,)


def test_the_road_before_a_place_hides_nothing():
    """Beams a little lower meet the road at 15 m; those that go on meet a wall at 40 m."""
    road, wall, place = make_wall(15.0), make_wall(40.0), ORIGIN + np.array([[25.0, 0, 0]])
    both = np.concatenate([wall, road])
    assert is_seen_through(image_of(both, num_ground=len(road)), place, 0.5).all()
    assert not is_seen_through(image_of(both), place, 0.5).any()  # the same as an obstacle
    assert not is_seen_through(image_of(road, num_ground=len(road)), place, 0.5).any()  # no beam went on


def test_a_sight_looks_from_wherever_its_sweep_was():
    turned = yaw_translation(np.pi / 2, np.array([3.0, -2.0, 0.0]))  # ref from the sweep's own frame
    sight = Sight([image_of(make_wall(10.0))], np.linalg.inv(turned))
    places = transform_points(turned, ORIGIN + np.array([[8.0, 0, 0], [12.0, 0, 0]]))
    np.testing.assert_array_equal(sight.is_through(places, 0.25), [True, False])
