from itertools import chain

import numpy as np
import pytest

from labeling.geometry.transforms import invert, transform_points, yaw_translation
from labeling.stages.flow import MAX_BATCH_FITS, MAX_BATCH_PAIRS, estimate_flow, make_batches, query_target
from labeling.stages.nsfp import FitProblem
from labeling.stages.targets import FlowTarget
from schemas.config import FlowParams, resolve_config
from schemas.errors import InvalidInput
from schemas.lidars import Beams, Lidar
from schemas.objects import Clusters

RIGID = FlowParams(method="rigid", without="surfaces")  # there are none between points strewn by chance
NETS = FlowParams(without="sparse_nets, surfaces")  # a net for whatever moves
LIDAR = Lidar((0.0, 0.0, 1.8), 0.0035, 0.0046, 0.02)
METHODS = pytest.mark.parametrize("params", [RIGID, NETS], ids=["rigid", "nsfp++"])
CAR_M, WALKER_M = (4.0, 2.0, 1.5), (0.5, 0.5, 1.7)


class Body:
    """A block on a straight or turning way; seen by the same points in each sweep unless ``is_resampled``."""

    def __init__(self, make_cloud, place_m, velocity_mps=(0, 0), yaw_rate=0.0, size_m=CAR_M, num_points=120, seed=0):
        self._make_cloud = make_cloud
        self._place, self._velocity, self._yaw_rate = np.array(place_m), np.array(velocity_mps), yaw_rate
        self._size, self._num, self._seed = size_m, num_points, seed

    def pose(self, time_s):
        return yaw_translation(self._yaw_rate * time_s, np.append(self._place + self._velocity * time_s, 0.0))

    def seen(self, time_s, is_resampled=False):
        seed = self._seed + (round(time_s * 1000) % 97 if is_resampled else 0)
        cloud = self._make_cloud(self._size, self._num, seed)
        return transform_points(self.pose(time_s), cloud).astype(np.float32)

    def flow(self, gap_s, is_resampled=False):
        points = self.seen(0.0, is_resampled)
        return transform_points(self.pose(gap_s) @ invert(self.pose(0.0)), points) - points


def group(clouds):
    sizes = [len(cloud) for cloud in clouds]
    return np.concatenate(clouds), Clusters(np.arange(sum(sizes)), np.cumsum([0, *sizes]))


def beams_of(points):
    return Beams((LIDAR,), np.zeros(len(points), np.uint8))


def target_of(gap_s, clouds):
    points = np.concatenate(clouds)
    return FlowTarget(gap_s, points, points, beams_of(points), beams_of(points))


def flow_of(points, *arguments):
    return estimate_flow(points, beams_of(points), *arguments)


def own_rng(cluster):
    return np.random.default_rng(cluster)


def estimate(bodies, params, gap_s=0.1, *, is_resampled=False, rng_of_cluster=own_rng):
    """Return the flow, and the end-point error of each body."""
    points, clusters = group([body.seen(0.0, is_resampled) for body in bodies])
    targets = [target_of(k * gap_s, [b.seen(k * gap_s, is_resampled) for b in bodies]) for k in (1, 2, -1, -2)]
    flow = flow_of(points, clusters, targets, params, rng_of_cluster)
    truth = np.concatenate([body.flow(gap_s, is_resampled) for body in bodies])
    error_m = np.linalg.norm(flow.flow_ref_m - truth, axis=1)
    return flow, np.bincount(clusters.cluster_of_point, weights=error_m) / np.diff(clusters.offsets)


@METHODS
@pytest.mark.parametrize(
    ("velocity", "gap_s"), [((8, 0), 0.1), ((6, 2), 0.1), ((-20, 0), 0.1), ((8, 0), 0.2), ((0, -5), 0.05)]
)
def test_a_translation_is_found(block_cloud, params, velocity, gap_s):
    flow, error_m = estimate([Body(block_cloud, (15, 3), velocity)], params, gap_s)
    assert error_m[0] < 0.02
    assert flow.gap_s == gap_s
    np.testing.assert_allclose(flow.flow_ref_m.mean(axis=0) / gap_s, [*velocity, 0], atol=0.1)


