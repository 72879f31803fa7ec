"""Known answers and laws of scores: what a track shows, and what that makes of its chances."""

from dataclasses import fields, replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from labeling.stages.refinement import SweepClock, refine_track
from labeling.stages.scoring import INTERCEPT, TERMS, chances, describe_rows, score_rows
from schemas.config import RefinementParams, resolve_config
from schemas.objects import AlignedTrack, LabeledTrack, Track

START_NS = 1_700_000_000_000_000_000
AGAINST = {"heading", "outside", "oversize", "gap"}
CAR_M = (4.2, 1.8, 1.5)
SHEET = ("left",)  # sides seen of a block: what a wall shows


def refined(aligned, missing=()):
    kept = [k for k in range(len(aligned.track.proposals)) if k not in missing]
    if missing:
        is_kept = np.isin(aligned.model_view, kept)
        aligned = replace(
            aligned,
            track=Track("track", tuple(aligned.track.proposals[k] for k in kept)),
            model_from_world=aligned.model_from_world[kept],
            error_m=aligned.error_m[kept],
            model_points=aligned.model_points[is_kept],
            model_view=np.searchsorted(kept, aligned.model_view[is_kept]).astype(np.int32),
        )
    stamps = START_NS + np.arange(kept[-1] + 1) * 100_000_000
    return aligned, refine_track(aligned, SweepClock(np.arange(len(stamps)), stamps), RefinementParams())


@pytest.fixture
def track_of(aligned_at, block_cloud):
    """Return a maker of a track: one cloud at ``speed_mps`` along x, 10 sweeps a second."""

    def make(cloud=None, num_views=12, speed_mps=8.0, missing=()):
        cloud = block_cloud(CAR_M) if cloud is None else cloud
        places = [(10 + 0.1 * speed_mps * k, 3) for k in range(num_views)]
        return refined(aligned_at([cloud] * num_views, places), missing)

    return make


@pytest.mark.parametrize(("period_ns", "num_looks"), [(50_000_000, 6.5), (100_000_000, 12), (500_000_000, 12)])
def test_views_twice_as_dense_are_worth_half_a_look_each(track_of, period_ns, num_looks):
    aligned, labeled = track_of()
    proposals = tuple(replace(p, timestamp_ns=START_NS + k * period_ns) for k, p in enumerate(aligned.track.proposals))
    evidence = describe_rows(replace(aligned, track=replace(aligned.track, proposals=proposals)), labeled)
    np.testing.assert_allclose(evidence["views"], np.log(num_looks))


def test_what_a_car_seen_from_all_sides_shows(track_of):
    evidence = describe_rows(*track_of())
    assert set(evidence) == {term.name for term in TERMS}
    np.testing.assert_allclose(evidence["points"], np.log1p(400))
    np.testing.assert_allclose(evidence["views"], np.log(12))
    np.testing.assert_allclose(evidence["travel"], np.log1p(8.8 / np.hypot(4.2, 1.8)), atol=0.01)
    np.testing.assert_allclose(evidence["best_view"], np.log1p(400))
    np.testing.assert_allclose(evidence["width_in_view"], 1.0, atol=0.02)
    np.testing.assert_allclose(evidence["seen_height"], 1.0, atol=0.02)
    for name in AGAINST:
        np.testing.assert_allclose(evidence[name], 0.0, atol=0.02, err_msg=name)


def test_a_width_that_was_completed_was_not_seen(track_of, block_cloud):
    aligned, labeled = track_of(block_cloud((5.0, 2.0, 1.5), sides=SHEET))
    assert labeled.boxes[0, 4] == pytest.approx(1.7)  # the least that a vehicle has
    assert describe_rows(aligned, labeled)["width_in_view"].max() < 0.2
    whole = track_of(block_cloud((5.0, 2.0, 1.5)))
    assert score_rows(aligned, labeled).max() < score_rows(*whole).min() - 0.1


def test_a_front_of_a_house_is_larger_than_any_road_user(track_of, block_cloud):
    wall = track_of(block_cloud((11.0, 0.4, 8.4), sides=SHEET))
    np.testing.assert_allclose(describe_rows(*wall)["oversize"], np.log(2), atol=0.02)
    assert score_rows(*wall).max() < 0.2
    assert describe_rows(*track_of(block_cloud((11.8, 2.6, 4.0))))["oversize"].max() == 0


@pytest.mark.parametrize(
    ("size_m", "factor"), [((0.8, 0.8, 2.76), 1.2), ((0.8, 0.8, 1.9), 1.0), ((0.8, 1.5, 2.76), 1.0)]
)
def test_what_is_narrow_and_higher_than_a_walker_is_oversize(track_of, block_cloud, size_m, factor):
    """The edge of a lorry that comes out from behind a house."""
    np.testing.assert_allclose(describe_rows(*track_of(block_cloud(size_m)))["oversize"], np.log(factor), atol=0.03)


