"""Join human labels of some categories with auto labels of everything else."""

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq

from labeling.exporters.output import ExportFolder
from labeling.exporters.segments import SegmentLabels, SweepLabels, read_segment
from labeling.folders.folder import METADATA_PREFIX, LabelFolder
from labeling.geometry.boxes import overlap_of_smaller, transform_boxes
from labeling.open_set.categories import known_categories
from labeling.open_set.rule import MergeRule
from labeling.readers.reader import SegmentReader, open_segment, require_dataset, segment_id_of
from schemas.arrays import Float64Array
from schemas.errors import InvalidInput
from schemas.frames import Annotations
from schemas.tables import SCHEMA_VERSION, merged
from schemas.tables.labels import LabelRows
from schemas.tables.merged import HumanRows


@dataclass(frozen=True, slots=True, eq=False)
class MergedSegment:
    """The labels of one segment, joined."""

    human: HumanRows
    auto: LabelRows  # of the tracks that stay
    auto_overlap: Float64Array  # (A,) share of the smaller box that each shares with people's; NaN: nobody looked
    num_dropped_tracks: int
    num_dropped_boxes: int  # of those tracks
    num_dropped_apart: int  # of those boxes, that overlap none themselves
    num_unplaced: int  # people's boxes in sweeps that were rejected


@dataclass(frozen=True, slots=True)
class MergeSummary:
    """What a merge came to."""

    human: Mapping[str, int]  # boxes of each category that was asked for by its name, or found
    num_auto_boxes: int
    num_auto_tracks: int
    num_dropped_boxes: int
    num_dropped_tracks: int
    num_dropped_apart: int
    unplaced: Mapping[str, int]  # people's boxes that are in no file, of each segment that has some
    num_written: int  # files
    num_kept: int  # files that were there already, with the same content


def merge_labels(
    folder: LabelFolder,
    dataset: str,
    segments: Sequence[str],
    output: str | Path,
    rule: MergeRule,
    *,
    min_score: float | None = None,
    on_segment: Callable[[int], None] = lambda num_done: None,
) -> MergeSummary:
    """Write SEGMENT.parquet for each segment, see ``schemas.tables.merged``; one segment is in memory at a time.

    Doing it again writes nothing; a file that holds something else is never replaced.

    Args:
        folder: The auto labels.
        dataset: A name of ``READERS``.
        segments: The recordings with their annotations, of segments that the folder has.
        output: A local folder or ``s3://`` prefix.
        rule: What is joined how.
        min_score: Leave out auto tracks whose boxes score less on average; None: what the labels recommend.
        on_segment: Called with the number of segments that are done, before each and at the end.

    Raises:
        InvalidInput: Labels or annotations are missing, or do not fit each other or the rule.
        ShardConflict: A file is there already, with other content.
        StorageTrouble: Disk or network refused.

    """
    if min_score is not None and not 0 <= min_score <= 1:
        raise InvalidInput(f"--min-score {min_score:g}: expected a score between 0 and 1")
    require_dataset(dataset)
    _require_labelled_once(folder, dataset, segments)
    _require_found(rule, dataset, segments)
    target = ExportFolder(output)
    human = Counter(dict.fromkeys(rule.human if rule.held_out is None else (), 0))
    auto, dropped = Counter[str](), Counter[str]()
    unplaced: dict[str, int] = {}
    schema = merged.SCHEMA.with_metadata({f"{METADATA_PREFIX}schema_version": str(SCHEMA_VERSION)})
    for number, uri in enumerate(segments):
        on_segment(number)
        reader = open_segment(dataset, uri)  # one at a time: it keeps its annotations
        labels = read_segment(folder, reader.segment_id, 0.0)
        cut = folder.recommended_min_score if min_score is None else min_score
        found = merge_segment(labels, reader, rule, cut)
        with target.writing(f"{reader.segment_id}.parquet") as file:
            table = merged.to_table(labels.dataset, reader.segment_id, found.human, found.auto, found.auto_overlap)
            pq.write_table(table.replace_schema_metadata(schema.metadata), file, compression="zstd")
        human.update(found.human.categories)
        auto.update(boxes=len(found.auto), tracks=len(set(found.auto.track_id.tolist())))
        dropped.update(boxes=found.num_dropped_boxes, tracks=found.num_dropped_tracks, apart=found.num_dropped_apart)
        if found.num_unplaced:
            unplaced[reader.segment_id] = found.num_unplaced
    on_segment(len(segments))
    return MergeSummary(
        human=dict(sorted(human.items())),
        num_auto_boxes=auto["boxes"],
        num_auto_tracks=auto["tracks"],
        num_dropped_boxes=dropped["boxes"],
        num_dropped_tracks=dropped["tracks"],
        num_dropped_apart=dropped["apart"],
        unplaced=unplaced,
        num_written=target.num_written,
        num_kept=target.num_kept,
    )


