from dataclasses import replace

import numpy as np
import pytest

from labeling.stages.adoption import adopt_strays
from labeling.stages.joining import extend
from schemas.config import JoiningParams
from schemas.objects import LabeledTrack, Track

PARAMS = JoiningParams()
START_NS = 1_700_000_000_000_000_000
SPEED_MPS = 8.0


@pytest.fixture
def car_at(block_cloud, proposal_at):
    """Return a maker of the whole or of a corner of a car that passes (0, ``y_m``) in sweep 0, as seen in one sweep."""
    whole = block_cloud((4.2, 1.8, 1.5), 60)
    corner = whole[(whole[:, 0] < -1.0) & (whole[:, 1] < 0)]

    def make(sweep, *, y_m=0.0, is_whole=False, ahead_m=0.0, velocity_mps=(SPEED_MPS, 0.0), first_row=0):
        place = (SPEED_MPS * 0.1 * sweep + ahead_m, y_m)
        return proposal_at(whole if is_whole else corner, sweep, place, 0.0, velocity_mps, first_row=first_row)

    return make


@pytest.fixture
def track_of(car_at):
    """Return a maker of the track of a car over some sweeps, and of its label."""

    def make(sweeps, y_m=0.0):
        proposals = tuple(car_at(k, y_m=y_m, is_whole=True) for k in sweeps)
        rows = np.array(range(min(sweeps), max(sweeps) + 1))
        count = len(rows)
        labeled = LabeledTrack(
            track_id="track",
            sweep_index=rows,
            timestamp_ns=START_NS + rows * 100_000_000,
            boxes=np.stack([[SPEED_MPS * 0.1 * k, y_m, 0.75, 4.2, 1.8, 1.5, 0.0] for k in rows]),
            velocity_mps=np.tile([SPEED_MPS, 0.0, 0.0], (count, 1)),
            score=np.ones(count),
            num_points=np.full(count, 60),
            is_observed=np.isin(rows, sweeps),
            boxes_visible=np.zeros((count, 7)),
            registration_error_m=np.zeros(count),
            point_rows=(np.empty(0, dtype=np.int32),) * count,
        )
        return Track("track", proposals), labeled

    return make


def adopt(pairs, strays, params=PARAMS):
    tracks, labeled = [track for track, _ in pairs], [label for _, label in pairs]
    sweeps = [[p] for track in tracks for p in track.proposals] + [[stray] for stray in strays]
    return adopt_strays(tracks, labeled, sweeps, params, "segment")


def sweeps_of(track):
    return [proposal.sweep_index for proposal in track.proposals]


def test_corners_seen_before_and_after_belong_to_the_car(track_of, car_at):
    strays = [car_at(k, first_row=500) for k in (3, 4, 12, 14)]
    (track,) = adopt([track_of(range(5, 12))], strays)
    assert sweeps_of(track) == [3, 4, *range(5, 12), 12, 14]
    assert track.proposals[0] is strays[0]
    assert track.track_id != "track"  # it is named after its first sweep


def test_two_corners_of_one_sweep_become_one_view(track_of, car_at):
    strays = [car_at(4), car_at(4, ahead_m=1.5, first_row=500)]
    (track,) = adopt([track_of(range(5, 12))], strays)
    assert sweeps_of(track) == [4, *range(5, 12)]
    assert len(track.proposals[0].points_world) == sum(len(stray.points_world) for stray in strays)


@pytest.mark.parametrize(
    ("sweep", "changes"),
    [
        (13, {"velocity_mps": (-SPEED_MPS, 0.0)}),
        (13, {"y_m": 3.0}),
        (13, {"ahead_m": 5.0}),
        (17, {}),
        (8, {"first_row": 500}),
    ],
    ids=["moves otherwise", "beside", "ahead", "too late", "seen already"],
)
def test_what_is_not_a_missing_piece_stays_alone(track_of, car_at, sweep, changes):
    pair = track_of(range(5, 12))
    assert adopt([pair], [car_at(sweep, **changes)]) == [pair[0]]


def test_a_box_that_is_wide_rather_than_long_is_no_small_one(track_of, car_at):
    """A long side that moves across itself has the object's length for its width."""
    track, label = track_of(range(5, 12))
    boxes = label.boxes.copy()
    boxes[:, 3:5] = boxes[:, 4:2:-1]
    boxes[:, 3] = 1.4
    middle = car_at(12, first_row=500, is_whole=True)
    middle = replace(middle, points_world=middle.points_world * [0.2, 1, 1] + [0.8 * middle.box_visible[0], 0, 0])
    assert sweeps_of(adopt([(track, replace(label, boxes=boxes))], [middle])[0]) == [*range(5, 12), 12]


def test_reach_zero_adopts_nothing(track_of, car_at):
    pair = track_of(range(5, 12))
    assert adopt([pair], [car_at(12)], JoiningParams(stray_reach_s=0.0)) == [pair[0]]


@pytest.mark.parametrize("order", [1, -1])
def test_of_two_cars_the_one_whose_place_it_is_takes_it(track_of, car_at, order):
    """Boxes are grown, so a corner may lie in both."""
    own, other = track_of(range(5, 12)), track_of(range(5, 12), y_m=1.5)
    tracks = adopt([own, other][::order], [car_at(12)])[::order]
    assert [len(track.proposals) for track in tracks] == [8, 7]


def test_without_tracks_there_is_nothing_to_extend(car_at):
    assert adopt([], [car_at(3)]) == []


def test_what_a_track_was_joined_from_is_no_stray(track_of, car_at):
    """Its views are new records, made of the points of several proposals."""
    whole, corner = car_at(11, is_whole=True), car_at(11, first_row=500)
    track, label = track_of(range(5, 11))
    joined = extend(track, [whole, corner], "segment")
    assert joined.proposals[-1] not in (whole, corner)
    assert adopt_strays([joined], [label], [[whole, corner]], PARAMS, "segment") == [joined]
