"""What one segment does next: which step goes to which kind of process, and what a death changes. No Ray, no clock.

A sweep goes through: ground -> static -> preparing -> votes -> plan -> fits -> finishing. Votes and fits are several
steps at once. When all sweeps are finished: link -> complete -> (regroup -> complete), as often as asked -> write.

A segment has a process of its own, the StaticRemoval actor, and tasks, which run wherever a CPU is free. It prepares
the sweeps, one after the other, and finds what their preparation needs, unless tasks have done so before: they take
late steps first, which free what early ones hold. An actor that is ahead takes any step, also one that was given to a
task which has not begun: so it never idles, and a segment goes on when there is no CPU for tasks at all. A task that
was overtaken so is not taken back: it counts until a CPU has let it find out.
"""

import heapq
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from enum import IntEnum
from typing import NamedTuple

from schemas.errors import WorkerLost
from workers.pipeline import MAX_ATTEMPTS, Limits


class Kind(IntEnum):
    """What a step does."""

    GROUND = 0
    STATIC = 1
    PREPARE = 2
    VOTE = 3
    PLAN = 4
    FIT = 5
    FINISH = 6
    LINK = 7
    COMPLETE = 8
    REGROUP = 9
    WRITE = 10


class Step(NamedTuple):
    """One thing that one process does in one go. What it gives follows from this and from the segment alone."""

    number: int  # of the sweep; of a step on tracks: how often they were regrouped before
    kind: Kind
    batch: int = 0
    start: int = 0  # of a vote or a fit: it is ``start:stop`` of its batch
    stop: int = 0
    is_whole: bool = True  # all of its batch, until its worker died with it twice
    attempt: int = 1


def pieces_after_death(step: Step) -> tuple[Step, ...]:
    """Return what to try after a worker died voting or fitting; nothing when the one cluster left is to blame.

    A batch and a single cluster are tried twice, for the death may not have been theirs; parts in between once, for
    halving a good one costs little.
    """
    size = step.stop - step.start
    if step.attempt == 1 and (step.is_whole or size == 1):
        return (step._replace(attempt=2),)
    if size == 1:
        return ()
    middle = step.start + size // 2
    part = step._replace(is_whole=False, attempt=1)
    return part._replace(stop=middle), part._replace(start=middle)


class Part(NamedTuple):
    """A vote or a fit that is over; lost when its one cluster ended every worker that tried it."""

    step: Step
    is_lost: bool = False


@dataclass(frozen=True, slots=True)
class Reach:
    """What a sweep's steps need of others. Ranges do not end earlier for later sweeps."""

    ground: Callable[[int], range]  # of which sweeps its static points need the ground
    static: Callable[[int], range]  # of which sweeps its preparation needs the static points


