import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from labeling.geometry.transforms import invert, transform_points, yaw_translation
from labeling.stages.icp import Target, align

HERE = np.eye(4)[None]


def run(source, target, starts=HERE, *, is_constrained=True, num_refined=3, cutoff_m=1.0, iterations=50):
    return align(
        np.asarray(source, dtype=np.float64),
        Target.of(np.asarray(target)),
        starts,
        iterations=iterations,
        cutoff_m=cutoff_m,
        is_constrained=is_constrained,
        num_refined=num_refined,
    )


@settings(max_examples=25)
@given(yaw=st.floats(-0.04, 0.04), shift=st.tuples(*[st.floats(-0.08, 0.08)] * 3), is_constrained=st.booleans())
def test_yaw_and_translation_are_recovered(body, yaw, shift, is_constrained):
    truth = yaw_translation(yaw, np.array(shift))
    alignment = run(transform_points(invert(truth), body), body, is_constrained=is_constrained)
    np.testing.assert_allclose(alignment.target_from_source, truth, atol=0.01)
    assert alignment.error_m < 0.01


@pytest.fixture(scope="module")
def body():
    """Return points on a car-like body, some 0.25 m apart, with no symmetry and no period."""
    x, y, z = np.meshgrid(np.arange(-2, 2.1, 0.25), np.arange(-1, 1.1, 0.25), np.arange(0, 1.6, 0.25), indexing="ij")
    is_shell = (np.abs(x) == 2) | (np.abs(y) == 1) | ((z == 1.5) & (x > -1)) | ((z == 0.75) & (x < -1))
    points = np.stack([x, y, z], axis=-1)[is_shell & ((z <= 0.75) | (x >= -1))]
    return points + np.random.default_rng(0).uniform(-0.08, 0.08, points.shape)


def test_constrained_keeps_the_z_axis_where_unconstrained_follows_the_roll(body):
    truth = np.eye(4)
    truth[:3, :3] = Rotation.from_euler("xyz", [0.06, -0.04, 0.05]).as_matrix()
    source = transform_points(invert(truth), body)
    free, bound = (run(source, body, is_constrained=flag) for flag in (False, True))
    np.testing.assert_allclose(free.target_from_source, truth, atol=0.01)
    np.testing.assert_array_equal(bound.target_from_source[2, :3], [0, 0, 1])
    np.testing.assert_array_equal(bound.target_from_source[:3, 2], [0, 0, 1])
    assert free.error_m < bound.error_m


def test_every_result_is_a_proper_motion(body):
    rng = np.random.default_rng(0)
    starts = np.stack([yaw_translation(a, rng.normal(0, 0.5, 3)) for a in rng.uniform(-3, 3, 12)])
    alignment = run(body[::3], body, starts, is_constrained=False, num_refined=12)
    rotation = alignment.target_from_source[:3, :3]
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-9)
    assert np.linalg.det(rotation) == pytest.approx(1.0)


def test_the_best_of_many_starts_wins(body):
    far = yaw_translation(2.8, np.array([3.0, -1.0, 0.2]))
    source = transform_points(invert(far), body)
    wrong, right = ([yaw_translation(a, np.array([x, 0, 0])) for x in (-9.0, 0.0, 3.0)] for a in (0.0, 2.7))
    assert run(source, body, np.stack(wrong)).error_m > 0.05
    alignment = run(source, body, np.stack(wrong + right), num_refined=6)
    np.testing.assert_allclose(alignment.target_from_source, far, atol=1e-6)


def test_only_the_most_promising_starts_are_refined(body):
    good, bad = np.eye(4), yaw_translation(0.5, np.array([0.6, 0.4, 0.0]))
    starts = np.stack([bad, bad, good])
    np.testing.assert_allclose(run(body, body, starts, num_refined=1).error_m, 0, atol=1e-12)


FAR_AWAY = np.array([50.0, 0.0, 0.0])


def test_no_overlap_costs_the_cutoff_and_moves_nothing(body):
    alignment = run(body + FAR_AWAY, body, cutoff_m=0.7)
    assert alignment.error_m == pytest.approx(0.7)
    np.testing.assert_array_equal(alignment.target_from_source, np.eye(4))


def test_the_error_counts_unmatched_points_at_the_cutoff(body):
    half = np.concatenate([body, body + FAR_AWAY])
    assert run(half, body, cutoff_m=0.7).error_m == pytest.approx(0.35)


@pytest.mark.parametrize("is_constrained", [True, False], ids=["constrained", "free"])
@pytest.mark.parametrize(
    "source",
    [np.zeros((1, 3)), np.zeros((30, 3)), np.outer(np.linspace(0, 1, 30), [1, 0, 0]), np.outer([0, 1], [0, 0, 1.0])],
    ids=["one point", "one place", "a line", "upright"],
)
def test_degenerate_sources_are_moved_onto_the_target(source, is_constrained):
    shift = np.array([0.01, -0.1, 0.1])  # along the line, less than half its spacing
    alignment = run(source, source + shift, is_constrained=is_constrained)
    moved = transform_points(alignment.target_from_source, source)
    np.testing.assert_allclose(moved, source + shift, atol=1e-6)
    rotation = alignment.target_from_source[:3, :3]
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-9)
    assert np.linalg.det(rotation) == pytest.approx(1.0)


def test_moving_the_target_moves_the_result_along(body):
    world = yaw_translation(1.1, np.array([300.0, -40.0, 2.0]))
    source = transform_points(yaw_translation(0.08, np.array([0.1, 0.05, 0.0])), body)
    here = run(source, body)
    there = run(source, transform_points(world, body), (world @ HERE[0])[None])
    np.testing.assert_allclose(there.target_from_source, world @ here.target_from_source, atol=1e-6)


def test_read_only_input_is_enough(body):
    arrays = [body.astype(np.float32), body.astype(np.float32), HERE.copy()]
    for array in arrays:
        array.flags.writeable = False
    assert run(*arrays).error_m == 0
