import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial import cKDTree

from labeling.geometry.boxes import points_in_box, to_box_frame
from labeling.geometry.transforms import transform_points
from labeling.readers.reader import SegmentReader
from labeling.synthetic.rigs import SpinningLidar
from labeling.synthetic.scene import Ground, Path, Scene, Slab, drive, wall
from labeling.synthetic.shapes import block, bus, car, cuboid, cyclist, swing_vertices, truck, walker
from schemas.errors import InvalidInput

EXACT = SpinningLidar(num_beams=32, azimuth_steps=720, noise_m=0.0, dropout=0.0)
SHAPES = [car(), car(style="van"), truck(), bus(), cyclist(), walker(), walker(is_walking=False), block()]


def test_reader_keeps_the_protocol():
    reader = Scene().reader(num_sweeps=1)

    assert isinstance(reader, SegmentReader)
    assert reader.read_sweep(0).num_points > 1000
    assert len(reader.read_annotations(0).track_ids) == 0


def test_one_sweep_has_no_flow():
    truth = Scene().reader(num_sweeps=1).read_point_truth(0)

    assert np.isnan(truth.flow_ref_m).all()
    assert truth.is_ground.all()


@pytest.mark.parametrize("index", [-1, 2])
def test_sweep_out_of_range_is_named(index):
    with pytest.raises(InvalidInput, match=f"sweep {index} is outside .*2 sweeps"):
        Scene().reader(num_sweeps=2).read_sweep(index)


def test_no_sweeps_is_an_error():
    with pytest.raises(InvalidInput, match="num_sweeps"):
        Scene().reader(num_sweeps=0)


def test_flat_ground_lies_on_its_plane():
    reader = Scene(ground=Ground(slope_x=0.03, slope_y=-0.02)).reader(1, lidar=EXACT)
    points = transform_points(reader.world_from_ego(0), reader.read_sweep(0).points_ego)

    np.testing.assert_allclose(points[:, 2], 0.03 * points[:, 0] - 0.02 * points[:, 1], atol=1e-3)  # float32 rays


def test_ego_takes_the_slope_of_the_ground():
    pose = Scene(ground=Ground(slope_x=0.05)).reader(1).world_from_ego(0)

    assert pose[2, 0] / pose[0, 0] == pytest.approx(0.05)
    np.testing.assert_allclose(pose[:3, :3] @ pose[:3, :3].T, np.eye(3), atol=1e-12)


def test_parts_of_the_ego_vehicle_ride_along_and_hide_what_is_behind_them():
    """A plate 3 m ahead of the lidar of a vehicle that turns: it is there when each of its points is seen."""
    ego = drive(block(), speed_mps=10.0, yaw_rate_radps=0.3).path
    plate = cuboid((4.35, 4.45), (-1, 1), (1.0, 2.5))
    reader = Scene(structures=(wall((30, -20), (30, 20)),), ego=ego, ego_parts=(plate,)).reader(5, lidar=EXACT)
    sweep, truth = reader.read_sweep(3), reader.read_point_truth(3)
    x, y, yaw, _ = ego.at(0.3 + sweep.capture_offset_s.astype(np.float64)).T
    points_world = transform_points(sweep.world_from_ego, sweep.points_ego)
    ahead_m = np.cos(yaw) * (points_world[:, 0] - x) + np.sin(yaw) * (points_world[:, 1] - y)
    is_own = np.abs(ahead_m - 4.35) < 0.001

    assert is_own.sum() > 500
    assert (reader.object_index(3)[is_own] == -1).all()
    assert not truth.is_ground[is_own].any()
    assert (truth.flow_ref_m[is_own] == 0).all()
    assert ahead_m[is_own].std() < 0.01 * sweep.points_ego[is_own, 0].std()  # the stamp's frame smears what rides along
    azimuth = np.arctan2(points_world[:, 1] - y, points_world[:, 0] - x) - yaw
    assert not (~is_own & (np.abs(azimuth) < 0.2) & (points_world[:, 2] > 1.4) & (points_world[:, 2] < 2.8)).any()


