"""Votes in batches: however a sweep's clusters are shared out, they say the same, to the last bit."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from labeling.stages import flow
from labeling.stages.flow import FlowScene, Vote, cut_votes, finish_flow, plan_flow, vote_flow
from labeling.stages.targets import RESIDUAL_CUTOFF_M, FlowTarget, View
from schemas.config import FlowParams
from schemas.lidars import NUM_WAYS, Beams, Lidar
from schemas.objects import Clusters

PARAMS = FlowParams(method="rigid")
LIDAR = Lidar((0.0, 0.0, 1.8), 0.0035, 0.0046, 0.02)
PAIR = tuple(replace(LIDAR, look_times_s=(time_s,) * NUM_WAYS) for time_s in (0.0, 0.05))
GAPS_S = (0.1, 0.2, -0.1, -0.2, 0.5, -0.5)  # the last two are far


def block(rng, center, size, num_points):
    return (rng.uniform(-0.5, 0.5, (num_points, 3)) * size + center).astype(np.float32)


def make_scene(seed, *, lidars=(LIDAR,)):
    """Cars, a bus of thousands of points, walkers, shreds, things that stand, and two cars that pass as one cluster."""
    rng = np.random.default_rng(seed)
    kinds = [((4, 2, 1.5), 120)] * 4 + [((12, 2.5, 3), 2500), ((0.5, 0.5, 1.7), 40), ((0.4, 0.4, 1.7), 7)]
    kinds += [((0.2, 0.2, 0.2), 3)] * 3
    passing = [(block(rng, (5, 30 + 2 * k, 1), (4, 1.8, 1.5), 90), (9.0 - 18 * k, 0, 0)) for k in (0, 1)]
    bodies = []
    for k, (size, num_points) in enumerate(kinds):
        velocity = rng.uniform(-12, 12, 3) * (1, 1, 0) * rng.choice([0, 0.1, 1])
        bodies.append((block(rng, (9.0 * k - 40, rng.uniform(-8, 8), 1), size, num_points), velocity))

    def seen(time_s, body):
        cloud, velocity = body
        noise_m = rng.normal(0, 0.01, cloud.shape)
        return (cloud + np.multiply(velocity, time_s) + noise_m).astype(np.float32)

    clouds = [np.concatenate([seen(0.0, body) for body in passing]), *(seen(0.0, body) for body in bodies)]
    points = np.concatenate(clouds)
    clusters = Clusters(np.arange(len(points)), np.cumsum([0, *map(len, clouds)]))

    def beams(num_points):
        return Beams(lidars, rng.integers(0, len(lidars), num_points).astype(np.uint8))

    targets = []
    for gap_s in GAPS_S:
        there = np.concatenate([seen(gap_s, body) for body in [*passing, *bodies]])
        stands = np.concatenate([there, block(rng, (0, 0, 1), (120, 60, 2), 5000)])
        is_far = abs(gap_s) > 0.3
        target = FlowTarget(gap_s, there, stands, beams(len(there)), beams(len(stands)), is_far)
        targets.append(target.asked_from(points))
    is_vacated = rng.random(len(points)) < 0.5
    return FlowScene(points, beams(len(points)), clusters, tuple(targets), is_vacated)


def bytes_of(votes):
    """Return what each cluster said, and each second body, as bytes."""
    names = ("velocity_mps", "residual_m", "still_residual_m", "is_still")
    said = {}
    for vote in votes:
        for k, cluster in enumerate(vote.clusters.tolist()):
            said[cluster] = b"".join(np.ascontiguousarray(getattr(vote.motion, name)[k]).tobytes() for name in names)
        for body in vote.motion.bodies:
            said["body", int(body.rows[0])] = body.rows.tobytes() + body.velocity_mps.tobytes()
    return said


SCENES = pytest.mark.parametrize("scene", [make_scene(0), make_scene(1, lidars=PAIR)], ids=["one lidar", "two lidars"])


@SCENES
@settings(max_examples=10)
@given(data=st.data())
def test_any_partition_of_the_clusters_gives_the_same_bytes(scene, data):
    batch_of = data.draw(st.lists(st.integers(0, 3), min_size=11, max_size=11))
    asked = np.arange(scene.clusters.num_clusters)
    batches = [asked[np.array(batch_of) == k] for k in set(batch_of)]
    whole = bytes_of([vote_flow(scene, asked, PARAMS)])
    assert bytes_of([vote_flow(scene, batch, PARAMS) for batch in batches]) == whole


def test_the_scene_has_bodies_and_things_that_stand_and_move():
    voted = vote_flow(make_scene(0), np.arange(11), PARAMS).motion
    assert voted.bodies
    assert set(voted.is_still) == {True, False}
    assert len({abs(velocity[0]) < PARAMS.slow_speed_mps for velocity in voted.velocity_mps[~voted.is_still]}) == 2


def test_votes_in_many_batches_give_the_flow_of_one(monkeypatch):
    scene, plans = make_scene(0), []
    for limit in (10**9, 100, 1):
        monkeypatch.setattr(flow, "MAX_BATCH_VOTES", limit)
        batches = cut_votes(scene, PARAMS)
        plans.append((len(batches), batches, [vote_flow(scene, batch, PARAMS) for batch in batches]))
    flows = [
        finish_flow(plan_flow(scene, votes[::-1], PARAMS, lambda _: np.random.default_rng(0)), ()).flow_ref_m
        for *_, votes in plans
    ]
    (one, whole, _), (few, some, _), (many, each, _) = plans
    assert 1 == one < few < many == scene.clusters.num_clusters
    assert np.concatenate(some).tolist() == np.concatenate(each).tolist() == whole[0].tolist()
    assert flows[0].any()
    assert flows[0].tobytes() == flows[1].tobytes() == flows[2].tobytes()


def test_a_cluster_that_no_worker_can_ask_stands_and_is_counted():
    scene = make_scene(0)
    asked = np.arange(scene.clusters.num_clusters)
    votes = [vote_flow(scene, asked[1:], PARAMS), Vote(asked[:1], None)]
    found = finish_flow(plan_flow(scene, votes, PARAMS, lambda _: np.random.default_rng(0)), ())
    assert found.is_failed.tolist() == [True] + [False] * 10
    assert not found.flow_ref_m[scene.clusters.cluster_of_point == 0].any()


def test_only_what_left_its_place_is_asked():
    scene = make_scene(0)
    still = replace(scene, is_vacated=np.zeros(len(scene.points_ref), dtype=bool))
    assert cut_votes(still, PARAMS) == ()
    assert len(np.concatenate(cut_votes(still, PARAMS.leave_out("vacated")))) == scene.clusters.num_clusters
    assert cut_votes(scene, FlowParams(method="nsfp")) == ()


@given(seed=st.integers(0, 2**32 - 1))
def test_standing_points_out_of_reach_change_no_distance(seed):
    """What is left out is no one's neighbour: the tree of the rest answers the same."""
    rng = np.random.default_rng(seed)
    spread = rng.choice([1.0, 30.0, 1000.0])
    asked, stands = (rng.uniform(-spread, spread, (n, 3)).astype(np.float32) for n in (40, 400))
    stands[:40] = asked + rng.uniform(-0.6, 0.6, asked.shape).astype(np.float32)
    beams = Beams((LIDAR,) * 3, np.arange(400, dtype=np.uint8) % 3)
    target = FlowTarget(0.1, stands, stands, beams, beams)
    fewer = target.asked_from(asked)
    assert len(fewer.standing_beams.of_point) == len(fewer.standing_points_ref)
    assert spread == 1.0 or len(fewer.standing_points_ref) < 400
    both = [View(t).standing_tree.query(asked, distance_upper_bound=RESIDUAL_CUTOFF_M)[0] for t in (target, fewer)]
    assert both[0].tobytes() == both[1].tobytes()
