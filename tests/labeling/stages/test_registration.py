import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from labeling.geometry.neighbors import build_tree
from labeling.geometry.transforms import invert, transform_points, yaw_of, yaw_translation
from labeling.geometry.voxels import group_by_voxel
from labeling.stages import icp, registration
from labeling.stages.registration import register_track
from schemas.config import RegistrationParams, resolve_config
from schemas.objects import Proposal, Track

PARAMS = RegistrationParams()
PAPER = resolve_config("paper").registration
BOTH = pytest.mark.parametrize("params", [PARAMS, PAPER], ids=["default", "paper"])


def ways(num_views, speed_mps=8.0, yaw_rate=0.0, yaw=0.4):
    """Return (T, 4, 4) world_from_object of a drive, ten views a second."""
    poses, place = [], np.array([20.0, -5.0])
    for k in range(num_views):
        heading = yaw + yaw_rate * k * 0.1
        poses.append(yaw_translation(heading, np.append(place, 0.0)))
        place = place + speed_mps * 0.1 * np.array([np.cos(heading), np.sin(heading)])
    return np.stack(poses)


@pytest.fixture
def track_of(proposal_at):
    """Return a maker of the track of clouds (one a view, object frame) on a way."""

    def make(clouds, poses, speed_mps=8.0):
        proposals = []
        for k, (cloud, pose) in enumerate(zip(clouds, poses, strict=True)):
            yaw = yaw_of(pose)
            velocity = speed_mps * np.array([np.cos(yaw), np.sin(yaw)])
            proposals.append(proposal_at(cloud, k, pose[:2, 3], yaw, velocity))
        return Track("track", tuple(proposals))

    return make


def offsets_m(aligned, poses):
    """Return (T, 4) how far each view is from most about where four corners of the object are in the model."""
    corners = np.array([[2.0, 1, 0], [2, -1, 0], [-2, 1, 0], [-2, -1, 1.5]])
    in_model = [transform_points(m @ p, corners) for m, p in zip(aligned.model_from_world, poses, strict=True)]
    return np.linalg.norm(np.stack(in_model) - np.median(in_model, axis=0), axis=2)


def spread_m(aligned, poses):
    return offsets_m(aligned, poses).max()


def drift_of(aligned, poses):
    return np.sqrt((offsets_m(aligned, poses) ** 2).mean())


@BOTH
@pytest.mark.parametrize("yaw_rate", [0.0, 0.7, -0.7], ids=["straight", "left", "right"])
def test_equal_views_are_laid_on_each_other(block_cloud, track_of, params, yaw_rate):
    poses = ways(8, yaw_rate=yaw_rate)
    aligned = register_track(track_of([block_cloud(num_points=200)] * 8, poses), params)
    assert spread_m(aligned, poses) < 0.02
    assert np.nanmax(aligned.error_m) < 0.02
    np.testing.assert_array_equal(np.isnan(aligned.error_m), np.arange(8) == aligned.target_view)


def test_views_from_changing_sides_make_one_whole(block_cloud, track_of):
    """It is seen from behind, from the left, from ahead; neighbours share a side, the first and the last share none."""
    sides = [("back", "top"), ("back", "left", "top"), ("left", "top"), ("left", "front", "top"), ("front", "top")]
    clouds = [block_cloud(num_points=300, seed=k, sides=side) for k, side in enumerate(sides)]
    poses = ways(5)
    aligned = register_track(track_of(clouds, poses), PARAMS)
    assert spread_m(aligned, poses) < 0.4
    in_object = transform_points(invert(poses[aligned.target_view]), aligned.model_points.astype(np.float64))
    np.testing.assert_allclose(np.ptp(in_object, axis=0), [4, 2, 1.5], atol=0.35)


