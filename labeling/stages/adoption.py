"""Adoption: proposals of no track -> the tracks whose object they are a part of.

A tracker links boxes of what is seen. Of an object that comes into view, or hides behind others, it sees another piece
each time, and the pieces do not overlap. Once the object is complete, where it must have been is known: a proposal that
lies there and moves alike is a part of it.
"""

from collections import defaultdict
from collections.abc import Iterator, Sequence

import numpy as np

from labeling.geometry.boxes import points_in_box
from labeling.geometry.times import bridged_s, median_period_s, seconds_between
from labeling.stages.joining import extend, is_alike
from schemas.arrays import Int32Array
from schemas.config import JoiningParams
from schemas.objects import BOX_LENGTH, BOX_WIDTH, LabeledTrack, Proposal, Track

MARGIN_M = 0.3  # by which a box is grown: where it was before or is afterwards is known so well
MIN_INSIDE_SHARE = 0.8  # of a proposal's points
REACHED_PERIODS = 1.6  # before and after a track, where sweeps are rare: the next one
MIN_LENGTH_M = 1.5  # of an object: smaller ones are seen whole, and what is near them is somebody else


def adopt_strays(
    tracks: Sequence[Track],
    labeled: Sequence[LabeledTrack],  # what refinement made of each track, same order
    proposals_of_sweeps: Sequence[Sequence[Proposal]],
    params: JoiningParams,
    segment_id: str,
) -> list[Track]:
    """Return the tracks with what belongs to them of the proposals that no track has; order stays.

    An object is looked for up to ``stray_reach_s`` before and after its track, where it would be at the speed it had
    there. Of several tracks the one whose box holds most of a proposal's points takes it.

    Source: ours; the paper drops what its tracker does not link.
    """
    adopted: dict[int, list[Proposal]] = defaultdict(list)
    for stray in _strays(tracks, proposals_of_sweeps):
        shares = [_share_inside(track, stray, params) for track in labeled]
        if max(shares, default=0.0) >= MIN_INSIDE_SHARE:
            adopted[int(np.argmax(shares))].append(stray)
    return [extend(track, adopted[k], segment_id) if k in adopted else track for k, track in enumerate(tracks)]


def _strays(tracks: Sequence[Track], proposals_of_sweeps: Sequence[Sequence[Proposal]]) -> Iterator[Proposal]:
    """Yield the proposals whose points no track has. A joined track has proposals of its own, with the same points."""
    taken: dict[int, list[Int32Array]] = defaultdict(list)
    for track in tracks:
        for proposal in track.proposals:
            taken[proposal.sweep_index].append(proposal.point_rows)
    for proposals in proposals_of_sweeps:
        for proposal in proposals:
            if not any(proposal.point_rows[0] in rows for rows in taken[proposal.sweep_index]):
                yield proposal


def _share_inside(track: LabeledTrack, proposal: Proposal, params: JoiningParams) -> float:
    """Return which share of a proposal's points lies where the object must have been; 0 where it moves otherwise."""
    end = 0 if proposal.sweep_index < track.sweep_index[0] else -1
    gap_s = seconds_between(proposal.timestamp_ns, int(track.timestamp_ns[end]))
    is_outside = not track.sweep_index[0] <= proposal.sweep_index <= track.sweep_index[-1]
    box = track.boxes[end].copy()
    reach_s = bridged_s(params.stray_reach_s, median_period_s(track.timestamp_ns), REACHED_PERIODS)
    if not is_outside or abs(gap_s) > reach_s or max(box[BOX_LENGTH], box[BOX_WIDTH]) < MIN_LENGTH_M:
        return 0.0
    box[:3] += track.velocity_mps[end] * gap_s
    is_near = np.linalg.norm(proposal.box_visible[:2] - box[:2]) <= np.hypot(box[BOX_LENGTH], box[BOX_WIDTH])
    if not is_near or not is_alike(proposal.velocity_mps, track.velocity_mps[end], params):
        return 0.0
    return float(points_in_box(proposal.points_world, box, MARGIN_M).mean())
