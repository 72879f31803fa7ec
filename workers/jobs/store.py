"""What callers ask of the job store: submit, look, list, cancel, retry."""

import base64
import binascii
import hashlib
import json
import secrets
from collections.abc import Sequence
from typing import Any, Final

from sqlalchemy import Connection, Row, Select, and_, func, insert, or_, select, update
from sqlalchemy.exc import IntegrityError

from schemas.api.jobs import (
    JobPage,
    JobRequest,
    JobState,
    JobStatus,
    SegmentPage,
    SegmentState,
)
from schemas.api.status import ServiceStatus
from schemas.errors import InvalidInput, JobConflict, QueueFull
from workers.jobs.bodies import describe_dispatcher, describe_job, describe_jobs, describe_segment
from workers.jobs.database import Database, now_ms
from workers.jobs.rows import JOB_COLUMNS, OPEN_JOBS, OPEN_SEGMENTS, find_job, record_event, set_job_state, stop_job
from workers.jobs.states import RETRYABLE_SEGMENTS
from workers.jobs.tables import dispatchers, jobs, segments

MAX_PAGE_SIZE: Final = 200
_INSERT_ROWS: Final = 1000
_HOUR_MS: Final = 3_600_000
_DAY_MS: Final = 24 * _HOUR_MS
_MOMENTS: Final = range(2**63)  # that a BigInteger holds
_POSITIONS: Final = range(2**31)  # that an Integer holds
_LABELLED: Final = (SegmentState.SUCCEEDED, SegmentState.PARTIAL)
_LOST: Final = (SegmentState.FAILED, SegmentState.CRASHED)


