from dataclasses import replace

import numpy as np
import pytest

from labeling.stages.tracking import link_proposals
from schemas.config import TrackingParams

PARAMS = TrackingParams()
PERIOD_S = 0.1


@pytest.fixture
def drive_by(block_cloud, proposal_at):
    """Return a maker of the proposals of one straight mover, {sweep: proposal}; rows tell movers apart."""

    def make(start_m, velocity_mps, sweeps=range(10), *, seen_velocity_mps=None, first_row=0, size_m=(4.0, 2.0, 1.5)):
        velocity = np.array(velocity_mps, dtype=np.float64)
        cloud = block_cloud(size_m, 60)
        yaw = float(np.arctan2(velocity[1], velocity[0]))
        seen = velocity if seen_velocity_mps is None else np.array(seen_velocity_mps)
        return {
            k: proposal_at(cloud, k, np.array(start_m) + velocity * k * 0.1, yaw, seen, first_row=first_row)
            for k in sweeps
        }

    return make


def by_sweep(*movers, num_sweeps=40):
    return [[mover[k] for mover in movers if k in mover] for k in range(num_sweeps)]


def link(*movers, params=PARAMS, segment_id="segment", num_sweeps=40):
    return link_proposals(by_sweep(*movers, num_sweeps=num_sweeps), params, segment_id, PERIOD_S)


def sweeps_of(track):
    return [proposal.sweep_index for proposal in track.proposals]


@pytest.mark.parametrize("velocity", [(8, 0), (-30, 5), (0, 1.4), (1, 1)], ids=lambda v: f"{v[0]}, {v[1]} m/s")
def test_constant_velocity_is_one_track(drive_by, velocity):
    (track,) = link(drive_by((10, 3), velocity))
    assert sweeps_of(track) == list(range(10))


def test_a_fast_small_object_is_followed_by_its_flow(drive_by):
    """Its boxes of successive sweeps do not overlap; only the flow carries one onto the other."""
    (track,) = link(drive_by((10, 3), (20, 0), size_m=(0.6, 0.6, 1.7)))
    assert len(track.proposals) == 10


def test_a_track_that_no_other_sweep_saw_through_goes(drive_by):
    """In one sweep of ten its place was seen empty: a tenth of its points."""
    mover = {k: replace(proposal, num_vacated=0) for k, proposal in drive_by((10, 3), (8, 0)).items()}
    assert link(mover) == []
    mover[4] = replace(mover[4], num_vacated=len(mover[4].points_world))
    assert len(link(mover)) == 1


def test_a_poor_first_flow_is_outgrown(drive_by):
    mover = drive_by((10, 3), (8, 0), range(10))
    mover[0] = drive_by((10, 3), (8, 0), [0], seen_velocity_mps=(14, 0))[0]
    (track,) = link(mover)
    assert sweeps_of(track) == list(range(10))


def test_crossing_objects_keep_their_ids(drive_by):
    along = drive_by((0, 0), (10, 0), range(30), size_m=(1, 1, 1.7))
    across = drive_by((15, -14), (0, 10), range(30), first_row=1000, size_m=(1, 1, 1.7))
    tracks = link(along, across)
    assert [sweeps_of(track) for track in tracks] == [list(range(30))] * 2
    for track, row in zip(tracks, (0, 1000), strict=True):
        assert {int(proposal.point_rows[0]) for proposal in track.proposals} == {row}


def test_oncoming_objects_passing_close_keep_their_ids(drive_by):
    there, back = drive_by((0, 0), (15, 0), range(20)), drive_by((30, 2.3), (-15, 0), range(20), first_row=1000)
    for track, row in zip(link(there, back), (0, 1000), strict=True):
        assert {int(proposal.point_rows[0]) for proposal in track.proposals} == {row}


@pytest.mark.parametrize(("num_missed", "num_tracks"), [(1, 1), (2, 1), (3, 2), (8, 2)])
def test_silence_is_bridged_up_to_the_limit(drive_by, num_missed, num_tracks):
    """0.35 s: the gaps between seen sweeps are 0.2, 0.3, 0.4 and 0.9 s."""
    sweeps = [*range(10), *range(10 + num_missed, 20 + num_missed)]
    tracks = link(drive_by((0, 0), (8, 0), sweeps))
    assert len(tracks) == num_tracks
    assert [k for track in tracks for k in sweeps_of(track)] == sweeps
    assert len({track.track_id for track in tracks}) == num_tracks