@pytest.mark.parametrize(("params", "bound_m"), [(RIGID, 0.06), (NETS, 0.3)], ids=["rigid", "nsfp++"])
def test_sweeps_that_sample_a_body_anew_blur_the_flow_only_so_much(block_cloud, params, bound_m):
    """Points of two sweeps are never the same; 120 on a car lie 0.4 m apart."""
    flow, error_m = estimate([Body(block_cloud, (15, 3), (8, 0))], params, is_resampled=True)
    assert error_m[0] < bound_m
    np.testing.assert_allclose(flow.flow_ref_m.mean(axis=0) * 10, [8, 0, 0], atol=1.0)


def test_a_turning_car_turns_by_nets_and_slides_by_the_vote(block_cloud):
    car = Body(block_cloud, (15, 3), (6, 0), yaw_rate=0.8)
    _, by_vote = estimate([car], RIGID)
    _, by_nets = estimate([car], NETS)
    assert by_vote[0] < 0.16  # the turn alone moves points by 0.14 m
    assert by_nets[0] < 0.4 * by_vote[0]


@METHODS
def test_two_cars_passing_close_keep_their_own_flow(block_cloud, params):
    cars = [Body(block_cloud, (10, 3), (8, 0)), Body(block_cloud, (12, 5.6), (-8, 0), seed=1)]
    flow, error_m = estimate(cars, params)
    assert error_m.max() < 0.12
    np.testing.assert_allclose(flow.flow_ref_m[:120].mean(axis=0) * 10, [8, 0, 0], atol=1.0)
    np.testing.assert_allclose(flow.flow_ref_m[120:].mean(axis=0) * 10, [-8, 0, 0], atol=1.0)


@METHODS
def test_what_stands_still_gets_zero_and_no_fit(block_cloud, params):
    bodies = [Body(block_cloud, (10, 3)), Body(block_cloud, (5, 3), (1.4, 0.5), size_m=WALKER_M, num_points=60)]
    flow, error_m = estimate(bodies, params, is_resampled=False)
    np.testing.assert_array_equal(flow.flow_ref_m[:120], 0)
    assert error_m[1] < 0.03
    assert flow.num_iterations[0] == 0
    assert (flow.num_iterations[1] > 0) == (params.method == "nsfp++")
    assert not flow.is_failed.any()


def test_what_one_velocity_explains_gets_no_net(block_cloud):
    cars = [Body(block_cloud, (10, 3), (8, 0)), Body(block_cloud, (10, 12), (6, 0), yaw_rate=2.5)]
    flow, error_m = estimate(cars, FlowParams(), is_resampled=False)
    assert flow.num_iterations[0] == 0
    assert error_m[0] < 0.02
    assert flow.num_iterations[1] > 0  # it spins: no translation explains it


@METHODS
@pytest.mark.parametrize(("num_points", "is_fitted"), [(3, False), (4, False), (5, True)])
def test_clusters_below_min_points_get_zero(block_cloud, params, num_points, is_fitted):
    flow, _ = estimate([Body(block_cloud, (5, 3), (4, 0), size_m=WALKER_M, num_points=num_points)], params)
    assert flow.flow_ref_m.any() == is_fitted
    assert (flow.num_iterations[0] > 0) == (is_fitted and params.method == "nsfp++")


