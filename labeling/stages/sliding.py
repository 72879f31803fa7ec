"""Sliding: long objects whose sides slide along themselves without a trace, told by their ends."""

from dataclasses import dataclass

from labeling.evidence.places import PlaceEvidence
from labeling.geometry.axes import depth_along
from schemas.arrays import BoolArray, Float32Array, Int64Array

MIN_LENGTH_M = 4.0  # of an object most of whose side covers itself when it creeps
END_M = 0.5  # depth of an end along the object
MIN_END_POINTS = 8
MIN_EMPTY_SHARE = 0.5  # of the sweeps that look at an end's place when the object is not there
MIN_OCCUPIED_SHARE = 0.7  # when it is
MIN_NEXT_SHARE = 0.25  # as the first, of the half metre behind: what creeps uncovers it later


def slides(points: Float32Array, rows: Int64Array, evidence: PlaceEvidence) -> bool:
    """Tell whether an object moves along itself: where one end is was nothing before, where the other is nothing after.

    At the ends of a segment only one of the two can be asked, and who walks away from a parked van leaves such a place:
    the object itself leaves what lies farther in as well.

    Args:
        points: (N, 3) of a sweep.
        rows: Those of the object.
        evidence: Of the places of all N points.

    Source: ours.

    """
    depth_m = depth_along(points[rows])
    length_m = depth_m.max()
    if length_m < MIN_LENGTH_M:
        return False
    from_ends = (depth_m, length_m - depth_m)
    ends = [_End(rows[depth < END_M], rows[(depth >= END_M) & (depth < 2 * END_M)]) for depth in from_ends]
    if min(len(end.tip) for end in ends) < MIN_END_POINTS:
        return False
    return _passes(evidence, *ends) or _passes(evidence, *ends[::-1])


@dataclass(frozen=True, slots=True, eq=False)
class _End:
    """Points of an object by how deep in it they lie."""

    tip: Int64Array  # rows of the first half metre
    next: Int64Array  # rows of the second


def _passes(evidence: PlaceEvidence, front: _End, rear: _End) -> bool:
    """Tell whether an object came to where its front is and leaves the place of its rear."""
    is_before = evidence.gap_s < 0
    comes = _is_left(evidence, front.tip, rear.tip, is_before)
    goes = _is_left(evidence, rear.tip, front.tip, ~is_before)
    if is_before.all():
        return comes and _share(evidence.is_empty, front.next, is_before) >= MIN_NEXT_SHARE
    if not is_before.any():
        return goes and _share(evidence.is_empty, rear.next, ~is_before) >= MIN_NEXT_SHARE
    return comes and goes


def _is_left(evidence: PlaceEvidence, empty: Int64Array, occupied: Int64Array, sweeps: BoolArray) -> bool:
    """Tell whether some sweeps looked through one end's place and found the other's occupied."""
    is_empty = _share(evidence.is_empty, empty, sweeps) >= MIN_EMPTY_SHARE
    return is_empty and _share(evidence.is_occupied, occupied, sweeps) >= MIN_OCCUPIED_SHARE


def _share(is_found: BoolArray, rows: Int64Array, sweeps: BoolArray) -> float:
    """Return the mean share of some points that some sweeps found so; 0 without a sweep."""
    return float(is_found[sweeps][:, rows].mean()) if sweeps.any() else 0.0
