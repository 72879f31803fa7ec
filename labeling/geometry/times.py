"""Time stamps: int64 nanoseconds since 1970. Differences are taken before anything becomes a float."""

from typing import overload

import numpy as np

from schemas.arrays import Float64Array, Int64Array


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
