"""What the lidars see of the vehicle that carries them, told from traffic that keeps its pace."""

from dataclasses import replace

import numpy as np
import pytest

from labeling.evidence.places import GroundedSweep
from labeling.geometry.transforms import transform_points, yaw_translation
from labeling.line import label_tracks, make_clock, observe_sweeps
from labeling.synthetic.rigs import SpinningLidar
from labeling.synthetic.scene import Scene, drive, wall
from labeling.synthetic.shapes import EGO_PARTS, block, car, cuboid, truck
from labeling.window import SweepWindow
from schemas.config import resolve_config
from schemas.errors import UnreadableSweep
from schemas.frames import GroundMask, Sweep
from schemas.lidars import Lidar

LIDAR = SpinningLidar(num_beams=32, azimuth_steps=900, min_range_m=0.25)
CONFIG = resolve_config("fast")
WALLS = (wall((-60, 14), (160, 14)), wall((-60, -14), (160, -14)))
TRAILER = (cuboid((-12.0, -3.5), (-1.2, 1.2), (0.3, 1.9)),)
PARTS = {**EGO_PARTS, "trailer": TRAILER}
SPEEDING_UP = ((0, 2.0), (2, 12.0))
CAB = np.random.default_rng(0).uniform([5.0, -1.1, 0.2], [5.6, 1.1, 2.2], (260, 3))  # as a recorder may paste it in


def road(ego_mps, movers=(), num_sweeps=14, **options):
    ego = drive(block(), speed_mps=ego_mps).path
    return Scene(movers=movers, ego=ego, **options).reader(num_sweeps, lidar=LIDAR)


class Changed:
    """A reader whose sweeps are changed; ``change`` may raise UnreadableSweep."""

    def __init__(self, reader, change):
        self._reader, self._change = reader, change
        self.dataset, self.uri, self.segment_id = reader.dataset, reader.uri, reader.segment_id
        self.timestamps_ns, self.lidars = reader.timestamps_ns, reader.lidars

    def read_sweep(self, index):
        return self._change(self._reader.read_sweep(index))


def paste(points):
    def change(sweep):
        return replace(
            sweep,
            points_ego=np.concatenate([sweep.points_ego, points]).astype(np.float32),
            capture_offset_s=np.concatenate([sweep.capture_offset_s, np.zeros(len(points), np.float32)]),
            lidar_of_point=np.concatenate([sweep.lidar_of_point, np.zeros(len(points), np.uint8)]),
        )

    return change


def marked(reader, index):
    return SweepWindow(reader, CONFIG).grounded(index).is_vehicle


@pytest.mark.parametrize("ego_mps", [8.0, SPEEDING_UP], ids=["steady", "speeding up"])
@pytest.mark.parametrize("part", PARTS)
def test_the_vehicle_is_found_whole_and_nothing_else_is(part, ego_mps):
    """A sweep has them where the vehicle was when they were seen: up to a metre from where it is at the stamp."""
    reader = road(ego_mps, (drive(car(), (20, 3.5), 0.0, 6.0),), ego_parts=PARTS[part])
    for index in (0, 7, 13):
        is_own = (reader.object_index(index) < 0) & ~reader.read_point_truth(index).is_ground
        assert is_own.sum() > 100
        is_marked = marked(reader, index)
        assert is_marked[is_own].mean() > 0.995
        assert not is_marked[~is_own].any()


def test_a_vehicle_that_is_not_seen_is_not_found(traffic):
    assert not SweepWindow(traffic, CONFIG).grounded(7).is_vehicle.any()


@pytest.fixture(
    params=[
        (truck(), (2.0, 3.5), 15.0, 14),
        (car(), (1.0, 3.0), 10.0, 14),
        (car(), (-1.0, -3.0), 10.0, 40),
        (car(), (10.0, 0.0), 8.0, 14),
        (car(), (14.0, 0.0), 10.0, 40),
        (car(), (-9.0, 0.0), 10.0, 40),
        (car(), (12.0, 0.0), 0.0, 14),
    ],
    ids=["lorry beside", "car beside", "for long", "ahead", "ahead for long", "behind for long", "all stand"],
)
def traffic(request):
    """Who keeps the vehicle's pace to the centimetre, as long as it is looked at."""
    shape, place, speed_mps, num_sweeps = request.param
    return road(speed_mps, (drive(shape, place, 0.0, speed_mps),), num_sweeps, structures=WALLS)


def test_who_keeps_the_pace_close_ahead_for_a_while_is_traffic():
    """Two metres from bumper to bumper, in which no road is in sight; then it speeds up."""
    ahead = drive(car(), (8.0, 0.0), 0.0, ((0, 8.0), (1.0, 8.0), (2.0, 14.0)))
    reader = road(8.0, (ahead,), 20)
    assert not any(marked(reader, index).any() for index in (0, 5, 19))