def test_a_second_look_at_all_views_together_undoes_drift(block_cloud, track_of):
    """Each view is 40 noisy points of two sides: the first are aligned with few points, the last with many."""
    poses, drift_m = ways(16), {"joint_rounds": [], "": []}
    for seed in range(0, 800, 100):
        clouds = []
        for k in range(16):
            cloud = block_cloud((4.0, 2.0, 1.5), 40, seed + k)
            noise = np.random.default_rng(seed + k).normal(0, 0.03, cloud.shape)
            clouds.append((cloud + noise)[(cloud[:, 0] > 0) | (cloud[:, 1] > 0)])
        track = track_of(clouds, poses)
        for without, found_m in drift_m.items():
            found_m.append(drift_of(register_track(track, RegistrationParams(without=without)), poses))
    assert np.mean(drift_m[""]) < 0.95 * np.mean(drift_m["joint_rounds"])


def test_a_lorry_that_passes_is_as_long_as_it_is(track_of):
    """Of eleven metres of side the lidar sees the seven abreast of it, most points in their middle.

    Both ends come into view at different times: that the side seen first reaches as far as the one seen last, a flat
    side would fit anywhere in between.
    """
    rng, poses = np.random.default_rng(0), ways(16, 10.0, yaw=0.0)
    middle = poses[:, 0, 3].mean()
    clouds = []
    for pose in poses:
        along = rng.uniform(-5.5, 5.5, 6000)
        offset_m = np.abs(along + pose[0, 3] - middle)
        is_seen = (offset_m < 3.5) & (rng.random(6000) < 0.9 * np.exp(-offset_m / 1.5))
        side = np.column_stack([along, np.full(6000, 1.25), rng.uniform(0.3, 3.4, 6000)])
        clouds.append((side[is_seen] + rng.normal(0, 0.02, (is_seen.sum(), 3))).astype(np.float32))
    track = track_of(clouds, poses, 10.0)
    lengths_m = {}
    for has_slide_test, params in ((True, PARAMS), (False, PARAMS.leave_out("slide_test"))):
        aligned = register_track(track, params)
        lengths_m[has_slide_test] = np.ptp(aligned.model_points[:, 0])
    assert lengths_m[True] == pytest.approx(11.0, abs=0.3)
    assert abs(lengths_m[False] - 11.0) > 1.0


def test_a_vehicle_does_not_turn_on_the_spot_and_a_walker_may(block_cloud, proposal_at):
    """The second view fits better across, and a flow that is off by a quarter turn says so too."""
    for scale, may_turn in ((1.0, False), (0.2, True)):
        long, wide = (block_cloud(np.multiply(size_m, scale), 400) for size_m in ((4.0, 3.0, 2.0), (3.0, 4.0, 2.0)))
        views = (
            proposal_at(long, 0, (0, 0), 0.0, (2.0, 0.0)),
            proposal_at(wide[:300], 1, (0.2, 0), 0.0, (2.0, 0.0), heading=-np.pi / 2),
        )
        turn = yaw_of(register_track(Track("track", views), PARAMS).model_from_world[1])
        assert abs(turn) == pytest.approx(np.pi / 2, abs=0.2) if may_turn else abs(turn) < 0.35


@pytest.mark.parametrize(("gap_sweeps", "may_jump"), [(1, False), (10, True)])
def test_a_view_lies_no_farther_from_where_flow_led_than_flow_led(block_cloud, proposal_at, gap_sweeps, may_jump):
    """The first view shows two boxes 7 m apart; the second shows one of them, and looks more like the other one."""
    own, other = block_cloud((1.5, 1.6, 1.5), 300), block_cloud((1.5, 2.4, 1.5), 300, seed=1)
    both = np.concatenate([own, other + np.array([7, 0, 0], dtype=np.float32)])
    seen = block_cloud((1.5, 2.3, 1.5), 300, seed=2)
    way_m = 10.0 * 0.1 * gap_sweeps
    views = (proposal_at(both, 0, (0, 0), 0.0, (10, 0)), proposal_at(seen, gap_sweeps, (way_m, 0), 0.0, (10, 0)))
    place = register_track(Track("track", views), PARAMS).model_from_world @ np.append([0, 0], [0, 1])
    jump_m = (place[1] - place[0])[0] + way_m
    assert jump_m == pytest.approx(7 if may_jump else 0, abs=0.3)


