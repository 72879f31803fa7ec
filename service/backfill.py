"""See every segment of a place through the service: ask for what nobody asked for, so many at a time, and follow it."""

import contextlib
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import islice
from typing import Any, Final, TypeVar

from pydantic import BaseModel

from schemas.api.jobs import JobState, JobStatus, SegmentState
from schemas.api.status import ServiceStatus
from schemas.backfill import BackfillSummary
from schemas.errors import InvalidInput, StorageTrouble
from service.client import Client, ServiceError, read_answer
from service.figures import Figures
from service.ledger import Batch, Ledger

M = TypeVar("M", bound=BaseModel)
Find = Callable[[Callable[[str], None]], Iterator[str]]  # takes what is to be told of those that are left out
POLL_S: Final = 1.0
_PATIENCE: Final = 60  # calls in a row that may fail while the service starts anew


@dataclass(frozen=True)
class Pace:
    """How much is asked for at once."""

    batch_size: int  # segments a job
    max_in_flight: int  # segments that were asked for and have not ended; at least ``batch_size``
    limit: int | None = None  # new segments in all


def new_batches(found: Iterator[str], ledger: Ledger, pace: Pace) -> Iterator[list[str]]:
    """Yield the segments that nobody asked for yet, so many at a time."""
    new = islice((segment for segment in found if segment not in ledger), pace.limit)
    while batch := list(dict.fromkeys(islice(new, pace.batch_size))):  # links give some segments several names
        yield batch


