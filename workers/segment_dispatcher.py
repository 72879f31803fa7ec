"""Claims segments, has them labelled, and keeps what it knows of them until the job store has taken it."""

import logging
import os
import secrets
import socket
import time
from collections.abc import Callable
from concurrent.futures import wait
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from typing import Any, Final

from pydantic import ValidationError
from ray.exceptions import RayError
from sqlalchemy.exc import DataError, DBAPIError, IntegrityError

from labeling.folders.entries import failed_entry
from labeling.folders.identity import code_version
from labeling.readers.reader import id_of_canonical
from schemas.api.jobs import Failure, SegmentState
from schemas.config import LabelingConfig
from schemas.errors import JobConflict, LabelingError, StaleClaim, WorkerLost
from schemas.manifest import SegmentEntry
from workers.attempts import Attempt
from workers.cluster import HealthProbe
from workers.jobs.claims import Claim, Dispatcher, FinishedJob, SegmentQueue, SegmentResult
from workers.pipeline import plan_limits, segments_at_once
from workers.ray_workers import Publication, RayWorkers
from workers.segment_labeler import SegmentOutcome

_LOGGER = logging.getLogger("motionlabel.dispatcher")
LEASE_S: Final = 15.0  # how long a segment stays ours without a word from us
_REPORT_S: Final = 1.0  # between two words on a segment: how late a cancelled job is noticed, at most
_HEARTBEAT_S: Final = 5.0
_STOP_S: Final = 1.5  # that Ray is given to kill labelers before we end
_COMPLAINT_S: Final = 10.0  # between two lines of the log on a store that is away


@dataclass(slots=True, eq=False)
class _Held:
    """A claimed segment, until the store has taken its end, or has given it to another."""

    claim: Claim
    told_s: float  # when the store last took a word on it
    due_s: float  # when it is to hear the next
    attempt: Attempt | None = None
    is_stopped: bool = False  # the attempt was killed
    death: str = ""  # how the attempt died, while it is being asked whether the cluster did
    died_s: float = 0.0
    settle: Callable[[], object] | None = None  # tells the store how it ended
    is_stale: bool = False  # it is another's; the attempt is being stopped


@dataclass(slots=True, eq=False)
class _Publishing:
    """A job's manifest, until the store has taken that it is out."""

    job: FinishedJob
    publication: Publication
    due_s: float
    end: Callable[[], object] | None = None  # tells the store