def test_the_densest_view_is_the_target_and_the_frame_hangs_on_its_centroid(block_cloud, track_of):
    clouds = [block_cloud(num_points=count) for count in (100, 150, 400, 120)]
    track = track_of(clouds, ways(4))
    aligned = register_track(track, PARAMS)
    assert aligned.target_view == 2
    expected = np.eye(4)
    expected[:3, 3] = -track.proposals[2].points_world.mean(axis=0)
    np.testing.assert_array_equal(aligned.model_from_world[2], expected)
    assert aligned.model_yaw == pytest.approx(track.proposals[2].box_visible[6])


def test_all_points_of_all_views_are_in_the_model(block_cloud, track_of):
    clouds = [block_cloud(num_points=count) for count in (100, 1500, 40)]
    track = track_of(clouds, ways(3))
    aligned = register_track(track, PARAMS)
    np.testing.assert_array_equal(np.bincount(aligned.model_view), [100, 1500, 40])
    for view in range(3):
        carried = transform_points(aligned.model_from_world[view], track.proposals[view].points_world)
        np.testing.assert_allclose(aligned.model_points[aligned.model_view == view], carried, atol=1e-5)


@pytest.mark.parametrize("is_constrained", [True, False])
def test_constrained_views_turn_about_z_only(block_cloud, proposal_at, is_constrained):
    """One view is rolled by 4 degrees: bumps in the road."""
    rolled = block_cloud(num_points=300) @ Rotation.from_euler("x", 0.07).as_matrix().T
    proposals = [proposal_at(block_cloud(num_points=400), 0, (0, 0), 0.0, (8, 0))]
    proposals.append(proposal_at(rolled.astype(np.float32), 1, (0.8, 0), 0.0, (8, 0)))
    params = RegistrationParams(without=() if is_constrained else "upright")
    aligned = register_track(Track("track", tuple(proposals)), params)
    tilt = np.arccos(np.clip(aligned.model_from_world[1, 2, 2], -1, 1))
    if is_constrained:
        assert tilt == 0.0
    else:
        assert tilt == pytest.approx(0.07, abs=0.03)


def test_the_grid_of_starts_finds_what_one_start_does_not(block_cloud, track_of):
    """The rear half after the front half: their centroids are 2 m apart, more than ICP reaches. Paper, appendix."""
    whole = block_cloud(num_points=600)
    clouds = [whole, whole[whole[:, 0] < -0.6]]
    poses = ways(2)
    with_grid, without = (
        register_track(track_of(clouds, poses), params) for params in (PAPER, PAPER.leave_out("translation_grid"))
    )
    assert spread_m(with_grid, poses) < 0.1
    assert with_grid.error_m[1] < without.error_m[1]


def test_headings_give_the_turn_to_start_from(block_cloud, track_of):
    poses = np.stack([yaw_translation(yaw, np.array([x, 0.0, 0])) for yaw, x in ((0.0, 0.0), (1.3, 3.0))])
    clouds = [block_cloud(num_points=300), block_cloud(num_points=200)]
    with_turn, without = (
        register_track(track_of(clouds, poses), params) for params in (PAPER, PAPER.leave_out("rotation_start"))
    )
    assert spread_m(with_turn, poses) < 0.15
    assert with_turn.error_m[1] < without.error_m[1]


@BOTH
@pytest.mark.parametrize(
    "cloud",
    [np.zeros((1, 3)), np.array([[0, 0, 0], [1, 0, 0.5]]), np.zeros((10, 3)), np.outer(np.arange(6), [0.5, 0, 0])],
    ids=["one point", "two points", "one place", "a line"],
)
@pytest.mark.parametrize("num_views", [1, 2, 6])
def test_degenerate_views_are_no_error(track_of, cloud, num_views, params):
    aligned = register_track(track_of([cloud.astype(np.float32)] * num_views, ways(num_views)), params)
    assert np.isfinite(aligned.model_from_world).all()
    assert np.isfinite(aligned.model_points).all()
    np.testing.assert_allclose(aligned.model_from_world[:, 2, 2], 1)
    assert np.isfinite(np.delete(aligned.error_m, aligned.target_view)).all()


