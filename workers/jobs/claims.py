"""What a dispatcher asks of the job store: claim segments, report on them, end jobs."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, Final

from sqlalchemy import Connection, Select, delete, exists, insert, select, update

from schemas.api.jobs import Failure, JobState, SegmentState
from schemas.errors import JobConflict, StaleClaim
from schemas.manifest import SegmentEntry
from workers.jobs.database import Database, now_ms
from workers.jobs.rows import (
    OPEN_JOBS,
    OPEN_SEGMENTS,
    as_line,
    end_job,
    find_job,
    record_event,
    set_job_state,
    stop_job,
)
from workers.jobs.states import state_after_lost_attempt
from workers.jobs.tables import dispatchers, jobs, segments

MAX_ATTEMPTS: Final = 3  # claims of one segment in one generation of its job
_CANDIDATES: Final = 8  # jobs looked at for one claim, should other dispatchers empty the first ones meanwhile
_EXPIRED_ROWS: Final = 100  # handled in one transaction
_PAGE_ROWS: Final = 500
_DAY_MS: Final = 86_400_000
_FREE: Final[dict[str, Any]] = {"holder": None, "lease_ms": None}
_LOST: Final = Failure(error="ClaimantLost", message="its dispatcher went silent: killed, or cut off from the store")


@dataclass(frozen=True, slots=True)
class Claim:
    """One segment in one dispatcher's hands, until the lease ends."""

    job_id: str
    generation: int
    position: int
    fence: int
    lease_s: float
    attempt: int  # from 1
    dataset: str
    uri: str
    output_uri: str
    config: dict[str, Any]  # the resolved LabelingConfig, as JSON


@dataclass(frozen=True, slots=True)
class FinishedJob:
    """A job whose segments have all ended, before its manifest is published."""

    job_id: str
    generation: int
    dataset: str
    output_uri: str
    config: dict[str, Any]


@dataclass(frozen=True, slots=True)
class SegmentResult:
    """How a segment ended. ``entry`` is there when it has labels, and may be when it failed."""

    uri: str
    state: SegmentState
    failure: Failure | None
    entry: SegmentEntry | None


@dataclass(frozen=True, slots=True)
class Dispatcher:
    """Who claims. The id is new with each start of the process."""

    id: str
    host: str
    pid: int
    code_version: str
    num_workers: int


