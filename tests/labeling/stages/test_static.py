from dataclasses import replace

import numpy as np
import pytest

from labeling.evidence.neighborhood import Neighborhood
from labeling.evidence.places import GroundedSweep
from labeling.evidence.vehicle import find_vehicle
from labeling.stages.ground import segment_ground
from labeling.stages.static import remove_static
from labeling.synthetic.rigs import SpinningLidar
from labeling.synthetic.scene import Scene, drive, wall
from labeling.synthetic.shapes import block, bus, car
from schemas.config import FlowParams, GroundParams, StaticParams, resolve_config
from schemas.frames import GroundMask, Sweep
from schemas.lidars import Lidar

LIDAR = SpinningLidar(num_beams=32, azimuth_steps=900)
PAPER = resolve_config("paper").static
HAND_MADE = Lidar((0.0, 0.0, 1.8), 0.0035, 0.0046, 0.02)
PARKED_X_M = (0.0, 6.0, 12.0, 18.0)


def voting_sweeps(stamps_ns, index, params):
    return Neighborhood(np.asarray(stamps_ns), params, FlowParams()).voters(index)


class World:
    """A scene and its sweeps with their ground, each made when asked for."""

    def __init__(self, scene, num_sweeps=41):
        self.reader = scene.reader(num_sweeps, lidar=LIDAR)
        self._held = {}

    def sweep(self, index):
        if index not in self._held:
            points = self.reader.read_sweep(index)
            ground = segment_ground(points.points_ego, GroundParams(), np.random.default_rng(0))
            self._held[index] = GroundedSweep(points, ground, self.reader.lidars)
        return self._held[index]

    def judge(self, index, params=None, voters=None):
        params = params or StaticParams()
        if voters is None:
            voters = voting_sweeps(self.reader.timestamps_ns, index, params)
        return remove_static(self.sweep(index), [self.sweep(int(k)) for k in voters], params)

    def dynamic_share(self, index, owner, **options):
        """Return the share of an object's points above the ground that is dynamic; owner -1: structures."""
        rows = (self.reader.object_index(index) == owner) & ~self.sweep(index).ground.is_ground
        assert rows.sum() > 20
        return self.judge(index, **options).is_dynamic[rows].mean()


@pytest.fixture(scope="module")
def street():
    """Return a wall, a row of parked cars (2 to 5), a mover (0) and a creeping car (1), seen from a moving vehicle."""
    movers = (drive(car(), (12, 4), 0.0, 8.0), drive(car(), (10, -4), 0.0, 1.5))
    parked = tuple(drive(car(), (x, -8)) for x in PARKED_X_M)
    ego = drive(block(), speed_mps=4.0).path
    return World(Scene(structures=(wall((-30, 12), (60, 12)),), movers=movers + parked, ego=ego))


@pytest.mark.parametrize("index", [0, 1, 20, 21, 40], ids=lambda index: f"sweep {index}")
def test_movers_are_dynamic_and_the_rest_is_static_at_ends_too(street, index):
    assert street.dynamic_share(index, 0) == 1.0
    assert street.dynamic_share(index, 1) == 1.0  # creeping: its long side slides along itself, the car is kept whole
    assert street.dynamic_share(index, -1) < 0.03
    parked = [street.dynamic_share(index, owner) for owner in (2, 3, 4)]
    assert np.median(parked) < 0.02
    assert max(parked) < 0.2  # at the ends of a segment one side is seen by few other sweeps


def test_ground_is_neither_and_all_else_is_one_of_both(street):
    mask, ground = street.judge(20), street.sweep(20).ground.is_ground
    np.testing.assert_array_equal(mask.is_static | mask.is_dynamic, ~ground)
    assert not (mask.is_static & mask.is_dynamic).any()


def test_order_of_the_window_and_the_sweep_itself_do_not_matter(street):
    voters = voting_sweeps(street.reader.timestamps_ns, 20, StaticParams())
    expected = street.judge(20).is_static
    np.testing.assert_array_equal(street.judge(20, voters=[*voters[::-1], 20]).is_static, expected)


def test_without_another_sweep_nothing_is_static(street):
    for params in (StaticParams(), PAPER):
        mask = street.judge(20, params, voters=[20])
        assert not mask.is_static.any()
        np.testing.assert_array_equal(mask.is_dynamic, ~street.sweep(20).ground.is_ground)


def test_a_wall_seen_again_after_a_bus_went_by_is_static():
    passing = drive(bus(), (-6, 6), 0.0, 10.0)
    world = World(Scene(structures=(wall((-30, 9), (30, 9)),), movers=(passing,)), num_sweeps=41)
    hidden = world.reader.read_sweep(6).points_ego, world.reader.object_index(6)
    assert (np.abs(hidden[0][hidden[1] == 0][:, 1] - 6) < 2).any()  # the bus stands before the wall in sweep 6
    for index in (0, 6, 20, 40):
        assert world.dynamic_share(index, -1) < (0.06 if index == 0 else 0.03)  # the first has four voters only
    assert world.dynamic_share(6, 0) > 0.98


