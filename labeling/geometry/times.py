"""Time stamps: int64 nanoseconds since 1970. Differences are taken before anything becomes a float."""

from typing import overload

import numpy as np

from schemas.arrays import Float64Array, Int64Array

MAX_BRIDGED_S = 1.2


@overload
def seconds_between(stamp_ns: int, since_ns: int) -> float: ...
@overload
def seconds_between(stamp_ns: Int64Array, since_ns: int | Int64Array) -> Float64Array: ...
def seconds_between(stamp_ns: Int64Array | int, since_ns: Int64Array | int) -> Float64Array | float:
    """Return the seconds from one time stamp to another, negative when it is the earlier one.

    A float64 holds a time stamp of today to 256 ns only: what is multiplied before it is subtracted is off by as much,
    and what is divided by a short time then, by far more.
    """
    difference_ns = np.subtract(stamp_ns, since_ns, dtype=np.int64)
    return difference_ns * 1e-9 if isinstance(difference_ns, np.ndarray) else float(difference_ns) * 1e-9


def median_period_s(timestamps_ns: Int64Array) -> float:
    """Return the usual time between two successive ones of (T,) ascending stamps; infinite for fewer than two."""
    if len(timestamps_ns) < 2:
        return float("inf")
    return float(np.median(np.diff(timestamps_ns)) * 1e-9)


def sweeps_within(duration_s: float, period_s: float) -> int:
    """Return how many sweeps a duration takes at a sweep every ``period_s``, those at its two ends among them."""
    return 1 + round(duration_s / period_s)


def bridged_s(silence_s: float, period_s: float, num_periods: float) -> float:
    """Return a silence that is not too long: ``silence_s``, or so many periods where sweeps are rarer than that.

    Never longer than MAX_BRIDGED_S, in which a road user that brakes or turns is lost, unless ``silence_s`` is. Where
    nothing is bridged at all, at zero, rare sweeps change nothing.
    """
    return silence_s and max(silence_s, min(num_periods * period_s, MAX_BRIDGED_S))
