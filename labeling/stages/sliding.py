"""Sliding: long objects whose sides slide along themselves without a trace, told by their ends."""

from dataclasses import dataclass

import numpy as np

from schemas.arrays import BoolArray, Float32Array, Float64Array, Int64Array

MIN_LENGTH_M = 4.0  # of an object most of whose side covers itself when it creeps
END_M = 0.5  # depth of an end along the object
MIN_END_POINTS = 8
MIN_EMPTY_SHARE = 0.5  # of the sweeps that look at an end's place when the object is not there
MIN_OCCUPIED_SHARE = 0.7  # when it is


@dataclass(frozen=True, slots=True, eq=False)
class Votes:
    """What other sweeps say of each point's place, those before (row 0) and those after (row 1)."""

    num_sweeps: Int64Array  # (2,)
    num_occupied: Int64Array  # (2, N) something was there
    num_empty: Int64Array  # (2, N) rays went through

    def share_of(self, rows: Int64Array) -> tuple[Float64Array, Float64Array]:
        """Return the (2,) shares of sweeps that found these points' places occupied and empty; NaN without a sweep."""
        num = np.where(self.num_sweeps > 0, self.num_sweeps, np.nan)
        return self.num_occupied[:, rows].mean(axis=1) / num, self.num_empty[:, rows].mean(axis=1) / num


def slides(points: Float32Array, rows: Int64Array, votes: Votes, rides_along: BoolArray) -> bool:
    """Tell whether an object moves along itself: where one end is was nothing before, where the other is nothing after.

    At the ends of a segment only one of the two can be asked. What rides along with the vehicle at both ends is a part
    of it: its trailer.

    Args:
        points: (N, 3) of a sweep.
        rows: Those of the object.
        votes: Of all N points.
        rides_along: (N,) keeps its place in the ego frame.

    Source: ours.

    """
    offset = points[rows, :2].astype(np.float64) - points[rows, :2].mean(axis=0, dtype=np.float64)
    along = offset @ np.linalg.eigh(offset.T @ offset)[1][:, 1]
    if np.ptp(along) < MIN_LENGTH_M:
        return False
    ends = [rows[along < along.min() + END_M], rows[along > along.max() - END_M]]
    if min(map(len, ends)) < MIN_END_POINTS or all(rides_along[end].mean() > 0.5 for end in ends):
        return False
    return _passes(votes, *ends) or _passes(votes, *ends[::-1])


def _passes(votes: Votes, front: Int64Array, rear: Int64Array) -> bool:
    """Tell whether an object came to where its front is and leaves the place of its rear."""
    here, gone = votes.share_of(front), votes.share_of(rear)
    before, after = 0, 1
    signs = [
        here[1][before] >= MIN_EMPTY_SHARE,
        here[0][after] >= MIN_OCCUPIED_SHARE,
        gone[0][before] >= MIN_OCCUPIED_SHARE,
        gone[1][after] >= MIN_EMPTY_SHARE,
    ]
    asked = votes.num_sweeps[[before, after, before, after]] > 0
    return bool(asked.any() and np.array(signs)[asked].all())
