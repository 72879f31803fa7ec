"""The figures of boxes: detection by overlap and level, bands, errors of right labels, oracle rows, wrong labels."""

from itertools import pairwise
from typing import Final

import numpy as np
from pydantic import BaseModel, ConfigDict

from labeling.evaluation.boxes import (
    LEVELS,
    OVERLAPS,
    Curve,
    Level,
    Matching,
    Overlap,
    detection_curve,
    interval,
    match,
    oracle_boxes,
    resampled_curves,
    sweep_overlaps,
    yaw_errors_rad,
)
from labeling.evaluation.evidence import TOUCHING_IOU, BoxEvidence
from schemas.arrays import BoolArray, Float64Array, FloatArray
from schemas.objects import BOX_HEIGHT, BOX_LENGTH

SPEED_BANDS_MPS: Final = (0.0, 3.0, 6.0, 9.0, 12.0, 15.0, np.inf)
RANGE_BANDS_M: Final = (0.0, 15.0, 30.0, np.inf)
LENGTH_BANDS_M: Final = (0.0, 1.2, 2.5, 6.0, np.inf)  # walkers, cycles, cars, trucks and buses
CENTER_EDGES_M: Final = np.linspace(0, 3, 31)
SIZE_EDGES_M: Final = np.linspace(0, 6, 31)
YAW_EDGES_RAD: Final = np.linspace(-np.pi, np.pi, 37)