class SegmentSchedule:
    """Keeps the order and the bounds of one segment's work."""

    def __init__(self, sweeps: range, reach: Reach, num_regroupings: int, limits: Limits) -> None:
        self._limits, self._reach, self._num_regroupings = limits, reach, num_regroupings
        self._prepared = _InOrder(sweeps)
        static = range(reach.static(sweeps[0]).start, reach.static(sweeps[-1]).stop)
        self._static = _InOrder(static)
        self._ground = _InOrder(range(reach.ground(static[0]).start, reach.ground(static[-1]).stop))
        self._num_sweeps = len(sweeps)
        self.num_finished = 0
        self.is_done = False
        self._num_ahead = 0  # sweeps between preparing and finishing
        self._late: list[Step] = []  # what can begin, but for the first three kinds
        self._parts: dict[tuple[int, Kind], list[Part]] = {}
        self._num_open: Counter[tuple[int, Kind]] = Counter()  # steps of that kind that are not over
        self._begun: set[Step] = set()
        self._tasks: dict[Step, bool] = {}  # those given to tasks: does it run?
        self._own: Step | None = None  # what the actor does
        self._deaths: Counter[tuple[int, Kind, int]] = Counter()

    @property
    def has_all_sweeps(self) -> bool:
        """True when every sweep is finished."""
        return self.num_finished == self._num_sweeps

    @property
    def first_needed(self) -> int:
        """The earliest sweep whose ground, or static points, may still be asked for."""
        if self._prepared.until == self._prepared.stop:
            return self._ground.stop
        return self._reach.ground(self._reach.static(self._prepared.until).start).start

    @property
    def known(self) -> range:
        """The sweeps that somebody has read, or could not read."""
        return range(self._ground.start, self._ground.until)

    def parts(self, sweep: int, kind: Kind) -> list[Part]:
        """Return the votes, or the fits, of a sweep, in order."""
        return sorted(self._parts.get((sweep, kind), ()))

    def next_task(self) -> Step | None:
        """Return a step to give to a task now; None: nothing, or enough are given."""
        if len(self._tasks) >= self._limits.tasks_in_flight:
            return None
        step = self._pop_late() or self._next_static() or self._next_ground()
        if step is not None:
            self._tasks[step] = False
            self._begun.add(step)
        return step

    def next_own(self, overdue: Iterable[Step] = ()) -> Step | None:
        """Return a step to give to the actor now; None: nothing, or it is busy.

        When nothing else is to do, it takes over one of those ``overdue`` that were given to tasks and do not run.
        """
        if self._own is not None:
            return None
        step = self._next_on_the_way() or self._pop_late() or self._next_static() or self._next_ground()
        if step is None:
            waiting = (task for task in overdue if self._tasks.get(task) is False and self.is_wanted(task))
            step = min(waiting, default=None)
        if step is not None:
            self._own = step
            self._begun.add(step)
        return step

    def is_wanted(self, step: Step) -> bool:
        """Return whether a step that was given away is not over. Any thread may ask."""
        return step in self._begun

    def task_begins(self, step: Step) -> None:
        """Note that a process has taken up a task."""
        if step in self._tasks:
            self._tasks[step] = True

    def task_ended(self, step: Step, sizes: Sequence[int] = ()) -> bool:
        """Note the end of a task; see ``own_ended``."""
        self._tasks.pop(step, None)
        return self._end(step, sizes)

    def own_ended(self, step: Step, sizes: Sequence[int] = ()) -> bool:
        """Note the end of what the actor did; False when a task has ended the same step before.

        Args:
            step: What has ended.
            sizes: Of the batches that follow: votes after preparing, fits after the plan, tracks after putting them
                into groups. How many clusters each has.

        """
        self._own = None
        return self._end(step, sizes)

    def task_died(self, step: Step) -> None:
        """Let a step be taken again whose process died, unless the actor does it too.

        Raises:
            WorkerLost: That was the last attempt.

        """
        self._tasks.pop(step, None)
        if step != self._own:
            self._repeat(step)

    def own_died(self) -> None:
        """Let what the actor did be taken again, when it died, unless a task has it too.

        Raises:
            WorkerLost: That was the last attempt.

        """
        step, self._own = self._own, None
        if step is not None and step not in self._tasks:
            self._repeat(step)

    def _next_on_the_way(self) -> Step | None:
        """Return the preparation of the next sweep, or what it waits for that nobody has begun."""
        sweep = self._prepared.next
        if sweep is None or self._num_ahead >= self._limits.sweeps_ahead:
            return None
        if self._reach.static(sweep).stop > self._static.until:
            return self._next_static() or self._next_ground()
        self._prepared.take()
        self._num_ahead += 1
        return Step(sweep, Kind.PREPARE)

    def _next_static(self) -> Step | None:
        sweep = self._static.next
        if sweep is None or self._reach.ground(sweep).stop > self._ground.until:
            return None
        self._static.take()
        return Step(sweep, Kind.STATIC)

    def _next_ground(self) -> Step | None:
        sweep, preparing = self._ground.next, self._prepared.next
        if sweep is None or preparing is None:
            return None
        needed = self._reach.ground(self._reach.static(preparing)[-1]).stop
        if sweep >= needed + self._limits.ground_ahead:
            return None
        self._ground.take()
        return Step(sweep, Kind.GROUND)

    def _pop_late(self) -> Step | None:
        return heapq.heappop(self._late) if self._late else None

    def _end(self, step: Step, sizes: Sequence[int]) -> bool:
        if step not in self._begun:
            return False
        self._begun.remove(step)
        match step.kind:
            case Kind.GROUND:
                self._ground.end(step.number)
            case Kind.STATIC:
                self._static.end(step.number)
            case Kind.PREPARE:
                self._prepared.end(step.number)
                self._open(step.number, Kind.VOTE, sizes)
            case Kind.PLAN:
                self._open(step.number, Kind.FIT, sizes)
            case Kind.VOTE | Kind.FIT:
                self._close(Part(step))
            case Kind.FINISH:
                for kind in (Kind.VOTE, Kind.FIT):
                    self._parts.pop((step.number, kind), None)
                self._num_ahead -= 1
                self.num_finished += 1
                if self.has_all_sweeps:
                    heapq.heappush(self._late, Step(0, Kind.LINK))
            case Kind.LINK | Kind.REGROUP:
                self._num_open[step.number, Kind.COMPLETE] = len(sizes)
                for batch, size in enumerate(sizes):
                    heapq.heappush(self._late, Step(step.number, Kind.COMPLETE, batch, 0, size))
                if not sizes:
                    self._go_on_with_tracks(step.number)
            case Kind.COMPLETE:
                self._num_open[step.number, Kind.COMPLETE] -= 1
                if not self._num_open[step.number, Kind.COMPLETE]:
                    self._go_on_with_tracks(step.number)
            case Kind.WRITE:
                self.is_done = True
        return True

    def _open(self, sweep: int, kind: Kind, sizes: Sequence[int]) -> None:
        self._num_open[sweep, kind] = len(sizes)
        for batch, size in enumerate(sizes):
            heapq.heappush(self._late, Step(sweep, kind, batch, 0, size))
        if not sizes:
            self._go_on(sweep, kind)

    def _close(self, part: Part) -> None:
        key = part.step.number, part.step.kind
        self._parts.setdefault(key, []).append(part)
        self._num_open[key] -= 1
        if not self._num_open[key]:
            self._go_on(*key)

    def _go_on(self, sweep: int, kind: Kind) -> None:
        del self._num_open[sweep, kind]
        heapq.heappush(self._late, Step(sweep, Kind.PLAN if kind == Kind.VOTE else Kind.FINISH))

    def _go_on_with_tracks(self, number: int) -> None:
        is_last = number == self._num_regroupings
        heapq.heappush(self._late, Step(number + 1, Kind.WRITE if is_last else Kind.REGROUP))

    def _repeat(self, step: Step) -> None:
        if step not in self._begun:
            return  # it had ended before
        self._begun.remove(step)
        if step.kind in (Kind.VOTE, Kind.FIT):
            pieces = pieces_after_death(step)
            for again in pieces:
                heapq.heappush(self._late, again)
            if pieces:
                self._num_open[step.number, step.kind] += len(pieces) - 1
            else:
                self._close(Part(step, is_lost=True))
            return
        self._deaths[step.number, step.kind, step.batch] += 1
        if self._deaths[step.number, step.kind, step.batch] == MAX_ATTEMPTS:
            raise WorkerLost(
                f"{MAX_ATTEMPTS} workers in a row died in step {step.kind.name.lower()} {step.number}: "
                "out of memory, or a fault in a library?"
            )
        match step.kind:
            case Kind.GROUND:
                self._ground.repeat(step.number)
            case Kind.STATIC:
                self._static.repeat(step.number)
            case Kind.PREPARE:
                self._num_ahead -= 1
                self._prepared.repeat(step.number)
            case _:
                heapq.heappush(self._late, step)


class _InOrder:
    """Sweeps that something is done with: it begins in order, and ends in any."""

    def __init__(self, sweeps: range) -> None:
        self.start, self.stop = sweeps.start, sweeps.stop
        self.until = sweeps.start  # all before are done
        self._first_new = sweeps.start
        self._again: list[int] = []
        self._done: set[int] = set()

    @property
    def next(self) -> int | None:
        """The sweep to begin next; None: all are begun."""
        if self._again:
            return self._again[0]
        return self._first_new if self._first_new < self.stop else None

    def take(self) -> None:
        """Begin the next one."""
        if self._again:
            heapq.heappop(self._again)
        else:
            self._first_new += 1

    def repeat(self, sweep: int) -> None:
        """Let one be begun again."""
        heapq.heappush(self._again, sweep)

    def end(self, sweep: int) -> None:
        """Note that one is done."""
        self._done.add(sweep)
        while self.until in self._done:
            self._done.remove(self.until)
            self.until += 1
