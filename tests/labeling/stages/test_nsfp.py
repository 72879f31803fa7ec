import numpy as np
import pytest
import torch
from scipy.optimize import minimize

from labeling.stages.nsfp import FitProblem, fit_nets
from schemas.config import FlowParams
from schemas.errors import InvalidInput

PARAMS = FlowParams()


def make_problem(points, target, *, start_m=(0, 0, 0), seed=0, cluster=0, fit_rows=None):
    points = np.asarray(points, dtype=np.float32)
    return FitProblem(
        clusters=np.array([cluster]),
        rows=np.arange(len(points)),
        points=points,
        fit_rows=np.arange(len(points)) if fit_rows is None else fit_rows,
        target=np.asarray(target, dtype=np.float32),
        target_rows=np.arange(len(target)),
        start_m=np.array(start_m, dtype=np.float64),
        rng=np.random.default_rng(seed),
    )


def fit_one(*arguments, params=PARAMS, **options):
    (result,) = fit_nets([make_problem(*arguments, **options)], params)
    return result


def test_a_right_start_is_kept_to_the_last_bit(block_cloud):
    cloud = block_cloud(num_points=100)
    result = fit_one(cloud, cloud + np.float32([0.8, -0.2, 0]), start_m=(0.8, -0.2, 0))
    np.testing.assert_allclose(result.flow_m, np.tile([0.8, -0.2, 0], (100, 1)), atol=1e-5)
    assert result.num_iterations <= PARAMS.patience + 1  # nothing to gain: it stops early
    assert result.final_loss_m2 < 1e-9
    assert result.is_finite


def test_a_voted_start_that_explains_the_points_stays_where_the_net_would_drift(block_cloud):
    """Two samplings of one rigid body: the nets follow the sampling, up to 0.19 m off."""
    cloud, target = block_cloud(num_points=300), block_cloud(num_points=300, seed=1) + np.float32([0.8, -0.2, 0])
    drifting = FlowParams(max_fit_residual_share=1.0)
    drifted = fit_one(cloud, target, start_m=(0.8, -0.2, 0), params=drifting)
    assert np.abs(drifted.flow_m - np.float32([0.8, -0.2, 0])).max() > 0.1
    kept = fit_one(cloud, target, start_m=(0.8, -0.2, 0))
    np.testing.assert_array_equal(kept.flow_m, np.tile(np.float32([0.8, -0.2, 0]), (300, 1)))


def test_a_turning_cluster_takes_the_field_of_the_net(block_cloud):
    cloud = block_cloud(num_points=120)
    own_m = 0.08 * np.column_stack([-cloud[:, 1], cloud[:, 0], np.zeros(120)]) + [0.5, 0, 0]
    result = fit_one(cloud, cloud + own_m, start_m=(0.5, 0, 0))
    assert (result.flow_m != np.float32([0.5, 0, 0])).any(axis=1).all()
    error_m, of_start_m = (np.linalg.norm(flow - own_m, axis=1).mean() for flow in (result.flow_m, [0.5, 0, 0]))
    assert error_m < 0.5 * of_start_m


def test_without_a_start_a_translation_is_learnt(block_cloud):
    cloud = block_cloud(num_points=100)
    params = FlowParams(without="voted_start", iterations=300, patience=60)
    result = fit_one(cloud, cloud + np.float32([0.5, 0.2, 0]), params=params)
    error_m = np.linalg.norm(result.flow_m - [0.5, 0.2, 0], axis=1)
    assert error_m.mean() < 0.12  # Chamfer matches are ambiguous along the flat sides
    assert np.linalg.norm(result.flow_m.mean(axis=0) - [0.5, 0.2, 0]) < 0.08


def test_the_nets_learn_a_turn_that_no_translation_explains(block_cloud):
    cloud = block_cloud(num_points=120)
    cos, sin = np.cos(0.08), np.sin(0.08)
    turned = cloud @ np.array([[cos, sin, 0], [-sin, cos, 0], [0, 0, 1]])
    result = fit_one(cloud, turned, params=FlowParams(local_consistency=0.1))  # the paper's alpha
    by_translation = np.linalg.norm(turned - cloud, axis=1).mean()
    assert np.linalg.norm(result.flow_m - (turned - cloud), axis=1).mean() < 0.25 * by_translation


