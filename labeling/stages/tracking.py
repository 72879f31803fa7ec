"""Tracking: proposals over time -> tracks."""

import hashlib
import uuid
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.optimize import linear_sum_assignment

from labeling.geometry.boxes import paired_bev_iou, tight_box
from labeling.geometry.times import bridged_s, seconds_between, sweeps_within
from schemas.arrays import Float64Array
from schemas.config import TrackingParams
from schemas.objects import BOX_HEIGHT, BOX_LENGTH, BOX_WIDTH, Proposal, Track

UNKNOWN_SPEED_MPS = 1000.0  # standard deviation of a velocity that no flow tells
MISSED_PERIODS = 2.4  # of silence, where sweeps are rare: one is missed, and capture times differ
MAX_SLIVER_M, MIN_SLIVER_HEIGHT_M = 0.9, 0.5  # of what may be a person, seen by a few beams
TRACK_NAMESPACE = uuid.UUID("6f0d7c1e-8a43-5a0e-9d27-3b1c5e2f4a68")


class _LiveTrack:
    """A track being grown, with the Kalman state (x, y, vx, vy) of its visible box's centre, world frame."""

    def __init__(self, first: Proposal, params: TrackingParams, has_flow: bool) -> None:
        self.proposals = [first]
        self._params = params
        self._time_ns = first.timestamp_ns
        velocity_noise_mps = params.velocity_noise_mps if has_flow else UNKNOWN_SPEED_MPS
        self._noise = np.diag([params.position_noise_m**2] * 2 + [velocity_noise_mps**2] * 2)
        self._state = np.concatenate([first.box_visible[:2], first.velocity_mps[:2]])
        self._covariance = self._noise
        self._velocities_mps = [self._state[2:]]

    def silence_s(self, timestamp_ns: int) -> float:
        return seconds_between(timestamp_ns, self.proposals[-1].timestamp_ns)

    def advanced_box(self, timestamp_ns: int) -> Float64Array:
        """Return the last visible box moved by the object's flow to ``timestamp_ns``."""
        box = self.proposals[-1].box_visible.copy()
        box[:2] += self._state[2:] * self.silence_s(timestamp_ns)
        return box

    def update(self, proposal: Proposal) -> None:
        """Predict to the proposal's time, then correct with its centre and its flow."""
        params = self._params
        dt = seconds_between(proposal.timestamp_ns, self._time_ns)
        transition = np.eye(4)
        transition[0, 2] = transition[1, 3] = dt
        gain_of_noise = np.kron([[dt * dt / 2], [dt]], np.eye(2))
        state = transition @ self._state
        covariance = transition @ self._covariance @ transition.T
        covariance = covariance + params.process_noise_mps2**2 * gain_of_noise @ gain_of_noise.T
        measured = np.concatenate([proposal.box_visible[:2], proposal.velocity_mps[:2]])
        gain = covariance @ np.linalg.inv(covariance + self._noise)
        self._state = state + gain @ (measured - state)
        rest = np.eye(4) - gain
        self._covariance = rest @ covariance @ rest.T + gain @ self._noise @ gain.T  # Joseph form
        self._time_ns = proposal.timestamp_ns
        self.proposals.append(proposal)
        self._velocities_mps.append(self._state[2:])

    def filtered_proposals(self) -> list[Proposal]:
        """Return the proposals with the filter's velocities, and tight boxes along them; the first has the second's."""
        if len(self.proposals) == 1:
            return self.proposals
        velocities = [self._velocities_mps[1], *self._velocities_mps[1:]]
        return [_with_velocity(proposal, *v) for proposal, v in zip(self.proposals, velocities, strict=True)]


def _vacated_share(track: _LiveTrack) -> float:
    num_points = sum(len(proposal.points_world) for proposal in track.proposals)
    return sum(proposal.num_vacated for proposal in track.proposals) / num_points


def _with_velocity(proposal: Proposal, x_mps: float, y_mps: float) -> Proposal:
    box = tight_box(proposal.points_world, float(np.arctan2(y_mps, x_mps)))
    return replace(proposal, velocity_mps=np.array([x_mps, y_mps, 0.0]), box_visible=box)