def test_ground_flags_know_kerbs_and_pavements_from_walls():
    ground = Ground(slope_x=0.02, slabs=(Slab((-30, 30), (4, 9)),))
    reader = Scene(ground, structures=(wall((-30, 9), (30, 9)),)).reader(1, lidar=EXACT)
    points, truth = reader.read_sweep(0).points_ego, reader.read_point_truth(0)
    world = transform_points(reader.world_from_ego(0), points)
    height = world[:, 2] - 0.02 * world[:, 0]

    is_wall = np.abs(world[:, 1] - 9) < 1e-3
    np.testing.assert_array_equal(truth.is_ground, ~is_wall)
    on_kerb = truth.is_ground & (height > 0.01) & (height < 0.11)
    on_pavement = truth.is_ground & (world[:, 1] > 4.01) & (np.abs(world[:, 0]) < 30)
    assert on_kerb.sum() > 10
    assert on_pavement.sum() > 500
    np.testing.assert_allclose(world[on_kerb, 1], 4, atol=1e-3)
    np.testing.assert_allclose(height[on_pavement], 0.12, atol=1e-3)


def test_a_wall_hides_what_is_behind():
    hidden, seen = drive(block(), (20, 0)), drive(block(), (-20, 0))
    reader = Scene(structures=(wall((10, -8), (10, 8)),), movers=(hidden, seen)).reader(1, lidar=EXACT)
    owner = reader.object_index(0)

    assert (owner == 0).sum() == 0
    assert (owner == 1).sum() > 20
    assert reader.read_annotations(0).track_ids == ("block-0000", "block-0001")


def test_a_moving_body_hides_what_is_behind_it_and_is_hidden_itself():
    near, far = drive(block(height_m=4.0), (10, -0.1), np.pi / 2, 1.0), drive(block(), (20, -0.1), np.pi / 2, 1.0)
    reader = Scene(movers=(near, far)).reader(1, lidar=EXACT)
    alone = Scene(movers=(far,)).reader(1, lidar=EXACT)

    assert (alone.object_index(0) == 0).sum() > 20
    assert (reader.object_index(0) == 1).sum() == 0


@settings(max_examples=20, deadline=None)
@given(
    shape=st.sampled_from([bus(), truck(), car(), cyclist(), block(30.0, 2.0, 2.0)]),
    x=st.floats(-25, 25),
    y=st.floats(3, 15),
    yaw=st.floats(-0.2, 0.2),
)
def test_a_creeping_body_is_seen_like_a_parked_one(shape, x, y, yaw):
    """Moving and fixed bodies take two ways through the caster; both must show the same world."""
    parked = Scene(movers=(drive(shape, (x, y + 2.5), yaw),)).reader(1, lidar=EXACT)
    creeping = Scene(movers=(drive(shape, (x, y + 2.5), yaw, 1e-9),)).reader(1, lidar=EXACT)
    owners = parked.object_index(0), creeping.object_index(0)

    assert (owners[0] == 0).sum() > 0
    assert abs(len(owners[0]) - len(owners[1])) <= 2  # a beam at an edge may go either way
    distance, nearest = cKDTree(parked.read_sweep(0).points_ego).query(creeping.read_sweep(0).points_ego)
    assert np.quantile(distance, 0.99) < 1e-3
    assert (owners[0][nearest] != owners[1]).mean() < 0.002


@settings(max_examples=15, deadline=None)
@given(
    speed=st.floats(0.5, 25),
    yaw=st.floats(-3.1, 3.1),
    angle=st.floats(-3, 3),
    slope=st.floats(-0.05, 0.05),
    hz=st.sampled_from([5.0, 10.0, 20.0]),
)
def test_flow_of_a_straight_mover_is_its_velocity_over_a_sweep(speed, yaw, angle, slope, hz):
    mover = drive(car(), (12 * np.cos(angle), 12 * np.sin(angle)), yaw, speed)
    reader = Scene(Ground(slope_x=slope), movers=(mover,)).reader(2, hz, EXACT)
    flow = reader.read_point_truth(0).flow_ref_m
    flow_world = flow @ reader.world_from_ego(0)[:3, :3].T
    owner = reader.object_index(0)

    expected = speed / hz * np.array([np.cos(yaw), np.sin(yaw), slope * np.cos(yaw)])
    assert (owner == 0).sum() > 5
    np.testing.assert_allclose(flow_world[owner == 0], np.tile(expected, ((owner == 0).sum(), 1)), atol=1e-5)
    assert not flow[owner < 0].any()


