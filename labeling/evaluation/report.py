"""Evaluate a label folder against the truth of its segments: one row of figures a log, and one over all logs pooled.

Which sweeps count. Boxes: every annotated sweep that the run was asked to label, that is every one in its sweeps table;
a rejected sweep counts, and what moves in it is missed. Static removal: the sweeps labelled (status ok) that have
annotations or point-wise truth. Flow: those of them with truth and prediction to a next sweep that was labelled too;
the last sweep and one before a gap have none. Logs are pooled by their points, boxes and tracks, not by averaging
their figures.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Final, Protocol

import numpy as np
import pyarrow as pa
from pydantic import BaseModel, ConfigDict

from labeling.evaluation.boxes import match, sweep_overlaps
from labeling.evaluation.detection import BoxFigures, box_figures
from labeling.evaluation.evidence import BoxEvidence, gather_evidence, pool
from labeling.evaluation.flow import (
    FlowFigures,
    FlowSums,
    StaticFigures,
    StaticSums,
    flow_figures,
    static_figures,
    sum_flow,
    sum_static,
)
from labeling.evaluation.tracks import HOTA_IOUS, TrackFigures, hota_sums, track_figures
from labeling.evaluation.truth import MAX_GAP_S, SegmentTruth, SweepPointTruth, read_truth, sweep_point_truth
from labeling.geometry.transforms import invert, rotate_vectors
from labeling.readers.reader import SegmentReader
from schemas.arrays import Float32Array, Float64Array, Int32Array, Int64Array
from schemas.errors import InvalidInput
from schemas.frames import Sweep
from schemas.objects import SweepObservation
from schemas.tables import labels, points, sweeps
from schemas.tables.points import PointRows

PASSES: Final = 2  # progress steps a sweep: once for the boxes, once for the points


class LabelSource(Protocol):
    """What is needed of a label folder."""

    @property
    def segment_ids(self) -> tuple[str, ...]:
        """Segments that have labels."""
        ...

    @property
    def recommended_min_score(self) -> float:
        """Score cut the labels come with."""
        ...

    def table(self, name: str, segment_id: str) -> pa.Table | None:
        """Return the labels, sweeps or points of a segment, None when that table was not written."""
        ...


class LogFigures(BaseModel):
    """Figures of one log, or of all pooled. None: the truth or the points table that a part needs is not there."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    name: str
    num_sweeps: int  # labelled or rejected
    num_rejected_sweeps: int
    flow: FlowFigures | None
    zero_flow: FlowFigures | None
    static: StaticFigures | None
    boxes: BoxFigures | None
    tracks: TrackFigures | None