def test_a_block_that_drifts_sideways_is_off_its_way(track_of):
    aligned, labeled = track_of()
    turned = labeled.boxes.copy()
    turned[:, 6] += np.pi / 6
    evidence = describe_rows(aligned, replace(labeled, boxes=turned))
    np.testing.assert_allclose(evidence["heading"], 0.5 - 0.15, atol=0.02)
    assert evidence["outside"].min() > 0.1  # a turned box leaves corners of the block outside
    assert (score_rows(aligned, replace(labeled, boxes=turned)) < labeled.score).all()


def test_a_row_without_points_is_the_less_sure_the_longer_the_gap(track_of):
    aligned, labeled = track_of(missing=(4, 5, 6, 9))
    evidence = describe_rows(aligned, labeled)
    np.testing.assert_allclose(evidence["gap"], [0, 0, 0, 0, 0.1, 0.2, 0.1, 0, 0, 0.1, 0, 0], atol=1e-6)
    assert (evidence["points"] == 0).tolist() == (~labeled.is_observed).tolist()
    assert labeled.score[5] <= labeled.score[4]
    assert labeled.score[~labeled.is_observed].max() < labeled.score[labeled.is_observed].min()


def test_scores_are_those_of_the_refined_track(track_of):
    aligned, labeled = track_of()
    np.testing.assert_array_equal(labeled.score, score_rows(aligned, labeled))


def test_an_average_row_has_the_chance_of_the_intercept():
    evidence = {term.name: np.full(3, term.mean) for term in TERMS}
    np.testing.assert_allclose(chances(evidence), 1 / (1 + np.exp(-INTERCEPT)))


@pytest.mark.parametrize("term", TERMS, ids=lambda term: term.name)
@given(low=st.floats(-5, 5), rise=st.floats(0, 10))
def test_each_term_speaks_one_way_only(term, low, rise):
    evidence = {term.name: np.full(2, term.mean) for term in TERMS}
    less, more = chances(evidence | {term.name: np.array([low, low + rise])})
    assert 0 <= less <= 1
    assert 0 <= more <= 1
    assert more <= less if term.name in AGAINST else more >= less


def without_order(record, order):
    """Return a record of R rows with its rows in another order."""
    changed = {}
    for field in fields(record):
        value = getattr(record, field.name)
        if isinstance(value, np.ndarray):
            changed[field.name] = value[order]
        elif isinstance(value, tuple):
            changed[field.name] = tuple(value[k] for k in order)
    return replace(record, **changed)


def test_time_may_run_backwards(track_of):
    aligned, labeled = track_of(missing=(4, 5, 9))
    order = np.arange(len(labeled.boxes))[::-1]
    back: LabeledTrack = without_order(labeled, order)
    back = replace(back, timestamp_ns=2 * START_NS - back.timestamp_ns, velocity_mps=-back.velocity_mps)
    views = Track("track", aligned.track.proposals[::-1])
    np.testing.assert_allclose(score_rows(replace(aligned, track=views), back), labeled.score[order], atol=1e-9)


def test_the_order_of_points_does_not_matter(track_of):
    aligned, labeled = track_of()
    rng = np.random.default_rng(1)
    shuffled = tuple(
        replace(proposal, points_world=rng.permutation(proposal.points_world)) for proposal in aligned.track.proposals
    )
    again: AlignedTrack = replace(aligned, track=Track("track", shuffled))
    np.testing.assert_allclose(score_rows(again, labeled), labeled.score, atol=1e-12)


@pytest.mark.parametrize("params", [RefinementParams(), resolve_config("paper").refinement], ids=["default", "paper"])
@pytest.mark.parametrize("num_views", [1, 2, 6])
@pytest.mark.parametrize(
    "cloud",
    [np.zeros((1, 3)), np.array([[0, 0, 0.5], [1, 0, 0.5]]), np.zeros((10, 3)), np.outer(np.arange(6), [0, 0, 9.0])],
    ids=["one point", "two points", "one place", "a mast"],
)
def test_whatever_a_track_is_its_scores_are_chances(aligned_at, cloud, num_views, params):
    aligned = aligned_at([cloud.astype(np.float32)] * num_views, [(10, 3)] * num_views)
    labeled = refine_track(aligned, SweepClock(np.arange(num_views), START_NS + np.arange(num_views)), params)
    for name, values in describe_rows(aligned, labeled).items():
        assert np.isfinite(values).all(), name
    assert ((labeled.score >= 0) & (labeled.score <= 1)).all()
