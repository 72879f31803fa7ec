"""Attribution: finished tracks -> which points of a sweep belong to which object, and the motion that follows.

Flow looks at a few sweeps; a track has seen its object for seconds. Once tracks stand, a point inside a moving object's
box moves as the object does, also when the static filter had taken it (long flat sides slide along themselves); a point
that seemed to move and belongs to no object stands still.
"""

from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from labeling.geometry.boxes import points_in_box
from labeling.geometry.transforms import invert, transform_points, yaw_translation
from schemas.arrays import BoolArray, Float32Array, Float64Array, FloatArray, Int32Array, Int64Array
from schemas.config import AttributionParams
from schemas.objects import BOX_YAW, LabeledTrack, SweepPoints


@dataclass(frozen=True, slots=True, eq=False)
class Claim:
    """A labelled object in one sweep. World frame."""

    track_id: str
    box: Float64Array  # (7,)
    next_box: Float64Array | None  # (7,) in the next usable sweep; None where the track ends
    velocity_mps: Float64Array  # (3,)
    score: float
    point_rows: Int32Array  # rows in the source sweep that made its proposal
    range_noise_m: float


@dataclass(frozen=True, slots=True, eq=False)
class PointMotion:
    """The points of a sweep that are called neither ground nor static, in the end."""

    is_dynamic: BoolArray  # (N,) of the points given
    owner: Int64Array  # (N,) position in the claims; -1 where none
    flow_world_m: Float32Array | None  # (N, 3)


def claims_by_sweep(tracks: Iterable[LabeledTrack]) -> Mapping[int, Sequence[Claim]]:
    """Sort what tracks say by sweep."""
    claims: dict[int, list[Claim]] = defaultdict(list)
    for track in tracks:
        for row, index in enumerate(track.sweep_index.tolist()):
            claims[index].append(
                Claim(
                    track.track_id,
                    track.boxes[row],
                    track.boxes[row + 1] if row + 1 < len(track.boxes) else None,
                    track.velocity_mps[row],
                    float(track.score[row]),
                    track.point_rows[row],
                    track.range_noise_m,
                )
            )
    return claims


def attribute_points(
    points: SweepPoints,  # flow: zero where static
    points_world: Float64Array,  # (N, 3)
    claims: Sequence[Claim],
    gap_s: float,  # to the next sweep
    params: AttributionParams,
) -> PointMotion:
    """Say of each point whether it moves, with which object, and how far to the next sweep.

    The points of an object are those inside its box, and move with it from this sweep to the next.
    Of several objects the one with the higher score takes a point, but below ``min_claim_score`` none that is of
    another's proposal. Slower than ``min_speed_mps``, an object stands and owns the points of its proposal alone. Other
    points have zero flow; they stay dynamic where their own flow says so.

    Without step ``tracks``: dynamic points, their flow and the points of proposals as they were estimated.

    Source: ours; the paper's flow ends where its tracks begin. Profile ``paper`` is without.

    """
    owner = np.full(len(points_world), -1)
    is_dynamic = points.is_dynamic.copy()
    flow = None if points.flow_world_m is None else points.flow_world_m.copy()
    has_track_flow = params.has("tracks")
    if has_track_flow and flow is not None:
        is_dynamic &= np.linalg.norm(flow, axis=1) >= params.min_stray_speed_mps * gap_s
        flow[:] = 0.0
    proposed = [np.isin(points.point_index, claim.point_rows) for claim in claims]
    is_proposed = np.any(proposed, axis=0) if proposed else np.zeros(len(points_world), dtype=bool)
    for number in sorted(range(len(claims)), key=lambda k: (claims[k].score, -k)):  # the best comes last and wins
        claim, is_own = claims[number], proposed[number]
        moves = np.linalg.norm(claim.velocity_mps[:2]) >= params.min_speed_mps or not has_track_flow
        if has_track_flow and moves:
            is_inside = points_in_box(points_world, claim.box, params.noise_factor * claim.range_noise_m)
            is_own = is_inside if claim.score >= params.min_claim_score else is_inside & (is_own | ~is_proposed)
        owner[is_own] = number
        is_dynamic[is_own] = moves
        if has_track_flow and flow is not None:
            flow[is_own] = _carry(points_world[is_own], claim, gap_s) if moves else 0.0
    return PointMotion(is_dynamic, owner, flow)


def _carry(points_world: Float64Array, claim: Claim, gap_s: float) -> FloatArray:
    """Return (P, 3) displacements of points that are fixed to the box."""
    if claim.next_box is None:
        return claim.velocity_mps * gap_s
    here, there = (yaw_translation(box[BOX_YAW], box[:3]) for box in (claim.box, claim.next_box))
    return transform_points(there @ invert(here), points_world) - points_world
