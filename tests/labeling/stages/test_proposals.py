import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from labeling.geometry.boxes import to_box_frame
from labeling.geometry.transforms import rotate_vectors, transform_points, yaw_translation
from labeling.stages.proposals import make_proposal, propose_boxes
from schemas.config import ProposalParams
from schemas.errors import InvalidInput
from schemas.lidars import Beams, Lidar
from schemas.objects import Clusters, DynamicPoints

PARAMS = ProposalParams()
LIDAR = Lidar((1.0, 0.0, 1.8), 0.0035, 0.0046, 0.02)
STAMP_NS = 1_700_000_000_000_000_000


def heap(center, num_points, seed=0, size_m=(4.0, 2.0, 1.5)):
    spread = np.random.default_rng(seed).uniform(-0.5, 0.5, (num_points, 3)) * size_m
    return (spread + center).astype(np.float32)


def dynamic_of(points, *, capture_s=None, pose=None, point_rows=None, ground_z=0.0):
    points = np.asarray(points, dtype=np.float32)
    rows = np.arange(len(points)) if point_rows is None else point_rows
    return DynamicPoints(
        sweep_index=7,
        timestamp_ns=STAMP_NS,
        world_from_ego=np.eye(4) if pose is None else pose,
        clusters=Clusters(rows.astype(np.int64), np.array([0, len(points)])),
        points_ego=points,
        beams=Beams((LIDAR,), np.zeros(len(points), np.uint8)),
        capture_offset_s=np.zeros(len(points), np.float32) if capture_s is None else capture_s.astype(np.float32),
        height_m=points[:, 2] - np.float32(ground_z),
        is_vacated=np.ones(len(points), dtype=bool),
    )


def velocities(*pairs):
    return np.concatenate([np.tile(np.float32(velocity), (count, 1)) for velocity, count in pairs])


def test_one_place_and_two_velocities_are_two_objects():
    points = heap((10, 3, 1), 200)
    velocity = velocities(((8, 0, 0), 120), ((1, 1, 0), 80))
    proposals = propose_boxes(dynamic_of(points), velocity, PARAMS)
    assert [p.point_rows.tolist() for p in proposals] == [list(range(120)), list(range(120, 200))]  # largest first
    np.testing.assert_allclose([p.velocity_mps for p in proposals], [[8, 0, 0], [1, 1, 0]], atol=1e-5)


@pytest.mark.parametrize("turn_s", [0.1, 0.5])
def test_what_the_seam_of_a_turn_shows_in_two_places_is_one_object(turn_s):
    """The left half of a car at 12 m/s is seen at the beginning of a turn, its right half at the end."""
    points = heap((10, 3, 1), 200)
    is_right = points[:, 1] < 3
    capture_s = np.where(is_right, turn_s, 0.0)
    points[is_right, 0] += 12 * turn_s
    velocity = velocities(((12, 0, 0), 200))
    (proposal,) = propose_boxes(dynamic_of(points, capture_s=capture_s), velocity, PARAMS)
    assert len(proposal.point_rows) == 200
    np.testing.assert_allclose(proposal.box_visible[3:6], [4, 2, 1.5], atol=0.1)
    late = propose_boxes(dynamic_of(points, capture_s=capture_s), velocity, PARAMS.leave_out("deskewing"))
    assert len(late) == (2 if turn_s > 0.3 else 1)


def test_one_velocity_and_two_places_are_two_objects():
    points = np.concatenate([heap((10, 3, 1), 100), heap((30, 3, 1), 60, seed=1)])
    proposals = propose_boxes(dynamic_of(points), velocities(((8, 0, 0), 160)), PARAMS)
    assert [len(p.point_rows) for p in proposals] == [100, 60]


def test_one_place_and_one_velocity_are_one_object():
    points = heap((10, 3, 1), 100)
    velocity = velocities(((8, 0, 0), 100)) + np.random.default_rng(0).normal(0, 0.2, (100, 3)).astype(np.float32)
    (proposal,) = propose_boxes(dynamic_of(points), velocity, PARAMS)
    assert len(proposal.point_rows) >= 95


