"""SemanticKITTI's moving object segmentation: sequences/SEGMENT/labels/SWEEP.label, one number a point."""

from collections.abc import Iterable
from typing import Final

import numpy as np
from numpy.typing import NDArray

from labeling.exporters.exporter import ExportOptions
from labeling.exporters.output import ExportFolder
from labeling.exporters.segments import SegmentLabels, SweepLabels
from schemas.errors import InvalidInput
from schemas.tables.points import PointRows

UNLABELED: Final = 0
STATIC: Final = 9
MOVING: Final = 251
INSTANCE_SHIFT: Final = 16  # the upper half of a label is the object, 0: none
_MAX_INSTANCES: Final = (1 << INSTANCE_SHIFT) - 1


def export(segments: Iterable[SegmentLabels], output: ExportFolder, options: ExportOptions) -> None:
    """Write a file a sweep; see ``Exporter``. Row i is the label of row i of the recorded sweep.

    What moves with a track is moving, what else may move is unlabeled, and the rest is static.
    """
    for segment in segments:
        if len(segment.track_numbers) > _MAX_INSTANCES:
            raise InvalidInput(
                f"segment {segment.segment_id} has {len(segment.track_numbers)} tracks, format semantickitti can tell "
                f"{_MAX_INSTANCES} apart: raise --min-score"
            )
        for sweep, moving in segment.with_points():
            labels = _label_points(sweep, moving, segment.track_numbers)
            path = f"sequences/{segment.segment_id}/labels/{sweep.sweep_index:06d}.label"
            output.put(path, labels.astype("<u4").tobytes())


def _label_points(sweep: SweepLabels, moving: PointRows, track_numbers: dict[str, int]) -> NDArray[np.uint32]:
    """Return the (N,) labels of a sweep; ``moving`` are its points that are neither ground nor static."""
    sure = set(sweep.rows.track_id.tolist())  # those that reach the score in this sweep
    instances = [track_numbers[track_id] + 1 if track_id in sure else 0 for track_id in moving.track_ids]
    instance = np.array([*instances, 0], dtype=np.uint32)[moving.track]  # -1, of no track, is the last
    labels = np.full(sweep.num_points, STATIC, dtype=np.uint32)
    labels[moving.point_index] = np.where(instance > 0, instance << INSTANCE_SHIFT | MOVING, UNLABELED)
    return labels