def test_what_left_before_or_came_after_is_dynamic():
    """A car that waits for most of the window, and one that arrives and stays."""
    leaves = drive(car(), (10, 5), 0.0, ((0, 0), (2.4, 0), (3.4, 8)))
    world = World(Scene(structures=(wall((-30, 12), (60, 12)),), movers=(leaves,)), num_sweeps=41)
    assert world.dynamic_share(0, 0) < 0.02  # waits, and is known to wait
    assert world.dynamic_share(32, 0) > 0.98


@pytest.mark.parametrize(
    ("place", "ego_mps", "indices"),
    [
        ((15, 3.5), 0.0, (0, 20, 40)),
        ((12, 3.5), 1.5, (0, 20, 40)),
        ((-14, 3.5), 1.5, (0, 20, 40)),
        ((-4, 12), 0.0, (0, 20, 40)),
        ((0, 3.5), 1.5, (20,)),
        ((0, 3.5), 0.0, (20,)),
        ((6, 3.5), 4.0, (0, 40)),
    ],
    ids=["ahead", "ahead, driving", "behind, driving", "across", "beside, driving", "beside", "overtaken"],
)
def test_a_bus_creeping_beside_the_vehicle_is_dynamic(place, ego_mps, indices):
    """At 1.5 m/s its twelve metres of side slide along themselves; its ends must tell."""
    ego = drive(block(), speed_mps=ego_mps).path
    structures = (wall((-30, 15), (60, 15)),)
    world = World(Scene(structures=structures, movers=(drive(bus(), place, 0.0, 1.5),), ego=ego))
    for index in indices:
        assert world.dynamic_share(index, 0) > 0.7


def test_a_trailer_is_a_part_of_the_vehicle_however_long_its_sides():
    """Its ends come and go as those of a bus do, before a house that other sweeps see where it is not."""
    rng = np.random.default_rng(0)
    side = np.column_stack([rng.uniform(-8, -2.5, 3000), np.full(3000, 1.2), rng.uniform(0.3, 1.5, 3000)])
    road = np.column_stack([rng.uniform(-20, 20, (3000, 2)), np.zeros(3000)])
    house = np.column_stack([rng.uniform(-60, 60, 40_000), np.full(40_000, 9.0), rng.uniform(-8, 4, 40_000)])
    sweeps = knowing_the_vehicle([make_sweep(k, [side, road, house], x_m=k * 0.15) for k in range(41)])
    params = StaticParams()
    voters = voting_sweeps(np.array([s.sweep.timestamp_ns for s in sweeps]), 20, params)
    assert remove_static(sweeps[20], [sweeps[k] for k in voters], params).is_static[:3000].all()


def test_a_parked_bus_that_others_pass_is_static():
    """Its ends are hidden now and then: a sweep that does not see them says nothing."""
    passing = (
        drive(car(), (-20, 3.2), 0.0, 5.0),
        drive(car(), (-35, 3.2), 0.0, 8.0),
        drive(car(), (30, 3.2), 0.0, -4.0),
    )
    scene = Scene(movers=(drive(bus(), (2, 8)), *passing), ego=drive(block(), speed_mps=2.0).path)
    world = World(scene)
    for index in (0, 10, 20, 30, 40):
        assert world.dynamic_share(index, 0) < 0.1


def test_what_rides_along_with_the_vehicle_is_static():
    rng = np.random.default_rng(0)
    mirror = rng.uniform([1.8, 0.9, 0.8], [2.0, 1.1, 1.0], (60, 3))
    beside = rng.uniform([20, 4, 0.2], [22, 6, 1.5], (60, 3))  # as fast as the vehicle, but not of it
    road = np.column_stack([rng.uniform(-20, 20, (3000, 2)), np.zeros(3000)])
    sweeps = knowing_the_vehicle([make_sweep(k, [mirror, beside, road], x_m=k * 1.0) for k in range(41)])
    params = StaticParams()
    voters = voting_sweeps(np.array([s.sweep.timestamp_ns for s in sweeps]), 20, params)
    mask = remove_static(sweeps[20], [sweeps[k] for k in voters], params)
    assert mask.is_static[:60].all()
    assert mask.is_dynamic[60:120].all()


def knowing_the_vehicle(sweeps):
    """Return the sweeps with what they show of the vehicle that takes them."""
    vehicle = find_vehicle(
        len(sweeps),
        lambda index: sweeps[index].sweep,
        lambda sweep: sweeps[sweep.index].ground,
        lambda sweep: sweeps[sweep.index - 1 if sweep.index else 1].sweep,
    )
    return [replace(s, is_vehicle=vehicle.covers(s.sweep.points_ego) & ~s.ground.is_ground) for s in sweeps]


