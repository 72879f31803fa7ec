"""Lidars whose steps, noise and phase are known, measured from what they saw."""

from dataclasses import replace

import numpy as np
import pytest

from labeling.evidence.lidars import lidars_of, measure_lidars
from labeling.geometry.transforms import transform_points, yaw_translation
from labeling.readers.reader import SegmentReader, open_segment
from labeling.synthetic.rigs import SpinningLidar
from labeling.synthetic.scene import Scene, wall
from schemas.lidars import NUM_WAYS, scans_of

ROOM = Scene(structures=(wall((-25, 9), (40, 14)), wall((35, -20), (30, 30)), wall((-20, -12), (30, -9))))


def street(options):
    return open_segment("synthetic", f"synthetic:street?sweeps=3&seed=1&{options}")


def sweeps_of(reader, number=2):
    return [reader.read_sweep(k) for k in range(number)]


def steps_of(lidar):
    return lidar.azimuth_step_rad, lidar.elevation_step_rad


def looks_of(lidar):
    """Return when it looks each way, NaN for never."""
    looks_s = np.array(lidar.look_times_s)
    return np.where(np.isfinite(looks_s), looks_s, np.nan)


@pytest.mark.parametrize(
    "options",
    [
        "beams=16",
        "beams=32&azimuth_steps=900",
        "beams=64",
        "beams=128",
        "rig=pair",
        "rig=taxi",
        "rig=rosette",
        "beams=32&noise_m=0.05",
    ],
)
def test_what_a_rig_is_is_measured(options):
    reader = street(options)
    measured = measure_lidars(sweeps_of(reader))
    assert len(measured) == len(reader.lidars)
    assert scans_of(measured) == scans_of(reader.lidars)
    for found, true in zip(measured, reader.lidars, strict=True):
        np.testing.assert_allclose(found.origin_m, true.origin_m, rtol=1e-6)
        np.testing.assert_allclose(steps_of(found), steps_of(true), rtol=0.1)
        assert found.range_noise_m == pytest.approx(true.range_noise_m, rel=0.35)
        looks_s, truly_s = looks_of(found), looks_of(true)
        assert (np.isfinite(looks_s) & np.isnan(truly_s)).mean() < 0.05
        if options != "rig=rosette":  # which looks everywhere all the time
            assert np.nanmedian(np.abs(looks_s - truly_s)) < 0.003


@pytest.mark.parametrize("noise_m", [0.01, 0.04, 0.12])
def test_noise_is_of_the_ranges_alone(noise_m):
    sweep = ROOM.reader(1, lidar=SpinningLidar(64, 1200, noise_m, dropout=0.3)).read_sweep(0)
    (lidar,) = measure_lidars([sweep])
    assert lidar.range_noise_m == pytest.approx(noise_m, rel=0.15)


@pytest.mark.parametrize("turned", [18, 36, 50])
def test_turning_the_rig_turns_when_it_looks_each_way_and_nothing_else(turned):
    """By a number of ways, so that each of them is another one."""
    yaw = 2 * np.pi * turned / NUM_WAYS
    turn = yaw_translation(yaw, np.array([3.0, -1.0, 0.5]))

    def move(sweep):
        points = transform_points(turn, sweep.points_ego).astype(np.float32)
        origins = transform_points(turn, sweep.sensor_origins_ego).astype(np.float32)
        return replace(sweep, points_ego=points, sensor_origins_ego=origins)

    sweeps = sweeps_of(street("beams=32&azimuth_steps=900&rig=pair"))
    there = measure_lidars([move(sweep) for sweep in sweeps])
    for before, after in zip(measure_lidars(sweeps), there, strict=True):
        np.testing.assert_allclose(steps_of(after), steps_of(before), rtol=0.02)
        assert after.range_noise_m == pytest.approx(before.range_noise_m, rel=0.02)
        np.testing.assert_allclose(looks_of(after), np.roll(looks_of(before), turned), atol=0.002)


@pytest.mark.parametrize("is_by_laser", [True, False], ids=["by beam", "by chance"])
def test_one_lidar_under_two_numbers_is_one(is_by_laser):
    (sweep,) = sweeps_of(street("beams=32&azimuth_steps=900"), 1)
    (whole,) = measure_lidars([sweep])
    number = np.random.default_rng(0).integers(0, 2, sweep.num_points)
    if is_by_laser:
        x, y, z = (sweep.points_ego - sweep.sensor_origins_ego[0]).T
        number = np.arctan2(z, np.hypot(x, y)) > np.deg2rad(-5)
    origins = np.repeat(sweep.sensor_origins_ego, 2, axis=0)
    first, second = measure_lidars([replace(sweep, lidar_of_point=number.astype(np.uint8), sensor_origins_ego=origins)])
    assert first == second == whole


def test_lidars_at_one_place_and_out_of_step_are_two():
    upper = SpinningLidar(32, 600)
    rig = (upper, replace(upper, starts_at_rad=0.0))
    first, second = measure_lidars([ROOM.reader(1, lidar=rig).read_sweep(0)])
    assert scans_of((first, second)) == (0, 1)
    assert first.origin_m == second.origin_m


@pytest.mark.parametrize("num_points", [0, 5])
def test_a_lidar_that_saw_nothing_gets_usual_values(num_points):
    (sweep,) = sweeps_of(street("beams=16&azimuth_steps=360"), 1)
    few = replace(
        sweep,
        points_ego=sweep.points_ego[:num_points],
        capture_offset_s=sweep.capture_offset_s[:num_points],
        lidar_of_point=sweep.lidar_of_point[:num_points],
    )
    for lidars in (measure_lidars([few]), measure_lidars([])):
        (lidar,) = lidars
        assert 0.001 < lidar.azimuth_step_rad <= lidar.elevation_step_rad < 0.02
        assert lidar.range_noise_m == pytest.approx(0.02)


def test_a_cloud_that_no_lidar_casts_gets_usual_values():
    """Points of all depths in each direction: no patch of them is a surface."""
    (sweep,) = sweeps_of(street("beams=16&azimuth_steps=360"), 1)
    points = np.random.default_rng(0).uniform([-40, -40, 0], [40, 40, 3], (sweep.num_points, 3)).astype(np.float32)
    assert measure_lidars([replace(sweep, points_ego=points)])[0].resolution_rad == measure_lidars([])[0].resolution_rad


class Recording(SegmentReader):
    """A street whose reader does not say what its lidars are; some sweeps cannot be read."""

    def __init__(self, unreadable=()):
        self._reader = street("beams=16&azimuth_steps=360")
        self.listing, self._unreadable = self._reader.listing, unreadable
        self.was_read = []

    def read_sweep(self, index):
        return self._reader.read_sweep(index)

    def read(self, index):
        self.was_read.append(index)
        return None if index in self._unreadable else self.read_sweep(index)


def test_the_first_sweeps_that_can_be_read_are_measured():
    whole, broken = Recording(), Recording(unreadable=(0,))
    assert lidars_of(whole, whole.read) == measure_lidars([whole.read_sweep(k) for k in range(3)])
    assert lidars_of(broken, broken.read) == measure_lidars([whole.read_sweep(k) for k in (1, 2)])
    assert whole.was_read == [0, 1, 2]


def test_a_reader_that_knows_its_lidars_is_believed():
    reader = street("rig=taxi&noise_m=0")
    assert lidars_of(reader, reader.read_sweep) == reader.lidars
