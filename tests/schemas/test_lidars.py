from dataclasses import replace

import numpy as np
import pytest

from schemas.errors import InvalidInput
from schemas.lidars import MIN_NOISE_M, MIN_RESOLUTION_RAD, NUM_WAYS, Beams, Lidar, scans_of

LIDAR = Lidar((1.0, 0.0, 2.0), 0.003, 0.005, 0.02)


def turning(starts_at_s, ways=slice(None)):
    """Return a lidar that turns in 0.1 s, from straight behind at this time; it sees some ways only."""
    looks_s = np.full(NUM_WAYS, np.inf)
    looks_s[ways] = ((np.arange(NUM_WAYS) / NUM_WAYS * 0.1 + starts_at_s) % 0.1)[ways]
    return replace(LIDAR, look_times_s=tuple(looks_s.tolist()))


@pytest.mark.parametrize(
    ("lidars", "expected"),
    [
        ((turning(0.0),), (0,)),
        ((turning(0.0), turning(0.05)), (0, 1)),
        ((turning(0.0), turning(0.025)), (0, 1)),
        ((turning(0.0), turning(0.002)), (0, 0)),
        ((turning(0.0), turning(0.098)), (0, 0)),
        ((LIDAR, turning(0.05)), (0, 0)),
        ((turning(0.0), turning(0.05, slice(0, 30)), turning(0.05, slice(40, 72))), (0, 1, 1)),
        ((turning(0.0, slice(0, 30)), turning(0.0, slice(40, 72)), turning(0.05, slice(20, 50))), (0, 0, 1)),
    ],
    ids=["one", "half a turn", "a quarter", "in step", "in step at the seam", "unknown", "nowhere both", "over both"],
)
def test_a_scan_is_what_lidars_in_step_see(lidars, expected):
    assert scans_of(lidars) == expected


def test_what_stands_between_two_lidars_out_of_step_is_in_one_scan_with_neither_by_chance():
    """The first and the third see no way in common; the second sees ways of both, later than either."""
    first, third = turning(0.0, slice(0, 30)), turning(0.03, slice(40, 72))
    assert scans_of((first, turning(0.06, slice(20, 60)), third)) == (0, 1, 0)
    assert scans_of((first, third, turning(0.03, slice(20, 60)))) == (0, 0, 1)


def test_beams_know_of_each_point_where_it_was_seen_from_and_how_well_its_place_is_told():
    other = replace(LIDAR, origin_m=(-3.0, 0.0, 2.0), elevation_step_rad=0.04, range_noise_m=0.05)
    beams = Beams((LIDAR, other), np.array([0, 1, 1], np.uint8))
    points = np.array([[11.0, 0, 2], [7, 0, 2], [-3, 0, 4]], np.float32)
    np.testing.assert_allclose(beams.origins_m, [[1, 0, 2], [-3, 0, 2], [-3, 0, 2]])
    np.testing.assert_allclose(beams.noise_m, [0.02, 0.05, 0.05])
    np.testing.assert_allclose(beams.resolution_m(points), [0.04, 0.2, 0.04])
    assert beams.main == other
    assert beams.of(np.array([0])).main == LIDAR
    assert beams.of(np.array([True, False, False])).main == LIDAR


def test_fine_steps_and_exact_ranges_are_believed_only_as_far_as_poses_are_sure():
    fine = replace(LIDAR, azimuth_step_rad=0.0005, elevation_step_rad=0.001, range_noise_m=0.001)
    assert (fine.resolution_rad, fine.noise_m) == (MIN_RESOLUTION_RAD, MIN_NOISE_M)
    assert replace(fine, azimuth_step_rad=0.03).resolution_rad == 0.015


def test_moved_beams_start_elsewhere_and_are_as_wide():
    turn = np.array([[0, -1, 0, 5], [1, 0, 0, 7], [0, 0, 1, 1], [0, 0, 0, 1]], dtype=np.float64)
    (moved,) = Beams((LIDAR,), np.zeros(1, np.uint8)).moved(turn).lidars
    np.testing.assert_allclose(moved.origin_m, [5, 8, 3])
    assert replace(moved, origin_m=LIDAR.origin_m) == LIDAR


def test_beams_of_a_lidar_that_is_not_there_are_refused():
    with pytest.raises(InvalidInput, match="names lidar 1, of 1"):
        Beams((LIDAR,), np.array([0, 1], np.uint8))
    with pytest.raises(InvalidInput, match="of_point must be"):
        Beams((LIDAR,), np.zeros(2))
