"""Sliding: long objects whose sides slide along themselves without a trace, told by their ends."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from schemas.arrays import BoolArray, Float32Array, Int64Array

MIN_LENGTH_M = 4.0  # of an object most of whose side covers itself when it creeps
END_M = 0.5  # depth of an end along the object
MIN_END_POINTS = 8
MIN_EMPTY_SHARE = 0.5  # of the sweeps that look at an end's place when the object is not there
MIN_OCCUPIED_SHARE = 0.7  # when it is
MIN_NEXT_SHARE = 0.25  # as the first, of the half metre behind: what creeps uncovers it later


@dataclass(frozen=True, slots=True, eq=False)
class PlaceVotes:
    """What other sweeps say of each point's place, those before (row 0) and those after (row 1)."""

    num_sweeps: Int64Array  # (2,)
    num_occupied: Int64Array  # (2, N) something was there
    num_empty: Int64Array  # (2, N) rays went through

    def is_occupied(self, rows: Int64Array) -> tuple[bool, bool]:
        """Tell whether the sweeps before, and those after, found these points' places occupied."""
        return self._is_found(self.num_occupied, rows, MIN_OCCUPIED_SHARE)

    def is_empty(self, rows: Int64Array, min_share: float = MIN_EMPTY_SHARE) -> tuple[bool, bool]:
        """Tell whether the sweeps before, and those after, looked through these points' places."""
        return self._is_found(self.num_empty, rows, min_share)

    def _is_found(self, votes: Int64Array, rows: Int64Array, min_share: float) -> tuple[bool, bool]:
        share = votes[:, rows].sum(axis=1) / np.maximum(self.num_sweeps * len(rows), 1)
        return bool(share[0] >= min_share), bool(share[1] >= min_share)


def slides(
    points: Float32Array, rows: Int64Array, votes: PlaceVotes, rides_along: Callable[[Int64Array], BoolArray]
) -> bool:
    """Tell whether an object moves along itself: where one end is was nothing before, where the other is nothing after.

    At the ends of a segment only one of the two can be asked, and who walks away from a parked van leaves such a place:
    the object itself leaves what lies farther in as well. What rides along with the vehicle at both ends is a part of
    it: its trailer.

    Args:
        points: (N, 3) of a sweep.
        rows: Those of the object.
        votes: Of all N points.
        rides_along: Tells of points, by their rows, whether they keep their place beside or behind the vehicle.

    Source: ours.

    """
    offset = points[rows, :2].astype(np.float64) - points[rows, :2].mean(axis=0, dtype=np.float64)
    along = offset @ np.linalg.eigh(offset.T @ offset)[1][:, 1]
    if np.ptp(along) < MIN_LENGTH_M:
        return False
    from_ends = (along - along.min(), along.max() - along)
    ends = [_End(rows[depth < END_M], rows[(depth >= END_M) & (depth < 2 * END_M)]) for depth in from_ends]
    if min(len(end.tip) for end in ends) < MIN_END_POINTS:
        return False
    is_slider = _passes(votes, *ends) or _passes(votes, *ends[::-1])
    return is_slider and not all(rides_along(end.tip).mean() > 0.5 for end in ends)


@dataclass(frozen=True, slots=True, eq=False)
class _End:
    """Points of an object by how deep in it they lie."""

    tip: Int64Array  # rows of the first half metre
    next: Int64Array  # rows of the second


def _passes(votes: PlaceVotes, front: _End, rear: _End) -> bool:
    """Tell whether an object came to where its front is and leaves the place of its rear."""
    before, after = 0, 1
    if not votes.num_sweeps.any():
        return False
    comes = votes.is_empty(front.tip)[before] and votes.is_occupied(rear.tip)[before]
    goes = votes.is_occupied(front.tip)[after] and votes.is_empty(rear.tip)[after]
    if not votes.num_sweeps[before]:
        return goes and votes.is_empty(rear.next, MIN_NEXT_SHARE)[after]
    if not votes.num_sweeps[after]:
        return comes and votes.is_empty(front.next, MIN_NEXT_SHARE)[before]
    return comes and goes
