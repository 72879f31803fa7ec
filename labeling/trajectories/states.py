"""A track at any instant: its label rows, interpolated."""

from dataclasses import dataclass

import numpy as np

from labeling.geometry.times import seconds_between
from labeling.geometry.transforms import wrap_angle
from schemas.arrays import BoolArray, Float64Array, Int64Array
from schemas.errors import InvalidInput
from schemas.objects import BOX_YAW
from schemas.tables.labels import LabelRows


@dataclass(frozen=True, slots=True, eq=False)
class TrackStates:
    """One object at instants of shape Q, world frame. All is zero where it is not known where the object is."""

    is_valid: BoolArray  # Q
    is_observed: BoolArray  # Q, False where a box that rests on no points has a say
    center_m: Float64Array  # Q + (3,)
    yaw_rad: Float64Array  # Q, (-pi, pi]
    velocity_mps: Float64Array  # Q + (3,)
    score: Float64Array  # Q


def interpolate_track(rows: LabelRows, timestamps_ns: Int64Array, max_gap_s: float) -> TrackStates:
    """Return the states of a track at instants between its rows, or at one of them.

    Positions, velocities and scores are linear in time between the row before and the row after, yaw goes the shorter
    way round. Nothing is said of instants before the first row, after the last, and within a longer gap.

    Args:
        rows: Of one track, one or more, ascending in time.
        timestamps_ns: Of any shape Q.
        max_gap_s: Longest time between two rows that is bridged.

    Raises:
        InvalidInput: Two rows of the track are of the same instant.

    """
    stamps_ns = rows.timestamp_ns
    if (np.diff(stamps_ns) <= 0).any():
        raise InvalidInput(f"track {rows.track_id[0]} is in two places at one instant: label the segment again")
    after = np.searchsorted(stamps_ns, timestamps_ns)
    is_inside = (timestamps_ns >= stamps_ns[0]) & (timestamps_ns <= stamps_ns[-1])
    after = np.minimum(after, len(stamps_ns) - 1)
    before = np.where(stamps_ns[after] == timestamps_ns, after, np.maximum(after - 1, 0))
    gap_s = seconds_between(stamps_ns[after], stamps_ns[before])
    is_valid = is_inside & (gap_s <= max_gap_s)
    since_s = seconds_between(timestamps_ns, stamps_ns[before])
    way = np.divide(since_s, gap_s, out=np.zeros(gap_s.shape), where=is_valid & (gap_s > 0))

    def between(values: Float64Array) -> Float64Array:  # (R,) or (R, 3)
        ways, valid = (part.reshape(part.shape + (1,) * (values.ndim - 1)) for part in (way, is_valid))
        return np.where(valid, values[before] + ways * (values[after] - values[before]), 0.0)

    yaw = rows.boxes[:, BOX_YAW]
    turned = wrap_angle(yaw[before] + way * wrap_angle(yaw[after] - yaw[before]))
    return TrackStates(
        is_valid=is_valid,
        is_observed=is_valid & rows.is_observed[before] & rows.is_observed[after],
        center_m=between(rows.boxes[:, :3]),
        yaw_rad=np.where(is_valid, turned, 0.0),
        velocity_mps=between(rows.velocity_mps),
        score=between(rows.score),
    )


def count_gaps(rows: LabelRows, max_gap_s: float) -> int:
    """Return how many times between successive rows of a track are too long to be bridged."""
    return int((seconds_between(rows.timestamp_ns[1:], rows.timestamp_ns[:-1]) > max_gap_s).sum())
