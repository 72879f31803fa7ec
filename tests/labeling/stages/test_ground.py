import numpy as np
import pytest

from labeling.geometry.transforms import transform_points, yaw_translation
from labeling.stages.ground import segment_ground
from labeling.synthetic.rigs import SpinningLidar
from labeling.synthetic.scene import Ground, Scene, Slab, drive, wall
from labeling.synthetic.shapes import car, walker
from schemas.config import GroundParams, resolve_config
from schemas.errors import InvalidInput

LIDAR = SpinningLidar(num_beams=32, azimuth_steps=720)
USERS = tuple(drive(shape, place) for shape, place in [(car(), (9, 4)), (car(), (-8, -5)), (walker(), (6, -6))])


def judge(points, params=None, seed=0):
    return segment_ground(points, params or GroundParams(), np.random.default_rng(seed))


def shares(scene, params=None):
    """Return the shares of the ground that is found, and of what stands higher than the margin that is kept."""
    reader = scene.reader(1, lidar=LIDAR)
    points, truth = reader.read_sweep(0).points_ego, reader.read_point_truth(0)
    mask = judge(points, params)
    world = points.astype(np.float64) @ reader.world_from_ego(0)[:3, :3].T + reader.world_from_ego(0)[:3, 3]
    true_height = world[:, 2] - scene.ground.height(world[:, 0], world[:, 1])
    is_near = np.linalg.norm(points[:, :2], axis=1) < 50
    stands = ~truth.is_ground & (true_height > 0.35) & is_near
    return mask.is_ground[truth.is_ground & is_near].mean(), (~mask.is_ground[stands]).mean()


@pytest.mark.parametrize(
    "ground",
    [
        Ground(),
        Ground(slope_x=0.08),
        Ground(slope_x=-0.08),
        Ground(slope_y=0.08),
        Ground(slope_x=0.05, slope_y=-0.05),
        Ground(crest_m=2.0, crest_x_m=25.0, crest_width_m=15.0),
        Ground(crest_m=-1.0, crest_x_m=0.0, crest_width_m=20.0),
        Ground(slabs=(Slab((-60, 60), (5.5, 12.0), 0.15), Slab((-60, 60), (-12.0, -7.0), 0.15))),
    ],
    ids=["flat", "8 % up", "8 % down", "8 % across", "slanting", "crest", "hollow", "kerbs"],
)
def test_the_road_is_found_and_what_stands_on_it_is_kept(ground):
    found, kept = shares(Scene(ground=ground, movers=USERS))
    assert found > 0.985
    assert kept > 0.985


def test_house_fronts_with_more_points_than_the_road_do_not_become_ground():
    fronts = (wall((-60, 5), (60, 5), 12.0), wall((-60, -5), (60, -5), 12.0), wall((30, -5), (30, 5), 12.0))
    scene = Scene(structures=fronts, movers=(drive(car(), (9, 2)),))
    is_ground = scene.reader(1, lidar=LIDAR).read_point_truth(0).is_ground
    assert is_ground.sum() < 0.5 * len(is_ground)
    found, kept = shares(scene)
    assert found > 0.985
    assert kept > 0.985


@pytest.mark.parametrize("profile", ["default", "paper"])
@pytest.mark.parametrize(
    "ground", [Ground(slope_x=0.08), Ground(slope_x=-0.08), Ground(slope_y=0.08)], ids=["up", "down", "across"]
)
def test_house_fronts_on_a_slope_of_8_percent_do_not_become_ground(ground, profile):
    fronts = (wall((-60, 5), (60, 5), 12.0, -6.0), wall((-60, -5), (60, -5), 12.0, -6.0))
    found, kept = shares(Scene(ground, fronts, (drive(car(), (9, 2)),)), resolve_config(profile).ground)
    assert found > 0.985
    assert kept > 0.985


def test_a_pavement_is_ground_and_so_is_its_kerb():
    scene = Scene(ground=Ground(slabs=(Slab((-60, 60), (5.5, 12.0), 0.15),)))
    reader = scene.reader(1, lidar=LIDAR)
    points = reader.read_sweep(0).points_ego
    mask = judge(points)
    is_kerb = (np.abs(points[:, 1] - 5.5) < 0.5) & (np.abs(points[:, 0]) < 20)
    assert is_kerb.sum() > 100
    assert mask.is_ground[is_kerb].mean() > 0.98
    far_up = (points[:, 1] > 7) & (points[:, 1] < 11) & (np.abs(points[:, 0]) < 20)
    np.testing.assert_allclose(mask.height_m[far_up], 0, atol=0.12)  # above the pavement, not above the road