def test_a_view_that_lies_nowhere_costs_the_cutoff(block_cloud, proposal_at):
    views = [proposal_at(block_cloud(), 0, (0, 0), 0.0, (8, 0))]
    scattered = block_cloud((300, 300, 30), num_points=30)
    views.append(proposal_at(scattered, 1, (0.8, 0), 0.0, (8, 0)))
    aligned = register_track(Track("track", tuple(views)), PARAMS)
    assert 0.8 < aligned.error_m[1] <= PARAMS.icp_cutoff_m


def moved_track(track, world):
    proposals = []
    for proposal in track.proposals:
        box = proposal.box_visible.copy()
        box[:3] = transform_points(world, box[None, :3])[0]
        box[6] += yaw_of(world)
        proposals.append(
            Proposal(
                proposal.sweep_index,
                proposal.timestamp_ns,
                box,
                world[:3, :3] @ proposal.velocity_mps,
                transform_points(world, proposal.points_world),
                proposal.point_rows,
                proposal.ground_z_m + world[2, 3],
                transform_points(world, proposal.sensor_origin_world[None])[0],
                proposal.num_vacated,
                proposal.range_noise_m,
            )
        )
    return Track(track.track_id, tuple(proposals))


@settings(max_examples=8)
@given(yaw=st.floats(-3, 3), x=st.floats(-5e4, 5e4), y=st.floats(-5e4, 5e4))
def test_moving_the_world_moves_the_views_along(moving_views, yaw, x, y):
    track, poses = moving_views
    world = yaw_translation(yaw, np.array([x, y, 30.0]))
    aligned = register_track(moved_track(track, world), PARAMS)
    assert spread_m(aligned, world @ poses) < 0.1


@pytest.fixture(scope="module")
def moving_views():
    rng = np.random.default_rng(0)
    poses, proposals = ways(4, yaw_rate=0.5), []
    body = rng.uniform([-2, -1, 0], [2, 1, 1.5], (150, 3))
    for k, pose in enumerate(poses):
        points = transform_points(pose, body)
        velocity = 8.0 * pose[:3, 0]
        box = np.array([*pose[:2, 3], 0.75, 4, 2, 1.5, yaw_of(pose)])
        rows = np.arange(150, dtype=np.int32)
        stamp = 1_700_000_000_000_000_000 + k * 100_000_000
        proposals.append(Proposal(k, stamp, box, velocity, points, rows, 0.0, np.array([0.0, 0, 1.8]), 150, 0.02))
    return Track("track", tuple(proposals)), poses


def test_the_same_track_gives_the_same_bytes(block_cloud, track_of):
    track = track_of([block_cloud(seed=k) for k in range(5)], ways(5))
    first, second = register_track(track, PARAMS), register_track(track, PARAMS)
    assert first.model_from_world.tobytes() == second.model_from_world.tobytes()
    assert first.model_points.tobytes() == second.model_points.tobytes()


def test_only_what_lies_worse_than_the_views_before_is_looked_for_elsewhere(block_cloud, track_of, monkeypatch):
    """That is the first one, of which nothing is known, and one that is full of noise."""
    poses, starts = ways(12), []
    clouds = [block_cloud(num_points=300, seed=k) for k in range(12)]
    clouds[8] = (clouds[8] + np.random.default_rng(0).normal(0, 0.15, (300, 3))).astype(np.float32)

    def count(source, target, of_view, **options):
        starts.append(len(of_view))
        return icp.align(source, target, of_view, **options)

    monkeypatch.setattr(registration, "align", count)
    register_track(track_of(clouds, poses), PARAMS.leave_out("joint_rounds"))
    assert starts == [1, 25, *[1] * 6, 1, 25, *[1] * 3]