def test_two_walkers_side_by_side_are_two_objects():
    """Half a metre apart and at one velocity: to Algorithm 1 of the paper they are one."""
    trunk_m = (0.2, 0.5, 1.5)
    points = np.concatenate([heap((12, 3, 1), 60, size_m=trunk_m), heap((12, 4, 1), 40, seed=1, size_m=trunk_m)])
    dynamic, velocity = dynamic_of(points), velocities(((1.4, 0, 0), 100))
    first, second = propose_boxes(dynamic, velocity, PARAMS)
    assert [p.point_rows.tolist() for p in (first, second)] == [list(range(60)), list(range(60, 100))]
    assert first.box_visible[4] == pytest.approx(0.5, abs=0.1)
    assert len(propose_boxes(dynamic, velocity, ProposalParams(without="walkers"))) == 1
    assert len(propose_boxes(dynamic, None, PARAMS)) == 1


def test_by_position_only_velocities_do_not_part():
    params = ProposalParams(without="flow_clustering")
    points, velocity = heap((10, 3, 1), 200), velocities(((8, 0, 0), 100), ((-8, 1, 0), 100))
    assert len(propose_boxes(dynamic_of(points), velocity, PARAMS)) == 2
    (proposal,) = propose_boxes(dynamic_of(points), velocity, params)
    np.testing.assert_allclose(proposal.velocity_mps, [0, 0.5, 0], atol=1e-5)


def test_slow_points_belong_to_nothing():
    points = heap((10, 3, 1), 100)
    assert propose_boxes(dynamic_of(points), velocities(((0.49, 0, 0), 100)), PARAMS) == ()
    assert propose_boxes(dynamic_of(points), np.zeros((100, 3), np.float32), PARAMS) == ()
    (proposal,) = propose_boxes(dynamic_of(points), velocities(((0.3, 0, 0), 40), ((1.01, 0, 0), 60)), PARAMS)
    assert proposal.point_rows.tolist() == list(range(40, 100))


def test_no_points_and_few_points_give_nothing():
    assert propose_boxes(dynamic_of(np.empty((0, 3))), np.empty((0, 3), np.float32), PARAMS) == ()
    for count in (1, 4):
        assert propose_boxes(dynamic_of(np.zeros((count, 3))), velocities(((5, 0, 0), count)), PARAMS) == ()
    assert len(propose_boxes(dynamic_of(np.zeros((5, 3))), velocities(((5, 0, 0), 5)), PARAMS)) == 1


@pytest.mark.parametrize("yaw", [0.0, 0.6, np.pi / 2, 2.5, -3.0])
def test_the_box_lies_along_the_motion_and_is_tight(block_cloud, yaw):
    turned = transform_points(yaw_translation(yaw, np.array([12.0, -4.0, 0.0])), block_cloud())
    velocity = velocities(((6 * np.cos(yaw), 6 * np.sin(yaw), 0), len(turned)))
    (proposal,) = propose_boxes(dynamic_of(turned), velocity, PARAMS)
    np.testing.assert_allclose(proposal.box_visible, [12, -4, 0.75, 4, 2, 1.5, yaw], atol=0.06)
    local = to_box_frame(proposal.points_world, proposal.box_visible)
    np.testing.assert_allclose(np.ptp(local, axis=0), proposal.box_visible[3:6], atol=1e-4)


def test_capture_time_is_the_mean_and_the_smear_is_carried_there():
    """A car at 20 m/s is seen during 50 ms: its points are a metre longer than the car."""
    points = heap((10, 3, 1), 300, size_m=(4.0, 2.0, 1.5)).astype(np.float64)
    capture_s = np.random.default_rng(1).uniform(0.02, 0.07, 300)
    smeared = points + capture_s[:, None] * [20, 0, 0]
    (proposal,) = propose_boxes(dynamic_of(smeared, capture_s=capture_s), velocities(((20, 0, 0), 300)), PARAMS)
    assert proposal.timestamp_ns - STAMP_NS == pytest.approx(capture_s.mean() * 1e9, abs=2e3)
    np.testing.assert_allclose(proposal.points_world, points + capture_s.mean() * np.array([20, 0, 0]), atol=1e-4)
    raw = PARAMS.leave_out("deskewing")
    (as_captured,) = propose_boxes(dynamic_of(smeared, capture_s=capture_s), velocities(((20, 0, 0), 300)), raw)
    np.testing.assert_allclose(as_captured.points_world, smeared, atol=1e-4)
    assert as_captured.timestamp_ns == proposal.timestamp_ns


