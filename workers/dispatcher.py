"""The dispatcher: the Ray driver. It claims segments from the job store, has them labelled, and reports.

    MOTIONLABEL_DATABASE_URL=URL python -m workers.dispatcher --data-dir DIR [--ray-address ADDRESS] [--workers N]

It alone writes the store on the workers' behalf. Whatever kills it, its leases run out and another takes over.
"""

import argparse
import contextlib
import logging
import os
import secrets
import signal
import socket
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import ray
from pydantic import ValidationError
from ray import ObjectRef
from sqlalchemy.exc import DBAPIError

from labeling.folders.entries import failed_entry
from labeling.folders.identity import code_version
from labeling.readers.reader import segment_id_of
from schemas.api.jobs import Failure, SegmentState
from schemas.config import LabelingConfig
from schemas.errors import JobConflict, LabelingError, StaleClaim, WorkerLost
from schemas.manifest import SegmentEntry
from workers import cluster
from workers.aggregator import Aggregator
from workers.attempts import Attempt
from workers.jobs.claims import Claim, Dispatcher, FinishedJob, SegmentQueue
from workers.jobs.database import URL_VARIABLE, open_database
from workers.pipeline import plan_limits, segments_at_once
from workers.segment_labeler import Assignment, SegmentOutcome

_LOGGER = logging.getLogger("motionlabel.dispatcher")
_TICK_S: Final = 0.25
_REPORT_S: Final = 1.0  # between two reports on a segment: how late a cancelled job is noticed, at most
_HEARTBEAT_S: Final = 5.0
_LEASE_S: Final = 15.0  # how long a segment stays ours without a word from us
_STOP_S: Final = 1.5  # that a labeler is given to end its tasks before it is killed
_Aggregator: Any = Aggregator  # to Ray's types an actor is a plain class


@dataclass(slots=True)
class _Running:
    """A claimed segment at work."""

    claim: Claim
    attempt: Attempt
    reported_s: float
    stopped_s: float | None = None


@dataclass(frozen=True, slots=True)
class _Publishing:
    """A job whose manifest is on its way."""

    job: FinishedJob
    written: ObjectRef[Any]


