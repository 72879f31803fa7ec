"""What sweeps say of places: rays go by the lidar that cast them."""

from dataclasses import replace

import numpy as np
import pytest

from labeling.evidence.lidars import measure_lidars
from labeling.evidence.places import GroundedSweep, look_at_places
from labeling.geometry.visibility import is_seen_through, make_range_image
from labeling.readers.reader import open_segment
from labeling.stages.ground import segment_ground
from labeling.synthetic.rigs import SpinningLidar
from labeling.synthetic.scene import Scene, drive, wall
from labeling.synthetic.shapes import block
from schemas.config import GroundParams, StaticParams

MARGIN_M = 0.25
LEFT, RIGHT = (0.0, 4.0, 1.5), (0.0, -4.0, 1.5)
PILLARS = tuple(drive(block(0.8, 0.8, 4.0), place) for place in ((8, 4), (4.2, -0.6)))
SEEN, HIDDEN, BOTH = (14.0, 4.0), (9.6, 3.8), (8.8, 0.0)  # from the one on the right; by nobody; by both


def ground_sweep(sweep, lidars):
    return GroundedSweep(sweep, segment_ground(sweep.points_ego, GroundParams(), np.random.default_rng(0)), lidars)


def look(rig, index=0, movers=()):
    scene = Scene(structures=(wall((30, -40), (30, 40), 8.0),), movers=movers)
    reader = scene.reader(2, lidar=rig)
    return ground_sweep(reader.read_sweep(index), reader.lidars)


def spots(*places):
    return np.array([[x, y, z] for x, y in places for z in (0.9, 1.2, 1.5)])


def is_through(grounded, places):
    return grounded.sight_from(grounded.sweep).is_through(places, MARGIN_M).reshape(-1, 3).all(axis=1)


def test_a_place_is_seen_through_by_the_lidar_that_looks_past_the_pillar():
    """Behind a pillar for one of two lidars 8 m apart, and open for the other; where nobody looks, nothing is said."""
    rig = tuple(SpinningLidar(64, 1800, origin_ego_m=origin) for origin in (LEFT, RIGHT))
    grounded = look(rig, movers=PILLARS)
    np.testing.assert_array_equal(is_through(grounded, spots(SEEN, HIDDEN, BOTH)), [True, False, True])
    alone = [look((lidar,), movers=PILLARS) for lidar in rig]
    np.testing.assert_array_equal(is_through(alone[0], spots(SEEN, HIDDEN, BOTH)), [False, False, True])
    np.testing.assert_array_equal(is_through(alone[1], spots(SEEN, HIDDEN, BOTH)), [True, False, True])


def test_the_middle_of_two_lidars_sees_what_neither_does():
    """Why origins are not averaged: from between them, rays of either seem to pass where none did."""
    rig = tuple(SpinningLidar(64, 1800, origin_ego_m=origin) for origin in (LEFT, RIGHT))
    grounded = look(rig, movers=PILLARS)
    middle = replace(grounded.lidars[0], origin_m=(0.0, 0.0, 1.5))
    image = make_range_image(grounded.sweep.points_ego, middle, grounded.ground.is_ground)
    wrong = is_seen_through(image, spots(SEEN, HIDDEN, BOTH), MARGIN_M).reshape(-1, 3).all(axis=1)
    np.testing.assert_array_equal(wrong, [True, True, True])


@pytest.mark.parametrize("is_by_beam", [True, False], ids=["by beam", "by chance"])
def test_one_lidar_under_two_numbers_sees_the_same(is_by_beam):
    sweep = open_segment("synthetic", "synthetic:street?sweeps=1&seed=1&beams=32&azimuth_steps=900").read_sweep(0)
    number = np.random.default_rng(0).integers(0, 2, sweep.num_points)
    if is_by_beam:
        number = (sweep.points_ego[:, 2] - sweep.sensor_origins_ego[0, 2]) > -0.05 * np.hypot(
            *sweep.points_ego[:, :2].T
        )
    origins = np.repeat(sweep.sensor_origins_ego, 2, axis=0)
    split = replace(sweep, lidar_of_point=number.astype(np.uint8), sensor_origins_ego=origins)
    whole, parts = (ground_sweep(one, measure_lidars([one])) for one in (sweep, split))
    places = np.random.default_rng(1).uniform([-30, -10, -0.5], [30, 10, 3], (5000, 3))
    expected = whole.sight_from(sweep).is_through(places, MARGIN_M)
    assert 500 < expected.sum() < 4500
    np.testing.assert_array_equal(parts.sight_from(split).is_through(places, MARGIN_M), expected)


def test_the_place_between_two_rows_of_a_few_beams_is_occupied():
    """What stands is found again between the rows of any lidar: they are farther apart where beams are few."""
    params = StaticParams()
    for beams in (16, 32, 64):
        reader = Scene(structures=(wall((25, -20), (25, 20), 6.0),), ego=drive(block(), speed_mps=8.0).path).reader(
            8, lidar=SpinningLidar(beams, 900)
        )
        now, later = (ground_sweep(reader.read_sweep(k), reader.lidars) for k in (0, 7))
        x, y, z = now.sweep.points_ego.T
        rows = np.flatnonzero((x > 20) & (np.abs(y) < 12) & (z > 0) & (z < 2.5))
        evidence = look_at_places(now, rows, [later], params)
        assert len(rows) > 100
        assert evidence.is_occupied.mean() > 0.97
        assert not evidence.is_through.any()