def link_proposals(
    proposals_of_sweeps: Sequence[Sequence[Proposal]],  # ascending in time
    params: TrackingParams,
    segment_id: str,
    period_s: float,
    *,
    has_flow: bool = True,
) -> list[Track]:
    """Connect the proposals of successive sweeps, one every ``period_s``, into tracks.

    The last box of each live track is advanced by its flow (filtered by the Kalman state) and matched to the new
    boxes by BEV IoU, Hungarian, at least ``min_iou``. Both are grown by as much as the object may be off after such a
    gap, did it brake or turn; slivers of people count as ``person_side_m`` wide. A track silent for longer than
    ``max_missed_s`` ends, but not for missing one sweep. One with fewer proposals than ``min_duration_s`` has sweeps,
    or than ``min_sweeps`` (all sweeps of a shorter segment), is dropped. So is one whose places no other sweep saw
    empty: a wall that comes into view behind an edge seems to move along with the edge.

    Without flow this is a regular tracker: the state's velocity follows from the centres alone. Velocity and heading of
    the proposals of its tracks are then the filter's.

    Returns:
        Tracks ordered by first sweep, then first point. Ids are uuid5 of segment, first sweep and first points.

    Source: paper section 3.2, "Multi-Object Tracking", and appendix. The length limit and silence are not in the paper,
    nor are the width of people and the growth with the gap.

    """
    max_missed_s = bridged_s(params.max_missed_s, period_s, MISSED_PERIODS)
    live: list[_LiveTrack] = []
    ended: list[_LiveTrack] = []
    for proposals in proposals_of_sweeps:
        if not proposals:
            continue
        now_ns = min(proposal.timestamp_ns for proposal in proposals)
        ended += [track for track in live if track.silence_s(now_ns) > max_missed_s]
        live = [track for track in live if track.silence_s(now_ns) <= max_missed_s]
        matches = _match(live, proposals, params, has_flow=has_flow)
        for track_index, proposal_index in matches.items():
            live[track_index].update(proposals[proposal_index])
        taken = set(matches.values())
        live += [_LiveTrack(proposal, params, has_flow) for k, proposal in enumerate(proposals) if k not in taken]
    min_sweeps = max(params.min_sweeps, sweeps_within(params.min_duration_s, period_s))
    min_sweeps = min(min_sweeps, len(proposals_of_sweeps))  # a pair of sweeps has tracks too
    long_enough = [track for track in ended + live if len(track.proposals) >= min_sweeps]
    if params.has("vacated"):
        long_enough = [track for track in long_enough if _vacated_share(track) >= params.min_vacated_share]
    long_enough.sort(key=lambda track: (track.proposals[0].sweep_index, tuple(track.proposals[0].point_rows[:1])))
    return [
        Track(
            make_track_id(segment_id, track.proposals[0]),
            tuple(track.proposals if has_flow else track.filtered_proposals()),
        )
        for track in long_enough
    ]


def _match(
    live: Sequence[_LiveTrack], proposals: Sequence[Proposal], params: TrackingParams, *, has_flow: bool
) -> dict[int, int]:
    if not live:
        return {}
    iou = np.zeros((len(live), len(proposals)))
    for j, proposal in enumerate(proposals):
        gap_s = np.array([track.silence_s(proposal.timestamp_ns) for track in live])
        expected = np.stack([track.advanced_box(proposal.timestamp_ns) for track in live])
        found = np.tile(proposal.box_visible, (len(live), 1))
        iou[:, j] = _overlap(expected, found, gap_s, params)
        if has_flow and params.has("either_way"):
            last = np.stack([track.proposals[-1].box_visible for track in live])
            found[:, :2] -= gap_s[:, None] * proposal.velocity_mps[:2]
            iou[:, j] = np.minimum(iou[:, j], _overlap(last, found, gap_s, params))
    rows, columns = linear_sum_assignment(np.where(iou >= params.min_iou, iou, -1.0), maximize=True)
    return {int(i): int(j) for i, j in zip(rows, columns, strict=True) if iou[i, j] >= params.min_iou}


def _overlap(boxes_a: Float64Array, boxes_b: Float64Array, gap_s: Float64Array, params: TrackingParams) -> Float64Array:
    """Return the (B,) BEV IoU of pairs of boxes that stand for the same instant, one of them known (B,) gaps away."""
    off_m = params.max_acceleration_mps2 * gap_s**2 / 2 if params.has("either_way") else np.zeros(len(gap_s))
    return paired_bev_iou(*(_wide(boxes, off_m, params) for boxes in (boxes_a, boxes_b)))


def _wide(boxes: Float64Array, margin_m: Float64Array, params: TrackingParams) -> Float64Array:
    """Return (B, 7) boxes grown by (B,) margins on each side.

    Narrow upright ones are at least as wide as a person: whether slivers of one overlap is chance.
    """
    sides_m = boxes[:, [BOX_LENGTH, BOX_WIDTH]]
    is_sliver = (sides_m.max(axis=1) < MAX_SLIVER_M) & (boxes[:, BOX_HEIGHT] >= MIN_SLIVER_HEIGHT_M)
    wide = boxes.copy()
    if params.has("person_width"):
        wide[:, [BOX_LENGTH, BOX_WIDTH]] = np.where(
            is_sliver[:, None], np.maximum(sides_m, params.person_side_m), sides_m
        )
    wide[:, [BOX_LENGTH, BOX_WIDTH]] += 2 * margin_m[:, None]
    return wide


def make_track_id(segment_id: str, first: Proposal) -> str:
    """Return the uuid5 of segment, first sweep and first points: the same for any number of workers and any retry."""
    points = hashlib.sha256(first.point_rows.tobytes()).hexdigest()
    return str(uuid.uuid5(TRACK_NAMESPACE, f"{segment_id}/{first.sweep_index}/{points}"))
