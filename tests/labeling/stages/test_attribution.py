import numpy as np
import pytest

from labeling.stages.attribution import Claim, attribute_points, claims_by_sweep
from schemas.config import AttributionParams
from schemas.objects import LabeledTrack, SweepPoints

TRACKS, FLOW = AttributionParams(), AttributionParams(without="tracks")
CAR = np.array([10.0, 0, 1, 4, 2, 2, 0])
GAP_S = 0.1


def sweep_of(points, *, is_dynamic=True, flow_mps=(0.0, 0.0, 0.0), has_flow=True):
    size = len(points)
    dynamic = np.broadcast_to(is_dynamic, size).copy()
    flow = (np.asarray(flow_mps) * GAP_S * dynamic[:, None]).astype(np.float32)
    return SweepPoints(
        np.array(points, dtype=np.float32).reshape(-1, 3),
        np.arange(100, 100 + size, dtype=np.int32),
        dynamic,
        np.zeros(size, dtype=np.int32),
        flow if has_flow else None,
    )


def claim_of(box=CAR, next_box=None, *, velocity=(5.0, 0, 0), score=0.9, rows=(), name="a"):
    return Claim(name, box, next_box, np.array(velocity), score, np.array(rows, dtype=np.int32), 0.02)


def attribute(points, claims, params=TRACKS):
    return attribute_points(points, points.points_ego.astype(np.float64), claims, GAP_S, params)


def test_points_in_the_box_of_a_moving_object_are_its_own_even_if_called_static():
    points = sweep_of([[10, 0, 1], [11.9, 0.9, 0.5], [14, 0, 1]], is_dynamic=[True, False, False])
    motion = attribute(points, [claim_of()])
    np.testing.assert_array_equal(motion.owner, [0, 0, -1])
    np.testing.assert_array_equal(motion.is_dynamic, [True, True, False])
    np.testing.assert_allclose(motion.flow_world_m, [[0.5, 0, 0], [0.5, 0, 0], [0, 0, 0]], atol=1e-6)


def test_points_turn_with_the_box():
    turned = CAR + np.array([0, 0, 0, 0, 0, 0, np.pi / 2])
    motion = attribute(sweep_of([[11, 0, 1], [10, 0, 1]]), [claim_of(next_box=turned)])
    np.testing.assert_allclose(motion.flow_world_m, [[-1, 1, 0], [0, 0, 0]], atol=1e-6)


def test_what_belongs_to_no_object_has_no_flow_and_stays_dynamic_only_if_it_seemed_to_move():
    points = sweep_of([[30, 0, 1], [40, 0, 1]], flow_mps=(3, 0, 0), is_dynamic=[True, False])
    motion = attribute(points, [claim_of()])
    np.testing.assert_array_equal(motion.is_dynamic, [True, False])
    np.testing.assert_array_equal(motion.flow_world_m, 0)
    still = attribute(sweep_of([[30, 0, 1]]), [claim_of()])
    assert not still.is_dynamic.any()
    slow = attribute(sweep_of([[30, 0, 1]], flow_mps=(0.9, 0, 0)), [claim_of()])
    assert not slow.is_dynamic.any()


def test_a_moving_object_owns_nothing_outside_of_its_box():
    """The other end of a sweep's turn may show it elsewhere: what is not in the box does not move, by definition."""
    points = sweep_of([[10, 0, 1], [13, 0, 1]], flow_mps=(5, 0, 0))
    motion = attribute(points, [claim_of(rows=[100, 101])])
    np.testing.assert_array_equal(motion.owner, [0, -1])
    np.testing.assert_allclose(motion.flow_world_m, [[0.5, 0, 0], [0, 0, 0]], atol=1e-6)


def test_an_object_that_pauses_owns_its_proposal_alone():
    points = sweep_of([[10, 0, 1], [10.5, 0, 1]], is_dynamic=[True, False])
    motion = attribute(points, [claim_of(velocity=(0.1, 0, 0), rows=[100])])
    np.testing.assert_array_equal(motion.owner, [0, -1])