@pytest.fixture
def count_points(monkeypatch):
    """Return a function that runs something and counts the points of models made, put into trees and asked of them."""
    counts = dict.fromkeys(("thinned", "in trees", "asked"), 0)

    class CountingTree:
        def __init__(self, points):
            self._tree, self.n = build_tree(points), len(points)
            counts["in trees"] += len(points)

        def query(self, points, **options):
            counts["asked"] += points[..., 0].size
            return self._tree.query(points, **options)

    def group(points, size):
        counts["thinned"] += len(points)
        return group_by_voxel(points, size)

    monkeypatch.setattr(icp, "build_tree", CountingTree)
    monkeypatch.setattr(registration, "group_by_voxel", group)

    def run(work):
        counts.update(dict.fromkeys(counts, 0))
        work()
        return dict(counts)

    return run


@BOTH
def test_a_view_costs_the_same_however_many_there_are(block_cloud, track_of, count_points, params):
    """Of 15 and of 120 views that show the object from ever new sides."""
    sides = [("back", "left"), ("left", "top"), ("left", "front"), ("front", "top"), ("front", "right")]
    params = params.model_copy(update={"max_source_points": 32})  # the paper's 25 starts are dear
    of_views = {}
    for num_views in (15, 120):
        clouds = [block_cloud(num_points=400, seed=k, sides=sides[5 * k // num_views]) for k in range(num_views)]
        track = track_of(clouds, ways(num_views))
        of_views[num_views] = count_points(lambda track=track: register_track(track, params))
    for name, few in of_views[15].items():
        assert 0 < few / 15 * 0.8 < of_views[120][name] / 120 < 1.25 * few / 15, name


def least_error_icp(source, target, start):
    """Return the error and the pose of the best iterate of one run of constrained ICP, written out plainly."""
    pose, best = start, (np.inf, start)
    for _ in range(PAPER.icp_iterations):
        moved = transform_points(pose, source)
        distance = np.linalg.norm(moved[:, None] - target, axis=2)
        is_near = distance.min(axis=1) < PAPER.icp_cutoff_m
        error_m = np.where(is_near, distance.min(axis=1), PAPER.icp_cutoff_m).mean()
        best = min(best, (error_m, pose), key=lambda iterate: iterate[0])
        a, b = moved[is_near], target[distance.argmin(axis=1)[is_near]]
        x, y = (a - a.mean(axis=0))[:, :2], (b - b.mean(axis=0))[:, :2]
        yaw = np.arctan2((x[:, 0] * y[:, 1] - x[:, 1] * y[:, 0]).sum(), (x * y).sum())
        turn = yaw_translation(yaw, np.zeros(3))
        pose = yaw_translation(yaw, b.mean(axis=0) - turn[:3, :3] @ a.mean(axis=0)) @ pose
    return best


def test_profile_paper_is_algorithm_2(block_cloud, track_of):
    poses = ways(4, yaw_rate=0.5)
    track = track_of([block_cloud(num_points=n, seed=n) for n in (40, 60, 50, 45)], poses)
    views = [proposal.points_world - proposal.points_world.mean(axis=0) for proposal in track.proposals]
    _, _, _, length, width, _, target_yaw = track.proposals[1].box_visible
    target = views[1]
    aligned = register_track(track, PAPER)
    for i in (2, 3, 0):
        turn = target_yaw - track.proposals[i].box_visible[6]
        strides = np.array([-0.5, -0.25, 0, 0.25, 0.5])
        places = [(u * length, v * width, 0) for u in strides for v in strides]
        to_world = yaw_translation(target_yaw, np.zeros(3))[:3, :3]
        runs = [least_error_icp(views[i], target, yaw_translation(turn, to_world @ place)) for place in places]
        error_m, pose = min(runs, key=lambda run: run[0])
        target = np.concatenate([target, transform_points(pose, views[i])])
        assert aligned.error_m[i] == pytest.approx(error_m, abs=1e-6)
        world_from_view = yaw_translation(0, track.proposals[i].points_world.mean(axis=0))
        np.testing.assert_allclose(aligned.model_from_world[i] @ world_from_view, pose, atol=1e-6)
