import numpy as np
import pytest

from labeling.evidence.neighborhood import Neighborhood
from schemas.config import FlowParams, StaticParams


def voting_sweeps(stamps_ns, index, params):
    return Neighborhood(stamps_ns, params, FlowParams()).voters(index)


def test_voting_sweeps_of_the_middle_stand_at_the_wanted_gaps():
    stamps = np.arange(100, dtype=np.int64) * 100_000_000
    np.testing.assert_array_equal(voting_sweeps(stamps, 50, StaticParams()), [30, 35, 40, 45, 55, 60, 65, 70])
    twice = np.arange(200, dtype=np.int64) * 50_000_000  # 20 Hz: the same seconds
    np.testing.assert_array_equal(voting_sweeps(twice, 100, StaticParams()), [60, 70, 80, 90, 110, 120, 130, 140])


@pytest.mark.parametrize("index", [0, 1, 20, 98, 99])
def test_voting_sweeps_never_contain_the_sweep_itself_nor_one_out_of_reach(index):
    stamps = np.arange(100, dtype=np.int64) * 100_000_000
    voters = voting_sweeps(stamps, index, StaticParams())
    gap_s = np.abs(stamps[voters] - stamps[index]) * 1e-9
    assert len(voters) >= 4
    assert (np.diff(voters) > 0).all()
    assert gap_s.min() > 0
    assert gap_s.max() <= 2.2


def test_voting_sweeps_do_not_reach_across_a_long_silence():
    stamps = np.concatenate([np.arange(10), 300 + np.arange(10)]).astype(np.int64) * 100_000_000
    assert set(voting_sweeps(stamps, 9, StaticParams())) <= set(range(9))
    assert set(voting_sweeps(stamps, 10, StaticParams())) <= set(range(11, 20))
    lonely = np.array([0, 10_000_000_000, 20_000_000_000], dtype=np.int64)
    assert len(voting_sweeps(lonely, 1, StaticParams())) == 0
    assert len(voting_sweeps(lonely[:1], 0, StaticParams())) == 0


@pytest.mark.parametrize(("num", "index", "expected"), [(1, 0, []), (1, 5, [4]), (3, 5, [2, 3, 4]), (3, 1, [0])])
def test_chamfer_looks_at_the_sweeps_just_before(num, index, expected):
    stamps = np.arange(10, dtype=np.int64) * 100_000_000
    params = StaticParams(method="chamfer", num_chamfer_sweeps=num)
    assert voting_sweeps(stamps, index, params) == expected


@pytest.mark.parametrize("index", [0, 9, 20, 39])
@pytest.mark.parametrize("bad", [(), (21,), (15, 18, 19, 22), tuple(range(10, 35))])
def test_what_cannot_be_read_is_as_if_it_were_not_there(index, bad):
    """The neighbours are those of a segment that never had the unreadable sweeps."""
    stamps_ns = np.arange(40, dtype=np.int64) * 100_000_000
    kept = np.array([k for k in range(40) if k not in bad or k == index])
    params = StaticParams(), FlowParams()
    told = Neighborhood(stamps_ns, *params, lambda k: k not in bad)
    without, place = Neighborhood(stamps_ns[kept], *params), int(np.flatnonzero(kept == index)[0])
    for name in ("voters", "flow", "far"):
        expected = [int(kept[k]) for k in getattr(without, name)(place)]
        assert getattr(told, name)(index) == expected, name


def test_flow_looks_at_the_next_sweep_first_and_back_where_there_is_none():
    neighborhood = Neighborhood(np.arange(10, dtype=np.int64) * 100_000_000, StaticParams(), FlowParams())
    assert neighborhood.flow(4) == [5, 6, 3, 2]
    assert neighborhood.flow(9) == [8, 7]
    assert neighborhood.far(4) == [0, 9]  # 0.4 s is near enough to half a second
    assert neighborhood.oldest(9) == 0


def at(rate_hz, num_sweeps=60):
    stamps_ns = np.round(np.arange(num_sweeps) * 1e9 / rate_hz).astype(np.int64)
    return Neighborhood(stamps_ns, StaticParams(), FlowParams())


@pytest.mark.parametrize(
    ("rate_hz", "flow", "far"),
    [
        (50, [5, 10, -5, -10], [-25, 25]),
        (20, [2, 4, -2, -4], [-10, 10]),
        (10, [1, 2, -1, -2], [-5, 5]),
        (5, [1, 2, -1, -2], [-2, 2]),
        (2, [1, -1], [-1, 1]),
        (1, [1, -1], []),
        (0.8, [], []),
    ],
)
def test_flow_looks_over_the_same_seconds_at_any_rate(rate_hz, flow, far):
    """0.1 and 0.2 s to either side, half a second for what is slow; or as far as the next sweep, up to 1.2 s."""
    neighborhood = at(rate_hz)
    assert [k - 30 for k in neighborhood.flow(30)] == flow
    assert [k - 30 for k in neighborhood.far(30)] == far
    assert neighborhood.following(30) == (31 if flow else None)


@pytest.mark.parametrize("rate_hz", [2, 10, 20])
def test_flow_has_neighbors_on_one_side_at_the_ends(rate_hz):
    neighborhood = at(rate_hz)
    assert all(k > 0 for k in neighborhood.flow(0))
    assert neighborhood.flow(0)
    assert all(k < 59 for k in neighborhood.flow(59))
    assert neighborhood.flow(59)
    assert neighborhood.following(59) is None


@pytest.mark.parametrize(("rate_hz", "num_missing"), [(10, 5), (2, 1)])
def test_nothing_is_looked_at_across_a_silence(rate_hz, num_missing):
    """Of 0.6 s among sweeps of 10 Hz, of 1 s among those of 2 Hz."""
    kept = np.array([k for k in range(60) if not 30 < k <= 30 + num_missing])
    stamps_ns = np.round(kept * 1e9 / rate_hz).astype(np.int64)
    neighborhood = Neighborhood(stamps_ns, StaticParams(), FlowParams())
    assert all(k < 30 for k in neighborhood.flow(30))
    assert all(k > 31 for k in neighborhood.flow(31))
    assert neighborhood.following(30) is None


@pytest.mark.parametrize("rate_hz", [1, 2, 10, 20])
@pytest.mark.parametrize("index", [0, 7, 30, 59])
def test_ranges_hold_all_that_is_looked_at(rate_hz, index):
    neighborhood = at(rate_hz)
    assert set(neighborhood.voters(index)) <= set(neighborhood.voter_range(index))
    looked_at = {*neighborhood.flow(index), *neighborhood.far(index)} | {neighborhood.following(index)}
    assert looked_at - {None} <= set(neighborhood.target_range(index))