class _Figures(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


Interval = tuple[float, float] | None  # 90 %


class DetectionFigures(_Figures):
    """Quality of the boxes by one overlap and level. None where nothing is to find, or nothing was labelled."""

    overlap: Overlap
    level: Level
    num_truths: int
    ap: float | None
    aph: float | None
    precision: float | None  # at the score cut
    recall: float | None  # at the score cut
    ap_interval: Interval = None
    aph_interval: Interval = None
    precision_interval: Interval = None
    recall_interval: Interval = None


class BandFigures(_Figures):
    """3D L1 of a band: truth by its own value, wrong labels by theirs."""

    quantity: str
    low: float
    high: float | None  # None: no upper end
    num_truths: int
    ap: float | None
    precision: float | None
    recall: float | None


class Histogram(_Figures):
    """Counts between edges; the first and the last bin hold what lies beyond them."""

    edges: tuple[float, ...]
    counts: tuple[int, ...]


class ErrorFigures(_Figures):
    """Errors of the right labels (3D L1) at the score cut."""

    num_matches: int
    center_median_m: float | None
    size_median_m: float | None  # |dl| + |dw| + |dh|
    yaw_median_rad: float | None  # of the absolute error
    center: Histogram
    size: Histogram
    yaw: Histogram  # signed


class OracleFigures(_Figures):
    """APH (3D L1) when parts of each box that overlaps a mover are taken from the truth."""

    name: str
    aph: float | None


class WrongLabels(_Figures):
    """Where wrong labels (3D L1) at the score cut lie."""

    num_wrong: int
    num_on_mover: int  # wrong extent or place, or a second box
    num_on_standing: int  # parked cars and other annotated objects that never move
    num_on_nothing: int


class BoxFigures(_Figures):
    """All figures of boxes of one log, or of several pooled."""

    num_sweeps: int
    num_labels: int  # in the region, any score
    num_objects: int  # movers to find, L2
    detection: tuple[DetectionFigures, ...]
    bands: tuple[BandFigures, ...]
    errors: ErrorFigures
    oracle: tuple[OracleFigures, ...]
    wrong: WrongLabels


def box_figures(
    evidence: BoxEvidence,
    overlaps: list[Float64Array],  # 3D IoU of each sweep
    matching: Matching,  # 3D L1
    min_score: float,
    *,
    has_interval: bool,
) -> BoxFigures:
    """Compute all figures of boxes but those of tracks."""
    bev = sweep_overlaps(evidence, evidence.label_boxes, "BEV")
    detection = []
    for overlap in OVERLAPS:
        for level in LEVELS:
            one = match(evidence, overlaps if overlap == "3D" else bev, level)
            detection.append(_detection_figures(evidence, one, (overlap, level), min_score, has_interval))
    is_kept = evidence.label_score >= min_score
    return BoxFigures(
        num_sweeps=evidence.num_sweeps,
        num_labels=len(evidence.label_sweep),
        num_objects=len(np.unique(evidence.truth_object[evidence.truth_is_open & (evidence.truth_num_points > 0)])),
        detection=tuple(detection),
        bands=_band_figures(evidence, matching, min_score),
        errors=_error_figures(evidence, matching, is_kept),
        oracle=_oracle_figures(evidence, overlaps, matching, min_score),
        wrong=_wrong_labels(evidence, overlaps, matching.is_wrong & is_kept),
    )


def _detection_figures(
    evidence: BoxEvidence, matching: Matching, kind: tuple[Overlap, Level], min_score: float, has_interval: bool
) -> DetectionFigures:
    found = detection_curve(evidence, matching, min_score)
    rounds: list[Curve] = []
    if has_interval:
        rounds = resampled_curves(evidence, matching, min_score, np.random.default_rng(0))
    return DetectionFigures(
        overlap=kind[0],
        level=kind[1],
        num_truths=int(matching.is_to_find.sum()),
        ap=found.average_precision,
        aph=found.average_precision_heading,
        precision=found.precision,
        recall=found.recall,
        ap_interval=interval([one.average_precision for one in rounds]),
        aph_interval=interval([one.average_precision_heading for one in rounds]),
        precision_interval=interval([one.precision for one in rounds]),
        recall_interval=interval([one.recall for one in rounds]),
    )


def _band_figures(evidence: BoxEvidence, matching: Matching, min_score: float) -> tuple[BandFigures, ...]:
    quantities = (
        ("speed_mps", SPEED_BANDS_MPS, evidence.label_speed_mps, evidence.truth_speed_mps),
        ("range_m", RANGE_BANDS_M, _range_m(evidence.label_boxes), _range_m(evidence.truth_boxes)),
        ("length_m", LENGTH_BANDS_M, evidence.label_boxes[:, BOX_LENGTH], evidence.truth_boxes[:, BOX_LENGTH]),
    )
    bands = []
    for quantity, edges, of_label, of_truth in quantities:
        for low, high in pairwise(edges):
            is_truth_in = (of_truth >= low) & (of_truth < high)
            is_label_in = (of_label >= low) & (of_label < high)
            found = detection_curve(evidence, matching, min_score, label_mask=is_label_in, truth_mask=is_truth_in)
            bands.append(
                BandFigures(
                    quantity=quantity,
                    low=low,
                    high=high if np.isfinite(high) else None,
                    num_truths=int((matching.is_to_find & is_truth_in).sum()),
                    ap=found.average_precision,
                    precision=found.precision,
                    recall=found.recall,
                )
            )
    return tuple(bands)


def _range_m(boxes_ego: Float64Array) -> Float64Array:
    distance: Float64Array = np.hypot(boxes_ego[:, 0], boxes_ego[:, 1])
    return distance


def _error_figures(evidence: BoxEvidence, matching: Matching, is_kept: BoolArray) -> ErrorFigures:
    counted = matching.is_right & is_kept
    ours, true = evidence.label_boxes[counted], evidence.truth_boxes[matching.truth_of_label[counted]]
    difference = ours - true
    center_m = np.linalg.norm(difference[:, :3], axis=1)
    size_m = np.abs(difference[:, BOX_LENGTH : BOX_HEIGHT + 1]).sum(axis=1)
    yaw_rad = yaw_errors_rad(evidence, matching, evidence.label_boxes)[counted]
    return ErrorFigures(
        num_matches=len(ours),
        center_median_m=_median(center_m),
        size_median_m=_median(size_m),
        yaw_median_rad=_median(np.abs(yaw_rad)),
        center=_histogram(center_m, CENTER_EDGES_M),
        size=_histogram(size_m, SIZE_EDGES_M),
        yaw=_histogram(yaw_rad, YAW_EDGES_RAD),
    )


def _median(values: FloatArray) -> float | None:
    return float(np.median(values)) if len(values) else None


def _histogram(values: Float64Array, edges: Float64Array) -> Histogram:
    counts, _ = np.histogram(np.clip(values, edges[0], edges[-1]), edges)
    return Histogram(edges=tuple(edges.tolist()), counts=tuple(counts.tolist()))


def _oracle_figures(
    evidence: BoxEvidence, overlaps: list[Float64Array], matching: Matching, min_score: float
) -> tuple[OracleFigures, ...]:
    rows = []
    for name, boxes in oracle_boxes(evidence, overlaps).items():
        rematched = match(evidence, sweep_overlaps(evidence, boxes), "L1")
        aph = detection_curve(evidence, rematched, min_score, boxes).average_precision_heading
        rows.append(OracleFigures(name=name, aph=aph))
    ours = detection_curve(evidence, matching, min_score).average_precision_heading
    return (*rows, OracleFigures(name="all ours", aph=ours))


def _wrong_labels(evidence: BoxEvidence, overlaps: list[Float64Array], is_wrong: BoolArray) -> WrongLabels:
    best = [iou.max(axis=1, initial=0.0) for iou in overlaps]
    is_on_mover = is_wrong & (np.concatenate([np.zeros(0), *best]) >= TOUCHING_IOU)
    is_on_standing = is_wrong & ~is_on_mover & evidence.is_on_standing
    num_wrong, num_on_mover, num_on_standing = (int(mask.sum()) for mask in (is_wrong, is_on_mover, is_on_standing))
    return WrongLabels(
        num_wrong=num_wrong,
        num_on_mover=num_on_mover,
        num_on_standing=num_on_standing,
        num_on_nothing=num_wrong - num_on_mover - num_on_standing,
    )