class SegmentDispatcher:
    """Keeps as many segments at work as the cluster has room for. Nothing in here waits for a worker."""

    def __init__(self, queue: SegmentQueue) -> None:
        self._queue = queue
        self._id = f"{socket.gethostname()}-{os.getpid()}-{secrets.token_hex(4)}"
        self._num_cpus = 0
        self._heartbeat_s = -_HEARTBEAT_S
        self._looked_s = -_REPORT_S
        self._running: list[_Running] = []
        self._publishing: list[_Publishing] = []
        self._aggregators: dict[str, Any] = {}  # by job

    def tick(self) -> None:
        """Take note of what ended, report what runs, start what waits."""
        now_s = time.monotonic()
        if now_s - self._heartbeat_s >= _HEARTBEAT_S:
            self._num_cpus = cluster.num_cpus()
            dispatcher = Dispatcher(self._id, socket.gethostname(), os.getpid(), code_version(), self._num_cpus)
            self._queue.heartbeat(dispatcher)
            self._heartbeat_s = now_s
        for running in list(self._running):
            self._follow(running, now_s)
        for publishing in list(self._publishing):
            self._end_job(publishing)
        if now_s - self._looked_s >= _REPORT_S:
            self._looked_s = now_s
            self._publish_manifests()
            self._claim_segments(now_s)
            self._drop_aggregators()

    def close(self) -> None:
        """Stop what runs and give it back: another dispatcher may have it at once."""
        with contextlib.suppress(ray.exceptions.RayError):  # a lost cluster has stopped it already
            self._stop_all()
        for running in self._running:
            with contextlib.suppress(StaleClaim):
                self._queue.release(running.claim)
        self._queue.sign_off(self._id)

    def _stop_all(self) -> None:
        for running in self._running:
            running.attempt.stop()
        deadline_s = time.monotonic() + _STOP_S
        while time.monotonic() < deadline_s and not all(running.attempt.is_ended for running in self._running):
            time.sleep(0.05)
        for running in self._running:
            running.attempt.kill()

    def _claim_segments(self, now_s: float) -> None:
        num_at_once = segments_at_once(self._num_cpus)
        while len(self._running) < num_at_once:
            claim = self._queue.claim_segment(self._id, _LEASE_S)
            if claim is None:
                return
            try:
                config = LabelingConfig.model_validate(claim.config)
            except ValidationError as error:  # a job that another version took in
                message = f"this version cannot use the job's parameters: {error.errors()[0]['msg']}"
                self._queue.finish(claim, SegmentState.FAILED, failure=Failure(error="InvalidInput", message=message))
                continue
            limits = plan_limits(self._num_cpus, num_at_once)
            assignment = Assignment(claim.dataset, claim.uri, claim.output_uri, config, limits)
            aggregator = self._aggregator(claim.job_id, claim.dataset, claim.output_uri, config)
            self._running.append(_Running(claim, Attempt(assignment, aggregator), now_s))
            _LOGGER.info("job %s: %s, attempt %d", claim.job_id, claim.uri, claim.attempt)

    def _follow(self, running: _Running, now_s: float) -> None:
        try:
            if running.attempt.is_ended:
                self._running.remove(running)
                self._settle(running)
            elif running.stopped_s is not None and now_s - running.stopped_s >= _STOP_S:
                running.attempt.kill()  # and with it what it started
            elif now_s - running.reported_s >= _REPORT_S:
                running.reported_s = now_s
                if self._report(running) and running.stopped_s is None:
                    running.stopped_s = now_s
                    running.attempt.stop()
        except StaleClaim as error:
            _LOGGER.warning("%s", error)
            running.attempt.kill()
            if running in self._running:
                self._running.remove(running)

    def _report(self, running: _Running) -> bool:
        """Tell the store how far a segment is, which keeps the lease; return whether its job is to stop."""
        progress = running.attempt.progress()
        if not progress.num_sweeps:
            return self._queue.renew(running.claim)
        return self._queue.report_progress(
            running.claim, progress.stage, progress.sweeps_done, progress.num_sweeps, progress.segment_id
        )

    def _settle(self, running: _Running) -> None:
        claim = running.claim
        try:
            outcome = running.attempt.outcome()
        except WorkerLost as error:
            if running.stopped_s is None:
                _LOGGER.warning("job %s: %s, attempt %d: %s", claim.job_id, claim.uri, claim.attempt, error)
                try:
                    cluster.require_health()
                except cluster.ClusterLost:
                    self._queue.release(claim)  # not the segment's fault: the attempt does not count
                    raise
                self._queue.release(claim, Failure(error="WorkerLost", message=str(error)))
                return
            outcome = None  # we killed it
        except LabelingError as error:
            entry = failed_entry(segment_id_of(claim.dataset, claim.uri), claim.uri, str(error))
            outcome = SegmentOutcome(entry, Failure(error=type(error).__name__, message=str(error)))
        if outcome is None:
            self._queue.release(claim)
            return
        entry = outcome.entry
        if entry.num_sweeps:
            self._queue.report_progress(claim, "done", entry.num_sweeps, entry.num_sweeps, entry.segment_id)
        self._queue.finish(claim, SegmentState(entry.state), failure=outcome.failure, entry=entry)
        _LOGGER.info("job %s: %s %s", claim.job_id, claim.uri, entry.state)

    def _publish_manifests(self) -> None:
        under_way = {publishing.job.job_id for publishing in self._publishing}
        for job in self._queue.list_finished_jobs():
            if job.job_id in under_way:
                continue
            entries = [
                result.entry
                if result.entry
                else _entry_without_labels(job.dataset, result.uri, result.state, result.failure)
                for result in self._queue.iterate_results(job.job_id)
            ]
            if any(entry.shards for entry in entries):
                config = LabelingConfig.model_validate(job.config)
                aggregator = self._aggregator(job.job_id, job.dataset, job.output_uri, config)
                self._publishing.append(_Publishing(job, aggregator.publish_manifest.remote(entries)))
            else:
                self._finish_job(job, None)

    def _end_job(self, publishing: _Publishing) -> None:
        if not ray.wait([publishing.written], timeout=0)[0]:
            return
        self._publishing.remove(publishing)
        failure = None
        try:
            ray.get(publishing.written)
        except ray.exceptions.RayTaskError as error:
            failure = Failure(
                error=type(error.cause).__name__, message=f"the manifest was not published: {error.cause}"
            )
        except ray.exceptions.RayError as error:
            _LOGGER.warning("job %s: publishing the manifest failed, again: %s", publishing.job.job_id, error)
            cluster.require_health()
            return  # the job is still listed as finished
        self._finish_job(publishing.job, failure)

    def _finish_job(self, job: FinishedJob, failure: Failure | None) -> None:
        try:
            state = self._queue.end_job(job, failure)
        except JobConflict as error:  # it was retried meanwhile
            _LOGGER.info("%s", error)
        else:
            _LOGGER.info("job %s: %s", job.job_id, state)

    def _aggregator(self, job_id: str, dataset: str, output_uri: str, config: LabelingConfig) -> Any:
        if job_id not in self._aggregators:
            self._aggregators[job_id] = _Aggregator.remote(dataset, output_uri, config)
        return self._aggregators[job_id]

    def _drop_aggregators(self) -> None:
        needed = {running.claim.job_id for running in self._running}
        needed |= {publishing.job.job_id for publishing in self._publishing}
        for job_id in self._aggregators.keys() - needed:
            del self._aggregators[job_id]  # it ends when nobody holds it


