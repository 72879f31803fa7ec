"""Scene flow and static removal against the truth, as sums that add up over sweeps and logs.

Domain: every source point with |x|, |y| <= 50 m that is not truth ground. What a run calls ground or static (it has no
row in the points table) predicts zero flow, so leaving points out cannot help. Zero flow is scored beside it.

* EPE3D: mean L2 error. Acc5, Acc10: share of points whose error is below 0.05 m, 0.10 m or, where truth flow is not
  zero, below 5 %, 10 % of it.
* theta: mean angle between truth and prediction over moving points, pi/2 where zero is predicted. Other definitions
  average over more points: compare like with like.
* Speed IoU: points binned by speed, TP / (TP + FP + FN) of each bin; the mean is over bins with >= 1,000 truth points.
* False motion: share of standing points flown faster than 1 m/s.
* Static: called ground or static. In-box figures are over points in annotated boxes, scene figures over the domain.
"""

from dataclasses import dataclass, fields
from typing import Final

import numpy as np
from pydantic import BaseModel, ConfigDict

from labeling.evaluation.truth import MOVING_MPS, SweepPointTruth
from schemas.arrays import BoolArray, Float64Array, Int64Array

SPEED_EDGES_MPS: Final = (3.0, 6.0, 9.0, 12.0, 15.0)
SPEED_BINS: Final = ("0-3", "3-6", "6-9", "9-12", "12-15", "15+")
MIN_BIN_POINTS: Final = 1000  # truth points that a speed bin needs to count in the mean
ZERO_M: Final = 1e-6  # a shorter displacement is none
_NUM_BINS: Final = len(SPEED_BINS)


class FlowFigures(BaseModel):
    """Scene flow over a set of points. None where there is nothing to average."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    num_sweeps: int
    num_points: int
    num_moving_points: int
    epe3d_m: float | None
    acc5: float | None
    acc10: float | None
    theta_rad: float | None
    moving_epe_m: float | None
    normalised_moving_epe: float | None  # over the mean truth displacement of the moving points
    standing_epe_m: float | None
    false_motion: float | None
    speed_iou: tuple[float | None, ...]  # a bin of SPEED_BINS each, None where neither truth nor prediction has points
    speed_num_points: tuple[int, ...]  # truth points a bin
    mean_speed_iou: float | None


class StaticFigures(BaseModel):
    """Static removal over a set of points. None where there is nothing to average."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    num_sweeps: int
    num_points: int
    in_box_precision: float | None
    in_box_recall: float | None
    scene_precision: float | None
    scene_recall: float | None
    moving_lost: float | None


@dataclass(frozen=True, slots=True, eq=False)
class FlowSums:
    """What the flow figures are made of."""

    num_sweeps: int = 0
    num_points: int = 0
    error_m: float = 0.0
    num_acc5: int = 0
    num_acc10: int = 0
    num_moving: int = 0
    moving_error_m: float = 0.0
    moving_displacement_m: float = 0.0
    num_angles: int = 0
    angle_rad: float = 0.0
    num_standing: int = 0
    standing_error_m: float = 0.0
    num_false_motion: int = 0
    confusion: Int64Array | int = 0  # (truth bin, predicted bin) counts

    def __add__(self, other: "FlowSums") -> "FlowSums":
        """Pool two sets of points."""
        return FlowSums(*(getattr(self, field.name) + getattr(other, field.name) for field in fields(self)))


@dataclass(frozen=True, slots=True, eq=False)
class StaticSums:
    """What the static figures are made of: numbers of points."""

    num_sweeps: int = 0
    num_points: int = 0
    num_called: int = 0
    num_standing: int = 0
    num_right: int = 0  # standing and called
    num_called_in_box: int = 0
    num_standing_in_box: int = 0
    num_right_in_box: int = 0

    def __add__(self, other: "StaticSums") -> "StaticSums":
        """Pool two sets of points."""
        return StaticSums(*(getattr(self, field.name) + getattr(other, field.name) for field in fields(self)))


