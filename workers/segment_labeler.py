"""Actor: leads one segment through the line. It passes references on; points never come through here."""

import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, Final, TypeAlias

import ray
from ray import ObjectRef
from ray import exceptions as rex

from labeling.folders.entries import all_rejected_entry, failed_entry
from labeling.folders.identity import LabelSet
from labeling.readers.reader import SegmentReader, open_segment, reopen, segment_id_of, sweep_range
from schemas.api.jobs import Failure
from schemas.config import LabelingConfig
from schemas.errors import LabelingError, StageFailed, StorageTrouble, WorkerLost
from schemas.listing import SegmentListing
from schemas.manifest import SegmentEntry
from schemas.objects import SweepObservation
from workers.flow_fits import FitFunction, finish, fit_batch, track_segment
from workers.pipeline import MAX_ATTEMPTS, Limits
from workers.schedule import FitPart, FitPiece, SegmentSchedule
from workers.static_removal import StaticRemoval

Ref: TypeAlias = ObjectRef[Any]

_TICK_S: Final = 0.2  # how often the stop flag is looked at
# To Ray's types a task has one result and an actor is a plain class.
_StaticRemoval: Any = StaticRemoval
_fit_batch: Any = fit_batch
_finish: Any = finish
_track_segment: Any = track_segment


@dataclass(frozen=True, slots=True)
class Assignment:
    """One attempt at one segment."""

    dataset: str
    uri: str
    attempt: str  # no other attempt has this name
    config: LabelingConfig
    limits: Limits
    fit: FitFunction | None = None  # None: the real one
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


class _Stopped(Exception):
    """The stop flag was seen."""


class _Died(Exception):
    """A process or a machine is gone; what it was doing can be done again."""


@ray.remote(num_cpus=0, max_restarts=0, concurrency_groups={"control": 2})  # type: ignore[call-overload]  # Ray's omit it
class SegmentLabeler:
    """Lives for one attempt at one segment. ``run`` does the work; the other methods answer meanwhile."""

    def __init__(self, assignment: Assignment, aggregator: Any) -> None:  # an actor's handle has no type of its own
        self._assignment, self._aggregator = assignment, aggregator
        self._progress = Progress()
        self._stop = threading.Event()

    @ray.method(concurrency_group="control")
    def progress(self) -> Progress:
        """Return where the segment stands."""
        return self._progress

    @ray.method(concurrency_group="control")
    def stop(self) -> None:
        """Tell ``run`` to kill its tasks and return; that takes less than a second."""
        self._stop.set()

    def run(self) -> SegmentOutcome | None:
        """Label the segment and publish its shards; None when stopped.

        Raises:
            WorkerLost: Workers died too often, or what only they had is gone. Another attempt may succeed.

        """
        dataset, uri = self._assignment.dataset, self._assignment.uri
        segment_id = segment_id_of(dataset, uri)
        try:
            listing, flow_folder = self._assignment.listing, self._assignment.config.flow.external_folder
            reader = open_segment(dataset, uri, flow_folder) if listing is None else reopen(listing)
            segment_id, uri = reader.segment_id, reader.uri
            return _Line(self._assignment, self._aggregator, reader, self._stop.is_set, self._note).run()
        except _Stopped:
            return None
        except _Died as error:
            raise WorkerLost(f"the process that writes the shards died: {error}") from None
        except StorageTrouble as error:
            raise WorkerLost(f"disk or network trouble: {error}") from None
        except WorkerLost:
            raise
        except LabelingError as error:
            failure = Failure(error=type(error).__name__, message=str(error))
            return SegmentOutcome(failed_entry(segment_id, uri, str(error)), failure)

    def _note(self, progress: Progress) -> None:
        self._progress = progress


