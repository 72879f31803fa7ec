"""Points come back within a centimetre, with what is known of them, in few bytes."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial import cKDTree

from labeling.replay.payload import MAX_POINTS
from labeling.replay.points import (
    GRID_M,
    GRID_MPS,
    MIN_STATIC,
    NO_TRACK,
    REACH_M,
    decode,
    encode,
    quantize,
    thin,
)

MOST_BYTES = 20e6  # of a page of 50 sweeps of 110,000 points


@pytest.fixture
def rng():
    return np.random.default_rng(0)


def street(rng, num_points):
    """Points as a lidar with 64 beams sees a road between walls, with noise of 2 cm."""
    azimuth = np.tile(np.linspace(-np.pi, np.pi, num_points // 64), 64)
    elevation = np.repeat(np.deg2rad(np.linspace(-24, 4, 64)), num_points // 64)
    to_ground = np.where(elevation < 0, 1.8 / np.maximum(-np.tan(elevation), 1e-9), np.inf)
    to_wall = 9 / np.maximum(np.abs(np.sin(azimuth)), 1e-9)
    distance = np.minimum(np.minimum(to_ground, to_wall), 120) + rng.normal(0, 0.02, len(azimuth))
    return np.column_stack([np.cos(azimuth), np.sin(azimuth), np.tan(elevation)]) * distance[:, None]


def round_trip(points):
    return decode(encode(points), points.num_static, len(points.tracks))


@given(st.integers(0, 60), st.integers(0, 60), st.integers(0, 2**32 - 1))
def test_what_is_decoded_is_what_was_encoded(num_static, num_moving, seed):
    rng = np.random.default_rng(seed)
    static, moving = (rng.uniform(-REACH_M, REACH_M, (rows, 3)) for rows in (num_static, num_moving))
    velocity = rng.uniform(-300, 300, (num_moving, 2))
    velocity[rng.random(num_moving) < 0.3] = np.nan
    track = rng.integers(NO_TRACK, 30_000, num_moving)
    points = round_trip(quantize(static, moving, velocity, track))

    assert points.num_static == num_static
    for found, expected in ((points.points_ego[:num_static], static), (points.points_ego[num_static:], moving)):
        order, rows = (np.lexsort(np.rint(places / GRID_M).T) for places in (found, expected))
        np.testing.assert_allclose(found[order], expected[rows], rtol=0, atol=GRID_M / 2 + 1e-9)
    order, rows = (np.lexsort(np.rint(places / GRID_M).T) for places in (points.points_ego[num_static:], moving))
    np.testing.assert_allclose(points.velocity_mps[order], velocity[rows], rtol=0, atol=GRID_MPS / 2 + 1e-9)
    np.testing.assert_array_equal(points.tracks[order], track[rows])


def test_points_come_back_within_a_centimetre_of_where_they_were(rng):
    source = street(rng, 6400)
    found = round_trip(quantize(source, np.empty((0, 3)), np.empty((0, 2)), np.empty(0, dtype=np.int64)))
    distance_m, _ = cKDTree(found.points_ego).query(source, p=np.inf)
    assert len(found.points_ego) == len(source)
    assert distance_m.max() <= 0.01 + 1e-9


def test_a_long_drive_of_large_sweeps_stays_small(rng):
    """As many points as fit a page by default, as bytes of base64, beside a library of 0.6 MB."""
    source = street(rng, 110_000)
    kept, _ = thin(source, MAX_POINTS // 50)
    block = encode(quantize(source[kept], np.empty((0, 3)), np.empty((0, 2)), np.empty(0, dtype=np.int64)))
    assert 50 * len(block) * 4 / 3 + 1e6 < MOST_BYTES
    assert len(block) / len(kept) < 3.5


def test_few_points_are_all_kept(rng):
    source = rng.normal(size=(MIN_STATIC, 3))
    rows, voxel_m = thin(source, 5)
    assert voxel_m == 0
    np.testing.assert_array_equal(rows, np.arange(MIN_STATIC))


def test_thinned_points_are_some_of_the_points_and_leave_no_place_bare(rng):
    source = street(rng, 64_000)
    rows, voxel_m = thin(source, 20_000)
    assert MIN_STATIC < len(rows) <= 20_000
    assert (np.diff(rows) > 0).all()
    distance_m, _ = cKDTree(source[rows]).query(source)
    assert distance_m.max() <= voxel_m * 3**0.5
    assert thin(source, 20_000)[1] == voxel_m