def sum_flow(
    truth: SweepPointTruth,
    flow_ego_m: Float64Array,  # (N, 3) predicted displacement to the next sweep, zero where nothing is predicted
    gap_s: float,
) -> FlowSums:
    """Compare the flow of one sweep with its truth."""
    if truth.flow_ego_m is None:
        return FlowSums()
    counts = truth.is_domain & np.isfinite(truth.flow_ego_m).all(axis=1)
    true, predicted, is_moving = truth.flow_ego_m[counts], flow_ego_m[counts], truth.is_moving[counts]
    error_m = np.linalg.norm(predicted - true, axis=1)
    true_m, predicted_m = np.linalg.norm(true, axis=1), np.linalg.norm(predicted, axis=1)
    has_angle = is_moving & (true_m > ZERO_M)
    true_bin = np.digitize(true_m / gap_s, SPEED_EDGES_MPS)
    predicted_bin = np.digitize(predicted_m / gap_s, SPEED_EDGES_MPS)
    return FlowSums(
        num_sweeps=1,
        num_points=len(error_m),
        error_m=float(error_m.sum()),
        num_acc5=_num_accurate(error_m, true_m, 0.05),
        num_acc10=_num_accurate(error_m, true_m, 0.10),
        num_moving=int(is_moving.sum()),
        moving_error_m=float(error_m[is_moving].sum()),
        moving_displacement_m=float(true_m[is_moving].sum()),
        num_angles=int(has_angle.sum()),
        angle_rad=float(_angles_rad(true[has_angle], predicted[has_angle]).sum()),
        num_standing=int((~is_moving).sum()),
        standing_error_m=float(error_m[~is_moving].sum()),
        num_false_motion=int((predicted_m[~is_moving] > MOVING_MPS * gap_s).sum()),
        confusion=np.bincount(true_bin * _NUM_BINS + predicted_bin, minlength=_NUM_BINS**2).reshape(_NUM_BINS, -1),
    )


def _num_accurate(error_m: Float64Array, true_m: Float64Array, limit: float) -> int:
    """Count errors below ``limit`` metres or, where truth flow is not zero, below that share of it."""
    return int(((error_m < limit) | ((true_m > ZERO_M) & (error_m < limit * true_m))).sum())


def _angles_rad(true: Float64Array, predicted: Float64Array) -> Float64Array:
    """Angle between (M, 3) vectors, pi/2 where the prediction is zero; stable near 0 and pi."""
    across = np.linalg.norm(np.cross(true, predicted), axis=1)
    angle: Float64Array = np.arctan2(across, (true * predicted).sum(axis=1))
    return np.where(np.linalg.norm(predicted, axis=1) > ZERO_M, angle, np.pi / 2)


def sum_static(
    truth: SweepPointTruth,
    is_called_static: BoolArray,  # (N,) called ground or static by the run
) -> StaticSums:
    """Compare what a run removed from one sweep with what stands."""
    called, standing, in_box = (mask[truth.is_domain] for mask in (is_called_static, ~truth.is_moving, truth.is_in_box))
    return StaticSums(
        num_sweeps=1,
        num_points=len(called),
        num_called=int(called.sum()),
        num_standing=int(standing.sum()),
        num_right=int((called & standing).sum()),
        num_called_in_box=int((called & in_box).sum()),
        num_standing_in_box=int((standing & in_box).sum()),
        num_right_in_box=int((called & standing & in_box).sum()),
    )


def flow_figures(sums: FlowSums) -> FlowFigures:
    """Turn pooled sums into figures."""
    confusion = np.zeros((_NUM_BINS, _NUM_BINS), dtype=np.int64) + sums.confusion
    right, true, predicted = np.diag(confusion), confusion.sum(axis=1), confusion.sum(axis=0)
    speed_iou = tuple(ratio(hit, union) for hit, union in zip(right, true + predicted - right, strict=True))
    counted = [iou for iou, points in zip(speed_iou, true, strict=True) if points >= MIN_BIN_POINTS and iou is not None]
    moving_epe_m = ratio(sums.moving_error_m, sums.num_moving)
    return FlowFigures(
        num_sweeps=sums.num_sweeps,
        num_points=sums.num_points,
        num_moving_points=sums.num_moving,
        epe3d_m=ratio(sums.error_m, sums.num_points),
        acc5=ratio(sums.num_acc5, sums.num_points),
        acc10=ratio(sums.num_acc10, sums.num_points),
        theta_rad=ratio(sums.angle_rad, sums.num_angles),
        moving_epe_m=moving_epe_m,
        normalised_moving_epe=ratio(sums.moving_error_m, sums.moving_displacement_m),
        standing_epe_m=ratio(sums.standing_error_m, sums.num_standing),
        false_motion=ratio(sums.num_false_motion, sums.num_standing),
        speed_iou=speed_iou,
        speed_num_points=tuple(int(points) for points in true),
        mean_speed_iou=ratio(sum(counted), len(counted)),
    )


def static_figures(sums: StaticSums) -> StaticFigures:
    """Turn pooled sums into figures."""
    num_moving = sums.num_points - sums.num_standing
    return StaticFigures(
        num_sweeps=sums.num_sweeps,
        num_points=sums.num_points,
        in_box_precision=ratio(sums.num_right_in_box, sums.num_called_in_box),
        in_box_recall=ratio(sums.num_right_in_box, sums.num_standing_in_box),
        scene_precision=ratio(sums.num_right, sums.num_called),
        scene_recall=ratio(sums.num_right, sums.num_standing),
        moving_lost=ratio(sums.num_called - sums.num_right, num_moving),
    )


def ratio(part: float, whole: float) -> float | None:
    """Return part / whole, None when there is no whole."""
    return float(part) / float(whole) if whole > 0 else None
