"""The tasks and the actor of one segment: what its schedule says, done on Ray."""

import time
from collections.abc import Callable, Iterable, Sequence
from functools import cache
from typing import TYPE_CHECKING, Any, Final, NamedTuple, TypeAlias

import ray
from ray import ObjectRef
from ray import exceptions as rex
from ray.util.scheduling_strategies import NodeAffinitySchedulingStrategy

from labeling.folders.entries import all_rejected_entry, find_published
from labeling.folders.identity import LabelSet
from labeling.readers.reader import SegmentReader, sweep_range
from labeling.storage.storage import open_storage
from schemas.api.jobs import Failure
from schemas.config import LabelingConfig
from schemas.errors import InvalidInput, LabelingError, StageFailed, StorageTrouble, WorkerLost
from schemas.manifest import SegmentEntry
from workers.cluster import cpus_of_machines
from workers.pipeline import GPU_OF_FIT, stays_home
from workers.results import Results
from workers.schedule import Kind, Reach, SegmentSchedule, Step
from workers.static_removal import StaticRemoval
from workers.steps import NUM_RETURNS, Segment, task

if TYPE_CHECKING:
    from workers.segment_labeler import Assignment

Ref: TypeAlias = ObjectRef[Any]

_TICK_S: Final = 0.2  # how often it is asked which tasks have begun
_PATIENCE_S: Final = 1.0  # that a task is given to find a CPU, before the segment's actor may take its step over
# To Ray's types a task has one result and an actor is a plain class.
_StaticRemoval: Any = StaticRemoval
_task: Any = task


class _Died(Exception):
    """A process or a machine is gone; what it was doing can be done again."""


class _Running(NamedTuple):
    """A step that was given to a process."""

    step: Step
    results: Sequence[Ref]
    is_own: bool
    since_s: float


