import numpy as np
import pytest

from labeling.stages.surfaces import follow_surfaces
from labeling.stages.targets import FlowTarget
from schemas.lidars import Beams, Lidar

ORIGIN = np.array([0.0, 0.0, 1.8])
RADIUS_M = 1.6
NOISE_M = 0.01
SPEED_MPS = np.array([8.0, 0.0, 0.0])


def see_dome(center, seed=0, origin=ORIGIN, num_rows=9):
    """Return where the rows of a lidar meet a dome on the road: few rows, dense points, as on a car's front."""
    toward = np.arctan2(*(np.asarray(center)[:2] - origin[:2])[::-1])
    azimuth, elevation = np.meshgrid(
        toward + np.deg2rad(np.arange(-25, 25, 0.4)), np.deg2rad(np.linspace(-24, 0, num_rows))
    )
    azimuth, elevation = azimuth.ravel(), elevation.ravel()
    rays = np.stack([np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)], 1)
    offset = np.asarray(center) - origin
    along = rays @ offset
    inside = along**2 - (offset @ offset - RADIUS_M**2)
    is_hit = (inside > 0) & (along > 0)
    range_m = along[is_hit] - np.sqrt(inside[is_hit])
    range_m += np.random.default_rng(seed).normal(0, NOISE_M, len(range_m))
    points = origin + rays[is_hit] * range_m[:, None]
    return points[points[:, 2] > 0.1].astype(np.float32)


def beams_of(points, origin=ORIGIN, lidar_of_point=None):
    lidar = Lidar(tuple(np.asarray(origin).tolist()), 0.007, 0.05, NOISE_M)
    lidar_of_point = np.zeros(len(points), np.uint8) if lidar_of_point is None else lidar_of_point
    return Beams((lidar, lidar), lidar_of_point)


def target_of(gap_s, points, origin=ORIGIN, lidar_of_point=None):
    beams = beams_of(points, origin, lidar_of_point)
    return FlowTarget(gap_s, points, points, beams, beams)


def follow(points, start_mps, targets, origin=ORIGIN, lidar_of_point=None):
    return follow_surfaces(points, beams_of(points, origin, lidar_of_point), start_mps, targets)


@pytest.mark.parametrize("place", [(6, -2.5, 0), (-6, -2.5, 0), (4, 5, 0)], ids=["ahead", "behind", "beside"])
@pytest.mark.parametrize("wrong_mps", [-2.0, -1.0, 1.0])
def test_a_velocity_that_laid_rows_onto_rows_is_put_right(place, wrong_mps):
    """Tolerance: 3 cm of displacement at the nearest sweep, a tenth of the spacing of rows."""
    here = see_dome(place)
    targets = [target_of(gap_s, see_dome(place + SPEED_MPS * gap_s, seed=k)) for k, gap_s in enumerate((0.1, -0.1))]
    fit = follow(here, SPEED_MPS + np.array([wrong_mps, 0, 0]), targets)
    assert fit is not None
    np.testing.assert_allclose(fit.velocity_mps, SPEED_MPS, atol=0.3)
    assert fit.residual_m < 0.03


def test_chords_of_what_is_convex_do_not_pull_it_aside():
    """Five rows: laid one way alone the dome lies .13 or .09 m/s beside its motion, and the errors of both meet."""
    start_mps = np.array([5.0, 0, 0])
    fits = []
    for seed in range(4):
        here = see_dome((6, 0, 0), seed=10 + seed, num_rows=5)
        target = target_of(0.1, see_dome((6.6, 0, 0), seed=seed, num_rows=5))
        fits.append(follow(here, start_mps, [target]))
    assert np.mean([fit.velocity_mps[0] for fit in fits]) == pytest.approx(6.0, abs=0.06)


def see_side(x_m, seed=0):
    """Return a flat side of 8 m beside the lidar that starts at ``x_m``."""
    rng = np.random.default_rng(seed)
    x, z = np.meshgrid(np.arange(0, 8, 0.1), np.arange(0.3, 2.5, 0.25))
    y = np.full(x.size, 3.0) + rng.normal(0, NOISE_M, x.size)
    return np.stack([x.ravel() + x_m + rng.uniform(0, 0.1), y, z.ravel()], axis=1).astype(np.float32)


def test_a_side_keeps_the_velocity_along_itself_and_finds_the_one_across():
    there = see_side(-4) + np.float32([0, 0.1, 0])
    fit = follow(see_side(-4, seed=1), np.array([1.5, 0, 0]), [target_of(0.1, there)])
    assert fit is not None
    assert fit.velocity_mps[0] == pytest.approx(1.5, abs=0.1)
    assert fit.velocity_mps[1] == pytest.approx(1.0, abs=0.1)


def test_a_start_that_is_as_good_stays():
    targets = [target_of(0.1, see_dome(np.array([6, -2.5, 0]) + SPEED_MPS * 0.1, seed=1))]
    assert follow(see_dome((6, -2.5, 0)), SPEED_MPS, targets) is None


def test_lidars_that_turn_out_of_phase_each_follow_their_own():
    """The second one looks 0.05 s later: its points of the next sweep are nearer to those of the first."""

    def lidar_of(*clouds):
        return np.repeat([0, 1], [len(cloud) for cloud in clouds]).astype(np.uint8)

    place, late = np.array([6, -2.5, 0]), SPEED_MPS * 0.05
    here = see_dome(place, num_rows=9), see_dome(place + late, seed=1, num_rows=8)
    there = [
        see_dome(place + moved, seed=k, num_rows=k) for moved, k in ((SPEED_MPS * 0.1, 9), (SPEED_MPS * 0.1 + late, 8))
    ]
    target = target_of(0.1, np.concatenate(there), lidar_of_point=lidar_of(*there))
    start_mps = SPEED_MPS - np.array([1.5, 0, 0])
    fit = follow(np.concatenate(here), start_mps, [target], lidar_of_point=lidar_of(*here))
    assert fit is not None
    np.testing.assert_allclose(fit.velocity_mps, SPEED_MPS, atol=0.4)


def test_what_has_few_points_or_meets_no_surface_keeps_its_velocity():
    here = see_dome((6, -2.5, 0))
    empty = np.empty((0, 3), dtype=np.float32)
    assert follow(here[:20], SPEED_MPS, [target_of(0.1, here)]) is None
    for nowhere in (empty, here[:2], here + np.float32([0, 20, 0])):
        assert follow(here, SPEED_MPS, [target_of(0.1, nowhere)]) is None


def test_a_rigid_motion_of_the_scene_changes_nothing():
    """Beams start elsewhere and look elsewhere, the same surfaces move the same way in the turned frame."""
    place, start_mps = np.array([6, -2.5, 0]), SPEED_MPS - np.array([1.0, 0, 0])
    angle = 2.5
    turn = np.array([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]])

    def move(points):
        return (points @ turn.T + [30, -20, 2]).astype(np.float32)

    here, there = see_dome(place), see_dome(place + SPEED_MPS * 0.1, seed=1)
    fit = follow(here, start_mps, [target_of(0.1, there)])
    origin = move(ORIGIN[None])[0].astype(np.float64)
    moved = follow(move(here), turn @ start_mps, [target_of(0.1, move(there), origin)], origin)
    np.testing.assert_allclose(moved.velocity_mps, turn @ fit.velocity_mps, atol=0.05)