@pytest.mark.parametrize("lowest_m", [0.25, 0.3, 0.35])
def test_a_cell_that_saw_only_a_side_of_a_car_is_no_ground(lowest_m):
    """Sparse beams: rings of road 3 m apart, between them the side of a car and no road."""
    ring = np.arange(-20, 21, 0.2)
    road = np.array([[x, y, 0] for x in np.arange(-18, 19, 3) for y in ring])
    side = np.array([[10.5, y, z] for y in np.arange(-2, 2, 0.1) for z in (lowest_m, lowest_m + 0.03, 0.8, 1.2)])
    mask = judge(np.concatenate([road, side]).astype(np.float32))
    assert mask.is_ground[: len(road)].all()
    assert not mask.is_ground[len(road) :].any()
    np.testing.assert_allclose(mask.height_m[len(road) :], side[:, 2], atol=0.05)


@pytest.mark.parametrize("origin_m", [0.0, 0.33, 1.73, 3.5], ids=lambda height: f"{height} m above the road")
def test_the_origin_may_be_on_the_road_or_on_the_roof(origin_m):
    reader = Scene(movers=USERS).reader(1, lidar=LIDAR)
    points = reader.read_sweep(0).points_ego + np.array([0, 0, 0.33 - origin_m], dtype=np.float32)
    mask, truth = judge(points), reader.read_point_truth(0)
    assert mask.is_ground[truth.is_ground].mean() > 0.985
    assert mask.is_ground[~truth.is_ground & (points[:, 2] > 0.35 - origin_m)].mean() < 0.01
    np.testing.assert_allclose(np.median(points[:, 2] - mask.height_m), -origin_m, atol=0.05)


def test_ghosts_below_the_road_do_not_pull_it_down():
    rng = np.random.default_rng(0)
    reader = Scene(movers=USERS).reader(1, lidar=LIDAR)
    points, truth = reader.read_sweep(0).points_ego, reader.read_point_truth(0)
    ghosts = points[rng.choice(np.flatnonzero(truth.is_ground), 150)] - [0, 0, 1] * rng.uniform(0.5, 4, (150, 1))
    mask = judge(np.concatenate([points, ghosts.astype(np.float32)]))
    assert mask.is_ground[: len(points)][truth.is_ground].mean() > 0.98
    assert mask.is_ground[len(points) :].all()  # nothing below the road is worth a second look
    assert np.median(mask.height_m[len(points) :]) < -1.5


def test_height_of_a_wall_is_measured_from_the_slope_beneath():
    ground = Ground(slope_x=0.08)
    reader = Scene(ground=ground, structures=(wall((15, -20), (15, 20), 5.0),)).reader(1, lidar=LIDAR)
    points = reader.read_sweep(0).points_ego
    world_z = points @ reader.world_from_ego(0)[2, :3] + reader.world_from_ego(0)[2, 3]
    on_wall = ~reader.read_point_truth(0).is_ground & (np.abs(points[:, 1]) < 10)
    assert on_wall.sum() > 500
    # the road at its foot is seen by a few beams only, and cells of wall alone take their lowest point for road
    np.testing.assert_allclose(judge(points).height_m[on_wall], world_z[on_wall] - 0.08 * 15, atol=0.3)


def test_without_refinement_there_is_one_plane():
    params = resolve_config("paper").ground
    points = (
        Scene(Ground(crest_m=2.0, crest_x_m=25.0, crest_width_m=15.0)).reader(1, lidar=LIDAR).read_sweep(0).points_ego
    )
    mask = judge(points, params)
    plane_z = points[:, 2].astype(np.float64) - mask.height_m
    design = np.column_stack([points[:, :2], np.ones(len(points))])
    plane, *_ = np.linalg.lstsq(design, plane_z, rcond=None)
    np.testing.assert_allclose(design @ plane, plane_z, atol=1e-4)
    np.testing.assert_array_equal(mask.is_ground, mask.height_m < params.inlier_distance_m)
    assert np.hypot(*plane[:2]) < np.tan(params.max_slope_rad)
    assert judge(points).is_ground.mean() > mask.is_ground.mean() + 0.01  # the crest needs more than a plane