def merge_segment(labels: SegmentLabels, reader: SegmentReader, rule: MergeRule, min_score: float) -> MergedSegment:
    """Join the labels of one segment with its annotations.

    Raises:
        InvalidInput: The recording is not what was labelled, has no annotations, or some that the rule does not know.

    """
    _require_same(labels, reader)
    annotated = {sweep.sweep_index: _read_human(reader, sweep.sweep_index, rule) for sweep in labels}
    if all(boxes is None for boxes in annotated.values()):
        raise InvalidInput(f"{reader.uri} has no annotations in the sweeps that were labelled: nothing to merge with")
    overlap = np.concatenate([np.empty(0), *(_overlap(sweep, annotated[sweep.sweep_index]) for sweep in labels)])
    is_overlapping = overlap >= rule.min_overlap  # False where nobody looked

    track_ids, track = np.unique(labels.rows.track_id, return_inverse=True)
    num_judged = np.bincount(track[~np.isnan(overlap)], minlength=len(track_ids))
    num_overlapping = np.bincount(track[is_overlapping], minlength=len(track_ids))
    is_good = np.isin(track_ids, [rows.track_id[0] for rows in labels.tracks(min_score)])
    is_dropped = is_good & (num_overlapping > rule.max_share * num_judged)
    is_kept_row, is_dropped_row = (is_good & ~is_dropped)[track], is_dropped[track]

    lost = [_read_human(reader, index, rule) for index in labels.rejected_sweeps]
    return MergedSegment(
        human=_join_human(labels, annotated),
        auto=labels.rows.take(is_kept_row),
        auto_overlap=overlap[is_kept_row],
        num_dropped_tracks=int(is_dropped.sum()),
        num_dropped_boxes=int(is_dropped_row.sum()),
        num_dropped_apart=int((is_dropped_row & ~is_overlapping).sum()),
        num_unplaced=sum(len(boxes.track_ids) for boxes in lost if boxes is not None),
    )


def _read_human(reader: SegmentReader, sweep_index: int, rule: MergeRule) -> Annotations | None:
    """Return what people drew of the categories that they annotate; None where the sweep has no annotations."""
    found = reader.read_annotations(sweep_index)
    if found is None:
        return None
    strange = set() if rule.held_out is None else set(found.categories) - rule.human - rule.held_out
    if strange:
        raise InvalidInput(
            f"{reader.uri}: sweep {sweep_index} has boxes of category {min(strange)}, and whether that is a vehicle "
            "is not known: name the categories to keep with --human, instead of --hold-out"
        )
    rows = [row for row, category in enumerate(found.categories) if category in rule.human]
    return Annotations(
        tuple(found.track_ids[row] for row in rows),
        tuple(found.categories[row] for row in rows),
        found.boxes_ego[rows],
    )


def _overlap(sweep: SweepLabels, human: Annotations | None) -> Float64Array:
    """Return (R,) the largest overlap of each auto box of a sweep with a person's box; NaN where nobody looked."""
    if human is None:
        return np.full(len(sweep.rows), np.nan)
    return overlap_of_smaller(sweep.boxes_ego, human.boxes_ego).max(axis=1, initial=0.0)


def _join_human(labels: SegmentLabels, annotated: Mapping[int, Annotations | None]) -> HumanRows:
    with_boxes = [(sweep, found) for sweep in labels if (found := annotated[sweep.sweep_index]) is not None]
    counts = [len(found.track_ids) for _, found in with_boxes]
    return HumanRows(
        sweep_index=np.repeat(np.array([sweep.sweep_index for sweep, _ in with_boxes], dtype=np.int64), counts),
        timestamp_ns=np.repeat(np.array([sweep.timestamp_ns for sweep, _ in with_boxes], dtype=np.int64), counts),
        track_ids=tuple(track_id for _, found in with_boxes for track_id in found.track_ids),
        categories=tuple(category for _, found in with_boxes for category in found.categories),
        boxes=np.concatenate([transform_boxes(sweep.world_from_ego, found.boxes_ego) for sweep, found in with_boxes]),
    )


def _require_same(labels: SegmentLabels, reader: SegmentReader) -> None:
    stamps_ns = dict(enumerate(reader.timestamps_ns.tolist()))
    for sweep in labels:
        if stamps_ns.get(sweep.sweep_index) != sweep.timestamp_ns:
            raise InvalidInput(
                f"{reader.uri}: sweep {sweep.sweep_index} is not the one that was labelled: has the recording changed "
                "since?"
            )


def _require_labelled_once(folder: LabelFolder, dataset: str, segments: Sequence[str]) -> None:
    seen: set[str] = set()
    for uri in segments:
        segment_id = segment_id_of(dataset, uri)
        folder.entry(segment_id)
        if segment_id in seen:
            raise InvalidInput(f"segment {uri} is named twice")
        seen.add(segment_id)


def _require_found(rule: MergeRule, dataset: str, segments: Sequence[str]) -> None:
    """Refuse categories that neither the data set is known to have nor any of the segments has."""
    strange = rule.human - known_categories(dataset)
    if not strange:
        return
    found = {name for uri in segments for name in _categories_of(open_segment(dataset, uri))}
    if strange - found:
        raise InvalidInput(
            f"--human {min(strange - found)}: no such category: these segments have "
            + (", ".join(sorted(found)) or "no annotations")
        )


def _categories_of(reader: SegmentReader) -> set[str]:
    annotated = (reader.read_annotations(index) for index in range(len(reader.timestamps_ns)))
    return {name for found in annotated if found is not None for name in found.categories}
