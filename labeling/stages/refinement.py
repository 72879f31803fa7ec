"""Refinement: the completed shape -> one amodal box, carried back to every sweep, with velocity and score."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import isotonic_regression

from labeling.geometry.times import median_period_s, seconds_between, sweeps_within
from labeling.geometry.transforms import wrap_angle, yaw_of
from labeling.stages.extent import MIN_VEHICLE_LENGTH_M, model_box
from labeling.stages.heading import model_heading
from labeling.stages.registration import model_to_world
from labeling.stages.scoring import score_rows
from labeling.stages.trajectory import interpolate_trajectory, smooth_trajectory
from schemas.arrays import Float64Array, Int32Array, Int64Array
from schemas.config import RefinementParams
from schemas.objects import BOX_HEIGHT, BOX_LENGTH, BOX_YAW, AlignedTrack, LabeledTrack

REAR_AXLE_SHARE = 0.28  # of the length of a vehicle, behind its middle
MIN_FAST_SWEEPS = 2  # at any rate
MIN_STEP_SHARE = 0.01  # of the gap between two sweeps, between the times of their rows

Scorer = Callable[[AlignedTrack, LabeledTrack], Float64Array]  # -> (R,); the scores of the track given are zero


@dataclass(frozen=True, slots=True, eq=False)
class SweepClock:
    """When the sweeps of a segment were taken: for rows between a track's proposals."""

    sweep_index: Int64Array  # (T,) ascending
    timestamp_ns: Int64Array  # (T,)

    @property
    def period_s(self) -> float:
        """Usual time from one sweep to the next."""
        return median_period_s(self.timestamp_ns)


def refine_track(
    aligned: AlignedTrack, clock: SweepClock, params: RefinementParams, score: Scorer = score_rows
) -> LabeledTrack:
    """Box the aggregated cloud of a track and carry the box back to each sweep.

    The heading of the model is the direction its views travelled, of a vehicle its rear axle; the box is the tight one
    along it, by default the extent that most views support, reaching down to the ground. Sweeps between the first and
    last proposal that have none get an interpolated row.

    Returns:
        Rows ascending in time. Velocity is the derivative of the (smoothed) trajectory.

    Source: paper Algorithm 2, last lines. Robust extent, ground anchor, smoothing, interpolation and scores are ours.

    """
    proposals = aligned.track.proposals
    world_from_model = model_to_world(aligned.model_from_world)
    proposal_ns = np.array([proposal.timestamp_ns for proposal in proposals])
    times_s = seconds_between(proposal_ns, int(proposal_ns[0]))
    yaw = model_heading(aligned, world_from_model, times_s, params)
    box = model_box(aligned, yaw, params)
    if params.has("travel_heading") and box[BOX_LENGTH] >= MIN_VEHICLE_LENGTH_M:
        yaw = model_heading(aligned, world_from_model, times_s, params, center=_rear_axle(box))
        box = model_box(aligned, yaw, params)

    centers = np.einsum("tab,b->ta", world_from_model[:, :3, :3], box[:3]) + world_from_model[:, :3, 3]
    if params.has("ground_anchor"):  # registration slides along upright sides; the ground does not
        centers[:, 2] = np.array([proposal.ground_z_m for proposal in proposals]) + box[BOX_HEIGHT] / 2
    yaws = np.array([yaw + yaw_of(transform) for transform in world_from_model])
    flows_mps = np.array([proposal.velocity_mps for proposal in proposals])
    in_time = np.argsort(times_s, kind="stable")  # what is met at the seam of two turns was seen in the later one first
    trajectory = smooth_trajectory(
        *(values[in_time] for values in (times_s, centers, yaws, flows_mps)), is_smoothed=params.has("smooth_motion")
    )

    rows = _rows_between(proposals[0].sweep_index, proposals[-1].sweep_index, clock)
    view_of_row = {proposal.sweep_index: k for k, proposal in enumerate(proposals)}
    view = np.array([view_of_row.get(int(index), -1) for index in clock.sweep_index[rows]])
    is_observed = view >= 0
    timestamp_ns = _row_times(clock.timestamp_ns[rows], view, proposal_ns)
    at_rows = interpolate_trajectory(trajectory, seconds_between(timestamp_ns, int(proposal_ns[0])))
    boxes = np.column_stack(
        [at_rows.centers, np.tile(box[BOX_LENGTH : BOX_HEIGHT + 1], (len(rows), 1)), wrap_angle(at_rows.yaws)]
    )
    num_points = np.array([len(p.points_world) for p in proposals])
    empty = np.empty(0, dtype=np.int32)
    visible = np.full((len(rows), 7), np.nan)
    visible[is_observed] = np.stack([proposals[k].box_visible for k in view[is_observed]])
    error_m = np.full(len(rows), np.nan)
    error_m[is_observed] = aligned.error_m[view[is_observed]]
    labeled = LabeledTrack(
        track_id=aligned.track.track_id,
        sweep_index=clock.sweep_index[rows],
        timestamp_ns=timestamp_ns,
        boxes=boxes,
        velocity_mps=at_rows.velocities,
        score=np.zeros(len(rows)),
        num_points=np.where(is_observed, num_points[view], 0),
        is_observed=is_observed,
        boxes_visible=visible,
        registration_error_m=error_m,
        point_rows=tuple(_point_rows(proposals[k].point_rows) if k >= 0 else empty for k in view),
        range_noise_m=aligned.track.range_noise_m,
    )
    return replace(labeled, score=score(aligned, labeled))


