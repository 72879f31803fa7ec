"""Actor: leads one segment through the line. It passes references on; points never come through here."""

from collections.abc import Callable
from dataclasses import dataclass
from queue import SimpleQueue
from typing import Any

import ray

from labeling.folders.entries import failed_entry
from labeling.readers.reader import open_segment, reopen, segment_id_of
from schemas.api.jobs import Failure
from schemas.config import LabelingConfig
from schemas.errors import LabelingError, StorageTrouble, WorkerLost
from schemas.listing import SegmentListing
from schemas.manifest import SegmentEntry
from workers.pipeline import Limits
from workers.schedule import Step
from workers.segment_line import SegmentLine


@dataclass(frozen=True, slots=True)
class Assignment:
    """One attempt at one segment."""

    dataset: str
    uri: str
    output: str
    config: LabelingConfig
    limits: Limits
    hook: Callable[[Step], None] | None = None  # see ``workers.steps.Segment``
    listing: SegmentListing | None = None  # None: the labeler lists the segment


@dataclass(frozen=True, slots=True)
class SegmentOutcome:
    """How a segment ended."""

    entry: SegmentEntry
    failure: Failure | None = None  # when there are no labels


@dataclass(frozen=True, slots=True)
class Progress:
    """Where a segment stands."""

    segment_id: str = ""  # empty until it is opened
    stage: str = "starting"  # then sweeps, then tracks
    sweeps_done: int = 0
    num_sweeps: int = 0


@ray.remote(num_cpus=0, max_restarts=0, concurrency_groups={"control": 2})  # type: ignore[call-overload]  # Ray's omit it
class SegmentLabeler:
    """Lives for one attempt at one segment. ``run`` does the work; the other methods answer meanwhile.

    It ends when it is killed, and with it what it has started.
    """

    def __init__(self, assignment: Assignment, aggregator: Any) -> None:  # an actor's handle has no type of its own
        self._assignment, self._aggregator = assignment, aggregator
        self._progress = Progress()
        self._begun: SimpleQueue[Step] = SimpleQueue()
        self._line: SegmentLine | None = None

    @ray.method(concurrency_group="control")
    def progress(self) -> Progress:
        """Return where the segment stands."""
        return self._progress

    @ray.method(concurrency_group="control")
    def task_begins(self, step: Step) -> bool:
        """Take note that a task waits for a CPU no more; return whether its step is still to be taken."""
        self._begun.put(step)
        return self._line is not None and self._line.is_wanted(step)

    def run(self) -> SegmentOutcome:
        """Label the segment and publish its shards.

        Raises:
            WorkerLost: Workers died too often, or what only they had is gone. Another attempt may succeed.

        """
        dataset, uri = self._assignment.dataset, self._assignment.uri
        segment_id = segment_id_of(dataset, uri)
        try:
            listing, flow_folder = self._assignment.listing, self._assignment.config.flow.external_folder
            reader = open_segment(dataset, uri, flow_folder) if listing is None else reopen(listing)
            segment_id, uri = reader.segment_id, reader.uri
            self._progress = Progress(segment_id)
            self._line = SegmentLine(self._assignment, reader, self._aggregator, self._take_begun)
            return SegmentOutcome(*self._line.run(self._say))
        except StorageTrouble as error:
            raise WorkerLost(f"disk or network trouble: {error}") from None
        except WorkerLost:
            raise
        except LabelingError as error:
            failure = Failure(error=type(error).__name__, message=str(error))
            return SegmentOutcome(failed_entry(segment_id, uri, str(error)), failure)

    def _say(self, stage: str, sweeps_done: int, num_sweeps: int) -> None:
        self._progress = Progress(self._progress.segment_id, stage, sweeps_done, num_sweeps)

    def _take_begun(self) -> list[Step]:
        return [self._begun.get() for _ in range(self._begun.qsize())]