def test_the_field_is_evaluated_at_points_the_fit_did_not_see(block_cloud):
    cloud = block_cloud(num_points=300)
    turned = cloud + 0.05 * np.column_stack([-cloud[:, 1], cloud[:, 0], np.zeros(300)]).astype(np.float32)
    result = fit_one(cloud, turned, fit_rows=np.arange(0, 300, 3), params=FlowParams(iterations=120))
    assert result.flow_m.shape == (300, 3)
    error_m = np.linalg.norm(result.flow_m - (turned - cloud), axis=1)
    is_seen = np.arange(300) % 3 == 0
    assert error_m[~is_seen].mean() < 2 * error_m[is_seen].mean() + 0.02


@pytest.mark.parametrize("alpha", [0.0, 0.5, 2.0])
def test_consistency_is_the_sum_over_all_pairs_of_equation_2(alpha):
    """Three points too far apart to be mistaken; the fit must end where eq. 2, written out pair by pair, is least."""
    points = np.array([[0, 0, 0], [10, 0, 0], [0, 10, 0]], dtype=np.float32)
    own_m = np.array([[0.6, 0, 0], [0.0, 0.3, 0], [-0.3, 0.3, 0.0]])

    def equation_2(flat):
        flow = flat.reshape(3, 3)
        chamfer = 2 * ((flow - own_m) ** 2).sum()  # from the cloud to the target and back
        pairs = sum(((flow[i] - flow[j]) ** 2).sum() for i in range(3) for j in range(3) if i != j)
        return chamfer + alpha / 3 * pairs

    expected = minimize(equation_2, np.zeros(9)).x.reshape(3, 3)
    params = FlowParams(
        local_consistency=alpha, without="backward_net", iterations=600, patience=200, learning_rate=0.003
    )
    result = fit_one(points, points + own_m, params=params)
    np.testing.assert_allclose(result.flow_m, expected, atol=0.01)


def test_matches_beyond_the_cutoff_do_not_pull():
    points = np.zeros((20, 3)) + np.linspace(0, 1, 20)[:, None]
    params = FlowParams(chamfer_cutoff_m=1.0)
    far = fit_one(points, points + np.array([3.0, -3.0, 3.0]), params=params)
    np.testing.assert_array_equal(far.flow_m, 0)
    near = fit_one(points, points + np.array([0.2, -0.2, 0.2]), params=params)
    assert np.abs(near.flow_m).max() > 0.1


@pytest.mark.parametrize("without", [(), "backward_net"])
def test_a_batch_gives_what_single_fits_give(block_cloud, without):
    """Different sizes in one padded batch. Tolerance 5 mm: float32 sums in another order, over 60 iterations."""
    params = FlowParams(without=without)

    def problems():
        clouds = [block_cloud((size, 1, 1), 30 + 25 * k, seed=k) for k, size in enumerate((4.0, 1.0, 0.5, 8.0))]
        targets = [cloud[: 20 + 30 * k] + np.float32([0.1 * k, 0.05, 0]) for k, cloud in enumerate(clouds)]
        return [
            make_problem(c, t, seed=k, start_m=(0.1 * k, 0, 0), cluster=k)
            for k, (c, t) in enumerate(zip(clouds, targets, strict=True))
        ]

    together = fit_nets(problems(), params)
    alone = [fit_nets([problem], params)[0] for problem in problems()]
    backwards = fit_nets(problems()[::-1], params)[::-1]
    for one, batched, reverse in zip(alone, together, backwards, strict=True):
        np.testing.assert_allclose(batched.flow_m, one.flow_m, atol=5e-3)
        np.testing.assert_allclose(reverse.flow_m, one.flow_m, atol=5e-3)
        assert batched.final_loss_m2 == pytest.approx(one.final_loss_m2, rel=0.05, abs=1e-5)