def test_the_plane_is_never_steeper_than_allowed():
    rng = np.random.default_rng(0)
    steep = np.column_stack([rng.uniform(-20, 20, (4000, 2)), np.zeros(4000)])
    steep[:, 2] = 0.5 * steep[:, 0]
    mask = judge(steep.astype(np.float32), GroundParams(without="local_surface", max_slope_rad=0.1))
    plane, *_ = np.linalg.lstsq(np.column_stack([steep[:, :2], np.ones(4000)]), steep[:, 2] - mask.height_m, rcond=None)
    assert np.hypot(*plane[:2]) <= np.tan(0.1) + 1e-6


def test_equal_seeds_give_equal_masks_and_the_input_stays_as_it_was():
    points = Scene(movers=USERS).reader(1, lidar=LIDAR).read_sweep(0).points_ego
    before = points.copy()
    first, second = judge(points, seed=3), judge(points, seed=3)
    np.testing.assert_array_equal(first.height_m, second.height_m)
    np.testing.assert_array_equal(points, before)


@pytest.mark.parametrize("seed", range(5))
def test_no_seed_loses_the_road(seed):
    reader = Scene(ground=Ground(slope_x=0.06), movers=USERS).reader(1, lidar=LIDAR)
    mask = judge(reader.read_sweep(0).points_ego, seed=seed)
    assert mask.is_ground[reader.read_point_truth(0).is_ground].mean() > 0.985


@pytest.mark.parametrize("num_points", [0, 1, 2])
def test_fewer_points_than_a_plane_needs_are_no_ground(num_points):
    mask = judge(np.ones((num_points, 3), dtype=np.float32))
    assert mask.is_ground.tolist() == [False] * num_points
    assert mask.height_m.tolist() == [0.0] * num_points


@pytest.mark.parametrize("without", [(), "local_surface"])
@pytest.mark.parametrize(
    "points",
    [np.ones((1000, 3)), np.outer(np.arange(500), [1, 1, 0]), np.full((3, 3), 500.0)],
    ids=["one place", "a line", "far away"],
)
def test_degenerate_clouds_are_no_error(points, without):
    mask = judge(points.astype(np.float32), GroundParams(without=without))
    assert mask.is_ground.all()
    np.testing.assert_allclose(mask.height_m, 0, atol=1e-3)


def test_what_does_not_fit_is_named():
    with pytest.raises(InvalidInput, match="points_ego"):
        judge(np.zeros((5, 3)))


# Laws


STREET = Scene(Ground(slope_x=0.05, slabs=(Slab((-60, 60), (5.5, 12.0), 0.15),)), movers=USERS)


def test_permuting_points_permutes_the_mask():
    points = STREET.reader(1, lidar=LIDAR).read_sweep(0).points_ego
    order = np.random.default_rng(0).permutation(len(points))
    mask, permuted = judge(points), judge(points[order])
    np.testing.assert_array_equal(permuted.is_ground, mask.is_ground[order])
    np.testing.assert_array_equal(permuted.height_m, mask.height_m[order])


@pytest.mark.parametrize(
    ("yaw", "shift_m", "median_m", "largest_m"),
    [
        (np.pi / 2, (0, 0, 0), 1e-5, 1e-4),  # the grids fall on themselves
        (0.0, (0, 0, 2), 1e-5, 1e-4),
        (1.0, (0, 0, 0), 0.005, 0.2),  # other cells: a kerb lies between others
        (0.0, (1.3, -0.7, 0), 0.005, 0.2),
    ],
    ids=["quarter turn", "up", "turn", "aside"],
)
def test_moving_the_whole_scene_changes_nothing(yaw, shift_m, median_m, largest_m):
    points = STREET.reader(1, lidar=LIDAR).read_sweep(0).points_ego
    is_near = np.linalg.norm(points[:, :2], axis=1) < 50
    moved = transform_points(yaw_translation(yaw, np.array(shift_m, dtype=np.float64)), points).astype(np.float32)
    here, there = judge(points), judge(moved)
    assert (here.is_ground != there.is_ground)[is_near].mean() < 0.001
    difference_m = np.abs(here.height_m - there.height_m)[is_near]
    assert np.median(difference_m) < median_m
    assert difference_m.max() < largest_m


@pytest.mark.parametrize("without", [(), "local_surface"])
def test_a_hundred_thousand_equal_points_cost_little(peak_growth_mb, without):
    points = np.ones((100_000, 3), dtype=np.float32)
    assert peak_growth_mb(lambda: judge(points, GroundParams(without=without))) < 60