class SegmentDispatcher:
    """Keeps as many segments at work as the cluster has room for.

    Nothing in here waits for a worker: what is asked is looked at again. What ended stays in hand until the store has
    taken it. A tick first looks, which needs no store, and then tells; where the store does not take a word, the rest
    of the tick's words wait for the next tick, and that one for a second, so that neither holds the others up.
    """

    def __init__(
        self,
        queue: SegmentQueue,
        workers: RayWorkers,
        *,
        lease_s: float = LEASE_S,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._queue, self._workers = queue, workers
        self._lease_s, self._clock = lease_s, clock
        self._id = f"{socket.gethostname()}-{os.getpid()}-{secrets.token_hex(4)}"
        self._num_cpus = 0
        self._heartbeat_due_s = self._search_due_s = self._complaint_due_s = clock()
        self._held: list[_Held] = []
        self._publishing: list[_Publishing] = []
        self._is_suspect = False  # somebody died since the cluster was last asked whether it lives
        self._probe: HealthProbe | None = None
        self._probed_s = 0.0

    def tick(self) -> None:
        """Take note of what ended, report what runs, start what waits.

        Raises:
            ClusterLost: The cluster does not run tasks any more.

        """
        now_s = self._clock()
        for held in list(self._held):
            self._look_at(held, now_s)
        for publishing in list(self._publishing):
            self._look_at_manifest(publishing, now_s)
        self._judge_deaths(now_s)
        try:
            self._tell(now_s)
        except DBAPIError as error:
            if now_s >= self._complaint_due_s:
                self._complaint_due_s = now_s + _COMPLAINT_S
                _LOGGER.warning("the job store does not answer: %s", _first_line(error))

    def close(self) -> None:
        """Stop what runs and give it back: another dispatcher may have it at once."""
        with suppress(RayError):  # a lost cluster has stopped it already
            self._stop_all()
        try:
            for held in self._held:
                with suppress(StaleClaim):
                    (held.settle or partial(self._queue.release, held.claim))()
            self._queue.sign_off(self._id)
        except DBAPIError as error:
            _LOGGER.warning("the job store does not answer, our leases will run out: %s", _first_line(error))

    def _stop_all(self) -> None:
        attempts = [held.attempt for held in self._held if held.attempt is not None]
        for held in list(self._held):
            self._look_at(held, self._clock())  # it may have ended by itself, at the last moment
        wait([attempt.kill() for attempt in attempts], timeout=_STOP_S)

    # What has become of what runs

    def _look_at(self, held: _Held, now_s: float) -> None:
        attempt = held.attempt
        if attempt is None or held.settle or held.death:
            return
        if attempt.is_ended:
            if held.is_stale:
                self._held.remove(held)
            else:
                self._note_end(held, attempt, now_s)
            attempt.kill()

    def _note_end(self, held: _Held, attempt: Attempt, now_s: float) -> None:
        claim = held.claim
        held.due_s = now_s
        try:
            outcome = attempt.outcome()
        except WorkerLost as error:
            if not held.is_stopped:
                _LOGGER.warning("job %s: %s, attempt %d: %s", claim.job_id, claim.uri, claim.attempt, error)
                held.death, held.died_s, self._is_suspect = str(error), now_s, True
                return
            held.settle = partial(self._queue.release, claim)
        except LabelingError as error:
            entry = failed_entry(id_of_canonical(claim.dataset, claim.uri), claim.uri, str(error))
            outcome = SegmentOutcome(entry, Failure(error=type(error).__name__, message=str(error)))
            held.settle = partial(self._finish, claim, outcome)
        else:
            held.settle = partial(self._finish, claim, outcome)

    def _look_at_manifest(self, publishing: _Publishing, now_s: float) -> None:
        if publishing.end or not publishing.publication.is_ended:
            return
        try:
            failure = publishing.publication.outcome()
        except WorkerLost as error:
            _LOGGER.warning("job %s: %s", publishing.job.job_id, error)
            self._is_suspect = True
            self._publishing.remove(publishing)  # the store still lists the job as finished
        else:
            publishing.end = partial(self._end_job, publishing.job, failure)
            publishing.due_s = now_s

    def _judge_deaths(self, now_s: float) -> None:
        """Tell a death of one process, which counts as an attempt, from that of the cluster, which does not."""
        if self._probe is None:
            if not self._is_suspect:
                return
            self._probe, self._probed_s, self._is_suspect = self._workers.probe(), now_s, False
        if not self._probe.is_answered():
            return
        self._probe = None
        for held in self._held:
            if held.death and held.died_s <= self._probed_s:
                crash = Failure(error="WorkerLost", message=held.death)
                held.settle, held.due_s = partial(self._queue.release, held.claim, crash), now_s

    # What the store is told, and asked for

    def _tell(self, now_s: float) -> None:
        due = [held for held in self._held if held.due_s <= now_s and not held.is_stale]
        for held in sorted(due, key=lambda held: held.due_s):
            self._tell_of(held, now_s)
        for publishing in list(self._publishing):
            if publishing.end and publishing.due_s <= now_s:
                publishing.due_s = now_s + _REPORT_S
                publishing.end()
                self._publishing.remove(publishing)
        if self._heartbeat_due_s <= now_s:
            self._heartbeat_due_s = now_s + _REPORT_S
            self._num_cpus = self._workers.num_cpus()
            self._queue.heartbeat(
                Dispatcher(self._id, socket.gethostname(), os.getpid(), code_version(), self._num_cpus)
            )
            self._heartbeat_due_s = now_s + _HEARTBEAT_S
        # Whoever looks for work takes back what ran out. After a pause, or with the store away, that may be our own:
        # not before all of it is renewed.
        has_overdue = any(now_s - held.told_s > self._lease_s for held in self._held if not held.is_stale)
        if self._search_due_s <= now_s and not has_overdue:
            self._search_due_s = now_s + _REPORT_S
            self._publish_manifests(now_s)
            self._claim_segments(now_s)
            at_work = {held.claim.job_id for held in self._held}
            self._workers.keep(at_work | {publishing.job.job_id for publishing in self._publishing})

    def _tell_of(self, held: _Held, now_s: float) -> None:
        held.due_s = now_s + _REPORT_S
        try:
            if held.settle:
                held.settle()
                self._held.remove(held)
                self._search_due_s = now_s  # hands are free
                return
            is_stopping = self._report(held)
            held.told_s = now_s
            if is_stopping and not held.is_stopped:
                self._stop(held)
        except StaleClaim as error:
            _LOGGER.warning("%s", error)
            self._give_up(held)
        except (DataError, IntegrityError) as error:  # it will not take this another time either
            if held.settle:
                message = f"the job store cannot hold how it ended: {_first_line(error)}"
                crash = Failure(error=type(error).__name__, message=message)
                held.settle = partial(self._queue.release, held.claim, crash)
            raise

    def _report(self, held: _Held) -> bool:
        """Tell the store how far a segment is, which keeps the lease; return whether its job is to stop."""
        assert held.attempt is not None
        progress = held.attempt.progress()
        if not progress.num_sweeps:
            return self._queue.renew(held.claim)
        return self._queue.report_progress(
            held.claim, progress.stage, progress.sweeps_done, progress.num_sweeps, progress.segment_id
        )

    def _stop(self, held: _Held) -> None:
        held.is_stopped = True
        if held.attempt is not None:
            held.attempt.kill()

    def _give_up(self, held: _Held) -> None:
        """Let go of a segment that is another's. What our attempt may publish meanwhile is what the other publishes."""
        if held.attempt is None or held.settle or held.death:
            self._held.remove(held)
            return
        held.is_stale = True
        self._stop(held)

    def _finish(self, claim: Claim, outcome: SegmentOutcome) -> None:
        entry = outcome.entry
        self._queue.finish(claim, SegmentState(entry.state), failure=outcome.failure, entry=entry)
        _LOGGER.info("job %s: %s %s", claim.job_id, claim.uri, entry.state)

    def _claim_segments(self, now_s: float) -> None:
        num_at_once = segments_at_once(self._num_cpus)
        if len(self._held) >= num_at_once:
            self._queue.expire()  # as a claim does
        while len(self._held) < num_at_once:
            claim = self._queue.claim_segment(self._id, self._lease_s)
            if claim is None:
                return
            held = _Held(claim, told_s=now_s, due_s=now_s + _REPORT_S)
            self._held.append(held)
            try:
                config = LabelingConfig.model_validate(claim.config)
            except ValidationError as error:
                held.settle = partial(self._queue.finish, claim, SegmentState.FAILED, failure=_explain(error))
                held.due_s = now_s
                continue
            held.attempt = self._workers.start(claim, config, plan_limits(self._num_cpus, num_at_once))
            _LOGGER.info("job %s: %s, attempt %d", claim.job_id, claim.uri, claim.attempt)

    def _publish_manifests(self, now_s: float) -> None:
        under_way = {publishing.job.job_id for publishing in self._publishing}
        for job in self._queue.list_finished_jobs():
            if job.job_id not in under_way:
                self._publish(job, now_s)

    def _publish(self, job: FinishedJob, now_s: float) -> None:
        try:
            results = self._queue.iterate_results(job.job_id)
            entries = [result.entry or _entry_without_labels(job.dataset, result) for result in results]
            if not any(entry.shards for entry in entries):
                self._end_job(job, None)
                return
            config = LabelingConfig.model_validate(job.config)
        except ValidationError as error:
            self._end_job(job, _explain(error))
            return
        self._publishing.append(_Publishing(job, self._workers.publish(job, config, entries), due_s=now_s))

    def _end_job(self, job: FinishedJob, failure: Failure | None) -> None:
        try:
            state = self._queue.end_job(job, failure)
        except JobConflict as error:  # it was retried meanwhile
            _LOGGER.info("%s", error)
            later = self._queue.find_finished_job(job.job_id)
            if later is not None:  # and has ended again: ours may stand where its manifest stood
                self._publish(later, self._clock())
        else:
            _LOGGER.info("job %s: %s", job.job_id, state)


def _explain(error: ValidationError) -> Failure:
    """Return the failure of a job, or of a segment of it, that another version took in."""
    problem = error.errors()[0]
    place = ".".join(map(str, problem["loc"]))
    reason = "there is no such option" if problem["type"] == "extra_forbidden" else problem["msg"]
    message = f"this version cannot use what another stored of the job: {place}: {reason}"
    return Failure(error="InvalidInput", message=message)


def _entry_without_labels(dataset: str, result: SegmentResult) -> SegmentEntry:
    reason = result.failure.message if result.failure else f"not labelled: {result.state}"
    return failed_entry(id_of_canonical(dataset, result.uri), result.uri, reason)


def _first_line(error: DBAPIError) -> str:
    text: Any = error.orig
    return str(text).partition("\n")[0]
