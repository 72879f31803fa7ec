"""One attempt at one segment, seen from the driver."""

from collections import Counter
from collections.abc import Mapping
from concurrent.futures import Future
from functools import partial
from types import MappingProxyType
from typing import Any, Final
from weakref import WeakSet

import ray
from ray import ObjectRef
from ray import exceptions as rex
from ray.util.scheduling_strategies import NodeAffinitySchedulingStrategy

from schemas.errors import StageFailed, WorkerLost
from workers.background import in_background
from workers.pipeline import choose_home
from workers.segment_labeler import Assignment, Progress, SegmentLabeler, SegmentOutcome

_SegmentLabeler: Any = SegmentLabeler  # to Ray's types an actor is a plain class


class Attempt:
    """Starts a SegmentLabeler, on the machine that is to be its home, and follows it. Nothing in here waits for it.

    Args:
        assignment: What to label.
        aggregator: The job's; an actor's handle has no type of its own.
        cpus_of_machine: As ``choose_home`` takes them; without, any machine will do.

    """

    def __init__(
        self, assignment: Assignment, aggregator: Any, cpus_of_machine: Mapping[str, float] = MappingProxyType({})
    ) -> None:
        homes = Counter(attempt._home for attempt in _ATTEMPTS if attempt._home)
        self._home: str | None = choose_home(cpus_of_machine, homes)
        _ATTEMPTS.add(self)
        options = {}
        if self._home is not None:
            options["scheduling_strategy"] = NodeAffinitySchedulingStrategy(self._home, soft=True)
        self._labeler = _SegmentLabeler.options(**options).remote(assignment, aggregator)
        self.running: ObjectRef[Any] = self._labeler.run.remote()  # ready when the attempt has ended
        self._asked: ObjectRef[Any] = self._labeler.progress.remote()
        self._progress = Progress()
        self._kill: Future[None] | None = None

    @property
    def is_ended(self) -> bool:
        """True when ``outcome`` has something to say."""
        return bool(ray.wait([self.running], timeout=0)[0])

    def progress(self) -> Progress:
        """Return what the labeler last said, and ask again."""
        if ray.wait([self._asked], timeout=0)[0]:
            try:
                self._progress = ray.get(self._asked)
            except rex.RayError:
                return self._progress  # it died: ``outcome`` says so
            self._asked = self._labeler.progress.remote()
        return self._progress

    def outcome(self) -> SegmentOutcome:
        """Return how an ended attempt ended.

        Raises:
            WorkerLost: The labeler, or what it needed, died or was killed.

        """
        try:
            outcome: SegmentOutcome = ray.get(self.running)
            return outcome
        except rex.RayTaskError as error:
            if isinstance(error.cause, WorkerLost):
                raise error.cause from None
            raise StageFailed.by(error.cause) from error
        except rex.RayError as error:
            raise WorkerLost(f"the segment's labeler died: {str(error).splitlines()[0]}") from None

    def kill(self) -> Future[None]:
        """Have the labeler killed, and with it all its tasks and its actor. Once more changes nothing.

        Every attempt is ended by this, whether it has come to an end or not: Ray kills what a dead process had started
        wherever it is, queued or in the middle of one long call.
        """
        if self._kill is None:  # not here: Ray waits for its GCS
            self._kill = in_background(partial(ray.kill, self._labeler))
        return self._kill


_ATTEMPTS: Final[WeakSet[Attempt]] = WeakSet()  # those that this process drives