def _entry_without_labels(dataset: str, uri: str, state: SegmentState, failure: Failure | None) -> SegmentEntry:
    return failed_entry(segment_id_of(dataset, uri), uri, failure.message if failure else f"not labelled: {state}")


def dispatch(
    database_url: str,
    data_dir: Path,
    ray_address: str = "",
    num_workers: int | None = None,
    *,
    parent_pid: int | None = None,
) -> int:
    """Dispatch until SIGTERM or Ctrl-C, or until the parent is gone; return the exit code.

    Args:
        database_url: Of the job store.
        data_dir: Where a Ray of our own puts what memory does not hold.
        ray_address: Of a cluster to join; empty: start one here.
        num_workers: CPUs of the Ray started here, by default all; no say in a cluster that runs already.
        parent_pid: Of the process that must not be outlived; None: there is none.

    Raises:
        InvalidInput: The store or the cluster cannot be reached.

    """
    stop = _Stop(parent_pid)
    data_dir.mkdir(parents=True, exist_ok=True)
    database = open_database(database_url)
    context = (
        cluster.remote_cluster(ray_address)
        if ray_address
        else cluster.local_cluster(num_workers or len(os.sched_getaffinity(0)), data_dir / "spilled")
    )
    with context:
        stop.listen()  # again: Ray puts handlers of its own in place
        dispatcher = SegmentDispatcher(SegmentQueue(database))
        try:
            while not stop.is_asked:
                try:
                    dispatcher.tick()
                except DBAPIError as error:  # a store that stays away costs us our leases, and no labels
                    _LOGGER.warning("the job store does not answer: %s", str(error.orig).splitlines()[0])
                time.sleep(_TICK_S)
        finally:
            dispatcher.close()
    database.close()
    return 0


class _Stop:
    """Notes SIGTERM, Ctrl-C and the end of the parent. The handlers only set a flag: the main loop looks at it."""

    def __init__(self, parent_pid: int | None) -> None:
        self._parent_pid = parent_pid
        self._is_signalled = False
        self.listen()

    @property
    def is_asked(self) -> bool:
        """True when it is time to end. An orphan's parent is another process, whoever adopts it."""
        return self._is_signalled or self._parent_pid not in (None, os.getppid())

    def listen(self) -> None:
        """Put the handlers in place."""
        for number in (signal.SIGTERM, signal.SIGINT):
            signal.signal(number, self._note)

    def _note(self, *_: object) -> None:
        self._is_signalled = True


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the dispatcher as a process of its own."""
    parser = argparse.ArgumentParser(prog="python -m workers.dispatcher", description="Drive the Ray workers.")
    url = os.environ.get(URL_VARIABLE)
    parser.add_argument(
        "--database-url", default=url, required=not url, help=f"job store; with a password: {URL_VARIABLE}"
    )
    parser.add_argument("--data-dir", required=True, type=Path, help="where Ray puts what memory does not hold")
    parser.add_argument("--ray-address", default="", help="cluster to join; by default a local Ray is started")
    parser.add_argument("--workers", type=int, help="CPUs of the local Ray; by default all of this machine")
    parser.add_argument("--parent-pid", type=int, help="end when this process is our parent no more")
    options = parser.parse_args(arguments)
    return run(
        options.database_url, options.data_dir, options.ray_address, options.workers, parent_pid=options.parent_pid
    )


def run(
    database_url: str,
    data_dir: Path,
    ray_address: str,
    num_workers: int | None,
    *,
    parent_pid: int | None = None,
) -> int:
    """Dispatch as ``dispatch`` does, with its log on stderr and errors as a line of it."""
    logging.basicConfig(level=logging.INFO, format="%(asctime)s %(levelname)s %(name)s: %(message)s")
    try:
        return dispatch(database_url, data_dir, ray_address, num_workers, parent_pid=parent_pid)
    except (LabelingError, cluster.ClusterLost) as error:
        _LOGGER.error("%s", error)
        return 1


if __name__ == "__main__":
    sys.exit(main())