@pytest.mark.parametrize(("num_sweeps", "num_tracks"), [(4, 0), (5, 1)])
def test_short_tracks_are_dropped(drive_by, num_sweeps, num_tracks):
    assert len(link(drive_by((0, 0), (8, 0), range(num_sweeps)))) == num_tracks


@pytest.mark.parametrize(("num_seen", "num_tracks"), [(2, 1), (1, 0)])
def test_a_segment_of_two_sweeps_keeps_tracks_of_two(drive_by, num_seen, num_tracks):
    assert len(link(drive_by((0, 0), (8, 0), range(num_seen)), num_sweeps=2)) == num_tracks


def test_what_overlaps_less_than_the_limit_is_not_the_same(drive_by):
    """A second object 3.6 m ahead of where the first one would be: IoU 0.05."""
    first, second = drive_by((0, 0), (8, 0), range(6)), drive_by((3.6, 0), (8, 0), range(6, 12))
    assert len(link(first, second)) == 2
    near = drive_by((2.5, 0), (8, 0), range(6, 12))  # IoU 0.23
    assert len(link(first, near)) == 1


@pytest.fixture
def drive_at(block_cloud, proposal_at):
    """Return a maker of the proposals of a mover, one every ``period_s``; places and flows are functions of time."""

    def make(period_s, sweeps, place_m, velocity_mps, size_m=(4.0, 2.0, 1.5)):
        proposals = {}
        for k in sweeps:
            at_s = k * period_s
            proposal = proposal_at(block_cloud(size_m, 60), k, place_m(at_s), 0.0, velocity_mps(at_s))
            start_ns = proposal.timestamp_ns - k * 100_000_000
            proposals[k] = replace(proposal, timestamp_ns=start_ns + round(at_s * 1e9))
        return proposals

    return make


def link_at(period_s, *movers):
    return link_proposals(by_sweep(*movers), PARAMS, "segment", period_s)


@pytest.mark.parametrize(("rate_hz", "num_sweeps"), [(2, 3), (5, 3), (10, 5), (20, 9)])
def test_a_track_lasts_as_long_at_any_rate(drive_at, rate_hz, num_sweeps):
    """0.4 s, and three sweeps at least."""
    for seen, num_tracks in ((num_sweeps, 1), (num_sweeps - 1, 0)):
        mover = drive_at(1 / rate_hz, range(seen), lambda s: (8 * s, 0), lambda _: (8, 0))
        assert len(link_at(1 / rate_hz, mover)) == num_tracks


@pytest.mark.parametrize("rate_hz", [2, 3.3, 5, 10, 20])
def test_one_sweep_may_be_missed_at_any_rate(drive_at, rate_hz):
    sweeps = [*range(5), *range(6, 15)]
    (track,) = link_at(1 / rate_hz, drive_at(1 / rate_hz, sweeps, lambda s: (8 * s, 0), lambda _: (8, 0)))
    assert sweeps_of(track) == sweeps


@pytest.mark.parametrize("size_m", [(4.0, 2.0, 1.5), (0.6, 0.6, 1.7)], ids=["car", "walker"])
def test_who_brakes_is_followed_at_two_sweeps_a_second(drive_at, size_m):
    """By 2.5 m/s2: after half a second 0.31 m from where its speed would have led. Boxes of 0.6 m hardly overlap."""

    def place(at_s):
        return 10 * at_s - 1.25 * at_s**2, 0

    (track,) = link_at(0.5, drive_at(0.5, range(8), place, lambda s: (10 - 2.5 * s, 0), size_m))
    assert len(track.proposals) == 8


def test_what_lies_where_another_would_be_but_did_not_come_from_there_is_not_the_same(drive_at):
    """Something else, found at 2 Hz where the first one is expected, and coming from elsewhere."""
    first = drive_at(0.5, range(3), lambda s: (8 * s, 0), lambda _: (8, 0))
    second = drive_at(0.5, range(3, 6), lambda s: (12, -8 * (s - 1.5)), lambda _: (0, -8))
    assert [sweeps_of(track) for track in link_at(0.5, first, second)] == [[0, 1, 2], [3, 4, 5]]
    paper = link_proposals(by_sweep(first, second), PARAMS.leave_out("either_way"), "segment", 0.5)
    assert sweeps_of(paper[0])[:4] == [0, 1, 2, 3]


