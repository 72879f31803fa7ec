"""Tracks against the truth: purity, completeness, identity switches, HOTA.

All but HOTA rest on the right labels of the 3D L1 matching. Purity is the share of a label track's right labels on its
main object, completeness the share of a mover's sweeps to find that its main label track found; both are means, over
label tracks with a right label and over movers to find. An identity switch is a found sweep of a mover whose label
track differs from that of the found sweep before.
"""

from typing import Final

import numpy as np
from pydantic import BaseModel, ConfigDict
from scipy.optimize import linear_sum_assignment

from labeling.evaluation.boxes import Matching
from labeling.evaluation.evidence import BoxEvidence, sweep_slices
from schemas.arrays import BoolArray, Float64Array, Int64Array

HOTA_IOUS: Final = np.arange(0.05, 0.96, 0.05)


class TrackFigures(BaseModel):
    """Quality of identities over time. None where there is nothing to average."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    num_label_tracks: int  # with at least one label that is not ignored
    num_truth_tracks: int  # movers to find
    purity: float | None
    completeness: float | None
    num_id_switches: int
    hota: float | None
    detection_accuracy: float | None  # DetA and AssA, means over the same thresholds as HOTA
    association_accuracy: float | None


def track_figures(
    evidence: BoxEvidence,
    matching: Matching,  # 3D L1, of all labels
    is_kept: BoolArray,  # (A,) labels at or above the score cut
    hota: Float64Array,  # (4, 19) of hota_sums, added over logs
) -> TrackFigures:
    """Score the tracks that the kept labels make."""
    is_right = matching.is_right & is_kept
    track = evidence.label_track[is_right]
    found = evidence.truth_object[matching.truth_of_label[is_right]]
    to_find = evidence.truth_object[matching.is_to_find]
    hits, association_sum, num_truths, num_labels = hota
    detection = hits / np.maximum(num_truths + num_labels - hits, 1)
    association = association_sum / np.maximum(hits, 1)
    has_truth = len(to_find) > 0
    return TrackFigures(
        num_label_tracks=len(np.unique(evidence.label_track[is_kept & ~matching.is_ignored])),
        num_truth_tracks=len(np.unique(to_find)),
        purity=_mean([_largest(found[track == one]) / (track == one).sum() for one in np.unique(track)]),
        completeness=_mean([_largest(track[found == one]) / (to_find == one).sum() for one in np.unique(to_find)]),
        num_id_switches=sum(int(np.count_nonzero(np.diff(track[found == one]))) for one in np.unique(found)),
        hota=float(np.sqrt(detection * association).mean()) if has_truth else None,
        detection_accuracy=float(detection.mean()) if has_truth else None,
        association_accuracy=float(association.mean()) if has_truth else None,
    )


def _largest(ids: Int64Array) -> int:
    """Return how often the commonest id occurs."""
    return int(np.unique(ids, return_counts=True)[1].max(initial=0))


def _mean(values: list[float]) -> float | None:
    return float(np.mean(values)) if values else None


def hota_sums(
    evidence: BoxEvidence,  # of one log
    matching: Matching,  # 3D L1
    overlaps: list[Float64Array],  # 3D IoU of each sweep
    is_kept: BoolArray,  # (A,) labels at or above the score cut
) -> Float64Array:
    """Return (4, 19) for each IoU threshold: hits, sum of the hits' association scores, truths, labels; logs add up.

    Truths are those to find, labels those neither cut nor ignored.

    Source: Luiten et al. 2021, HOTA, eq. 7-11, and its reference evaluation: in each sweep the matching favours pairs
    of tracks that agree over the whole recording.
    """
    is_counted = is_kept & ~matching.is_ignored
    truth_ids, truth_count = np.unique(evidence.truth_object[matching.is_to_find], return_counts=True)
    label_ids, label_count = np.unique(evidence.label_track[is_counted], return_counts=True)
    sweeps = []  # of each sweep: indices into label_ids, into truth_ids, IoU
    label_rows = sweep_slices(evidence.label_sweep, evidence.num_sweeps)
    truth_rows = sweep_slices(evidence.truth_sweep, evidence.num_sweeps)
    for iou, labels, truths in zip(overlaps, label_rows, truth_rows, strict=True):
        kept, to_find = is_counted[labels], matching.is_to_find[truths]
        label_index = np.searchsorted(label_ids, evidence.label_track[labels][kept])
        truth_index = np.searchsorted(truth_ids, evidence.truth_object[truths][to_find])
        sweeps.append((label_index, truth_index, iou[np.ix_(kept, to_find)]))

    agreement = np.zeros((len(label_ids), len(truth_ids)))
    for label_index, truth_index, iou in sweeps:
        rivals = iou.sum(axis=0, keepdims=True) + iou.sum(axis=1, keepdims=True) - iou
        share = np.divide(iou, rivals, out=np.zeros_like(iou), where=rivals > 0)
        agreement[np.ix_(label_index, truth_index)] += share
    either = label_count[:, None] + truth_count[None]
    alignment = agreement / (either - agreement)

    matches = np.zeros((len(HOTA_IOUS), *agreement.shape))
    for label_index, truth_index, iou in sweeps:
        rows, columns = linear_sum_assignment(alignment[np.ix_(label_index, truth_index)] * iou, maximize=True)
        is_hit = iou[rows, columns] >= HOTA_IOUS[:, None] - np.finfo(float).eps  # (19, pairs)
        matches[:, label_index[rows], truth_index[columns]] += is_hit
    hits = matches.sum(axis=(1, 2))
    association = (matches * matches / (either - matches)).sum(axis=(1, 2))  # eq. 9 and 10
    return np.stack([hits, association, np.full_like(hits, truth_count.sum()), np.full_like(hits, label_count.sum())])