class JobStore:
    """The callers' door. Each method is one transaction; any thread may call it."""

    def __init__(self, database: Database, *, sees: str | None = None, max_open_segments: int | None = None) -> None:
        """Take the owner whose jobs are all that there is behind this door, and how much one owner may have open.

        None: the jobs of all owners; without a limit.
        """
        self._database = database
        self._sees = sees
        self._max_open_segments = max_open_segments

    def submit(self, request: JobRequest, *, owner: str = "") -> JobStatus:
        """Queue a job. A request that its owner submitted already under its ``client_job_id`` returns that job.

        ``owner`` is whoever submits it, empty when nobody was asked.

        Raises:
            JobConflict: Another request of this owner has this ``client_job_id``.
            QueueFull: The owner would have more open segments than one may.

        """
        fingerprint = _fingerprint(request)
        job_id = secrets.token_hex(8)
        try:
            with self._database.write() as connection:
                earlier = _find_earlier(connection, request, fingerprint, owner)
                if earlier is None:
                    self._require_room(connection, owner, len(request.segments))
                    _insert_job(connection, job_id, request, fingerprint, owner)
                return describe_job(connection, earlier or job_id)
        except IntegrityError:  # PostgreSQL: the same request came in at the same moment, and was first
            with self._database.read() as connection:
                earlier = _find_earlier(connection, request, fingerprint, owner)
                if earlier is None:
                    raise
                return describe_job(connection, earlier)

    def get_job(self, job_id: str) -> JobStatus:
        """Return a job as it stands.

        Raises:
            JobNotFound: There is none.

        """
        with self._database.read() as connection:
            return describe_job(connection, job_id, owner=self._sees)

    def list_jobs(
        self,
        *,
        state: JobState | None = None,
        dataset: str | None = None,
        page_size: int = 50,
        page_token: str | None = None,
    ) -> JobPage:
        """Return a page of jobs, newest first; ``page_token`` continues from an earlier page.

        Raises:
            InvalidInput: A page size out of bounds, or a token that no listing returned.

        """
        _check_page_size(page_size)
        query = self._select_jobs(*JOB_COLUMNS).order_by(jobs.c.created_ms.desc(), jobs.c.id.desc())
        if state is not None:
            query = query.where(jobs.c.state == state)
        if dataset is not None:
            query = query.where(jobs.c.dataset == dataset)
        if page_token is not None:
            created, job_id = _read_token(page_token, _MOMENTS, None)
            older = jobs.c.created_ms < created
            query = query.where(or_(older, and_(jobs.c.created_ms == created, jobs.c.id < job_id)))
        with self._database.read() as connection:
            rows = connection.execute(query.limit(page_size + 1)).all()
            last = rows[page_size - 1] if len(rows) > page_size else None
            return JobPage(
                jobs=tuple(describe_jobs(connection, rows[:page_size])),
                next_page_token=_make_token(last.created_ms, last.id) if last else None,
            )

    def list_segments(
        self,
        job_id: str,
        *,
        state: SegmentState | None = None,
        page_size: int = 50,
        page_token: str | None = None,
    ) -> SegmentPage:
        """Return a page of a job's segments, sorted by URI.

        Raises:
            JobNotFound: There is no such job.
            InvalidInput: A page size out of bounds, or a token that no listing returned.

        """
        _check_page_size(page_size)
        columns = [column for column in segments.c if column.name != "entry"]
        query = select(*columns).where(segments.c.job_id == job_id).order_by(segments.c.position)
        if state is not None:
            query = query.where(segments.c.state == state)
        if page_token is not None:
            query = query.where(segments.c.position > _read_token(page_token, _POSITIONS)[0])
        with self._database.read() as connection:
            find_job(connection, job_id, owner=self._sees)
            rows = connection.execute(query.limit(page_size + 1)).all()
        is_more = len(rows) > page_size
        return SegmentPage(
            segments=tuple(describe_segment(row) for row in rows[:page_size]),
            next_page_token=_make_token(rows[page_size - 1].position) if is_more else None,
        )

    def request_cancel(self, job_id: str) -> JobStatus:
        """Cancel what waits and tell what runs to stop. Asking again changes nothing.

        Raises:
            JobNotFound: There is no such job.
            JobConflict: It has ended otherwise.

        """
        with self._database.write() as connection:
            job = find_job(connection, job_id, owner=self._sees, lock=True)
            state = JobState(job.state)
            if state.is_ended and state is not JobState.CANCELLED:
                raise JobConflict(f"job {job_id} has ended {state}: there is nothing to cancel")
            if not state.is_ended and job.stop is None:
                stop_job(connection, job, JobState.CANCELLED, now_ms(connection))
            return describe_job(connection, job_id)

    def retry_failed(self, job_id: str) -> JobStatus:
        """Queue the segments of an ended job that have no labels once more; its deadline starts again.

        Raises:
            JobNotFound: There is no such job.
            JobConflict: It has not ended, or every segment has labels.
            QueueFull: As ``submit``.

        """
        with self._database.write() as connection:
            job = find_job(connection, job_id, owner=self._sees, lock=True)
            if not JobState(job.state).is_ended:
                raise JobConflict(f"job {job_id} is {job.state}: wait until it has ended, or cancel it")
            now = now_ms(connection)
            reopened = connection.execute(
                update(segments)
                .where(segments.c.job_id == job_id, segments.c.state.in_(RETRYABLE_SEGMENTS))
                .values(**_fresh_segment(now))
            ).rowcount
            self._require_room(connection, job.owner, reopened)  # the job is not open yet, so these are not counted
            is_unpublished = job.state == JobState.FAILED and not reopened  # labels everywhere, but no manifest
            if not reopened and not is_unpublished:
                raise JobConflict(f"job {job_id}: every segment has labels, there is nothing to retry")
            set_job_state(
                connection,
                job,
                JobState.RUNNING if is_unpublished else JobState.QUEUED,
                now,
                detail=f"generation {job.generation + 1}; segments that wait again: {reopened}",
                stop=None,
                generation=job.generation + 1,
                num_kept=job.num_segments - reopened,
                deadline_ms=_deadline_ms(job.deadline_s, now),
                started_ms=now if is_unpublished else None,
                finished_ms=None,
                failure=None,
            )
            return describe_job(connection, job_id)

    def status(self) -> ServiceStatus:
        """Return the service's state in numbers, counted by the database.

        Jobs and failures are those behind this door; queue, pace and dispatchers are the whole service's.
        """
        is_queued, is_running = segments.c.queued_ms.is_not(None), segments.c.lease_ms.is_not(None)
        with self._database.read() as connection:
            now = now_ms(connection)
            by_state = self._select_jobs(jobs.c.state, func.count()).group_by(jobs.c.state)
            job_counts: dict[str, int] = dict(connection.execute(by_state).all())
            queue = connection.execute(select(func.count(), func.min(segments.c.queued_ms)).where(is_queued)).one()
            stages = connection.execute(
                select(segments.c.stage, func.count()).where(is_running).group_by(segments.c.stage)
            ).all()
            by_stage = {stage or "starting": count for stage, count in stages}
            done = connection.execute(
                select(
                    func.count().label("segments"),
                    func.coalesce(func.sum(segments.c.sweeps_done), 0).label("sweeps"),
                    func.min(segments.c.started_ms).label("first_start"),
                    func.max(segments.c.finished_ms).label("last_end"),
                ).where(segments.c.finished_ms > now - _HOUR_MS, segments.c.state.in_(_LABELLED))
            ).one()
            failures = self._read_failures(connection, now)
            latest = select(dispatchers).order_by(dispatchers.c.heartbeat_ms.desc()).limit(MAX_PAGE_SIZE)
            return ServiceStatus(
                jobs={state: job_counts.get(state, 0) for state in JobState},
                queued_segments=queue[0],
                running_segments=sum(by_stage.values()),
                oldest_queued_age_s=None if queue[1] is None else max(0, now - queue[1]) / 1000,
                running_by_stage=by_stage,
                segments_per_hour=done.segments,
                sweeps_per_hour=int(done.sweeps),
                measured_s=_measured_s(done, now, is_going_on=bool(by_stage)),
                failures_by_error={row.error: row.segments for row in failures},
                last_failed_job_by_error=self._find_last_failed(connection, failures),
                dispatchers=tuple(describe_dispatcher(row, now) for row in connection.execute(latest)),
            )

    def _require_room(self, connection: Connection, owner: str, num_more: int = 0) -> None:
        """Refuse what would give an owner too many open segments. Two requests at one moment may pass it by one."""
        if self._max_open_segments is None:
            return
        is_open = (jobs.c.owner == owner) & jobs.c.state.in_(OPEN_JOBS)
        num_submitted = connection.scalar(select(func.sum(jobs.c.num_segments)).where(is_open)) or 0
        if num_submitted + num_more <= self._max_open_segments:  # quickly said, and mostly enough
            return
        of_jobs = select(func.count()).select_from(jobs).join(segments)
        num_open = connection.scalar(of_jobs.where(is_open, segments.c.state.in_(OPEN_SEGMENTS))) or 0
        if num_open + num_more > self._max_open_segments:
            raise QueueFull(
                f"{num_open + num_more} segments would wait or run, {num_open} without this request, and one owner may "
                f"have {self._max_open_segments} (MOTIONLABEL_MAX_OPEN_SEGMENTS): wait until some have ended, or cancel"
            )

    def _select_jobs(self, *columns: Any) -> Select[Any]:
        return select(*columns) if self._sees is None else select(*columns).where(jobs.c.owner == self._sees)

    def _select_lost(self, *columns: Any) -> Select[Any]:
        """Select from the segments that failed; the database looks at their end first, and at few jobs."""
        query = select(*columns).where(segments.c.state.in_(_LOST))
        return query if self._sees is None else query.join(jobs).where(jobs.c.owner == self._sees)

    def _read_failures(self, connection: Connection, now: int) -> Sequence[Row[Any]]:
        """Return the segments that failed in the last day, counted by error, each with the moment of its latest."""
        last_ms = func.max(segments.c.finished_ms).label("last_ms")
        query = self._select_lost(segments.c.error, func.count().label("segments"), last_ms)
        return connection.execute(query.where(segments.c.finished_ms > now - _DAY_MS).group_by(segments.c.error)).all()

    def _find_last_failed(self, connection: Connection, failures: Sequence[Row[Any]]) -> dict[str, str]:
        """Return the job of the latest segment of each error; of several at one moment, the one that sorts last."""
        last_ms = {row.error: row.last_ms for row in failures}
        query = self._select_lost(segments.c.error, segments.c.finished_ms, segments.c.job_id)
        at_last = query.where(segments.c.finished_ms.in_(last_ms.values())).order_by(segments.c.job_id)
        found = connection.execute(at_last)
        return {row.error: row.job_id for row in found if row.finished_ms == last_ms.get(row.error)}