class SegmentQueue:
    """The dispatchers' door. Each method is one transaction, unless it says otherwise; any thread may call it."""

    def __init__(self, database: Database) -> None:
        self._database = database

    def claim_segment(self, holder: str, lease_s: float) -> Claim | None:
        """Take the next segment: highest priority, then oldest job, then order of URI. None: nothing waits.

        Calls ``expire`` first, in a transaction of its own.
        """
        self.expire()
        # Not EXISTS: PostgreSQL would join the jobs with every waiting segment there is (170 ms at a million, not 5).
        first_waiting = (
            select(segments.c.position)
            .where(segments.c.job_id == jobs.c.id, segments.c.state == SegmentState.QUEUED)
            .order_by(segments.c.position)
            .limit(1)
            .scalar_subquery()
        )
        candidates = (
            select(jobs.c.id)
            .where(jobs.c.state.in_((JobState.QUEUED, JobState.RUNNING)), first_waiting.is_not(None))
            .order_by(jobs.c.priority.desc(), jobs.c.created_ms, jobs.c.id)
            .limit(_CANDIDATES)
        )
        with self._database.write() as connection:
            for job_id in connection.scalars(candidates).all():
                claim = _claim_of_job(connection, job_id, holder, lease_s)
                if claim is not None:
                    return claim
        return None

    def renew(self, claim: Claim) -> bool:
        """Extend the lease; True when the job is to stop.

        Raises:
            StaleClaim: The segment is not the claimant's any more.

        """
        return self._update_held(claim)

    def report_progress(
        self, claim: Claim, stage: str, sweeps_done: int, num_sweeps: int, segment_id: str | None = None
    ) -> bool:
        """Say how far a segment is, and extend the lease; True when the job is to stop.

        Raises:
            StaleClaim: The segment is not the claimant's any more.

        """
        values = {"stage": stage, "sweeps_done": sweeps_done, "num_sweeps": num_sweeps}
        return self._update_held(claim, **values, **({"segment_id": segment_id} if segment_id else {}))

    def finish(
        self,
        claim: Claim,
        state: SegmentState,
        *,
        failure: Failure | None = None,
        entry: SegmentEntry | None = None,
    ) -> None:
        """End a segment: SUCCEEDED, PARTIAL, FAILED or CRASHED. See ``release`` for one that did not run to its end.

        Raises:
            StaleClaim: The segment is not the claimant's any more; nothing was changed.
            ValueError: Another state, labels without an entry, or a failure without a reason.

        """
        if state in (SegmentState.SUCCEEDED, SegmentState.PARTIAL):
            if entry is None:
                raise ValueError(f"a {state} segment needs its entry in the manifest")
        elif state not in (SegmentState.FAILED, SegmentState.CRASHED) or failure is None:
            raise ValueError(f"a segment cannot be finished as {state} with failure {failure}")
        with self._database.write() as connection:
            find_job(connection, claim.job_id, lock=True)
            now = now_ms(connection)
            values: dict[str, Any] = {"finished_ms": now, **_failure_columns(failure)}
            if entry is not None:
                values |= {"segment_id": entry.segment_id, "entry": entry.model_dump(mode="json")}
                if entry.num_sweeps:
                    values |= {"stage": "done", "sweeps_done": entry.num_sweeps, "num_sweeps": entry.num_sweeps}
            _update_claimed(connection, claim, state=state, **_FREE, **values)
            _record(connection, claim.job_id, claim.position, claim.attempt, state, now, failure)

    def release(self, claim: Claim, crash: Failure | None = None) -> SegmentState:
        """Give a segment back that did not run to its end, and return its new state.

        CANCELLED when its job is to stop. Else QUEUED; after a crash only while attempts are left, then CRASHED.
        Without a crash the attempt does not count.

        Raises:
            StaleClaim: The segment is not the claimant's any more.

        """
        with self._database.write() as connection:
            job = find_job(connection, claim.job_id, lock=True)
            attempts = claim.attempt if crash else claim.attempt - 1
            state = state_after_lost_attempt(attempts, MAX_ATTEMPTS, is_stopping=job.stop is not None)
            now = now_ms(connection)
            _update_claimed(connection, claim, attempts=attempts, **_lost_columns(state, now, crash))
            _record(connection, claim.job_id, claim.position, claim.attempt, state, now, crash)
        return state

    def expire(self) -> None:
        """Apply what time decides: stop jobs past their deadline, take back segments whose lease has run out.

        Whoever holds segments renews them first: after a pause, or a store that was away, they might be its own.
        """
        with self._database.write() as connection:
            now = now_ms(connection)
            is_late = (jobs.c.deadline_ms <= now) & jobs.c.stop.is_(None) & jobs.c.state.in_(OPEN_JOBS)
            late = select(jobs.c.id).where(is_late).limit(_EXPIRED_ROWS)
            for job_id in connection.scalars(late.with_for_update(skip_locked=True)).all():
                stop_job(connection, find_job(connection, job_id), JobState.TIMED_OUT, now)
            is_lost = segments.c.lease_ms <= now
            lost = select(segments.c.job_id).where(is_lost).order_by(segments.c.lease_ms).limit(_EXPIRED_ROWS)
            holders = select(jobs.c.id, jobs.c.stop).where(jobs.c.id.in_(set(connection.scalars(lost))))
            for job in connection.execute(holders.with_for_update(skip_locked=True)).all():
                of_job = select(segments.c.position, segments.c.attempts).where(segments.c.job_id == job.id, is_lost)
                for row in connection.execute(of_job).all():
                    state = state_after_lost_attempt(row.attempts, MAX_ATTEMPTS, is_stopping=job.stop is not None)
                    is_it = (segments.c.job_id == job.id) & (segments.c.position == row.position)
                    taken_back = update(segments).where(is_it, is_lost)  # once more: it may have just reported
                    if connection.execute(taken_back.values(**_lost_columns(state, now, _LOST))).rowcount:
                        _record(connection, job.id, row.position, row.attempts, state, now, _LOST)

    def list_finished_jobs(self, limit: int = 10) -> list[FinishedJob]:
        """Return open jobs without an open segment, oldest first: publish the manifest of each, then ``end_job``."""
        query = _finished_jobs().where(jobs.c.state.in_(OPEN_JOBS)).order_by(jobs.c.created_ms, jobs.c.id)
        with self._database.read() as connection:
            return [FinishedJob(*row) for row in connection.execute(query.limit(limit))]

    def find_finished_job(self, job_id: str) -> FinishedJob | None:
        """Return a job without an open segment, whether it has ended or not; None: it has one."""
        with self._database.read() as connection:
            row = connection.execute(_finished_jobs().where(jobs.c.id == job_id)).one_or_none()
        return None if row is None else FinishedJob(*row)

    def iterate_results(self, job_id: str) -> Iterator[SegmentResult]:
        """Yield how each ended segment of a job ended, sorted by URI; reads page by page, a transaction each."""
        columns = [segments.c[name] for name in ("position", "uri", "state", "error", "message", "entry")]
        query = select(*columns).where(segments.c.job_id == job_id, segments.c.state.not_in(OPEN_SEGMENTS))
        last = -1
        while True:
            page = query.where(segments.c.position > last).order_by(segments.c.position).limit(_PAGE_ROWS)
            with self._database.read() as connection:
                rows = connection.execute(page).all()
            for row in rows:
                failure = Failure(error=row.error, message=row.message) if row.error else None
                entry = SegmentEntry.model_validate(row.entry) if row.entry else None
                yield SegmentResult(row.uri, SegmentState(row.state), failure, entry)
            if len(rows) < _PAGE_ROWS:
                return
            last = rows[-1].position

    def end_job(self, job: FinishedJob, failure: Failure | None = None) -> JobState:
        """Put a job into its last state, which follows from its segments. Ending it twice changes nothing.

        With ``failure``, for a manifest that could not be published, the state is FAILED whatever the segments are.

        Raises:
            JobConflict: A segment is open, or the job was retried in between.

        """
        with self._database.write() as connection:
            row = find_job(connection, job.job_id, lock=True)
            if row.generation != job.generation:
                raise JobConflict(f"job {job.job_id} is in generation {row.generation}, not {job.generation}")
            state = JobState(row.state)
            return state if state.is_ended else end_job(connection, row, now_ms(connection), failure)

    def heartbeat(self, dispatcher: Dispatcher) -> None:
        """Say that a dispatcher lives; forget those that were silent for a day."""
        row = {name: getattr(dispatcher, name) for name in ("host", "pid", "code_version", "num_workers")}
        with self._database.write() as connection:
            now = now_ms(connection)
            known = update(dispatchers).where(dispatchers.c.id == dispatcher.id).values(heartbeat_ms=now, **row)
            if not connection.execute(known).rowcount:
                first = {"id": dispatcher.id, "started_ms": now, "heartbeat_ms": now}
                connection.execute(insert(dispatchers).values(**first, **row))
            connection.execute(delete(dispatchers).where(dispatchers.c.heartbeat_ms < now - _DAY_MS))

    def sign_off(self, dispatcher_id: str) -> None:
        """Take a dispatcher that stops in good order off the list."""
        with self._database.write() as connection:
            connection.execute(delete(dispatchers).where(dispatchers.c.id == dispatcher_id))

    def _update_held(self, claim: Claim, **values: Any) -> bool:
        with self._database.write() as connection:
            lease_ms = _lease_end_ms(connection, claim.lease_s)
            _update_claimed(connection, claim, lease_ms=lease_ms, **values)
            return connection.scalar(select(jobs.c.stop).where(jobs.c.id == claim.job_id)) is not None