@pytest.mark.parametrize("yaw", [0.5, np.pi / 2, np.pi])
def test_the_frame_may_look_anywhere_and_lie_anywhere(yaw):
    """As that of a lidar mounted askew: the vehicle is about the way it drives."""
    new_from_old = yaw_translation(yaw, np.array([0.3, -0.2, -1.6]))

    def move(sweep):
        return replace(
            sweep,
            points_ego=transform_points(new_from_old, sweep.points_ego).astype(np.float32),
            sensor_origins_ego=transform_points(new_from_old, sweep.sensor_origins_ego).astype(np.float32),
            world_from_ego=sweep.world_from_ego @ np.linalg.inv(new_from_old),
        )

    reader = road(SPEEDING_UP, (drive(truck(), (2.0, 4.0), 0.0, SPEEDING_UP),), ego_parts=EGO_PARTS["roof"])
    expected, found = marked(reader, 9), marked(Changed(reader, move), 9)
    assert expected.sum() > 1000
    assert (found != expected).mean() < 0.001


def test_a_vehicle_that_starts_late_is_known_from_the_start():
    reader = Changed(road(((0, 0.0), (1.5, 0.0), (2.0, 6.0)), num_sweeps=30), paste(CAB))
    assert all(marked(reader, index)[-len(CAB) :].all() for index in (0, 15, 29))


@pytest.mark.parametrize("speed_mps", [0.0, 0.3], ids=["stands", "creeps"])
def test_a_vehicle_that_hardly_moves_cannot_be_told_from_what_stands(speed_mps):
    assert not marked(Changed(road(speed_mps, num_sweeps=10), paste(CAB)), 5).any()


def test_every_part_of_a_segment_knows_the_same_vehicle():
    """Wherever a process begins, and though two of the sweeps that are looked at cannot be read."""

    def lose(sweep):
        if sweep.index in (0, 7):
            raise UnreadableSweep("lost")
        return sweep

    def open_reader():
        return Changed(road(SPEEDING_UP, ego_parts=EGO_PARTS["bonnet"]), lose)

    through = SweepWindow(open_reader(), CONFIG)
    expected = [through.grounded(index).is_vehicle for index in (1, 2, 8, 13)]
    assert min(is_vehicle.sum() for is_vehicle in expected) > 100
    for index, is_vehicle in zip((1, 2, 8, 13), expected, strict=True):
        np.testing.assert_array_equal(marked(open_reader(), index), is_vehicle)


def test_rays_beside_a_part_of_the_vehicle_go_on():
    """A rack near the lidar takes many directions of a range image; a place behind it was seen through all the same."""
    rng = np.random.default_rng(0)
    rack = rng.uniform([0.30, -0.3, -0.1], [0.35, 0.3, 0.1], (20_000, 3))
    house = rng.uniform([20.0, -4.0, -2.0], [20.1, 4.0, 2.0], (4000, 3))
    points = np.concatenate([rack, house]).astype(np.float32)
    num = len(points)
    origin = np.zeros((1, 3), np.float32)
    sweep = Sweep(0, 0, points, np.zeros(num, np.float32), np.eye(4), origin, np.zeros(num, np.uint8))
    ground = GroundMask(np.zeros(len(points), bool), np.ones(len(points), np.float32))
    place = np.array([[10.0, 0.5, 0.2]], dtype=np.float32)
    lidars = (Lidar((0.0, 0.0, 0.0), np.deg2rad(0.2), np.deg2rad(0.27), 0.02),)
    blocked = GroundedSweep(sweep, ground, lidars)
    assert not blocked.sight_from(sweep).is_through(place, 0.25).any()
    knowing = GroundedSweep(sweep, ground, lidars, np.arange(len(points)) < len(rack))
    assert knowing.sight_from(sweep).is_through(place, 0.25).all()
    assert len(knowing.obstacles_from(sweep)) == len(house)


def label(reader):
    observations = list(observe_sweeps(reader, CONFIG))
    return label_tracks([o.proposals for o in observations], make_clock(observations), CONFIG, reader.segment_id)


def test_a_lorry_beside_and_a_cab_ahead_that_both_keep_their_place_are_told_apart():
    """They were boxes of 5.4 m of the lorry, and a car in every sweep."""
    reader = road(15.0, (drive(truck(), (2.0, 3.5), 0.0, 15.0),), structures=WALLS)
    (track,) = (track for track in label(Changed(reader, paste(CAB))) if track.score.max() > 0.5)
    assert len(track.sweep_index) == 14
    assert abs(track.boxes[0, 3] - 10.0) < 1.0
    assert abs(track.boxes[0, 1] - 3.5) < 0.5