class Backfill:
    """One run over one place."""

    def __init__(
        self,
        client: Client,
        ledger: Ledger,
        find: Find,
        pace: Pace,
        *,
        tell: Callable[[str], None],
        is_retrying: bool = False,
    ) -> None:
        """Take what is needed; nothing is asked yet.

        Args:
            client: The service.
            ledger: What was asked for before; its records are not read yet.
            find: Gives the segments of the place, each time all of them.
            pace: How much at once.
            tell: Is told, in one line each, which jobs and segments went wrong.
            is_retrying: What earlier runs left without labels is run again.

        """
        self._client, self._ledger, self._find, self._pace = client, ledger, find, pace
        self._tell, self._is_retrying = tell, is_retrying
        self._census: Iterator[None] = self._take_census()
        self._figures = Figures(time.monotonic())
        self._open: dict[str, tuple[Batch, JobStatus]] = {}  # by id: jobs that have not ended
        self._segments: Counter[SegmentState] = Counter()  # of those that have
        self._num_ended_before = 0  # segments, when this run first saw their jobs
        self._num_earlier = self._num_new = 0  # segments that were asked for before, and in this run
        self._num_new_expected: int | None = None
        self._num_jobs = self._num_refused = self._num_unusable = 0
        self._is_all_asked = False

    def steps(self) -> Iterator[None]:
        """Submit what is to be submitted, and wait until all has ended; yields after each look at the service.

        Raises:
            InvalidInput: The service refuses what is asked of it.
            ServiceError: It cannot be reached, and did not come back.
            StorageTrouble: Segments cannot be listed, or records not put. What was asked for goes on.

        """
        earlier = self._ledger.read_new()
        self._num_earlier = sum(len(batch.record.segments) for batch in earlier)
        yield from self._submit(earlier)
        for segments in new_batches(self._find(self._leave_out), self._ledger, self._pace):
            yield from self._wait_for_room(len(segments))
            batches = self._ledger.claim(segments)
            self._num_new += sum(len(batch.record.segments) for batch in batches)
            yield from self._submit(batches)
        self._num_new_expected, self._is_all_asked = self._num_new, True
        self._census = iter(())
        while self._open:
            self._look_again()
            yield

    def summarize(self, dataset: str, place: str, output_uri: str) -> BackfillSummary:
        """Return how far it is."""
        segments = self._segments.copy()
        for _, job in self._open.values():
            segments.update(job.segments)
        num_ended = sum(count for state, count in segments.items() if state.is_ended)
        num_seen = num_ended - self._num_ended_before
        num_expected = None if self._num_new_expected is None else self._num_earlier + self._num_new_expected
        num_left = None if num_expected is None else max(num_expected - self._num_refused - num_ended, 0)
        figures = self._figures
        return BackfillSummary(
            dataset=dataset,
            place=place,
            output_uri=output_uri,
            is_complete=self._is_all_asked and not self._open,
            num_jobs=self._num_jobs,
            segments={state: segments[state] for state in SegmentState},
            num_refused=self._num_refused,
            num_unusable=self._num_unusable,
            num_done_before=self._ledger.num_done,
            num_expected=num_expected,
            elapsed_s=figures.elapsed_s,
            segments_per_hour=figures.per_hour(num_seen),
            eta_s=None if num_left is None else figures.eta_s(num_seen, num_left),
            core_hours=figures.core_hours,
            expected_core_hours=None if num_left is None else figures.expected_core_hours(num_seen, num_left),
        )

    def _leave_out(self, reason: str) -> None:
        self._num_unusable += 1
        self._tell(reason)

    def _take_census(self) -> Iterator[None]:
        """Count the new segments of the place, one a step: how many are still to come is not known otherwise."""
        num_new = 0
        with contextlib.suppress(StorageTrouble):  # then it stays unknown
            for segment in self._find(lambda _: None):
                num_new += self._ledger.is_new(segment)
                if num_new == self._pace.limit:
                    break
                yield
            self._num_new_expected = num_new

    def _submit(self, batches: Sequence[Batch]) -> Iterator[None]:
        for batch in batches:
            yield from self._wait_for_room(len(batch.record.segments))
            refusals: list[tuple[str, InvalidInput]] = []
            jobs = list(self._ask(batch.record.request, refusals))
            if not jobs and len(refusals) > 1:  # no single segment is to blame
                raise refusals[0][1]
            for segment, refusal in refusals:
                self._tell(f"{segment} is refused: {refusal}")
            self._num_refused += len(refusals)
            for job in map(self._retry, jobs) if self._is_retrying else jobs:
                self._num_jobs += 1
                self._num_ended_before += _count_ended(job)
                self._take(batch, job)

    def _ask(self, request: dict[str, Any], refusals: list[tuple[str, InvalidInput]]) -> Iterator[JobStatus]:
        """Submit a job; where the service does not take one of its segments, those beside it in halves.

        The halves have names that follow from the job's, so asking once more gives the same jobs. Only when the service
        takes it all one day are segments in two jobs, and the later one finds the labels there.
        """
        try:
            yield self._call(JobStatus, lambda: self._client.post("/v1/jobs", request))
        except InvalidInput as refusal:
            segments, name = request["segments"], request["client_job_id"]
            if not str(refusal).startswith("/segments/"):
                raise
            if len(segments) == 1:
                refusals.append((segments[0], refusal))
                return
            half = len(segments) // 2
            for number, part in enumerate((segments[:half], segments[half:])):
                yield from self._ask({**request, "segments": part, "client_job_id": f"{name}.{number}"}, refusals)

    def _retry(self, job: JobStatus) -> JobStatus:
        """Run again what is without labels."""
        if not job.state.is_ended or job.state is JobState.SUCCEEDED:
            return job
        try:
            return self._call(JobStatus, lambda: self._client.post(f"/v1/jobs/{job.id}:retry"))
        except InvalidInput:  # every segment has labels, if not all; or it runs again already
            return self._get(JobStatus, f"/v1/jobs/{job.id}")

    def _wait_for_room(self, num_segments: int) -> Iterator[None]:
        while self._open and self._num_open + num_segments > self._pace.max_in_flight:
            self._look_again()
            yield

    def _look_again(self) -> None:
        """Ask the service how all stands, a moment later; meanwhile the census goes on."""
        next_look_s = time.monotonic() + POLL_S
        while (left_s := next_look_s - time.monotonic()) > 0:
            if next(self._census, self) is self:
                time.sleep(left_s)
        for batch, job in list(self._open.values()):
            self._take(batch, self._get(JobStatus, f"/v1/jobs/{job.id}"))
        service = self._get(ServiceStatus, "/v1/status")
        num_running = sum(job.segments[SegmentState.RUNNING] for _, job in self._open.values())
        self._figures.look(time.monotonic(), num_running, service)

    def _take(self, batch: Batch, job: JobStatus) -> None:
        """Take note of how a job stands."""
        self._open[job.id] = batch, job
        if not job.state.is_ended:
            return
        del self._open[job.id]
        self._segments.update(job.segments)
        is_whole = job.num_segments == len(batch.record.segments)
        if job.state is not JobState.SUCCEEDED:
            self._tell(f"job {job.id} has ended {job.state}: see `motionlabel status {job.id}`")
        elif is_whole:
            self._ledger.mark_done(batch)

    @property
    def _num_open(self) -> int:
        return sum(job.num_segments - _count_ended(job) for _, job in self._open.values())

    def _get(self, model: type[M], path: str) -> M:
        return self._call(model, lambda: self._client.get(path))

    def _call(self, model: type[M], ask: Callable[[], Any]) -> M:
        """Ask until the service answers; it may be starting anew. What is asked twice is done once."""
        for _ in range(_PATIENCE):
            try:
                return read_answer(model, ask())
            except ServiceError:
                time.sleep(POLL_S)
        return read_answer(model, ask())


def _count_ended(job: JobStatus) -> int:
    return sum(count for state, count in job.segments.items() if state.is_ended)