def _finished_jobs() -> Select[Any]:
    columns = [jobs.c[name] for name in ("id", "generation", "dataset", "output_uri", "config")]
    is_open = exists().where(segments.c.job_id == jobs.c.id, segments.c.state.in_(OPEN_SEGMENTS))
    return select(*columns).where(~is_open)


def _claim_of_job(connection: Connection, job_id: str, holder: str, lease_s: float) -> Claim | None:
    job = connection.execute(select(jobs).where(jobs.c.id == job_id).with_for_update()).one()
    waiting = select(segments).where(segments.c.job_id == job_id, segments.c.state == SegmentState.QUEUED)
    segment = connection.execute(waiting.order_by(segments.c.position).limit(1)).one_or_none()
    if segment is None:  # another dispatcher was faster, or the job was stopped
        return None
    now = now_ms(connection)
    if job.state == JobState.QUEUED:
        set_job_state(connection, job, JobState.RUNNING, now, started_ms=now)
    connection.execute(
        update(segments)
        .where(segments.c.job_id == job_id, segments.c.position == segment.position)
        .values(
            state=SegmentState.RUNNING,
            attempts=segment.attempts + 1,
            fence=segment.fence + 1,
            holder=holder,
            queued_ms=None,
            lease_ms=_lease_end_ms(connection, lease_s),
            started_ms=now,
            stage=None,
            sweeps_done=0,
        )
    )
    _record(connection, job_id, segment.position, segment.attempts + 1, SegmentState.RUNNING, now, None)
    return Claim(
        job_id=job_id,
        generation=job.generation,
        position=segment.position,
        fence=segment.fence + 1,
        lease_s=lease_s,
        attempt=segment.attempts + 1,
        dataset=job.dataset,
        uri=segment.uri,
        output_uri=job.output_uri,
        config=job.config,
    )


def _lease_end_ms(connection: Connection, lease_s: float) -> int:
    return now_ms(connection) + round(1000 * lease_s)


def _update_claimed(connection: Connection, claim: Claim, **values: Any) -> None:
    is_held = (
        (segments.c.job_id == claim.job_id)
        & (segments.c.position == claim.position)
        & (segments.c.fence == claim.fence)
        & (segments.c.state == SegmentState.RUNNING)
    )
    if not connection.execute(update(segments).where(is_held).values(**values)).rowcount:
        raise StaleClaim(f"{claim.uri} of job {claim.job_id}: this claim ended, or its lease ran out; drop the result")


def _lost_columns(state: SegmentState, now: int, failure: Failure | None) -> dict[str, Any]:
    columns: dict[str, Any] = {"state": state, **_FREE}
    if state is SegmentState.QUEUED:
        return columns | {"queued_ms": now}
    return columns | {"finished_ms": now} | (_failure_columns(failure) if state is SegmentState.CRASHED else {})


def _failure_columns(failure: Failure | None) -> dict[str, str]:
    if failure is None:
        return {}
    return {"error": failure.error, "message": as_line(failure.message)}


def _record(
    connection: Connection,
    job_id: str,
    position: int,
    attempt: int,
    state: SegmentState,
    now: int,
    failure: Failure | None,
) -> None:
    detail = f"{failure.error}: {failure.message}" if failure else ""
    record_event(connection, job_id, state, now, position=position, attempt=attempt, detail=detail)