class _Line:
    """The tasks and actors of one segment. Whatever ends it, none of them goes on."""

    def __init__(
        self,
        assignment: Assignment,
        aggregator: Any,
        reader: SegmentReader,
        is_stopped: Callable[[], bool],
        note: Callable[[Progress], None],
    ) -> None:
        self._assignment, self._aggregator = assignment, aggregator
        self._listing, self._segment_id, self._uri = reader.listing, reader.segment_id, reader.uri
        self._label_set = LabelSet.of(reader, assignment.config)
        self._sweeps = sweep_range(reader, assignment.config)
        self._is_stopped, self._note = is_stopped, note
        self._schedule: SegmentSchedule[Ref] = SegmentSchedule(self._sweeps, assignment.limits)
        self._config = ray.put(assignment.config)
        self._streams: list[Any] = [None] * assignment.limits.streams
        self._in_flight: dict[Ref, Callable[[Ref], None]] = {}  # and what to do when it has ended
        self._tasks: set[Ref] = set()  # of those in flight, what can be killed
        self._works: dict[int, Ref] = {}
        self._observations: dict[int, SweepObservation] = {}  # without points and proposals
        self._rows: dict[int, Ref] = {}  # observations as they are written
        self._proposals: dict[int, Ref] = {}

    def run(self) -> SegmentOutcome:
        """Go through all sweeps, then track, then publish."""
        self._say("starting")
        attempt = self._assignment.attempt
        begun = self._wait_for(self._aggregator.begin.remote(self._label_set, self._uri, attempt))
        if begun is not None:
            return SegmentOutcome(begun)
        try:
            while not self._schedule.is_done:
                self._say("sweeps")
                self._submit()
                self._step()
            observations = [self._observations[sweep] for sweep in self._sweeps]
            if all(observation.is_rejected for observation in observations):
                return self._all_rejected(observations[0].reason)
            self._say("tracks")
            tracks = self._track(observations)
            publishing = self._aggregator.publish.remote(self._segment_id, self._uri, attempt, tracks)
            return SegmentOutcome(self._wait_for(publishing))
        finally:
            self._end_all()

    def _submit(self) -> None:
        """Start whatever the schedule allows, late steps first: they free what early ones hold."""
        while (finishable := self._schedule.next_to_finish()) is not None:
            self._start_finish(*finishable)
        while (piece := self._schedule.next_fit()) is not None:
            ended, results = _fit_batch.remote(self._works[piece.sweep], piece, self._config, self._assignment.fit)
            self._follow(ended, partial(self._on_fit, piece, results), is_task=True)
        for stream in range(len(self._streams)):
            if (sweeps := self._schedule.next_to_prepare(stream)) is not None:
                self._start_prepare(stream, sweeps)

    def _step(self) -> None:
        """Wait for something to end, and act on all that has."""
        if self._is_stopped():
            raise _Stopped
        done, _ = ray.wait(list(self._in_flight), num_returns=1, timeout=_TICK_S)
        for ref in done:
            self._tasks.discard(ref)
            self._in_flight.pop(ref)(ref)

    def _follow(self, ref: Ref, on_end: Callable[[Ref], None], *, is_task: bool = False) -> None:
        self._in_flight[ref] = on_end
        if is_task:
            self._tasks.add(ref)

    def _start_prepare(self, stream: int, sweeps: range) -> None:
        if self._streams[stream] is None:
            self._streams[stream] = _StaticRemoval.remote(self._listing, self._assignment.config)
        batch_sizes, work = self._streams[stream].prepare.remote(sweeps)
        self._follow(batch_sizes, partial(self._on_prepared, stream, sweeps.start, work))

    def _on_prepared(self, stream: int, sweep: int, work: Ref, ref: Ref) -> None:
        try:
            batch_sizes = _value(ref)
        except _Died:
            self._streams[stream] = None  # the next one starts anew
            self._schedule.preparing_died(stream)
        else:
            self._works[sweep] = work
            self._schedule.prepared(stream, batch_sizes)

    def _on_fit(self, piece: FitPiece, results: Ref, ref: Ref) -> None:
        try:
            _value(ref)
        except _Died:
            self._schedule.fit_died(piece)
        else:
            self._schedule.fitted(piece, results)

    def _start_finish(self, sweep: int, parts: Sequence[FitPart[Ref]]) -> None:
        results = [part.result for part in parts if part.result is not None]
        numbers = iter(range(len(results)))
        layout = [FitPart(part.piece, None if part.result is None else next(numbers)) for part in parts]
        bare, rows, proposals = _finish.remote(self._works[sweep], layout, self._config, *results)
        self._follow(bare, partial(self._on_finished, sweep, rows, proposals), is_task=True)

    def _on_finished(self, sweep: int, rows: Ref, proposals: Ref, ref: Ref) -> None:
        try:
            self._observations[sweep] = _value(ref)
        except _Died:
            self._schedule.finishing_died(sweep)
            return
        del self._works[sweep]
        self._rows[sweep], self._proposals[sweep] = rows, proposals
        for turn in self._schedule.finished(sweep):
            written = self._aggregator.add_sweep.remote(
                self._segment_id, self._assignment.attempt, self._rows.pop(turn)
            )
            self._follow(written, self._on_written)

    def _on_written(self, ref: Ref) -> None:
        _value(ref)
        self._schedule.written()

    def _track(self, observations: list[SweepObservation]) -> Ref:
        proposals = [self._proposals[sweep] for sweep in self._sweeps]
        for _ in range(MAX_ATTEMPTS):
            ended, tracks = _track_segment.remote(observations, self._config, self._segment_id, *proposals)
            try:
                self._wait_for(ended, is_task=True)
            except _Died:
                continue
            return tracks
        raise WorkerLost(f"{MAX_ATTEMPTS} workers in a row died tracking {self._segment_id}: out of memory?")

    def _all_rejected(self, reason: str) -> SegmentOutcome:
        entry = all_rejected_entry(self._segment_id, self._uri, len(self._sweeps), reason)
        return SegmentOutcome(entry, Failure(error="UnreadableSweep", message=entry.reason))

    def _wait_for(self, ref: Ref, *, is_task: bool = False) -> Any:
        """Return a value, or stop when told to."""
        ended: list[Ref] = []
        self._follow(ref, ended.append, is_task=is_task)
        while not ended:
            self._step()
        return _value(ref)

    def _say(self, stage: str) -> None:
        self._note(Progress(self._segment_id, stage, self._schedule.num_written, len(self._sweeps)))

    def _end_all(self) -> None:
        for task in self._tasks:
            ray.cancel(task, force=True)  # a fit may be in one long call, where a softer way is not heard
        for stream in self._streams:
            if stream is not None:
                ray.kill(stream)
        self._aggregator.forget.remote(self._segment_id, self._assignment.attempt)


def _value(ref: Ref) -> Any:
    """Return the value of a reference that is ready.

    Raises:
        _Died: Its process is gone.
        WorkerLost: It was there and is lost, with its machine.
        LabelingError: What the work itself raised.

    """
    try:
        return ray.get(ref)
    except (rex.WorkerCrashedError, rex.OutOfMemoryError, rex.NodeDiedError, rex.RayActorError) as error:
        raise _Died(str(error)) from None
    except rex.RayTaskError as error:
        cause = error.cause
        if isinstance(cause, OSError | StorageTrouble):
            raise WorkerLost(f"disk or network trouble: {cause}") from None
        if isinstance(cause, LabelingError):
            raise cause from None
        raise StageFailed.by(cause) from error
    except rex.RayError as error:
        raise WorkerLost(f"{type(error).__name__}: {error}") from None