class Report(BaseModel):
    """All that `motionlabel evaluate` says."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    min_score: float  # cut of precision, recall, errors and tracks
    azimuth_deg: float | None
    logs: tuple[LogFigures, ...]
    pooled: LogFigures
    notes: tuple[str, ...]


@dataclass(frozen=True, slots=True, eq=False)
class _PointRows:
    """The points table of one segment, by sweep."""

    offsets: Int64Array  # (T + 1,)
    point_index: Int32Array  # (P,)
    flow_world_m: Float32Array  # (P, 3) NaN where null

    def of_sweep(self, index: int) -> tuple[Int32Array, Float32Array]:
        rows = slice(self.offsets[index], self.offsets[index + 1])
        return self.point_index[rows], self.flow_world_m[rows]


@dataclass(frozen=True, slots=True, eq=False)
class _LogEvidence:
    """What one log adds to the pool."""

    name: str
    num_sweeps: int
    num_rejected_sweeps: int
    has_points: bool
    flow: FlowSums
    zero_flow: FlowSums
    static: StaticSums
    boxes: BoxEvidence | None
    hota: Float64Array  # (4, 19)


def evaluate_segments(
    folder: LabelSource,
    readers: Sequence[SegmentReader],
    *,
    azimuth_deg: float | None,
    min_score: float | None,
    progress: Callable[[int], None] | None = None,
) -> Report:
    """Judge the labels of some segments, one sweep of points in memory at a time.

    Args:
        folder: The labels.
        readers: The recordings with their truth.
        azimuth_deg: Truth, labels and points farther from straight ahead are left out; None: all around.
        min_score: Cut of precision, recall, errors and tracks; None: the one the labels recommend. AP uses all scores.
        progress: Called with the number of steps done so far, of PASSES for each sweep of each reader.

    Raises:
        InvalidInput: No segment, a segment without labels or without truth, or labels of another recording.

    """
    if not readers:
        raise InvalidInput("no segment to evaluate: name at least one")
    cut = folder.recommended_min_score if min_score is None else min_score
    num_done = 0

    def advance(steps: int) -> None:
        nonlocal num_done
        num_done += steps
        if progress is not None:
            progress(num_done)

    logs = [_read_log(folder, reader, azimuth_deg, cut, advance) for reader in readers]
    has_boxes = [log.boxes for log in logs if log.boxes is not None]
    pooled = _LogEvidence(
        name="all logs",
        num_sweeps=sum(log.num_sweeps for log in logs),
        num_rejected_sweeps=sum(log.num_rejected_sweeps for log in logs),
        has_points=any(log.has_points for log in logs),
        flow=sum((log.flow for log in logs), FlowSums()),
        zero_flow=sum((log.zero_flow for log in logs), FlowSums()),
        static=sum((log.static for log in logs), StaticSums()),
        boxes=pool(has_boxes) if has_boxes else None,
        hota=np.sum([log.hota for log in logs], axis=0),
    )
    return Report(
        min_score=cut,
        azimuth_deg=azimuth_deg,
        logs=tuple(_figures(log, cut, has_interval=False) for log in logs),
        pooled=_figures(pooled, cut, has_interval=True),
        notes=tuple(note for log in logs for note in _notes(log)),
    )


def _read_log(
    folder: LabelSource,
    reader: SegmentReader,
    azimuth_deg: float | None,
    min_score: float,
    advance: Callable[[int], None],
) -> _LogEvidence:
    name = reader.segment_id
    if name not in folder.segment_ids:
        known = ", ".join(folder.segment_ids[:5]) + (", ..." if len(folder.segment_ids) > 5 else "")
        raise InvalidInput(f"no labels of segment {name} ({reader.uri}): the folder has {known or 'none'}")
    sweep_table, label_table = folder.table("sweeps", name), folder.table("labels", name)
    if sweep_table is None or label_table is None:
        missing = "sweeps" if sweep_table is None else "labels"
        raise InvalidInput(f"segment {name}: the folder has no {missing} table of it")
    observations = sweeps.from_table(sweep_table)
    is_ok = _check_sweeps(observations, reader)
    truth = read_truth(reader, advance)
    has_annotations = any(truth.is_annotated[index] for index in is_ok)
    if not has_annotations and all(reader.read_point_truth(index) is None for index, ok in is_ok.items() if ok):
        raise InvalidInput(
            f"segment {name}: nothing to evaluate against: {reader.uri} has neither annotations nor point-wise truth "
            f"for the {len(is_ok)} sweeps that were labelled"
        )
    evidence, hota = None, np.zeros((4, len(HOTA_IOUS)))
    if has_annotations:
        evidence = gather_evidence(truth, labels.from_table(label_table), _poses(truth, observations), azimuth_deg)
        overlaps = sweep_overlaps(evidence, evidence.label_boxes)
        matching = match(evidence, overlaps, "L1")
        hota = hota_sums(evidence, matching, overlaps, evidence.label_score >= min_score)
    point_table = folder.table("points", name)
    if point_table is None:
        advance(len(reader.timestamps_ns))
        sums = FlowSums(), FlowSums(), StaticSums()
    else:
        by_sweep = _by_sweep(points.from_table(point_table), len(reader.timestamps_ns))
        sums = _judge_points(truth, reader, by_sweep, is_ok, azimuth_deg, advance)
    num_rejected = sum(not ok for ok in is_ok.values())
    return _LogEvidence(name, len(is_ok), num_rejected, point_table is not None, *sums, evidence, hota)


def _check_sweeps(observations: Sequence[SweepObservation], reader: SegmentReader) -> dict[int, bool]:
    """Return for each sweep of the table whether it was labelled, not rejected."""
    is_ok = {}
    for observation in observations:
        index, timestamp_ns = observation.sweep_index, observation.timestamp_ns
        if not 0 <= index < len(reader.timestamps_ns) or reader.timestamps_ns[index] != timestamp_ns:
            raise InvalidInput(
                f"segment {reader.segment_id}: sweep {index} of the labels is stamped {timestamp_ns} ns, {reader.uri} "
                "has no such sweep there: the recording has changed since it was labelled"
            )
        is_ok[index] = not observation.is_rejected
    return dict(sorted(is_ok.items()))


def _poses(truth: SegmentTruth, observations: Sequence[SweepObservation]) -> dict[int, Float64Array]:
    """Return the pose of each annotated sweep of the table; the table's own where the sweep cannot be read."""
    poses = {}
    for observation in observations:
        index = observation.sweep_index
        if truth.is_annotated[index]:
            is_read = np.isfinite(truth.world_from_ego[index]).all()
            poses[index] = truth.world_from_ego[index] if is_read else observation.world_from_ego
    return poses


