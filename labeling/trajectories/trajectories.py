"""Trajectories of all objects of a label folder, and the formats that they are written in."""

from collections.abc import Callable, Iterable, Iterator, Mapping, Set
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Final, NamedTuple, Protocol

import numpy as np

from labeling.exporters.exporter import require_labels
from labeling.exporters.output import ExportFolder
from labeling.exporters.segments import SegmentLabels, read_segment
from labeling.folders.folder import LabelFolder
from labeling.geometry.times import bridged_s, median_period_s
from labeling.trajectories.states import count_gaps
from labeling.trajectories.windows import Horizon
from schemas.errors import InvalidInput
from schemas.tables.labels import LabelRows

# A longer silence has no flow either (flow.max_gap_s): who brakes or turns meanwhile leaves the straight line.
MAX_GAP_S: Final = 0.55
_REACHED_PERIODS: Final = 1.6  # where sweeps are rarer than that, from one to the next


@dataclass(frozen=True, slots=True, eq=False)
class SegmentTracks:
    """The tracks of one segment that are good enough, whole."""

    labels: SegmentLabels
    tracks: tuple[LabelRows, ...]  # by track id, each ascending in time
    max_gap_s: float  # longest time between two rows that is bridged

    @property
    def start_ns(self) -> int:
        """When the segment's clock starts: time stamp of its first usable sweep."""
        return self.labels.sweeps[0].timestamp_ns if self.labels.sweeps else 0


class TrajectoryFormat(NamedTuple):
    """Who writes a format."""

    module: str
    content: str  # for people
    unit: str  # of what is counted
    ignores: Set[str] = frozenset()  # fields of Horizon without a meaning in it


class TrajectoryWriter(Protocol):
    """What the module of a format has: one function ``write``."""

    def __call__(self, segments: Iterable[SegmentTracks], output: ExportFolder, horizon: Horizon) -> int:
        """Write the tracks of some segments, gone through once, and return how many units. Same input, same bytes."""
        ...


FORMATS: Final[Mapping[str, TrajectoryFormat]] = {
    "parquet": TrajectoryFormat("labeling.trajectories.parquet", "windows in the objects' own frames", "windows"),
    "scenarionet": TrajectoryFormat(
        "labeling.trajectories.scenarionet",
        "a scenario a segment, for MetaDrive",
        "scenarios",
        frozenset({"step_s", "history_s", "future_s"}),
    ),
}


@dataclass(frozen=True, slots=True)
class TrajectorySummary:
    """What was written."""

    num_segments: int
    num_tracks: int
    num_units: int  # of the format
    num_gaps: int  # between rows of a track, not bridged
    num_written: int  # files
    num_kept: int  # files that were there already, with the same content


def make_horizon(format_name: str, chosen: Mapping[str, float]) -> Horizon:
    """Return the horizon with what a user chose.

    Raises:
        InvalidInput: Unknown format, a choice that means nothing to it, or one that is out of range.

    """
    if format_name not in FORMATS:
        raise InvalidInput(f"unknown format {format_name!r}: expected one of {', '.join(FORMATS)}")
    for name in chosen:
        if name in FORMATS[format_name].ignores:
            raise InvalidInput(f"--{name.replace('_', '-')} means nothing to format {format_name}: it has no windows")
    return Horizon(**chosen)


def write_trajectories(
    folder: LabelFolder,
    output: str | Path,
    horizon: Horizon | None = None,
    *,
    format_name: str = "parquet",
    max_gap_s: float = MAX_GAP_S,
    min_score: float | None = None,
    on_segment: Callable[[int], None] = lambda num_done: None,
) -> TrajectorySummary:
    """Write the trajectories of all labelled objects, a segment at a time.

    Doing it again writes nothing; a file that holds something else is never replaced.

    Args:
        folder: The labels.
        output: A local folder or ``s3://`` prefix.
        horizon: Which instants; None: the default.
        format_name: A name of ``FORMATS``.
        max_gap_s: Longest time between two boxes of a track that is bridged; where sweeps are rarer, the next is.
        min_score: Leave out tracks whose boxes score less on average; None: what the labels recommend.
        on_segment: Called with the number of segments that are done, before each and at the end.

    Raises:
        InvalidInput: Unknown format, a value out of range, or labels that cannot be read.
        ShardConflict: A file is there already, with other content.
        StorageTrouble: Disk or network refused.

    """
    if not 0 <= max_gap_s <= 60:
        raise InvalidInput(f"--max-gap-s {max_gap_s:g}: expected 0 to 60")
    if min_score is not None and not 0 <= min_score <= 1:
        raise InvalidInput(f"--min-score {min_score:g}: expected a score between 0 and 1")
    chosen = horizon or make_horizon(format_name, {})
    require_labels(folder)
    cut = folder.recommended_min_score if min_score is None else min_score
    write: TrajectoryWriter = import_module(FORMATS[format_name].module).write
    target = ExportFolder(output)
    num_tracks = num_gaps = 0

    def read() -> Iterator[SegmentTracks]:
        nonlocal num_tracks, num_gaps
        for number, segment_id in enumerate(folder.segment_ids):
            on_segment(number)
            labels = read_segment(folder, segment_id, 0.0)
            period_s = median_period_s(np.array([sweep.timestamp_ns for sweep in labels], dtype=np.int64))
            bridged = bridged_s(max_gap_s, period_s, _REACHED_PERIODS)
            segment = SegmentTracks(labels, tuple(labels.tracks(cut)), bridged)
            num_tracks += len(segment.tracks)
            num_gaps += sum(count_gaps(rows, bridged) for rows in segment.tracks)
            yield segment

    num_units = write(read(), target, chosen)
    on_segment(len(folder.entries))
    return TrajectorySummary(len(folder.entries), num_tracks, num_units, num_gaps, target.num_written, target.num_kept)
