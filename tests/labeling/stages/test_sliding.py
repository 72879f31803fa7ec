import numpy as np
import pytest

from labeling.evidence.places import PlaceEvidence
from labeling.stages.sliding import slides

SIDE = (
    np.stack(np.meshgrid(np.linspace(0, 10, 101), [3.0], np.linspace(0.5, 2, 4)), axis=-1)
    .reshape(-1, 3)
    .astype(np.float32)
)
ALL = np.arange(len(SIDE))
X_M = SIDE[:, 0]


def votes_of(front_x_m, rear_x_m, speed_mps, gaps_s=(-2.0, -1.5, -1.0, -0.5, 0.5, 1.0, 1.5, 2.0)):
    """Return what sweeps say that see the places of the side whether or not the object covers them."""
    gap_s = np.array(gaps_s)[:, None]
    is_covered = (rear_x_m + speed_mps * gap_s <= X_M) & (front_x_m + speed_mps * gap_s >= X_M)
    return PlaceEvidence(gap_s[:, 0], is_covered, ~is_covered)


def vacate(evidence, side, rows):
    """Say of places that the sweeps on one side looked through them."""
    sweeps = (evidence.gap_s > 0) == bool(side)
    evidence.is_occupied[np.ix_(sweeps, rows)], evidence.is_through[np.ix_(sweeps, rows)] = False, True


@pytest.mark.parametrize("gaps_s", [(-1.0, -0.5, 0.5, 1.0), (0.5, 1.0), (-1.0, -0.5)], ids=["middle", "start", "end"])
@pytest.mark.parametrize("speed_mps", [1.5, -1.5, 0.0])
def test_an_object_slides_where_one_end_comes_and_the_other_goes(speed_mps, gaps_s):
    assert slides(SIDE, ALL, votes_of(10, 0, speed_mps, gaps_s)) == (speed_mps != 0)


def test_no_other_sweep_tells_nothing():
    assert not slides(SIDE, ALL, votes_of(10, 0, 1.5, ()))


def test_what_grows_or_shrinks_at_both_ends_does_not_slide():
    """Hidden behind something before, and seen after: it did not come."""
    votes = votes_of(10, 0, 0.0)
    at_ends = (X_M < 0.5) | (X_M > 9.5)
    vacate(votes, 0, at_ends)
    assert not slides(SIDE, ALL, votes)


@pytest.mark.parametrize("gaps_s", [(0.5, 1.0, 1.5, 2.0), (-2.0, -1.5, -1.0, -0.5)], ids=["start", "end"])
def test_who_walks_away_from_a_parked_van_does_not_make_it_slide(gaps_s):
    """At an end of a segment only places that were left, or taken, can be asked: his were 0.4 m of its side."""
    votes = votes_of(10, 0, 0.0, gaps_s)
    side, is_his = int(gaps_s[0] > 0), X_M < 0.4
    vacate(votes, side, is_his)
    assert not slides(SIDE, ALL, votes)


def test_an_end_that_is_not_seen_tells_nothing():
    votes = votes_of(10, 0, 1.5)
    votes.is_through[:, X_M > 9.5] = False
    assert not slides(SIDE, ALL, votes)


def test_what_is_short_or_shows_too_few_points_at_an_end_is_not_judged():
    votes = votes_of(10, 0, 1.5)
    assert not slides(SIDE, np.flatnonzero(X_M < 3.5), votes)
    assert not slides(SIDE, np.flatnonzero((X_M < 9.5) | (SIDE[:, 2] > 1.9)), votes)