def test_flow_carries_points_onto_the_same_surface_one_sweep_later():
    """A turning block seen without rolling shutter: flowed points lie on the faces of its next box."""
    lidar = SpinningLidar(64, 1800, noise_m=0.0, dropout=0.0, has_rolling_shutter=False)
    mover = drive(block(), (10, 3), 0.4, 8.0, yaw_rate_radps=0.8)
    reader = Scene(movers=(mover,)).reader(3, lidar=lidar)
    rows = reader.object_index(1) == 0
    moved = reader.read_sweep(1).points_ego[rows] + reader.read_point_truth(1).flow_ref_m[rows]
    local = to_box_frame(moved, reader.read_annotations(2).boxes_ego[0])

    gap = np.abs(np.abs(local) - np.array([2.0, 1.0, 0.75])).min(axis=1)
    assert rows.sum() > 100
    assert gap.max() < 2e-3


def test_a_pausing_mover_has_zero_flow_to_the_last_bit():
    mover = drive(car(), (10, 4), 0.3, speed_mps=((0, 6), (0.5, 0), (1.0, 0), (1.5, 6)))
    reader = Scene(movers=(mover,)).reader(16)

    speeds = [
        np.linalg.norm(reader.read_point_truth(i).flow_ref_m[reader.object_index(i) == 0], axis=1).max() * 10
        for i in range(15)
    ]
    offset = float(reader.read_sweep(0).capture_offset_s[reader.object_index(0) == 0].mean())
    assert speeds[0] == pytest.approx(6 - 12 * (offset + 0.05), abs=0.1)  # braking at 12 m/s2 from its capture on
    assert max(speeds[6:9]) == 0
    assert speeds[14] > 4


@pytest.mark.parametrize("shape", SHAPES, ids=lambda shape: f"{shape.kind} {shape.size_m[0]:.1f} m")
def test_boxes_are_tight_around_what_is_seen(shape):
    still = [drive(shape, (8 * np.cos(a), 8 * np.sin(a)), a + 0.7) for a in (0.5, 1.7, 3.0, 4.4)]
    reader = Scene(movers=tuple(still)).reader(1, lidar=SpinningLidar(128, 3600, noise_m=0.0, dropout=0.0))
    boxes = reader.read_annotations(0).boxes_ego
    local = np.concatenate(
        [to_box_frame(reader.read_sweep(0).points_ego[reader.object_index(0) == i], boxes[i]) for i in range(4)]
    )

    slack = 0.3 if shape.kind == "walker" and shape.parts[1].swing_rad else 0.02  # a walker's box is the mean stride
    half = np.array(shape.size_m) / 2
    assert (np.abs(local) <= half + slack).all()
    assert (local.max(axis=0) >= half - 0.1 - slack).all()
    assert (local[:, :2].min(axis=0) <= -(half - 0.1 - slack)[:2]).all()
    assert local[:, 2].min() < -half[2] + 0.35  # the lowest beam on a wheel or shoe


def test_boxes_speak_for_the_mean_capture_time():
    """A fast car abeam is seen late in the turn: its box is where it was then, and holds its points."""
    reader = Scene(movers=(drive(block(), (-3, 8), 0.0, 20.0),)).reader(2, lidar=EXACT)
    sweep, owner = reader.read_sweep(0), reader.object_index(0)
    box = reader.read_annotations(0).boxes_ego[0]
    offset = float(sweep.capture_offset_s[owner == 0].mean())

    assert 0.06 < offset < 0.09
    assert box[0] == pytest.approx(-3 + 20 * offset, abs=1e-3)
    assert points_in_box(sweep.points_ego[owner == 0], box, margin_m=0.2).all()


def test_without_points_a_box_speaks_for_the_stamp():
    reader = Scene(structures=(wall((4, -9), (4, 9)),), movers=(drive(block(), (20, 0), 0.0, 10.0),)).reader(2)

    assert reader.read_annotations(1).boxes_ego[0, 0] == pytest.approx(21.0)


def test_rolling_shutter_follows_the_turn():
    sweep = Scene().reader(1).read_sweep(0)
    azimuth = np.arctan2(sweep.points_ego[:, 1], sweep.points_ego[:, 0] - 1.35)

    np.testing.assert_allclose(sweep.capture_offset_s, (azimuth + np.pi) / (2 * np.pi) * 0.1, atol=1e-6)
    assert (np.diff(sweep.capture_offset_s) >= 0).all()