def is_mover(track: LabeledTrack, params: RefinementParams) -> bool:
    """Tell whether a track is a road user that was ever fast: what only creeps lives on the noise of its flow."""
    is_fast = np.linalg.norm(track.velocity_mps[:, :2], axis=1) >= params.min_top_speed_mps
    min_fast_sweeps = max(MIN_FAST_SWEEPS, sweeps_within(params.min_fast_s, median_period_s(track.timestamp_ns)))
    has_moved = int(is_fast.sum()) >= min(min_fast_sweeps, len(is_fast)) or not params.has("movers_only")
    return has_moved and bool(track.boxes[0, BOX_HEIGHT] <= params.max_height_m or not params.has("height_limit"))


def _rear_axle(box: Float64Array) -> Float64Array:
    heading = np.array([np.cos(box[BOX_YAW]), np.sin(box[BOX_YAW]), 0.0])
    return box[:3] - REAR_AXLE_SHARE * box[BOX_LENGTH] * heading


def _point_rows(rows: Int32Array) -> Int32Array:
    return np.sort(rows)


def _rows_between(first: int, last: int, clock: SweepClock) -> Int64Array:
    return np.flatnonzero((clock.sweep_index >= first) & (clock.sweep_index <= last))


def _row_times(sweep_ns: Int64Array, view: Int64Array, proposal_ns: Int64Array) -> Int64Array:
    """Return (R,) capture times: the proposal's, else the sweep's stamp plus the delay interpolated from neighbours.

    Ascending: an object at the seam is met at the end of one turn and at the beginning of the next, in either order.
    Such rows take the ascending times nearest to theirs, a hundredth of the sweeps' gap apart.
    """
    seen = np.flatnonzero(view >= 0)
    delay_ns = np.interp(np.arange(len(view)), seen, proposal_ns[view[seen]] - sweep_ns[seen])
    captured_ns = sweep_ns - sweep_ns[0] + np.rint(delay_ns).astype(np.int64)
    least_ns = MIN_STEP_SHARE * (sweep_ns - sweep_ns[0])
    fitted_ns = isotonic_regression(captured_ns - least_ns).x + least_ns
    return sweep_ns[0] + np.rint(fitted_ns).astype(np.int64)