def _by_sweep(rows: PointRows, num_sweeps: int) -> _PointRows:
    order = np.argsort(rows.sweep_index, kind="stable")
    return _PointRows(
        offsets=np.searchsorted(rows.sweep_index[order], np.arange(num_sweeps + 1)),
        point_index=rows.point_index[order],
        flow_world_m=rows.flow_world_m[order],
    )


def _judge_points(
    truth: SegmentTruth,
    reader: SegmentReader,
    rows: _PointRows,
    is_ok: dict[int, bool],
    azimuth_deg: float | None,
    advance: Callable[[int], None],
) -> tuple[FlowSums, FlowSums, StaticSums]:
    """Return the sums of flow, of zero flow and of static removal over the sweeps labelled."""
    flow, zero_flow, static = FlowSums(), FlowSums(), StaticSums()
    for index in range(len(reader.timestamps_ns)):
        if is_ok.get(index, False) and np.isfinite(truth.world_from_ego[index]).all():
            sweep = reader.read_sweep(index)
            _check_point_index(rows.of_sweep(index)[0], sweep.num_points, reader, index)
            point_truth = sweep_point_truth(truth, sweep, reader.read_point_truth(index), azimuth_deg)
            if point_truth is not None:
                gap_s = truth.gap_s(index) if is_ok.get(index + 1, False) else np.inf
                sums = judge_sweep(sweep, point_truth, *rows.of_sweep(index), gap_s)
                flow, zero_flow, static = flow + sums[0], zero_flow + sums[1], static + sums[2]
        advance(1)
    return flow, zero_flow, static


def judge_sweep(
    sweep: Sweep,
    point_truth: SweepPointTruth,
    point_index: Int32Array,  # (P,)
    flow_world_m: Float32Array,  # (P, 3)
    gap_s: float,  # to the next sweep; infinite when that was not labelled
) -> tuple[FlowSums, FlowSums, StaticSums]:
    """Return the sums of flow, of zero flow and of static removal of one sweep."""
    is_called_static = np.ones(sweep.num_points, dtype=bool)
    is_called_static[point_index] = False
    static = sum_static(point_truth, is_called_static)
    has_flow = not len(point_index) or bool(np.isfinite(flow_world_m).any())
    if not has_flow or gap_s > MAX_GAP_S:
        return FlowSums(), FlowSums(), static
    predicted = np.zeros((sweep.num_points, 3))
    predicted[point_index] = rotate_vectors(invert(sweep.world_from_ego), np.nan_to_num(flow_world_m))
    zero = np.zeros_like(predicted)
    return sum_flow(point_truth, predicted, gap_s), sum_flow(point_truth, zero, gap_s), static


def _check_point_index(point_index: Int32Array, num_points: int, reader: SegmentReader, index: int) -> None:
    if len(point_index) and not 0 <= point_index.min() <= point_index.max() < num_points:
        raise InvalidInput(
            f"segment {reader.segment_id}: the points table names row {point_index.max()} of sweep {index}, which has "
            f"{num_points} points: the recording has changed since it was labelled"
        )


def _figures(log: _LogEvidence, min_score: float, *, has_interval: bool) -> LogFigures:
    boxes = tracks = None
    if log.boxes is not None:
        overlaps = sweep_overlaps(log.boxes, log.boxes.label_boxes)
        matching = match(log.boxes, overlaps, "L1")
        boxes = box_figures(log.boxes, overlaps, matching, min_score, has_interval=has_interval)
        tracks = track_figures(log.boxes, matching, log.boxes.label_score >= min_score, log.hota)
    return LogFigures(
        name=log.name,
        num_sweeps=log.num_sweeps,
        num_rejected_sweeps=log.num_rejected_sweeps,
        flow=flow_figures(log.flow) if log.flow.num_sweeps else None,
        zero_flow=flow_figures(log.zero_flow) if log.zero_flow.num_sweeps else None,
        static=static_figures(log.static) if log.static.num_sweeps else None,
        boxes=boxes,
        tracks=tracks,
    )


def _notes(log: _LogEvidence) -> list[str]:
    notes = []
    if not log.has_points:
        notes.append(f"{log.name}: no points table, so no flow and static figures: label with --points to have them")
    elif not log.flow.num_sweeps:
        notes.append(f"{log.name}: no two neighbouring sweeps with truth were labelled, so no flow figures")
    if log.num_rejected_sweeps:
        notes.append(
            f"{log.name}: {log.num_rejected_sweeps} of {log.num_sweeps} sweeps rejected: what moves there is missed"
        )
    if log.boxes is None:
        notes.append(f"{log.name}: no annotations, so no figures of boxes and tracks")
    return notes
