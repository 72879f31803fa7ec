"""Tracks in the order in which a person should look at them: what is most likely wrong first."""

from dataclasses import dataclass

import numpy as np

from labeling.geometry.times import seconds_between
from schemas.objects import BOX_LENGTH
from schemas.tables.labels import LabelRows


@dataclass(frozen=True, slots=True)
class TrackSummary:
    """What tells a doubtful track from a good one."""

    track_id: str
    num_boxes: int
    mean_score: float
    jump_m: float  # largest distance of a box from where the one before and the velocities of both put it
    size_change: float  # largest side over smallest, less one, of the axis that changes most
    top_speed_mps: float


def summarize(rows: LabelRows) -> TrackSummary:
    """Sum up one track's boxes, ascending in time."""
    centers = rows.boxes[:, :BOX_LENGTH]
    gaps_s = seconds_between(rows.timestamp_ns[1:], rows.timestamp_ns[:-1])[:, None]
    expected = centers[:-1] + (rows.velocity_mps[:-1] + rows.velocity_mps[1:]) / 2 * gaps_s
    sides = rows.boxes[:, BOX_LENGTH : BOX_LENGTH + 3]
    return TrackSummary(
        track_id=str(rows.track_id[0]),
        num_boxes=len(rows),
        mean_score=float(rows.score.mean()),
        jump_m=float(np.linalg.norm(centers[1:] - expected, axis=1).max(initial=0.0)),
        size_change=float((sides.max(axis=0) / sides.min(axis=0)).max() - 1),
        top_speed_mps=float(np.linalg.norm(rows.velocity_mps[:, :2], axis=1).max()),
    )


def doubt(track: TrackSummary) -> tuple[float, float, float, str]:
    """Return what to sort by: lowest score first, of equal scores, as they are shown, the largest jump, then size."""
    return round(track.mean_score, 2), -track.jump_m, -track.size_change, track.track_id