def test_equal_keys_give_equal_bytes_and_other_keys_do_not(block_cloud):
    cloud, target = block_cloud(num_points=60), block_cloud(num_points=60, seed=1) + np.float32([0.3, 0, 0])
    first, again, other = (fit_one(cloud, target, seed=seed).flow_m for seed in (7, 7, 8))
    assert first.tobytes() == again.tobytes()
    assert first.tobytes() != other.tobytes()


def test_moving_the_cluster_far_away_changes_nothing(block_cloud):
    """The nets see offsets from the cluster's mean; on a grid of 2^-10 m no bit is lost on the way to 64 m."""
    cloud, target = (np.round(block_cloud(num_points=64, seed=seed) * 1024) / 1024 for seed in (0, 1))
    here, there = (fit_one(cloud + far, target + far) for far in (np.zeros(3), np.array([64.0, -32.0, 1.0])))
    np.testing.assert_allclose(there.flow_m, here.flow_m, atol=1e-5)


def test_a_broken_fit_is_reported_and_hurts_nobody_else(block_cloud):
    cloud = block_cloud(num_points=40)
    good = make_problem(cloud, cloud + np.float32([0.2, 0, 0]), cluster=1)
    broken = cloud.copy()
    broken[3] = np.nan
    results = fit_nets([make_problem(broken, cloud, cluster=0), good], PARAMS)
    assert [result.is_finite for result in results] == [False, True]
    (alone,) = fit_nets([make_problem(cloud, cloud + np.float32([0.2, 0, 0]), cluster=1)], PARAMS)
    np.testing.assert_allclose(results[1].flow_m, alone.flow_m, atol=5e-3)


def test_iterations_are_bounded_and_the_best_iterate_is_kept(block_cloud):
    cloud, target = block_cloud(num_points=60), block_cloud(num_points=60, seed=1) + np.float32([0.3, 0, 0])
    losses = []
    for iterations in (1, 10, 40):
        result = fit_one(cloud, target, params=FlowParams(iterations=iterations, local_consistency=0.0))
        assert result.num_iterations <= iterations
        losses.append(result.final_loss_m2)
    assert losses[0] > losses[1] > losses[2]


@pytest.mark.parametrize(
    ("num_points", "num_targets"), [(1, 1), (1, 50), (50, 1), (2, 2)], ids=lambda number: f"{number}"
)
def test_the_smallest_problems_are_no_error(num_points, num_targets):
    points = np.linspace(0, 1, num_points * 3).reshape(-1, 3)
    target = np.linspace(0.1, 1.1, num_targets * 3).reshape(-1, 3)
    result = fit_one(points, target)
    assert result.is_finite
    assert np.isfinite(result.flow_m).all()


def test_equal_points_move_together():
    result = fit_one(np.ones((50, 3)), np.ones((50, 3)) + np.array([0.4, 0, 0]), params=FlowParams(iterations=150))
    np.testing.assert_allclose(result.flow_m, np.tile([0.4, 0, 0], (50, 1)), atol=0.03)


def test_a_cloud_too_large_for_a_distance_matrix_is_fitted_all_the_same(peak_growth_mb):
    """5,000 against 5,000 points: their matrix alone would have 25 million entries, and twice that with gradients."""
    cloud = np.random.default_rng(0).uniform(-20, 20, (5000, 3)).astype(np.float32)
    params = FlowParams(iterations=2, hidden_units=16)
    results = []
    growth_mb = peak_growth_mb(lambda: results.append(fit_one(cloud, cloud + np.float32(0.1), params=params)))
    assert growth_mb < 80
    assert results[0].is_finite
    assert results[0].num_iterations == 2


def test_nets_are_fitted_on_the_cpu_whatever_the_machine_has(monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    assert fit_one(np.eye(3), np.eye(3)).is_finite


def test_a_gpu_is_used_when_asked_for_and_refused_in_one_line_when_not_there(monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    with pytest.raises(InvalidInput, match=r"^flow\.device is cuda, but PyTorch finds no GPU here: .*$"):
        fit_one(np.eye(3), np.eye(3), params=FlowParams(device="cuda"))
