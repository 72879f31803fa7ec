from dataclasses import replace

import numpy as np
import pytest

from labeling.line import label_tracks
from labeling.stages.joining import join_tracks
from labeling.stages.refinement import SweepClock
from labeling.stages.tracking import make_track_id
from schemas.config import JoiningParams, LabelingConfig
from schemas.objects import LabeledTrack, Track

PARAMS = JoiningParams()
CAR_M, WALKER_M = (4.2, 1.8, 1.5), (0.5, 0.6, 1.75)
START_NS = 1_700_000_000_000_000_000


@pytest.fixture
def piece(block_cloud, proposal_at):
    """Return a maker of a track along x and of its label; ``sides`` are what was seen of an object of ``size_m``."""

    def make(start_m, speed_mps, sweeps, *, size_m=CAR_M, sides=("back", "right"), first_row=0):
        cloud, velocity = block_cloud(size_m, 60, sides=sides), np.array([speed_mps, 0.0])
        places = [np.array(start_m) + velocity * 0.1 * k for k in sweeps]
        proposals = tuple(
            proposal_at(cloud, k, place, 0.0, velocity, first_row=first_row)
            for k, place in zip(sweeps, places, strict=True)
        )
        count = len(proposals)
        labeled = LabeledTrack(
            track_id=make_track_id("segment", proposals[0]),
            sweep_index=np.array(sweeps, dtype=np.int64),
            timestamp_ns=START_NS + np.array(sweeps, dtype=np.int64) * 100_000_000,
            boxes=np.stack([[*place, size_m[2] / 2, *size_m, 0.0] for place in places]),
            velocity_mps=np.tile([speed_mps, 0.0, 0.0], (count, 1)),
            score=np.ones(count),
            num_points=np.full(count, 60),
            is_observed=np.ones(count, dtype=bool),
            boxes_visible=np.stack([proposal.box_visible for proposal in proposals]),
            registration_error_m=np.zeros(count),
            point_rows=tuple(proposal.point_rows for proposal in proposals),
        )
        return Track(labeled.track_id, proposals), labeled

    return make


def join(*pieces, params=PARAMS):
    return join_tracks([track for track, _ in pieces], [labeled for _, labeled in pieces], params, "segment")


def sweeps_of(track):
    return [proposal.sweep_index for proposal in track.proposals]


def test_pieces_seen_at_both_ends_of_a_turn_are_carried_to_one_instant(piece):
    """Half a second later at 8 m/s one is 4 m ahead of the other: they do not touch as they were seen."""
    early, late = piece((10, 3), 8, range(8)), piece((14, 3), 8, range(8), first_row=1000)
    track, labeled = late
    half_s = 500_000_000
    proposals = tuple(replace(p, timestamp_ns=p.timestamp_ns + half_s) for p in track.proposals)
    late = replace(track, proposals=proposals), replace(labeled, timestamp_ns=labeled.timestamp_ns + half_s)
    assert len(join(early, late)) == 1
    assert len(join(early, piece((14.5, 3), 8, range(8), first_row=1000))) == 2


def test_two_pieces_of_a_car_become_one_track(piece):
    rear, side = piece((10, 3), 8, range(8)), piece((10.3, 3.1), 8.4, range(3, 12), sides=("left",), first_row=1000)
    (track,) = join(rear, side)
    assert sweeps_of(track) == list(range(12))
    for k in range(3, 8):
        united, parts = track.proposals[k], (rear[0].proposals[k], side[0].proposals[k - 3])
        np.testing.assert_array_equal(np.sort(united.point_rows), [*range(60), *range(1000, 1060)])
        np.testing.assert_array_equal(united.points_world, np.concatenate([part.points_world for part in parts]))
        assert united.velocity_mps[0] == pytest.approx(8.2)
        assert united.box_visible[4] > max(part.box_visible[4] for part in parts)
    assert track.proposals[0] is rear[0].proposals[0]
    assert track.proposals[-1] is side[0].proposals[-1]


def test_pieces_seen_at_either_end_of_the_lidars_turn_are_carried_to_one_instant(piece):
    """A car of 4.2 m that begins and ends the turn is 0.9 m longer at 10 m/s, if nobody minds the time."""
    rear, side = piece((10, 3), 10, range(4)), piece((10.9, 3), 10, range(4), sides=("left",), first_row=1000)
    late = tuple(replace(p, timestamp_ns=p.timestamp_ns + 90_000_000) for p in side[0].proposals)
    (track,) = join(rear, (Track(side[0].track_id, late), side[1]))
    for k, united in enumerate(track.proposals):
        assert united.timestamp_ns == rear[0].proposals[k].timestamp_ns + 45_000_000
        assert np.ptp(united.points_world[:, 0]) == pytest.approx(CAR_M[0], abs=0.15)
        assert united.points_world[:, 0].min() == pytest.approx(10 + k + 0.45 - CAR_M[0] / 2, abs=0.01)


@pytest.mark.parametrize(
    ("start_m", "speed_mps", "size_m"),
    [((10, 3.7), 1.4, WALKER_M), ((16, 3), 8, CAR_M), ((7.5, 3), 14, CAR_M)],
    ids=["two walkers side by side", "a car behind a car", "one through the other at another speed"],
)
def test_two_objects_stay_two(piece, start_m, speed_mps, size_m):
    own_speed = 1.4 if size_m == WALKER_M else 8
    pieces = (
        piece((10, 3), own_speed, range(10), size_m=size_m),
        piece(start_m, speed_mps, range(10), size_m=size_m, first_row=1000),
    )
    assert join(*pieces) == [track for track, _ in pieces]  # the very same records


