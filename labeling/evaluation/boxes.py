"""Boxes against the truth: matching, precision and recall, AP, APH, errors, the oracle table.

Truth to find: movers in the region (evidence.py) while they move, with more than 5 points (L1) or at least 1 (L2).
Ignored, neither right nor wrong: movers while they pause, with too few points, or centred outside the region. All else
is wrong to label, parked cars too.

In each sweep labels choose by falling score (then IoU): the free truth to find with the greatest IoU >= 0.4, else a
free ignored one, and are then right, or ignored; else they are wrong. One label a truth. AP is the mean over 101 recall
points of the best precision at or beyond; labels of equal score enter together. APH weights a right label's part of the
precision by 1 - |yaw error| / pi. Intervals resample the objects: truth objects with the labels on them, and label
tracks with their wrong labels.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, Literal

import numpy as np

from labeling.evaluation.evidence import BoxEvidence, sweep_slices
from labeling.geometry.boxes import bev_iou, iou_3d
from labeling.geometry.transforms import wrap_angle
from schemas.arrays import BoolArray, Float64Array, Int64Array
from schemas.objects import BOX_HEIGHT, BOX_LENGTH, BOX_YAW

MIN_IOU: Final = 0.4
MIN_POINTS: Final = {"L1": 6, "L2": 1}
RECALL_POINTS: Final = np.linspace(0, 1, 101)
NUM_ROUNDS: Final = 200  # of resampling
INTERVAL: Final = (0.05, 0.95)

Overlap = Literal["3D", "BEV"]
Level = Literal["L1", "L2"]
OVERLAPS: Final[tuple[Overlap, ...]] = ("3D", "BEV")
LEVELS: Final[tuple[Level, ...]] = ("L1", "L2")


@dataclass(frozen=True, slots=True, eq=False)
class Matching:
    """What became of each label, for one kind of overlap and one level."""

    is_to_find: BoolArray  # (B,)
    truth_of_label: Int64Array  # (A,) the truth a right label found, -1: none
    is_ignored: BoolArray  # (A,)

    @property
    def is_right(self) -> BoolArray:
        """(A,) the label found a truth."""
        return self.truth_of_label >= 0

    @property
    def is_wrong(self) -> BoolArray:
        """(A,) neither right nor ignored."""
        return ~self.is_right & ~self.is_ignored


@dataclass(frozen=True, slots=True)
class Curve:
    """Detection quality of a set of labels: over all scores, and at one cut."""

    average_precision: float | None  # None without truth to find
    average_precision_heading: float | None
    precision: float | None  # at the cut; None without labels
    recall: float | None


def sweep_overlaps(evidence: BoxEvidence, label_boxes: Float64Array, overlap: Overlap = "3D") -> list[Float64Array]:
    """Return the (labels, truths) IoU of each sweep; ``label_boxes`` (A, 7) stand in for the evidence's own."""
    measure = iou_3d if overlap == "3D" else bev_iou
    return [
        measure(label_boxes[labels], evidence.truth_boxes[truths])
        for labels, truths in zip(
            sweep_slices(evidence.label_sweep, evidence.num_sweeps),
            sweep_slices(evidence.truth_sweep, evidence.num_sweeps),
            strict=True,
        )
    ]


def match(evidence: BoxEvidence, overlaps: list[Float64Array], level: Level) -> Matching:
    """Give each truth at most one label: greedy by score, truth to find before ignored truth, greatest IoU first."""
    is_to_find = evidence.truth_is_open & (evidence.truth_num_points >= MIN_POINTS[level])
    truth_of_label = np.full(len(evidence.label_sweep), -1)
    is_ignored = np.zeros(len(evidence.label_sweep), dtype=bool)
    label_start = truth_start = 0
    for iou in overlaps:
        num_labels, num_truths = iou.shape
        scores = evidence.label_score[label_start : label_start + num_labels]
        # An ignored truth ranks below every truth to find, whatever its IoU.
        to_find = is_to_find[truth_start : truth_start + num_truths]
        rank = np.where(iou >= MIN_IOU, iou + to_find, 0.0)
        for label in np.lexsort((-rank.max(axis=1), -scores)) if num_truths else ():
            best = int(np.argmax(rank[label]))
            if rank[label, best] > 0:
                rank[:, best] = 0.0
                if to_find[best]:
                    truth_of_label[label_start + label] = truth_start + best
                else:
                    is_ignored[label_start + label] = True
        label_start, truth_start = label_start + num_labels, truth_start + num_truths
    return Matching(is_to_find, truth_of_label, is_ignored)


def yaw_errors_rad(evidence: BoxEvidence, matching: Matching, label_boxes: Float64Array) -> Float64Array:
    """Return (A,) signed yaw errors in (-pi, pi] of right labels, zero elsewhere."""
    is_right = matching.is_right
    error = np.zeros(len(is_right))
    truth = matching.truth_of_label[is_right]
    error[is_right] = wrap_angle(label_boxes[is_right, BOX_YAW] - evidence.truth_boxes[truth, BOX_YAW])
    return error