@pytest.mark.parametrize("method", ["rigid", "nsfp++", "nsfp"])
def test_no_points_and_no_target_are_no_error(block_cloud, method):
    params = FlowParams(method=method)
    empty = np.empty((0, 3), dtype=np.float32)
    nowhere = target_of(0.1, [empty])
    car = Body(block_cloud, (10, 3))
    points, clusters = group([car.seen(0.0)])
    alone = flow_of(points, clusters, [nowhere], params, own_rng)
    np.testing.assert_array_equal(alone.flow_ref_m, np.zeros_like(points))
    assert not alone.is_failed.any()
    nobody = Clusters(np.empty(0, np.int64), np.zeros(1, np.int64))
    for target in (nowhere, target_of(0.1, [points])):
        flow = flow_of(empty, nobody, [target], params, own_rng)
        assert flow.flow_ref_m.shape == (0, 3)
        assert len(flow.is_failed) == 0


@METHODS
def test_what_left_no_place_does_not_move(block_cloud, params):
    """Both seem to move alike; rays passed through the places of the first alone."""
    bodies = [Body(block_cloud, (15, y), (4, 0)) for y in (3, -6)]
    points, clusters = group([body.seen(0.0) for body in bodies])
    targets = [target_of(0.1, [body.seen(0.1) for body in bodies])]
    is_vacated = np.zeros(len(points), dtype=bool)
    is_vacated[: len(points) // 20] = True
    flow = flow_of(points, clusters, targets, params, own_rng, is_vacated)
    mine = clusters.cluster_of_point == 0
    np.testing.assert_allclose(flow.flow_ref_m[mine].mean(axis=0), [0.4, 0, 0], atol=0.02)
    np.testing.assert_array_equal(flow.flow_ref_m[~mine], 0)


@METHODS
def test_no_flow_is_steeper_than_a_road(block_cloud, params):
    """Rows of points that lie 0.3 m higher in the next sweep: the beams met the object elsewhere, it did not climb."""
    car = Body(block_cloud, (15, 3), (8, 0))
    points, clusters = group([car.seen(0.0)])
    target = target_of(0.1, [car.seen(0.1) + np.float32([0, 0, 0.3])])
    climbs = flow_of(points, clusters, [target], params.model_copy(update={"max_grade": 1e6}), own_rng)
    assert climbs.flow_ref_m[:, 2].mean() == pytest.approx(0.3, abs=0.05)
    flow = flow_of(points, clusters, [target], params, own_rng).flow_ref_m
    assert (np.abs(flow[:, 2]) <= 0.12 * np.hypot(flow[:, 0], flow[:, 1]) + 1e-6).all()
    np.testing.assert_allclose(flow[:, :2].mean(axis=0), [0.8, 0], atol=0.05)


@METHODS
def test_a_shred_beside_a_car_moves_as_the_car_does(block_cloud, params):
    """Three points, fewer than get a flow of their own: what explains the car explains them."""
    car = Body(block_cloud, (15, 3), (8, 0))
    shred = np.float32([[17.6, 3.0, 0.8], [17.7, 3.1, 0.9], [17.6, 3.1, 1.0]])
    points, clusters = group([car.seen(0.0), shred])
    target = target_of(0.1, [car.seen(0.1), shred + np.float32([0.8, 0, 0])])
    flow = flow_of(points, clusters, [target], params, own_rng).flow_ref_m
    np.testing.assert_allclose(flow[clusters.cluster_of_point == 1], np.tile([0.8, 0, 0], (3, 1)), atol=0.05)
    alone = flow_of(points, clusters, [target], params.leave_out("pieces"), own_rng)
    assert not alone.flow_ref_m[clusters.cluster_of_point == 1].any()


def test_a_later_sweep_helps_where_the_next_one_lost_the_object(block_cloud):
    car = Body(block_cloud, (15, 3), (8, 0))
    points, clusters = group([car.seen(0.0)])
    empty = np.empty((0, 3), dtype=np.float32)
    targets = [target_of(0.1, [empty]), target_of(-0.1, [car.seen(-0.1)]), target_of(-0.2, [car.seen(-0.2)])]
    flow = flow_of(points, clusters, targets, NETS, own_rng)
    np.testing.assert_allclose(flow.flow_ref_m, np.tile([0.8, 0, 0], (len(points), 1)), atol=0.02)


@METHODS
def test_a_backward_gap_gives_the_flow_to_the_sweep_before(block_cloud, params):
    car = Body(block_cloud, (15, 3), (8, 0))
    points, clusters = group([car.seen(0.0)])
    flow = flow_of(points, clusters, [target_of(-0.1, [car.seen(-0.1)])], params, own_rng)
    assert flow.gap_s == -0.1
    np.testing.assert_allclose(flow.flow_ref_m.mean(axis=0), [-0.8, 0, 0], atol=0.02)


@pytest.mark.parametrize(("params", "atol_mps"), [(RIGID, 0.01), (NETS, 0.1)], ids=["rigid", "nsfp++"])
def test_a_doubled_time_gap_gives_the_same_speeds(block_cloud, params, atol_mps):
    bodies = [
        Body(block_cloud, (10, 3), (8, 0)),
        Body(block_cloud, (20, 9), (0, -2), size_m=WALKER_M, num_points=50, seed=2),
    ]
    speeds = []
    for gap_s in (0.1, 0.2):
        flow, _ = estimate(bodies, params, gap_s)
        speeds.append([part.mean(axis=0) / gap_s for part in (flow.flow_ref_m[:120], flow.flow_ref_m[120:])])
    np.testing.assert_allclose(speeds[0], speeds[1], atol=atol_mps)


@pytest.mark.parametrize(("params", "atol_m"), [(RIGID, 1e-5), (NETS, 0.02)], ids=["rigid", "nsfp++"])
def test_permuting_clusters_and_points_permutes_the_flow(block_cloud, params, atol_m):
    """Each cluster keeps its own random numbers. Nets: float32 sums in another order, over the iterations."""
    bodies = [Body(block_cloud, (9 * k, 3), (3 * k, 1), num_points=60 + 9 * k, seed=k) for k in range(1, 4)]
    expected, _ = estimate(bodies, params)
    order, rng = [2, 0, 1], np.random.default_rng(0)
    clouds = [body.seen(0.0) for body in bodies]
    rows = [rng.permutation(len(cloud)) for cloud in clouds]
    points, clusters = group([clouds[k][rows[k]] for k in order])
    targets = [target_of(k * 0.1, [b.seen(k * 0.1) for b in bodies]) for k in (1, 2, -1, -2)]
    flow = flow_of(points, clusters, targets, params, lambda c: own_rng(order[c]))
    starts = np.cumsum([0, *map(len, clouds)])
    same = np.concatenate([expected.flow_ref_m[starts[k] + rows[k]] for k in order])
    np.testing.assert_allclose(flow.flow_ref_m, same, atol=atol_m)


@METHODS
def test_equal_keys_give_equal_bytes_whatever_came_before(block_cloud, params):
    bodies = [Body(block_cloud, (10, 3), (8, 0)), Body(block_cloud, (20, 9), (0, -2), seed=2)]
    first, _ = estimate(bodies, params, is_resampled=True)
    np.random.default_rng(5).normal(size=10)
    estimate(bodies[:1], params)
    second, _ = estimate(bodies, params, is_resampled=True)
    assert first.flow_ref_m.tobytes() == second.flow_ref_m.tobytes()


@pytest.mark.parametrize("method", ["rigid", "nsfp++", "nsfp"])
def test_read_only_input_is_enough_and_stays_as_it_was(block_cloud, method):
    car = Body(block_cloud, (15, 3), (8, 0))
    arrays = [car.seen(0.0), car.seen(0.1)]
    before = [array.copy() for array in arrays]
    for array in arrays:
        array.flags.writeable = False
    clusters = Clusters(np.arange(120), np.array([0, 120]))
    target = target_of(0.1, [arrays[1]])
    flow_of(arrays[0], clusters, [target], FlowParams(method=method, iterations=3), own_rng)
    for array, copy in zip(arrays, before, strict=True):
        np.testing.assert_array_equal(array, copy)


@METHODS
def test_a_hundred_thousand_equal_points_cost_little(peak_growth_mb, params):
    points, clusters = group([np.ones((100_000, 3), dtype=np.float32)])
    targets = [target_of(gap_s, [points + np.float32([5 * gap_s, 5 * gap_s, 0])]) for gap_s in (0.1, -0.1)]
    flows = []
    growth_mb = peak_growth_mb(lambda: flows.append(flow_of(points, clusters, targets, params, own_rng)))
    assert growth_mb < 300  # all pairs would be 40 GB
    np.testing.assert_allclose(flows[0].flow_ref_m[0], [0.5, 0.5, 0], atol=0.02)


def test_one_net_for_all_is_fitted_once_and_knows_no_clusters(block_cloud):
    car, other = Body(block_cloud, (10, 3), (3, 0)), Body(block_cloud, (14, 9), (3, 0), seed=1)
    params = FlowParams(method="nsfp", without="voted_start", iterations=200, patience=50)
    whole, error_m = estimate([car, other], params)
    assert len(set(whole.num_iterations)) == 1
    assert error_m.max() < 0.15
    points, _ = group([car.seen(0.0), other.seen(0.0)])
    one = Clusters(np.arange(240), np.array([0, 240]))
    flow = flow_of(points, one, [target_of(0.1, [car.seen(0.1), other.seen(0.1)])], params, own_rng)
    np.testing.assert_allclose(flow.flow_ref_m, whole.flow_ref_m, atol=1e-6)


def test_profile_paper_moves_a_walker(block_cloud):
    """The paper's eight layers of 128 units, from zero, pruned about the centroid; fewer iterations."""
    params = resolve_config("paper", {"flow.iterations": 150}).flow
    walker = Body(block_cloud, (5, 3), (1.4, 0.5), size_m=WALKER_M, num_points=60)
    flow, error_m = estimate([walker], params)
    assert error_m[0] < 0.05
    assert flow.num_iterations[0] > 20


def test_profile_paper_fits_what_stands_still_as_well(block_cloud):
    params = resolve_config("paper", {"flow.iterations": 5}).flow
    flow, _ = estimate([Body(block_cloud, (10, 3))], params)
    assert flow.num_iterations.tolist() == [5]


# Box query, paper section 3.1


def grid(low, high, step=0.25):
    """Return the nodes of a grid at height 1, none of them on a multiple of half a metre."""
    x, y = np.meshgrid(np.arange(low, high, step), np.arange(low, high, step), indexing="ij")
    return np.stack([x.ravel() + 0.01, y.ravel() + 0.01, np.ones(x.size)], axis=1).astype(np.float32)


def outline(length, width, center=(0.0, 0.0)):
    corners = np.array([[-1, -1], [-1, 1], [1, -1], [1, 1]]) * [length / 2, width / 2] + center
    return np.column_stack([corners, np.ones(4)]).astype(np.float32)


@pytest.mark.parametrize(
    ("length", "width", "buffers_m"),
    [(4, 2, (2.5, 1.25)), (2, 4, (1.25, 2.5)), (3, 3, (2.5, 2.5)), (8, 1, (2.5, 0.3125))],
)
def test_buffers_follow_the_aspect_ratio(length, width, buffers_m):
    params = FlowParams(max_buffer_m=2.5, without=("voted_start", "pruning"))
    target = grid(-8, 8)
    found = query_target(outline(length, width), target, np.zeros(3), params)
    reach = np.array([length / 2 + buffers_m[0], width / 2 + buffers_m[1]])
    np.testing.assert_array_equal(found, np.flatnonzero((np.abs(target[:, :2]) <= reach).all(axis=1)))


def test_without_expansion_the_tight_box_is_asked():
    params = FlowParams(without=("expansion", "voted_start", "pruning"))
    target = grid(-8, 8)
    found = query_target(outline(4, 2), target, np.zeros(3), params)
    np.testing.assert_array_equal(found, np.flatnonzero((np.abs(target[:, :2]) <= [2, 1]).all(axis=1)))


@pytest.mark.parametrize("num_points", [4, 20, 400])
def test_pruning_keeps_as_many_as_the_cluster_has_nearest_to_its_mean(num_points):
    rng = np.random.default_rng(0)
    cluster = rng.uniform([-2, -1, 0], [2, 1, 1.5], (num_points, 3)).astype(np.float32)
    target = rng.uniform([-4, -4, 0], [4, 4, 1.5], (300, 3)).astype(np.float32)
    wide = FlowParams(without=("voted_start", "pruning"))
    candidates = query_target(cluster, target, np.zeros(3), wide)
    found = query_target(cluster, target, np.zeros(3), FlowParams(without="voted_start"))
    distance = np.linalg.norm(target - cluster.mean(axis=0), axis=1)
    assert len(found) == min(len(candidates), num_points)
    assert set(found) == set(candidates[np.argsort(distance[candidates])[: len(found)]])
    assert (np.diff(found) > 0).all()


def test_about_the_voted_place_the_query_moves_with_the_vote():
    target = grid(-8, 8)
    there = FlowParams(max_buffer_m=1.0, without="pruning")
    found = query_target(outline(2, 2), target, np.array([3.0, -1.0, 0]), there)
    inside = (np.abs(target[:, :2] - [3, -1]) <= 2).all(axis=1)
    np.testing.assert_array_equal(found, np.flatnonzero(inside))


@pytest.mark.parametrize("cluster", [np.zeros((1, 3)), np.zeros((9, 3)), np.outer(np.arange(5), [1, 0, 0])])
def test_a_cluster_without_width_still_has_a_query(cluster):
    cluster = cluster.astype(np.float32)
    found = query_target(cluster, np.concatenate([cluster, grid(5, 8)]), np.zeros(3), FlowParams())
    np.testing.assert_array_equal(found, np.arange(len(cluster)))
    assert len(query_target(cluster, np.empty((0, 3), dtype=np.float32), np.zeros(3), FlowParams())) == 0


# Batches


def problem_of(num_fit, num_target, cluster):
    points = np.zeros((num_fit, 3), dtype=np.float32)
    rows = np.arange(num_fit)
    target = np.zeros((num_target, 3), dtype=np.float32)
    return FitProblem(
        np.array([cluster]), rows, points, rows, target, np.arange(len(target)), np.zeros(3), own_rng(cluster)
    )


def test_batches_hold_each_problem_once_within_their_bounds_in_any_order():
    rng = np.random.default_rng(0)
    problems = [problem_of(*rng.integers(5, 900, 2), cluster) for cluster in range(200)]
    problems += [problem_of(6, 9, cluster) for cluster in range(200, 400)]
    problems.append(problem_of(4000, 4000, 400))  # larger than a batch may be: it goes alone
    batches = make_batches(problems)
    clusters = [[int(problem.clusters[0]) for problem in batch] for batch in batches]
    assert sorted(chain.from_iterable(clusters)) == list(range(401))
    assert [400] in clusters
    for batch in batches:
        widest = max(len(p.fit_rows) for p in batch) * max(max(len(p.target), len(p.fit_rows)) for p in batch)
        assert len(batch) <= MAX_BATCH_FITS
        assert len(batch) == 1 or widest * len(batch) <= 2 * MAX_BATCH_PAIRS
    shuffled = make_batches([problems[k] for k in rng.permutation(len(problems))])
    assert [[int(problem.clusters[0]) for problem in batch] for batch in shuffled] == clusters


def test_no_problems_no_batches():
    assert make_batches([]) == ()


def test_what_does_not_fit_is_named(block_cloud):
    points, clusters = group([block_cloud()])
    with pytest.raises(InvalidInput, match="points_ref"):
        flow_of(points[1:], clusters, [target_of(0.1, [points])], RIGID, own_rng)