def test_the_order_of_proposals_within_a_sweep_does_not_matter(drive_by):
    movers = [drive_by((0, 4 * k), (5 + k, 0), range(12), first_row=1000 * k) for k in range(5)]
    rng = np.random.default_rng(0)
    shuffled = [list(rng.permutation(np.array(sweep, dtype=object))) for sweep in by_sweep(*movers)]
    expected, tracks = link(*movers), link_proposals(shuffled, PARAMS, "segment", PERIOD_S)
    assert [track.track_id for track in tracks] == [track.track_id for track in expected]
    assert [sweeps_of(track) for track in tracks] == [list(range(12))] * 5


def test_ids_are_the_same_again_and_differ_between_segments_and_objects(drive_by):
    movers = [drive_by((0, 4 * k), (5, 0), first_row=1000 * k) for k in range(3)]
    first, again, other = (
        [track.track_id for track in link(*movers, segment_id=segment_id)] for segment_id in ("a", "a", "b")
    )
    assert first == again
    assert len({*first, *other}) == 6


def test_tracks_come_in_the_order_of_their_first_sweeps(drive_by):
    late, early = drive_by((0, 0), (8, 0), range(5, 15)), drive_by((0, 9), (8, 0), range(1, 15), first_row=1000)
    assert [sweeps_of(track)[0] for track in link(late, early)] == [1, 5]


def test_each_proposal_is_in_at_most_one_track_and_time_ascends(drive_by):
    rng = np.random.default_rng(3)
    movers = [
        drive_by(rng.uniform(-8, 8, 2), rng.uniform(-6, 6, 2), rng.permutation(30)[:24], first_row=1000 * k)
        for k in range(6)
    ]
    tracks = link(*movers, params=TrackingParams(min_sweeps=1, min_duration_s=0.0))
    proposals = [proposal for track in tracks for proposal in track.proposals]
    assert len({id(proposal) for proposal in proposals}) == len(proposals) == 6 * 24
    for track in tracks:
        assert (np.diff(sweeps_of(track)) > 0).all()


def test_nothing_to_link():
    assert link_proposals([], PARAMS, "segment", PERIOD_S) == []
    assert link_proposals([[], [], ()], PARAMS, "segment", PERIOD_S) == []


def test_without_flow_the_filter_tells_velocity_and_heading(drive_by):
    mover = drive_by((10, 3), (6, 3), range(12), seen_velocity_mps=(0, 0))
    (track,) = link_proposals(by_sweep(mover), PARAMS, "segment", PERIOD_S, has_flow=False)
    assert sweeps_of(track) == list(range(12))
    for proposal in track.proposals:
        np.testing.assert_allclose(proposal.velocity_mps, [6, 3, 0], atol=0.1)
        assert proposal.box_visible[6] == pytest.approx(np.arctan2(3, 6), abs=0.02)
        np.testing.assert_allclose(proposal.box_visible[3:6], [4, 2, 1.5], rtol=0.1)


def test_without_flow_a_fast_small_object_is_lost(drive_by):
    """Its boxes of successive sweeps do not overlap, and a plain tracker knows no velocity to begin with."""
    mover = drive_by((10, 3), (20, 0), seen_velocity_mps=(0, 0), size_m=(0.6, 0.6, 1.7))
    assert link_proposals(by_sweep(mover), PARAMS, "segment", PERIOD_S, has_flow=False) == []


def test_without_flow_one_proposal_keeps_its_box(drive_by):
    mover = drive_by((10, 3), (6, 3), [0], seen_velocity_mps=(0, 0))
    (track,) = link_proposals([[mover[0]]], PARAMS, "segment", PERIOD_S, has_flow=False)
    assert track.proposals == (mover[0],)


def test_slivers_of_a_person_are_matched_as_if_they_were_as_wide_as_one(drive_by):
    """A few beams show 0.1 m of a walker, now his left and now his right."""
    sliver_m = (0.1, 0.1, 1.6)
    left, right = (drive_by((10, y), (1.4, 0), size_m=sliver_m) for y in (0.12, -0.12))
    seen = {k: (left if k % 2 else right)[k] for k in range(10)}
    (track,) = link(seen)
    assert sweeps_of(track) == list(range(10))
    assert len(link(seen, params=TrackingParams(without="person_width"))) == 2


@pytest.mark.parametrize("size_m", [(0.1, 0.1, 0.4), (0.1, 1.2, 1.6)], ids=["low", "wide"])
def test_what_is_no_sliver_of_a_person_is_matched_as_it_is(drive_by, size_m):
    left, right = (drive_by((10 + x, 3), (1.4, 0), size_m=size_m) for x in (0.2, -0.2))
    assert len(link({k: (left if k % 2 else right)[k] for k in range(10)})) == 2