class SegmentLine:
    """What it has started ends with the process that it is in."""

    def __init__(
        self,
        assignment: "Assignment",
        reader: SegmentReader,
        aggregator: Any,
        take_begun: Callable[[], Iterable[Step]],
    ) -> None:
        config = assignment.config
        self._config, self._aggregator, self._output = config, aggregator, assignment.output
        self._take_begun = take_begun
        self._sweeps, self._uri = sweep_range(reader, config), reader.uri
        self._label_set = LabelSet.of(reader, config)
        self._results = Results(reader, self._sweeps, self._label_set)
        near = self._results.neighborhood
        self._schedule = SegmentSchedule(
            self._sweeps,
            Reach(cache(near.voter_range), cache(near.target_range)),
            len(config.joining.regroupings),
            assignment.limits,
        )
        self._options = _options_of_home(assignment)
        self._gpus = GPU_OF_FIT if config.flow.device == "cuda" else 0
        self._segment = ray.put(Segment(reader.listing, assignment.output, config, assignment.hook))
        self._me = ray.get_runtime_context().current_actor
        self._actor: Any = None
        self._waking: Ref | None = None  # while the actor waits for a CPU, or imports
        self._running: dict[Ref, _Running] = {}

    def run(self, say: Callable[[str, int, int], None]) -> tuple[SegmentEntry, Failure | None]:
        """Go through all sweeps, then the tracks, then publish.

        Args:
            say: Is told the stage, how many sweeps are done, and how many there are.

        Raises:
            WorkerLost: Processes died too often, or what only they had is gone. Another attempt may succeed.

        """
        num_sweeps = len(self._sweeps)
        say("starting", 0, num_sweeps)
        try:
            _value(self._aggregator.prepare.remote())
        except _Died as error:
            raise WorkerLost(f"the process that prepares the folder died: {error}") from None
        published = find_published(open_storage(self._output), self._label_set, self._uri)
        if published is not None:
            return published, None
        _require_gpu(self._config)
        while not self._schedule.is_done:
            if self._schedule.has_all_sweeps and (reason := self._results.reason_to_reject_all()):
                entry = all_rejected_entry(self._label_set.segment_id, self._uri, num_sweeps, reason)
                return entry, Failure(error="UnreadableSweep", message=entry.reason)
            stage = "tracks" if self._schedule.has_all_sweeps else "sweeps"
            say(stage, self._schedule.num_finished, num_sweeps)
            self._start_steps()
            self._take_ends()
        assert self._results.entry is not None  # of the last step
        return self._results.entry, None

    def is_wanted(self, step: Step) -> bool:
        """Return whether a task that begins should take its step: the actor may have done it. Any thread may ask."""
        return self._schedule.is_wanted(step)

    def _start_steps(self) -> None:
        for begun in self._take_begun():
            self._schedule.task_begins(begun)
        if self._actor is None:
            self._actor = _StaticRemoval.options(**self._options, num_gpus=self._gpus).remote(self._segment)
            self._waking = self._actor.wake.remote()
        if self._waking is None:
            overdue_s = time.monotonic() - _PATIENCE_S
            overdue = [run.step for run in self._running.values() if run.since_s < overdue_s]
            if (step := self._schedule.next_own(overdue)) is not None:
                method = self._actor.take.options(num_returns=NUM_RETURNS[step.kind])
                inputs = self._results.inputs(step, self._schedule)
                self._follow(step, method.remote(self._schedule.first_needed, step, *inputs), is_own=True)
        while (step := self._schedule.next_task()) is not None:
            start = _task.options(
                **self._options,
                num_gpus=self._gpus if step.kind == Kind.FIT else 0,
                num_returns=NUM_RETURNS[step.kind],
                name=_name(step),
            )
            inputs = self._results.inputs(step, self._schedule)
            self._follow(step, start.remote(self._me, self._segment, step, *inputs), is_own=False)

    def _follow(self, step: Step, refs: Any, *, is_own: bool) -> None:
        first, *results = refs if isinstance(refs, list) else [refs]
        self._running[first] = _Running(step, results, is_own, time.monotonic())

    def _take_ends(self) -> None:
        """Wait for something to end, and act on all that has."""
        refs = [*self._running, *([self._waking] if self._waking else [])]
        ended = ray.wait(refs, num_returns=len(refs), timeout=0)[0] or ray.wait(refs, timeout=_TICK_S)[0]
        for ref in ended:
            if ref == self._waking:
                self._on_wake(ref)
            else:
                self._on_end(self._running.pop(ref), ref)

    def _on_wake(self, ref: Ref) -> None:
        self._waking = None
        try:
            _value(ref)
        except _Died:
            self._lose_actor()

    def _on_end(self, run: _Running, ref: Ref) -> None:
        try:
            value = _value(ref)
        except _Died:
            if run.is_own:
                self._lose_actor()
            else:
                self._schedule.task_died(run.step)
            return
        end = self._schedule.own_ended if run.is_own else self._schedule.task_ended
        if end(run.step, _sizes(run.step.kind, value)):  # else another process was faster
            self._results.take(run.step, value, run.results, self._schedule)

    def _lose_actor(self) -> None:
        self._actor = None  # the next one goes on
        self._schedule.own_died()


def _sizes(kind: Kind, value: Any) -> Sequence[int]:
    """Return the sizes of the batches that follow a step; none follow one that was done by another process before."""
    if value is None:
        return ()
    if kind in (Kind.LINK, Kind.REGROUP):
        return value[1]
    return value if kind in (Kind.PREPARE, Kind.PLAN) else ()


def _name(step: Step) -> str:
    return f"{step.kind.name.lower()} {step.number}" + (f".{step.batch}" if step.stop else "")


def _require_gpu(config: LabelingConfig) -> None:
    resources: dict[str, float] = ray.cluster_resources()  # type: ignore[no-untyped-call]  # Ray's
    if config.flow.device == "cuda" and not resources.get("GPU"):  # Ray would wait for one for ever
        raise InvalidInput("flow.device is cuda, but the Ray cluster has no GPU: expected one, or flow.device=cpu")


def _options_of_home(assignment: "Assignment") -> dict[str, Any]:
    """Return the options that keep processes on this machine, where the segment is to stay."""
    here = ray.get_runtime_context().get_node_id()
    if not stays_home(assignment.limits, int(cpus_of_machines().get(here, 0))):
        return {}
    return {"scheduling_strategy": NodeAffinitySchedulingStrategy(here, soft=True)}


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
        if isinstance(cause, rex.RayError):
            raise WorkerLost(f"{type(cause).__name__}: {cause}") from None
        raise StageFailed.by(cause) from error
    except rex.RayError as error:
        raise WorkerLost(f"{type(error).__name__}: {error}") from None