def _measured_s(done: Row[Any], now: int, *, is_going_on: bool) -> float | None:
    if done.last_end is None:
        return None
    return max(0, (now if is_going_on else done.last_end) - max(done.first_start, now - _HOUR_MS)) / 1000


def _fingerprint(request: JobRequest) -> str:
    """Return a digest that says whether two requests are the same; a value left out is its default."""
    text = json.dumps(request.model_dump(mode="json", exclude_defaults=True), sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()


def _find_earlier(connection: Connection, request: JobRequest, fingerprint: str, owner: str) -> str | None:
    if request.client_job_id is None:
        return None
    query = select(jobs.c.id, jobs.c.fingerprint).where(jobs.c.client_job_id == request.client_job_id)
    earlier = connection.execute(query.where(jobs.c.owner == owner)).one_or_none()
    if earlier is None:
        return None
    if earlier.fingerprint != fingerprint:
        raise JobConflict(f"client_job_id {request.client_job_id} is job {earlier.id}, which asks for something else")
    return str(earlier.id)


def _insert_job(connection: Connection, job_id: str, request: JobRequest, fingerprint: str, owner: str) -> None:
    now = now_ms(connection)
    connection.execute(
        insert(jobs).values(
            id=job_id,
            client_job_id=request.client_job_id,
            owner=owner,
            fingerprint=fingerprint,
            dataset=request.dataset,
            output_uri=request.output_uri,
            profile=request.profile,
            config=request.make_config().model_dump(mode="json"),
            priority=request.priority,
            deadline_s=request.deadline_s,
            num_segments=len(request.segments),
            state=JobState.QUEUED,
            generation=1,
            num_kept=0,
            created_ms=now,
            deadline_ms=_deadline_ms(request.deadline_s, now),
        )
    )
    uris = sorted(request.segments)
    for start in range(0, len(uris), _INSERT_ROWS):
        rows = [
            {"job_id": job_id, "position": start + i, "uri": uri, "fence": 0, **_fresh_segment(now)}
            for i, uri in enumerate(uris[start : start + _INSERT_ROWS])
        ]
        connection.execute(insert(segments), rows)
    record_event(connection, job_id, JobState.QUEUED, now, detail=f"segments that wait: {len(uris)}")


def _fresh_segment(now: int) -> dict[str, Any]:
    fresh: dict[str, Any] = {"state": SegmentState.QUEUED, "attempts": 0, "sweeps_done": 0, "queued_ms": now}
    empty = ("holder", "lease_ms", "stage", "num_sweeps", "started_ms", "finished_ms", "error", "message", "entry")
    return fresh | dict.fromkeys(empty)


def _deadline_ms(deadline_s: float | None, now: int) -> int | None:
    return None if deadline_s is None else now + round(1000 * deadline_s)


def _check_page_size(page_size: int) -> None:
    if not 1 <= page_size <= MAX_PAGE_SIZE:
        raise InvalidInput(f"page_size must be 1 to {MAX_PAGE_SIZE}, got {page_size}")


def _make_token(*key: int | str) -> str:
    return base64.urlsafe_b64encode(json.dumps(key).encode()).decode().rstrip("=")


def _read_token(token: str, *bounds: range | None) -> list[Any]:
    """Return what a token was made of: numbers within bounds that the database knows, and, where None, an id."""
    try:
        key = json.loads(base64.urlsafe_b64decode(token + "=" * (-len(token) % 4)))
    except (binascii.Error, ValueError, RecursionError):
        key = None
    if not isinstance(key, list) or len(key) != len(bounds) or not all(map(_is_key, key, bounds)):
        raise InvalidInput(f"page_token {token[:80]!r} is not one that this listing returned")
    return key


def _is_key(part: object, bounds: range | None) -> bool:
    if bounds is None:
        return isinstance(part, str) and part.isalnum()
    return type(part) is int and part in bounds