def test_a_shred_of_an_object_at_another_speed_is_dropped_and_what_outlives_it_is_not(piece):
    """A strip of a lorry's side that seems to slide along it, for five sweeps; and one that goes on for long after."""
    lorry = piece((0, 0), 8, range(20), size_m=(11.0, 2.5, 3.4))
    shred = piece((1.0, 1.0), 4, range(4, 9), size_m=(0.7, 0.3, 2.9), first_row=1000)
    assert join(lorry, shred) == join(shred, lorry) == [lorry[0]]
    long = piece((3.0, 0.5), 8, range(20), size_m=(4.0, 1.5, 2.0), first_row=1000)
    assert len(join(lorry, long)[0].proposals[0].point_rows) == 120  # at the same speed: a piece of it
    lasting = piece((6.6, 1.0), 4, range(16, 31), size_m=(0.7, 0.3, 2.9), first_row=1000)
    assert [len(track.proposals) for track in join(lorry, lasting)] == [31]


@pytest.mark.parametrize(("speed_mps", "num_tracks"), [(8.0, 1), (14.0, 2)], ids=["alike", "through it"])
def test_one_common_sweep_tells_pieces_that_move_alike(piece, speed_mps, num_tracks):
    """The second piece begins in the sweep in which the first one ends, and at its place."""
    first, second = piece((0, 0), 8, range(10)), piece((7.2 - 0.9 * speed_mps, 0), speed_mps, range(9, 20))
    assert len(join(first, second)) == num_tracks


@pytest.mark.parametrize(
    ("num_silent", "offset_m", "speed_mps", "num_tracks"),
    [(9, 0, 8, 1), (9, 4, 8, 2), (9, 0, 12, 2), (13, 0, 8, 1), (15, 0, 8, 2)],
    ids=["1 s", "elsewhere", "much faster", "1.4 s", "1.6 s"],
)
def test_a_track_that_goes_on_behind_an_occlusion_is_one(piece, num_silent, offset_m, speed_mps, num_tracks):
    """The later piece begins ``offset_m`` ahead of the place reached at the mean of both speeds."""
    first, second_sweep = piece((0, 0), 8, range(10)), 10 + num_silent
    gap_s = (num_silent + 1) * 0.1
    begin_m = 7.2 + (8 + speed_mps) / 2 * gap_s + offset_m - speed_mps * second_sweep * 0.1
    second = piece((begin_m, 0), speed_mps, range(second_sweep, second_sweep + 6), first_row=1000)
    tracks = join(first, second)
    assert len(tracks) == num_tracks
    assert [k for track in tracks for k in sweeps_of(track)] == [*range(10), *range(second_sweep, second_sweep + 6)]
    assert tracks[0].track_id == first[0].track_id


@pytest.mark.parametrize(("speed_mps", "silence_s", "num_tracks"), [(1.0, 18, 1), (1.0, 22, 2), (3.0, 18, 2)])
def test_what_paused_is_one_and_what_drove_off_is_not(piece, speed_mps, silence_s, num_tracks):
    later = range(4 + 10 * silence_s, 10 + 10 * silence_s)
    back_m = speed_mps * silence_s  # the later piece begins 0.1 s of travel beyond where the first one ended
    pieces = piece((0, 0), speed_mps, range(5)), piece((-back_m + 0.4, 0), speed_mps, later, first_row=1000)
    assert len(join(*pieces)) == num_tracks


def test_the_rows_of_a_pause_are_interpolated_and_without_rounds_there_is_none(piece):
    before, after = piece((10, 3), 1.2, range(6)), piece((10 - 1.2 * 2.5, 3), 1.2, range(31, 37), first_row=1000)
    proposals = [[p for track, _ in (before, after) for p in track.proposals if p.sweep_index == k] for k in range(37)]
    clock = SweepClock(np.arange(37), START_NS + np.arange(37) * 100_000_000)
    (joined,) = label_tracks(proposals, clock, LabelingConfig(), "segment")
    assert joined.sweep_index.tolist() == list(range(37))
    assert joined.is_observed.tolist() == [True] * 6 + [False] * 25 + [True] * 6
    assert joined.num_points[6:31].max() == 0
    assert np.linalg.norm(np.diff(joined.boxes[:, :2], axis=0), axis=1).max() < 0.3
    apart = label_tracks(proposals, clock, LabelingConfig(joining=JoiningParams(without="tracks,strays")), "segment")
    assert [labeled.track_id for labeled in apart] == [before[0].track_id, after[0].track_id]
    assert all(labeled.is_observed.all() for labeled in apart)


def test_order_does_not_change_the_joined_track(piece):
    pieces = [
        piece((10, 3), 8, range(8)),
        piece((10.3, 3), 8, range(8), first_row=1000),
        piece((10, 3), 8, range(12, 18), first_row=2000),
        piece((10, -9), 8, range(8), first_row=3000),
    ]
    there, back = join(*pieces), join(*pieces[::-1])
    assert [len(track.proposals) for track in there] == [14, 8]
    assert {track.track_id for track in there} == {track.track_id for track in back}
    assert there[0].proposals[0].point_rows.tolist() == back[1].proposals[0].point_rows.tolist()


def test_nothing_to_join():
    assert join() == []