def test_ground_and_sensor_are_carried_to_the_world():
    pose = yaw_translation(0.5, np.array([100.0, 50.0, 3.0]))
    dynamic = dynamic_of(heap((10, 3, 1), 100), pose=pose, ground_z=-0.4)
    proposal = make_proposal(dynamic, np.arange(100), np.array([5.0, 0, 0]), is_deskewed=True)
    assert proposal.ground_z_m == pytest.approx(2.6, abs=1e-5)
    np.testing.assert_allclose(proposal.sensor_origin_world, transform_points(pose, np.array([[1.0, 0, 1.8]]))[0])
    assert (proposal.sweep_index, proposal.timestamp_ns) == (7, STAMP_NS)


def test_rows_are_those_of_the_source_sweep():
    rows = np.random.default_rng(0).permutation(5000)[:100]
    (proposal,) = propose_boxes(
        dynamic_of(heap((10, 3, 1), 100), point_rows=rows), velocities(((5, 0, 0), 100)), PARAMS
    )
    np.testing.assert_array_equal(proposal.point_rows, rows)


@settings(max_examples=20)
@given(yaw=st.floats(-3, 3), x=st.floats(-1000, 1000), y=st.floats(-1000, 1000))
def test_moving_the_world_moves_the_proposals(yaw, x, y):
    points = np.concatenate([heap((10, 3, 1), 100), heap((30, 3, 1), 60, seed=1)])
    velocity = velocities(((8, 0, 0), 100), ((0, -3, 0), 60))
    pose = yaw_translation(yaw, np.array([x, y, 2.0]))
    for here, there in zip(
        propose_boxes(dynamic_of(points), velocity, PARAMS),
        propose_boxes(dynamic_of(points, pose=pose), velocity, PARAMS),
        strict=True,
    ):
        np.testing.assert_allclose(there.points_world, transform_points(pose, here.points_world), atol=1e-6)
        np.testing.assert_allclose(there.velocity_mps, rotate_vectors(pose, here.velocity_mps), atol=1e-6)
        np.testing.assert_allclose(there.box_visible[3:6], here.box_visible[3:6], atol=1e-6)
        np.testing.assert_allclose(
            there.box_visible[:3], transform_points(pose, here.box_visible[None, :3])[0], atol=1e-6
        )


def test_a_hundred_thousand_equal_points_cost_little(peak_growth_mb):
    """The neighbour lists of plain DBSCAN would take 80 GB."""
    dynamic, velocity = dynamic_of(np.ones((100_000, 3))), velocities(((5, 0, 0), 100_000))
    found = []
    assert peak_growth_mb(lambda: found.extend(propose_boxes(dynamic, velocity, PARAMS))) < 150
    assert [len(proposal.point_rows) for proposal in found] == [100_000]


def test_equal_velocities_over_a_wide_crowd_cost_little(peak_growth_mb):
    points = np.random.default_rng(0).uniform(-50, 50, (100_000, 3)) * [1, 1, 0.02]
    dynamic, velocity = dynamic_of(points), velocities(((5, 0, 0), 100_000))
    assert peak_growth_mb(lambda: propose_boxes(dynamic, velocity, PARAMS)) < 600


def test_what_does_not_fit_is_named():
    with pytest.raises(InvalidInput, match="velocity_ref_mps"):
        propose_boxes(dynamic_of(np.zeros((5, 3))), np.zeros((4, 3), np.float32), PARAMS)


@given(yaw=st.floats(-3.1, 3.1), seed=st.integers(0, 20))
@settings(max_examples=20, deadline=None)
def test_without_flow_a_place_is_an_object_in_its_smallest_box(yaw, seed):
    blocks = [
        transform_points(yaw_translation(yaw, place), heap((0, 0, 1), 300, seed)) for place in ((10, 3, 0), (25, 3, 0))
    ]
    proposals = propose_boxes(dynamic_of(np.concatenate(blocks)), None, PARAMS)
    assert [len(p.point_rows) for p in proposals] == [300, 300]
    for proposal in proposals:
        assert not proposal.velocity_mps.any()
        assert proposal.box_visible[3] > proposal.box_visible[4]
        turn = (proposal.box_visible[6] - yaw + np.pi / 2) % np.pi - np.pi / 2  # front and rear look the same
        assert abs(turn) < np.deg2rad(6)


@pytest.mark.parametrize("num_points", [0, 1, 4])
def test_without_flow_too_few_points_are_no_object(num_points):
    assert propose_boxes(dynamic_of(heap((10, 3, 1), num_points)), None, PARAMS) == ()