def test_ego_motion_is_compensated_within_the_sweep():
    """A turning, driving ego sees a wall; carried to the world, all sweeps lie on it."""
    times = np.arange(0, 2, 0.05)
    path = Path(times, np.column_stack([12 * times, 0 * times, 0.3 * times, 12 * times]))
    reader = Scene(structures=(wall((-50, 9), (80, 9)),), ego=path).reader(10, lidar=EXACT)

    for index in (0, 9):
        world = transform_points(reader.world_from_ego(index), reader.read_sweep(index).points_ego)
        np.testing.assert_allclose(world[~reader.read_point_truth(index).is_ground, 1], 9, atol=2e-3)


def test_range_noise_and_dropout_have_the_stated_size():
    clean = Scene().reader(1, lidar=EXACT).read_sweep(0)
    noisy = Scene().reader(1, lidar=SpinningLidar(32, 720, noise_m=0.05, dropout=0.0)).read_sweep(0)
    lost = Scene().reader(1, lidar=SpinningLidar(32, 720, noise_m=0.0, dropout=0.05)).read_sweep(0)
    origin = np.array([1.35, 0.0, 1.64])

    spread = np.linalg.norm(noisy.points_ego - origin, axis=1) - np.linalg.norm(clean.points_ego - origin, axis=1)
    assert spread.std() == pytest.approx(0.05, rel=0.05)
    near, kept = (np.linalg.norm(sweep.points_ego, axis=1) < 8 for sweep in (clean, lost))
    assert 0.03 < 1 - kept.sum() / near.sum() < 0.2
    assert (~kept).sum() / (~near).sum() < kept.sum() / near.sum()  # more is lost far away


def test_legs_swing_with_the_distance_walked():
    mover = drive(walker(), (6, 0), np.pi / 2, 1.45)
    reader = Scene(movers=(mover,)).reader(9, lidar=SpinningLidar(64, 3600, noise_m=0.0, dropout=0.0))
    spread = []
    for index in range(9):
        box = reader.read_annotations(index).boxes_ego[0]
        local = to_box_frame(reader.read_sweep(index).points_ego[reader.object_index(index) == 0], box)
        spread.append(np.ptp(local[local[:, 2] < -0.6, 0]))  # between the shoes

    assert min(spread) < 0.35
    assert max(spread) > 0.6


def test_limbs_of_a_walker_at_rest_hang():
    (leg, distance) = (walker().parts[1], 0.0)

    np.testing.assert_allclose(swing_vertices(leg, distance), leg.mesh.vertices, atol=1e-12)


def test_what_stands_still_is_seen_at_the_same_place_again():
    structures = (wall((-20, 8), (40, 8)), wall((-20, -9), (40, -9)))
    ego = drive(block(), speed_mps=8.0).path
    lidar = SpinningLidar(64, 1800)
    reader = Scene(structures=structures, movers=(drive(car(), (14, 5)),), ego=ego).reader(6, lidar=lidar)
    clouds = [
        transform_points(
            reader.world_from_ego(i), reader.read_sweep(i).points_ego[~reader.read_point_truth(i).is_ground]
        )
        for i in (0, 5)
    ]
    clouds = [cloud[(np.abs(cloud[:, 0] - 8) < 8) & (cloud[:, 2] < 3)] for cloud in clouds]

    distance, _ = cKDTree(clouds[1]).query(clouds[0])
    assert np.median(distance) < 0.06  # noise of 0.02 and the spacing of beams
    assert np.quantile(distance, 0.95) < 0.2


def test_any_order_gives_the_same_bytes():
    scene = Scene(movers=(drive(walker(), (7, 3), 1.0, 1.5), drive(car(), (12, -3), 0.0, 9.0)))
    forward, backward = scene.reader(5), scene.reader(5)
    ascending = [forward.read_sweep(i).points_ego.tobytes() for i in range(5)]
    descending = [backward.read_sweep(i).points_ego.tobytes() for i in reversed(range(5))]

    assert ascending == descending[::-1]
    assert len(set(ascending)) == 5


def test_many_moving_parts_need_few_ray_casters():
    """A process dies at about a thousand open3d scenes; here 1,500 parts move."""
    movers = tuple(drive(walker(), (10.0 + i, 5.0), 0.0, 1.0) for i in range(300))
    reader = Scene(movers=movers).reader(1, lidar=SpinningLidar(16, 90))

    assert reader.read_sweep(0).num_points > 0
    assert (reader.object_index(0) >= 0).any()