def make_sweep(index, parts, x_m=0.0, gap_s=0.1):
    points = np.concatenate(parts).astype(np.float32)
    pose = np.eye(4)
    pose[0, 3] = x_m
    stamp = 1_700_000_000_000_000_000 + round(index * gap_s * 1e9)
    times, lidar = np.zeros(len(points), np.float32), np.zeros(len(points), np.uint8)
    sweep = Sweep(index, stamp, points, times, pose, np.array([[0, 0, 1.8]], np.float32), lidar)
    return GroundedSweep(sweep, GroundMask(points[:, 2] < 0.05, points[:, 2]), (HAND_MADE,))


@pytest.mark.parametrize("step_m", [0.015, 0.025])
@pytest.mark.parametrize("gap_s", [0.1, 0.05])
def test_chamfer_marks_what_moved_less_than_20_cm_a_second(step_m, gap_s):
    """The paper's test: nearer than 0.2 m/s times the gap to a point of the sweep before. No floor, no spread."""
    heap = np.random.default_rng(0).uniform([5, 5, 0.5], [15, 15, 2.0], (40, 3))
    moved = heap + np.array([0, 0, step_m * gap_s / 0.1])
    before, now = make_sweep(0, [heap], gap_s=gap_s), make_sweep(1, [moved], gap_s=gap_s)
    mask = remove_static(now, [before], PAPER)
    assert mask.is_static.tolist() == [step_m < 0.2 * 0.1] * 40
    assert (PAPER.method, PAPER.max_speed_mps, PAPER.noise_factor, PAPER.resolution_factor) == (
        "chamfer",
        0.2,
        0.0,
        0.0,
    )


def test_chamfer_removes_the_ego_motion_first():
    heap = np.random.default_rng(0).uniform([5, 5, 0.5], [15, 15, 2.0], (40, 3))
    before, now = make_sweep(0, [heap], x_m=0.0), make_sweep(1, [heap - [1.5, 0, 0]], x_m=1.5)
    assert remove_static(now, [before], PAPER).is_static.all()


def test_chamfer_keeps_movers_on_a_street(street):
    assert street.dynamic_share(20, 0, params=PAPER) > 0.9
    assert street.dynamic_share(20, -1, params=PAPER) > 0.2  # and most of the wall, which is why the default differs


@pytest.mark.parametrize("method", ["visibility", "chamfer"])
@pytest.mark.parametrize("empty", ["this one", "the others", "all"])
def test_sweeps_without_a_point_above_ground_are_no_error(method, empty):
    road = np.column_stack([np.random.default_rng(0).uniform(-5, 5, (50, 2)), np.zeros(50)])
    heap = np.random.default_rng(1).uniform([5, 5, 0.5], [8, 8, 2.0], (40, 3))
    now = make_sweep(1, [road] if empty != "the others" else [road, heap])
    other = make_sweep(0, [road] if empty != "this one" else [road, heap])
    mask = remove_static(now, [other], StaticParams(method=method))
    assert not mask.is_static.any()
    np.testing.assert_array_equal(mask.is_dynamic, ~now.ground.is_ground)


def test_permuting_points_permutes_the_mask(street):
    voters = voting_sweeps(street.reader.timestamps_ns, 20, StaticParams())
    window = [street.sweep(int(k)) for k in voters]
    sweep, ground = street.sweep(20).sweep, street.sweep(20).ground
    order = np.random.default_rng(0).permutation(sweep.num_points)
    moved = {name: getattr(sweep, name)[order] for name in ("points_ego", "capture_offset_s", "lidar_of_point")}
    mask = GroundMask(ground.is_ground[order], ground.height_m[order])
    shuffled = GroundedSweep(replace(sweep, **moved), mask, street.reader.lidars)
    expected = street.judge(20).is_static[order]
    # the merge grid of connected components keeps one point of a cell, so a handful at its rims may differ
    assert (remove_static(shuffled, window, StaticParams()).is_static != expected).mean() < 0.002


def test_moving_the_world_changes_nothing(street):
    """Poses far away, as on city coordinates: the reference frame is the sweep's own."""
    voters = voting_sweeps(street.reader.timestamps_ns, 20, StaticParams())
    moved = {int(k): shift_world(street.sweep(int(k)), 250_000.0) for k in [*voters, 20]}
    mask = remove_static(moved[20], [moved[int(k)] for k in voters], StaticParams())
    assert (mask.is_static != street.judge(20).is_static).mean() < 0.001  # poses lose the last bits


def shift_world(grounded, shift_m):
    sweep = grounded.sweep
    pose = sweep.world_from_ego.copy()
    pose[:2, 3] += shift_m
    return GroundedSweep(replace(sweep, world_from_ego=pose), grounded.ground, grounded.lidars)
