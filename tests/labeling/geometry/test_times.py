import numpy as np
import pytest

from labeling.geometry.times import seconds_between

TODAY_NS = 1_795_000_000_123_456_789


@pytest.mark.parametrize("gap_ns", [1, -7, 100_000_000, 2_300_000_001])
def test_a_difference_is_exact_whatever_the_date(gap_ns):
    assert seconds_between(TODAY_NS + gap_ns, TODAY_NS) == gap_ns * 1e-9
    stamps_ns = TODAY_NS + np.array([0, gap_ns])
    assert seconds_between(stamps_ns, TODAY_NS).tolist() == [0.0, gap_ns * 1e-9]
    assert seconds_between(stamps_ns, stamps_ns[::-1]).tolist() == [-gap_ns * 1e-9, gap_ns * 1e-9]
