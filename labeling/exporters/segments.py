"""The labels of one segment as exporters see them: sweep by sweep, boxes also in the ego frame."""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise

import numpy as np

from labeling.folders.folder import LabelFolder
from labeling.geometry.boxes import transform_boxes
from labeling.geometry.transforms import invert
from labeling.readers.reader import SegmentReader, open_segment
from schemas.arrays import Float64Array, Int64Array
from schemas.errors import InvalidInput
from schemas.frames import Sweep
from schemas.tables import labels, points, sweeps
from schemas.tables.labels import LabelRows
from schemas.tables.points import PointRows


@dataclass(frozen=True, slots=True, eq=False)
class SweepLabels:
    """The boxes of one usable sweep."""

    sweep_index: int
    timestamp_ns: int  # of the sweep, whenever in its turn an object was met
    world_from_ego: Float64Array  # (4, 4)
    num_points: int  # of the recorded sweep: N, before any filter
    rows: LabelRows  # world frame, by track id

    @property
    def boxes_ego(self) -> Float64Array:
        """(B, 7) the boxes in the frame of the vehicle; upright there as they are in the world."""
        return transform_boxes(invert(self.world_from_ego), self.rows.boxes)


@dataclass(frozen=True, eq=False)
class SegmentLabels:
    """The labels of one segment that reach a score."""

    folder: LabelFolder
    segment_id: str
    dataset: str
    sweeps: tuple[SweepLabels, ...]  # ascending, those that were not rejected; with or without boxes
    rows: LabelRows  # of all sweeps, by sweep and then by track id
    rejected_sweeps: tuple[int, ...] = ()

    def __iter__(self) -> Iterator[SweepLabels]:
        """Go through the sweeps."""
        return iter(self.sweeps)

    @property
    def timestamps_ns(self) -> Int64Array:
        """(R,) time stamp of the sweep of each row."""
        timestamps_ns = np.array([sweep.timestamp_ns for sweep in self], dtype=np.int64)
        return timestamps_ns.repeat([len(sweep.rows) for sweep in self])

    @property
    def boxes_ego(self) -> Float64Array:
        """(R, 7) box of each row in the frame of the vehicle in its sweep."""
        return np.concatenate([np.empty((0, 7)), *(sweep.boxes_ego for sweep in self)])

    def with_points(self) -> Iterator[tuple[SweepLabels, PointRows]]:
        """Go through the sweeps, each with its points that are neither ground nor static, whatever their score.

        Raises:
            InvalidInput: The labels have no table of points, or not of these sweeps.

        """
        place = f"{self.folder.storage.root}: segment {self.segment_id}"
        if self.folder.shard("points", self.segment_id) is None:
            raise InvalidInput(f"{place} has no table of points, which this format needs: label it again with --points")
        groups = map(points.from_table, self.folder.row_groups("points", self.segment_id))
        none = points.from_table(points.SCHEMA.empty_table())
        upcoming = next(groups, none)
        for sweep in self:
            found = none
            if set(upcoming.sweep_index.tolist()) == {sweep.sweep_index}:
                found, upcoming = upcoming, next(groups, none)
            if len(found) and found.point_index.max() >= sweep.num_points:
                raise InvalidInput(f"{place} has points that sweep {sweep.sweep_index} does not have: label it again")
            yield sweep, found
        if len(upcoming):
            raise InvalidInput(f"{place} has points of other sweeps than its table of sweeps: label it again")

    def tracks(self, min_score: float) -> Iterator[LabelRows]:
        """Yield tracks by their ids, each whole and ascending in time, whose boxes score ``min_score`` on average.

        The average is the share of a track's boxes that is expected to be right; a cut of boxes would leave holes.
        """
        by_track = self.rows.take(np.lexsort((self.rows.timestamp_ns, self.rows.track_id)))
        _, starts = np.unique(by_track.track_id, return_index=True)
        for start, stop in pairwise([*starts.tolist(), len(by_track)]):
            rows = by_track.take(np.arange(start, stop))
            if rows.score.mean() >= min_score:
                yield rows

    def open_recording(self) -> SegmentReader:
        """Open what was labelled, where it was then.

        Raises:
            InvalidInput: It is not there any more, or cannot be read.

        """
        uri = self.folder.entry(self.segment_id).uri
        try:
            return open_segment(self.dataset, uri)
        except InvalidInput as error:
            raise InvalidInput(f"this format needs the recording of segment {self.segment_id}: {error}") from None

    def read_recorded(self, reader: SegmentReader, sweep: SweepLabels) -> Sweep:
        """Read a sweep of the recording.

        Raises:
            InvalidInput: It is not what was labelled.
            UnreadableSweep: It cannot be read now.

        """
        recorded = reader.read_sweep(sweep.sweep_index)
        if recorded.num_points != sweep.num_points:
            raise InvalidInput(
                f"sweep {sweep.sweep_index} of {reader.uri} has {recorded.num_points} points, but its labels were made "
                f"from {sweep.num_points}: has the recording changed since?"
            )
        return recorded

    @cached_property
    def track_numbers(self) -> dict[str, int]:
        """A number from 0 on of each track, in the order of their first boxes."""
        return {str(track_id): number for number, track_id in enumerate(dict.fromkeys(self.rows.track_id.tolist()))}


def read_segment(folder: LabelFolder, segment_id: str, min_score: float) -> SegmentLabels:
    """Read a segment's boxes of at least ``min_score``, and its sweeps.

    Raises:
        InvalidInput: A table is missing, or not what the manifest says.

    """
    label_table, sweep_table = folder.table("labels", segment_id), folder.table("sweeps", segment_id)
    if label_table is None or sweep_table is None:
        missing = "labels" if label_table is None else "sweeps"
        raise InvalidInput(f"{folder.storage.root} has no table {missing} of segment {segment_id}: label it again")
    rows = labels.from_table(label_table)
    rows = rows.take(rows.score >= min_score)
    rows = rows.take(np.lexsort((rows.track_id, rows.sweep_index)))
    of_all_sweeps = sweeps.from_table(sweep_table)
    observations = [observation for observation in of_all_sweeps if not observation.is_rejected]
    rejected = tuple(observation.sweep_index for observation in of_all_sweeps if observation.is_rejected)
    unknown = set(rows.sweep_index.tolist()) - {observation.sweep_index for observation in observations}
    if unknown:
        raise InvalidInput(
            f"{folder.storage.root}: segment {segment_id} has boxes in sweep {min(unknown)}, which has no usable row "
            "in its table of sweeps: label it again"
        )
    of_sweeps = tuple(
        SweepLabels(
            observation.sweep_index,
            observation.timestamp_ns,
            observation.world_from_ego,
            observation.num_points,
            rows.take(rows.sweep_index == observation.sweep_index),
        )
        for observation in observations
    )
    dataset = str(sweep_table["dataset"][0]) if len(sweep_table) else ""
    return SegmentLabels(folder, segment_id, dataset, of_sweeps, rows, rejected)
