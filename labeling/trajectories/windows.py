"""What an object did until an instant, and what it does next, as the object itself would say it."""

from dataclasses import dataclass
from typing import Final

import numpy as np

from labeling.geometry.transforms import wrap_angle
from labeling.trajectories.states import interpolate_track
from schemas.arrays import Float64Array, Int64Array
from schemas.errors import InvalidInput
from schemas.objects import BOX_LENGTH, BOX_YAW
from schemas.tables.labels import LabelRows
from schemas.tables.trajectories import TrajectoryRows

_S_IN_NS: Final = 1_000_000_000
MAX_HZ: Final = 100.0


@dataclass(frozen=True, slots=True)
class Horizon:
    """Which instants count: anchors on one clock for a whole segment, and steps around each. In seconds."""

    hz: float = 10.0  # steps a second
    step_s: float = 0.5  # from one anchor to the next
    history_s: float = 1.0  # Sec. 4.4 of the paper, after the Waymo Open Motion Dataset
    future_s: float = 8.0  # what it is asked for

    def __post_init__(self) -> None:
        """Check the values.

        Raises:
            InvalidInput: One of them is out of range, or no whole number of steps fits into history or future.

        """
        for name, value, low, high in (
            ("hz", self.hz, 0.1, MAX_HZ),
            ("step-s", self.step_s, 0.01, 3600.0),
            ("history-s", self.history_s, 0.0, 60.0),
            ("future-s", self.future_s, 0.0, 60.0),
        ):
            if not low <= value <= high:  # NaN is in no range
                raise InvalidInput(f"--{name} {value:g}: expected {low:g} to {high:g}")
        for name, value in (("history-s", self.history_s), ("future-s", self.future_s)):
            if abs(value * self.hz - round(value * self.hz)) > 1e-6:
                raise InvalidInput(f"--{name} {value:g}: expected a whole number of steps of 1/{self.hz:g} s")

    @property
    def num_history(self) -> int:
        """Steps before the anchor."""
        return round(self.history_s * self.hz)

    @property
    def num_future(self) -> int:
        """Steps after the anchor."""
        return round(self.future_s * self.hz)

    @property
    def offsets_ns(self) -> Int64Array:
        """(T,) time from the anchor of each step, T = history + 1 + future; 0 at place ``num_history``."""
        return steps_ns(np.arange(-self.num_history, self.num_future + 1), self.hz)

    def anchors_ns(self, start_ns: int, first_ns: int, last_ns: int) -> Int64Array:
        """Return the anchors from ``first_ns`` to ``last_ns``, ends included, of the clock through ``start_ns``."""
        step_ns = round(self.step_s * _S_IN_NS)
        first, last = -((start_ns - first_ns) // step_ns), (last_ns - start_ns) // step_ns
        return start_ns + np.arange(first, last + 1, dtype=np.int64) * step_ns


def steps_ns(numbers: Int64Array, hz: float) -> Int64Array:
    """Return the time of each step after step 0, to the nearest nanosecond: errors do not add up."""
    return np.rint(numbers * (_S_IN_NS / hz)).astype(np.int64)


def cut_windows(
    rows: LabelRows,  # of one track, ascending in time
    start_ns: int,
    horizon: Horizon,
    max_gap_s: float,
) -> TrajectoryRows:
    """Return a window around each anchor at which it is known where the object is, in the frame that it has there.

    That frame has its origin in the centre of the box at the anchor, x along its heading, and z up.
    """
    anchors_ns = horizon.anchors_ns(start_ns, int(rows.timestamp_ns[0]), int(rows.timestamp_ns[-1]))
    anchors_ns = anchors_ns[interpolate_track(rows, anchors_ns, max_gap_s).is_valid]
    anchor = interpolate_track(rows, anchors_ns, max_gap_s)
    steps = interpolate_track(rows, anchors_ns[:, None] + horizon.offsets_ns, max_gap_s)
    offset_m = np.where(steps.is_valid[..., None], steps.center_m - anchor.center_m[:, None], 0.0)
    return TrajectoryRows(
        track_id=str(rows.track_id[0]),
        size_m=rows.boxes[0, BOX_LENGTH:BOX_YAW],
        num_history=horizon.num_history,
        anchor_timestamp_ns=anchors_ns,
        anchor_center_m=anchor.center_m,
        anchor_yaw_rad=anchor.yaw_rad,
        is_valid=steps.is_valid,
        is_observed=steps.is_observed,
        center_m=_turn(offset_m, -anchor.yaw_rad),
        yaw_rad=np.where(steps.is_valid, wrap_angle(steps.yaw_rad - anchor.yaw_rad[:, None]), 0.0),
        velocity_mps=_turn(steps.velocity_mps, -anchor.yaw_rad),
        score=steps.score,
    )


def _turn(vectors: Float64Array, yaw_rad: Float64Array) -> Float64Array:
    """Turn (A, T, 3) vectors about z, all steps of an anchor by the same (A,) angle."""
    cos, sin = np.cos(yaw_rad)[:, None], np.sin(yaw_rad)[:, None]
    x, y, z = np.moveaxis(vectors, 2, 0)
    return np.stack([x * cos - y * sin, x * sin + y * cos, z], axis=2)