def curve(
    score: Float64Array,  # (A,)
    right: Float64Array,  # (A,) weight of a right label, else 0
    wrong: Float64Array,  # (A,) weight of a wrong label, else 0
    heading: Float64Array,  # (A,) 1 - |yaw error| / pi
    num_to_find: float,  # weight of all truths to find
    min_score: float,
) -> Curve:
    """Return AP and APH over all scores, precision and recall of the labels at or above ``min_score``."""
    is_kept = score >= min_score
    kept_right, kept = right[is_kept].sum(), (right + wrong)[is_kept].sum()
    precision = float(kept_right / kept) if kept > 0 else None
    if num_to_find <= 0:
        return Curve(None, None, precision, None)
    order = np.argsort(-score, kind="stable")
    is_last_of_score = np.append(np.diff(score[order]) != 0, True)[: len(score)]
    found = np.cumsum(right[order])[is_last_of_score]
    found_heading = np.cumsum((right * heading)[order])[is_last_of_score]
    labelled = np.cumsum((right + wrong)[order])[is_last_of_score]
    recall = found / num_to_find
    averages = []
    for hits in (found, found_heading):
        at_recall = np.divide(hits, labelled, out=np.zeros(len(hits)), where=labelled > 0)
        best_beyond = np.append(np.maximum.accumulate(at_recall[::-1])[::-1], 0.0)
        # Tolerance: 0.29 as 29 hundredths and as 29 / 100 differ in the last bit.
        averages.append(float(best_beyond[np.searchsorted(recall, RECALL_POINTS - 1e-9, side="left")].mean()))
    return Curve(averages[0], averages[1], precision, float(kept_right / num_to_find))


def detection_curve(
    evidence: BoxEvidence,
    matching: Matching,
    min_score: float,
    label_boxes: Float64Array | None = None,
    label_mask: BoolArray | None = None,  # (A,) wrong labels that count; right ones count with their truth
    truth_mask: BoolArray | None = None,  # (B,)
) -> Curve:
    """Score a matching, of all labels and truths or of those in a band."""
    boxes = evidence.label_boxes if label_boxes is None else label_boxes
    is_to_find = matching.is_to_find if truth_mask is None else matching.is_to_find & truth_mask
    is_right = matching.is_right.copy()
    is_right[is_right] = is_to_find[matching.truth_of_label[is_right]]
    is_wrong = matching.is_wrong if label_mask is None else matching.is_wrong & label_mask
    heading = 1 - np.abs(yaw_errors_rad(evidence, matching, boxes)) / np.pi
    return curve(
        evidence.label_score, is_right.astype(float), is_wrong.astype(float), heading, int(is_to_find.sum()), min_score
    )


def resampled_curves(
    evidence: BoxEvidence, matching: Matching, min_score: float, rng: np.random.Generator
) -> list[Curve]:
    """Return the curves of NUM_ROUNDS draws of as many truth objects and label tracks, with replacement."""
    is_right, is_wrong = matching.is_right, matching.is_wrong
    heading = 1 - np.abs(yaw_errors_rad(evidence, matching, evidence.label_boxes)) / np.pi
    objects, object_of_truth = np.unique(evidence.truth_object[matching.is_to_find], return_inverse=True)
    tracks, track_of_label = np.unique(evidence.label_track[is_wrong], return_inverse=True)
    object_of_label = np.searchsorted(objects, evidence.truth_object[matching.truth_of_label[is_right]])
    curves = []
    for _ in range(NUM_ROUNDS):
        object_weight = np.bincount(rng.integers(0, max(len(objects), 1), len(objects)), minlength=len(objects))
        track_weight = np.bincount(rng.integers(0, max(len(tracks), 1), len(tracks)), minlength=len(tracks))
        right, wrong = np.zeros((2, len(is_right)))
        right[is_right] = object_weight[object_of_label]
        wrong[is_wrong] = track_weight[track_of_label]
        num_to_find = float(object_weight[object_of_truth].sum())
        curves.append(curve(evidence.label_score, right, wrong, heading, num_to_find, min_score))
    return curves


def interval(values: Sequence[float | None]) -> tuple[float, float] | None:
    """Return the 90 % interval of the resampled values, None when none is defined."""
    known = [value for value in values if value is not None]
    if not known:
        return None
    low, high = np.quantile(known, INTERVAL)
    return float(low), float(high)


def oracle_boxes(evidence: BoxEvidence, overlaps: list[Float64Array]) -> dict[str, Float64Array]:
    """Return label boxes with parts taken from the mover each overlaps most; boxes that overlap none stay.

    Source: the appendix's oracle table: all from truth; position ours, the rest truth; size ours; heading ours.
    """
    best = np.full(len(evidence.label_sweep), -1)
    label_start = truth_start = 0
    for iou in overlaps:
        if iou.size:
            best[label_start : label_start + len(iou)] = np.where(
                iou.max(axis=1) > 0, truth_start + iou.argmax(axis=1), -1
            )
        label_start, truth_start = label_start + iou.shape[0], truth_start + iou.shape[1]
    has_truth = best >= 0
    ours = {
        "all from truth": slice(0, 0),
        "position ours": slice(0, BOX_LENGTH),
        "size ours": slice(BOX_LENGTH, BOX_HEIGHT + 1),
        "heading ours": slice(BOX_YAW, BOX_YAW + 1),
    }
    mixed = {}
    for name, columns in ours.items():
        boxes = evidence.label_boxes.copy()
        boxes[has_truth] = evidence.truth_boxes[best[has_truth]]
        boxes[:, columns] = evidence.label_boxes[:, columns]
        mixed[name] = boxes
    return mixed
