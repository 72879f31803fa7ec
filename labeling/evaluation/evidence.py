"""What boxes are judged by: labels in the region beside the truth boxes of movers, of one log or of several pooled.

Region: |x| <= 50 m, |y| <= 20 m in the ego frame (and the view, where only that is annotated), by box centre. Labels
outside are left out; truth outside stays, to be ignored.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Final

import numpy as np

from labeling.evaluation.truth import SegmentTruth, is_in_view
from labeling.geometry.boxes import iou_3d, transform_boxes
from labeling.geometry.transforms import invert
from schemas.arrays import BoolArray, Float64Array, FloatArray, Int64Array
from schemas.tables.labels import LabelRows

REGION_X_M: Final = 50.0
REGION_Y_M: Final = 20.0
TOUCHING_IOU: Final = 0.1  # from here on a wrong label is said to lie on an object


@dataclass(frozen=True, slots=True, eq=False)
class BoxEvidence:
    """Rows of labels and of truths, each ordered by sweep. Boxes are in the ego frame of their sweep."""

    num_sweeps: int
    label_sweep: Int64Array  # (A,) ascending, numbered over all pooled sweeps
    label_track: Int64Array  # (A,) numbered over all pooled tracks
    label_boxes: Float64Array  # (A, 7)
    label_score: Float64Array  # (A,)
    label_speed_mps: Float64Array  # (A,) horizontal
    truth_sweep: Int64Array  # (B,) ascending
    truth_object: Int64Array  # (B,)
    truth_boxes: Float64Array  # (B, 7)
    truth_speed_mps: Float64Array  # (B,)
    truth_num_points: Int64Array  # (B,)
    truth_is_open: BoolArray  # (B,) moving and in the region: to find, given points enough
    is_on_standing: BoolArray  # (A,) IoU with an annotated object that is no mover reaches TOUCHING_IOU


def gather_evidence(
    truth: SegmentTruth,
    labels: LabelRows,
    world_from_ego: dict[int, Float64Array],  # (4, 4) of each evaluated sweep
    azimuth_deg: float | None,
) -> BoxEvidence:
    """Bring labels and truth of the evaluated sweeps of one log together in the ego frame of their sweep.

    Labels are compared where they stand: label and annotation speak for the same instant (see truth.py).
    """
    labels = labels.take(np.argsort(labels.sweep_index, kind="stable"))
    _, track = np.unique(labels.track_id, return_inverse=True)
    boxes_ego = labels.boxes.copy()
    is_on_standing = np.zeros(len(boxes_ego), dtype=bool)
    sweep_number = np.full(len(boxes_ego), -1)
    truth_rows, truth_sweep = [np.zeros(0, dtype=np.int64)], [np.zeros(0, dtype=np.int64)]
    is_mover = truth.is_mover[truth.object_index]
    for number, (sweep, pose) in enumerate(sorted(world_from_ego.items())):
        here = slice(*np.searchsorted(labels.sweep_index, [sweep, sweep + 1]))
        rows = np.arange(len(is_mover))[truth.rows_of(sweep)]
        boxes_ego[here] = transform_boxes(invert(pose), labels.boxes[here])
        standing = iou_3d(boxes_ego[here], truth.boxes_ego[rows[~is_mover[rows]]])
        is_on_standing[here] = (standing >= TOUCHING_IOU).any(axis=1)
        sweep_number[here] = number
        truth_rows.append(rows[is_mover[rows]])
        truth_sweep.append(np.full(len(truth_rows[-1]), number))

    kept = np.flatnonzero((sweep_number >= 0) & _is_in_region(boxes_ego, azimuth_deg))
    rows = np.concatenate(truth_rows)
    return BoxEvidence(
        num_sweeps=len(world_from_ego),
        label_sweep=sweep_number[kept],
        label_track=track[kept],
        label_boxes=boxes_ego[kept],
        label_score=labels.score[kept],
        label_speed_mps=np.hypot(*labels.velocity_mps[kept, :2].T),
        is_on_standing=is_on_standing[kept],
        truth_sweep=np.concatenate(truth_sweep),
        truth_object=truth.object_index[rows],
        truth_boxes=truth.boxes_ego[rows],
        truth_speed_mps=truth.speed_mps[rows],
        truth_num_points=truth.num_points[rows],
        truth_is_open=truth.is_moving[rows] & _is_in_region(truth.boxes_ego[rows], azimuth_deg),
    )


def _is_in_region(boxes_ego: FloatArray, azimuth_deg: float | None) -> BoolArray:
    is_near = (np.abs(boxes_ego[:, 0]) <= REGION_X_M) & (np.abs(boxes_ego[:, 1]) <= REGION_Y_M)
    return is_near & is_in_view(boxes_ego, azimuth_deg)


def pool(evidence: Sequence[BoxEvidence]) -> BoxEvidence:
    """Put the evidence of several logs side by side; sweeps, tracks and objects get numbers of their own."""
    if len(evidence) == 1:
        return evidence[0]
    sweeps = np.cumsum([0, *(log.num_sweeps for log in evidence)])
    tracks = np.cumsum([0, *(_num_ids(log.label_track) for log in evidence)])
    objects = np.cumsum([0, *(_num_ids(log.truth_object) for log in evidence)])
    starts = {"label_sweep": sweeps, "truth_sweep": sweeps, "label_track": tracks, "truth_object": objects}
    columns = {}
    for name in BoxEvidence.__dataclass_fields__:
        if name != "num_sweeps":
            start = starts.get(name)
            parts = [getattr(log, name) for log in evidence]
            columns[name] = np.concatenate(
                parts if start is None else [p + s for p, s in zip(parts, start, strict=False)]
            )
    return BoxEvidence(num_sweeps=int(sweeps[-1]), **columns)


def _num_ids(ids: Int64Array) -> int:
    return int(ids.max()) + 1 if len(ids) else 0


def sweep_slices(sweep_of_row: Int64Array, num_sweeps: int) -> list[slice]:
    """Return the rows of each sweep."""
    bounds = np.searchsorted(sweep_of_row, np.arange(num_sweeps + 1))
    return [slice(int(start), int(stop)) for start, stop in pairwise(bounds)]
