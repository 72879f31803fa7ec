import numpy as np
import pytest

from labeling.geometry.times import bridged_s, median_period_s, seconds_between, sweeps_within

TODAY_NS = 1_795_000_000_123_456_789


@pytest.mark.parametrize("gap_ns", [1, -7, 100_000_000, 2_300_000_001])
def test_a_difference_is_exact_whatever_the_date(gap_ns):
    assert seconds_between(TODAY_NS + gap_ns, TODAY_NS) == gap_ns * 1e-9
    stamps_ns = TODAY_NS + np.array([0, gap_ns])
    assert seconds_between(stamps_ns, TODAY_NS).tolist() == [0.0, gap_ns * 1e-9]
    assert seconds_between(stamps_ns, stamps_ns[::-1]).tolist() == [-gap_ns * 1e-9, gap_ns * 1e-9]


def test_the_period_is_that_of_most_sweeps():
    stamps_ns = TODAY_NS + np.array([0, 1, 2, 3, 20, 21, 22]) * 100_000_000
    assert median_period_s(stamps_ns) == pytest.approx(0.1)
    assert median_period_s(stamps_ns[:1]) == np.inf


@pytest.mark.parametrize(("period_s", "expected"), [(0.05, 9), (0.1, 5), (0.11, 5), (0.2, 3), (0.5, 2), (np.inf, 1)])
def test_a_duration_takes_as_many_sweeps_as_fit(period_s, expected):
    assert sweeps_within(0.4, period_s) == expected


@pytest.mark.parametrize(("period_s", "expected"), [(0.05, 0.35), (0.1, 0.35), (0.2, 0.48), (0.5, 1.2), (2.0, 1.2)])
def test_what_may_be_bridged_is_seconds_or_sweeps_where_they_are_rare(period_s, expected):
    assert bridged_s(0.35, period_s, 2.4) == pytest.approx(expected)
    assert bridged_s(1.5, period_s, 2.4) == 1.5