@pytest.mark.parametrize(("speed_mps", "moves"), [(0.6, False), (0.8, True)])
def test_an_object_that_creeps_stands(speed_mps, moves):
    points = sweep_of([[10, 0, 1], [10.5, 0, 1]], flow_mps=(speed_mps, 0, 0))
    motion = attribute(points, [claim_of(velocity=(speed_mps, 0, 0), rows=[100, 101])])
    np.testing.assert_array_equal(motion.owner, [0, 0])
    np.testing.assert_array_equal(motion.is_dynamic, moves)
    np.testing.assert_allclose(motion.flow_world_m[:, 0], speed_mps * GAP_S * moves, atol=1e-6)


@pytest.mark.parametrize(("score", "owner"), [(0.4, 1), (0.6, 0)])
def test_a_box_takes_points_of_another_proposal_only_when_it_is_believed(score, owner):
    claims = [claim_of(score=score), claim_of(CAR + np.array([0, 1, 0, 0, 0, 0, 0]), score=0.1, rows=[100], name="b")]
    motion = attribute(sweep_of([[10, 0.5, 1], [10, -0.5, 1]]), claims)
    np.testing.assert_array_equal(motion.owner, [owner, 0])


@pytest.mark.parametrize("order", [1, -1])
def test_of_two_objects_the_surer_one_takes_a_point(order):
    claims = [claim_of(score=0.3, velocity=(1, 0, 0)), claim_of(score=0.8, velocity=(2, 0, 0))][::order]
    motion = attribute(sweep_of([[10, 0, 1]]), claims)
    assert claims[motion.owner[0]].score == 0.8
    np.testing.assert_allclose(motion.flow_world_m, [[0.2, 0, 0]], atol=1e-6)


def test_without_a_next_sweep_there_is_no_flow_but_there_are_owners():
    motion = attribute(sweep_of([[10, 0, 1], [30, 0, 1]], has_flow=False), [claim_of()])
    assert motion.flow_world_m is None
    np.testing.assert_array_equal(motion.owner, [0, -1])
    np.testing.assert_array_equal(motion.is_dynamic, [True, True])  # nothing says that the second one stands


def test_method_flow_leaves_what_was_estimated():
    points = sweep_of([[10, 0, 1], [10.5, 0, 1], [30, 0, 1]], is_dynamic=[True, False, True], flow_mps=(3, 1, 0))
    motion = attribute(points, [claim_of(rows=[100])], FLOW)
    np.testing.assert_array_equal(motion.owner, [0, -1, -1])
    np.testing.assert_array_equal(motion.is_dynamic, points.is_dynamic)
    np.testing.assert_array_equal(motion.flow_world_m, points.flow_world_m)


def test_no_points_and_no_claims():
    assert len(attribute(sweep_of([]), [claim_of()]).owner) == 0
    assert not attribute(sweep_of([[1, 2, 3]]), []).is_dynamic.any()


def test_claims_know_where_their_object_goes_next():
    size = 2
    track = LabeledTrack(
        "t",
        np.array([4, 6]),  # sweep 5 could not be used
        np.array([0, 200_000_000]),
        np.stack([CAR, CAR + np.array([1, 0, 0, 0, 0, 0, 0])]),
        np.zeros((size, 3)),
        np.array([0.5, 0.6]),
        np.zeros(size, dtype=np.int64),
        np.ones(size, dtype=bool),
        np.zeros((size, 7)),
        np.zeros(size),
        (np.array([1, 2], dtype=np.int32), np.array([3], dtype=np.int32)),
    )
    claims = claims_by_sweep([track])
    assert sorted(claims) == [4, 6]
    np.testing.assert_array_equal(claims[4][0].next_box, track.boxes[1])
    assert claims[6][0].next_box is None
    assert claims[6][0].score == 0.6
