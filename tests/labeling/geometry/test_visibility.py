import numpy as np
import pytest

from labeling.geometry.visibility import is_seen_through, make_range_image

ORIGIN = np.array([0.0, 0.0, 1.5])


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
    image = make_range_image(make_wall(10.0, azimuth_deg), ORIGIN)
    ways = np.deg2rad(azimuth_deg + np.array([-10.0, 0.0, 10.0]))  # across the seam at 180 degrees too
    points = ORIGIN + range_m * np.stack([np.cos(ways), np.sin(ways), np.zeros(3)], axis=1)
    np.testing.assert_array_equal(is_seen_through(image, points, 0.5), [is_empty] * 3)


def test_where_no_ray_came_back_nothing_is_proved():
    image = make_range_image(make_wall(10.0), ORIGIN)
    places = ORIGIN + np.array([[-5.0, 0, 0], [0, 5.0, 0], [5.0, 0, 4.0]])  # behind, beside, above the wall
    assert not is_seen_through(image, places, 0.5).any()
    assert not is_seen_through(make_range_image(np.empty((0, 3)), ORIGIN), places, 0.5).any()


def test_beside_an_edge_the_nearer_neighbour_decides():
    pole = make_wall(5.0, azimuth_deg=0.0, half_width_deg=0.3)
    image = make_range_image(np.concatenate([make_wall(20.0), pole]), ORIGIN)
    ways = np.deg2rad([0.0, 0.7, 3.0])
    points = ORIGIN + 8.0 * np.stack([np.cos(ways), np.sin(ways), np.zeros(3)], axis=1)
    np.testing.assert_array_equal(is_seen_through(image, points, 0.5), [False, False, True])


def test_only_the_place_relative_to_the_origin_matters():
    rng = np.random.default_rng(0)
    cloud, points = make_wall(12.0), ORIGIN + rng.uniform([1, -4, -1], [14, 4, 1], (200, 3))
    shift = np.array([1000.0, -500.0, 30.0])
    here = is_seen_through(make_range_image(cloud, ORIGIN), points, 0.5)
    there = is_seen_through(make_range_image(cloud + shift, ORIGIN + shift), points + shift, 0.5)
    assert 20 < here.sum() < 180
    np.testing.assert_array_equal(here, there)


def test_margin_may_differ_from_point_to_point_and_no_point_is_fine():
    image = make_range_image(make_wall(10.0), ORIGIN)
    points = ORIGIN + np.array([[8.0, 0, 0], [8.0, 0, 0]])
    np.testing.assert_array_equal(is_seen_through(image, points, np.array([1.0, 3.0])), [True, False])
    assert is_seen_through(image, np.empty((0, 3)), 0.5).shape == (0,)
