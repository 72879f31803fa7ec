"""Statements on jobs that both doors of the store need. Each runs inside its caller's transaction.

Whoever changes a segment's state from outside, or reads whether its job is to stop, locks the job first and the segment
second. PostgreSQL then neither deadlocks nor lets a segment slip back into the queue of a job that was just stopped;
SQLite has one writer at a time anyway.
"""

from collections.abc import Collection, Mapping
from typing import Any, Final

from sqlalchemy import Connection, Row, delete, func, insert, select, update

from schemas.api.jobs import Failure, JobState, SegmentState
from schemas.errors import JobConflict, JobNotFound
from workers.jobs.states import JOB_TRANSITIONS, end_of_job
from workers.jobs.tables import events, jobs, segments

OPEN_JOBS: Final = tuple(state for state in JobState if not state.is_ended)
OPEN_SEGMENTS: Final = tuple(state for state in SegmentState if not state.is_ended)
MAX_EVENTS: Final = 50_000  # of one job: two attempts at each segment of the largest, with room to spare
_MAX_TEXT: Final = 2000

JOB_COLUMNS: Final = [column for column in jobs.c if column.name not in ("config", "fingerprint")]


def find_job(connection: Connection, job_id: str, *, owner: str | None = None, lock: bool = False) -> Row[Any]:
    """Return a job's row without its config; locked until the transaction ends when asked.

    Raises:
        JobNotFound: There is none, or none of this owner where one is named.

    """
    query = select(*JOB_COLUMNS).where(jobs.c.id == job_id)
    if owner is not None:
        query = query.where(jobs.c.owner == owner)
    row = connection.execute(query.with_for_update() if lock else query).one_or_none()
    if row is None:
        raise JobNotFound(f"no job {job_id}")
    return row


def count_segments(connection: Connection, job_ids: Collection[str]) -> dict[str, dict[SegmentState, int]]:
    """Return how many segments of each job are in each state; states without any count zero."""
    counts = {job_id: dict.fromkeys(SegmentState, 0) for job_id in job_ids}
    query = (
        select(segments.c.job_id, segments.c.state, func.count())
        .where(segments.c.job_id.in_(job_ids))
        .group_by(segments.c.job_id, segments.c.state)
    )
    for job_id, state, count in connection.execute(query):
        counts[job_id][SegmentState(state)] = count
    return counts


def record_event(
    connection: Connection,
    job_id: str,
    state: JobState | SegmentState,
    now: int,
    *,
    position: int | None = None,
    attempt: int | None = None,
    detail: str = "",
) -> None:
    """Record what happened to a locked job, or to its segment at ``position``; the job keeps its newest events only.

    The lock is what lets numbers have no gaps, and be seen in their order.
    """
    newest = select(func.coalesce(func.max(events.c.sequence), 0)).where(events.c.job_id == job_id).scalar_subquery()
    event = {"state": state, "at_ms": now, "position": position, "attempt": attempt, "detail": as_line(detail) or None}
    added = insert(events).values(job_id=job_id, sequence=newest + 1, **event)
    sequence = connection.execute(added.returning(events.c.sequence)).scalar_one()
    if sequence > MAX_EVENTS:
        is_old = (events.c.job_id == job_id) & (events.c.sequence <= sequence - MAX_EVENTS)
        connection.execute(delete(events).where(is_old))


def as_line(text: str) -> str:
    """Return a text as a line that any database takes: no NUL, no half of a pair of characters."""
    return " ".join(text.replace("\0", "").encode(errors="replace").decode().split())[:_MAX_TEXT]


def set_job_state(
    connection: Connection, job: Row[Any], target: JobState, now: int, *, detail: str = "", **values: Any
) -> None:
    """Move a locked job to ``target``, set further columns and record it.

    Raises:
        JobConflict: The transition is not allowed.

    """
    if target not in JOB_TRANSITIONS[JobState(job.state)]:
        raise JobConflict(f"job {job.id} is {job.state} and cannot become {target}")
    connection.execute(update(jobs).where(jobs.c.id == job.id).values(state=target, **values))
    record_event(connection, job.id, target, now, detail=detail)


def stop_job(connection: Connection, job: Row[Any], stop: JobState, now: int) -> None:
    """Cancel what waits of a locked, open job, and tell what runs to stop; ``stop`` is CANCELLED or TIMED_OUT."""
    num_waiting = connection.execute(
        update(segments)
        .where(segments.c.job_id == job.id, segments.c.state == SegmentState.QUEUED)
        .values(state=SegmentState.CANCELLED, queued_ms=None, finished_ms=now)
    ).rowcount
    connection.execute(update(jobs).where(jobs.c.id == job.id).values(stop=stop))
    if job.state == JobState.QUEUED:  # nothing ran, so there is nothing to publish
        end_job(connection, find_job(connection, job.id), now)
    else:
        detail = f"to become {stop}; segments that waited and are CANCELLED: {num_waiting}"
        set_job_state(connection, job, JobState.CANCELLING, now, detail=detail)


def end_job(connection: Connection, job: Row[Any], now: int, failure: Failure | None = None) -> JobState:
    """Put a locked job whose segments have all ended into its last state: FAILED when ``failure`` is given.

    Raises:
        JobConflict: A segment is open.

    """
    counts = count_segments(connection, [job.id])[job.id]
    end = end_of_job(counts, JobState(job.stop) if job.stop else None)
    if end is None:
        raise JobConflict(f"job {job.id} cannot end: some of its segments are still open")
    if failure is None:
        failure = _explain(connection, job, end, counts)
    else:
        end = JobState.FAILED
    values = {"finished_ms": now, "failure": failure and failure.model_dump()}
    set_job_state(connection, job, end, now, detail=failure.message if failure else "", **values)
    return end


def _explain(
    connection: Connection, job: Row[Any], end: JobState, counts: Mapping[SegmentState, int]
) -> Failure | None:
    if end is JobState.TIMED_OUT:
        num_labelled = counts[SegmentState.SUCCEEDED] + counts[SegmentState.PARTIAL]
        return Failure(
            error="DeadlineExceeded",
            message=f"{num_labelled} of {job.num_segments} segments were labelled within {job.deadline_s:g} s",
        )
    lost = (SegmentState.FAILED, SegmentState.CRASHED)
    num_lost = sum(counts[state] for state in lost)
    if not num_lost:
        return None
    first = connection.execute(
        select(segments.c.uri, segments.c.error, segments.c.message)
        .where(segments.c.job_id == job.id, segments.c.state.in_(lost))
        .order_by(segments.c.position)
        .limit(1)
    ).one()
    message = f"{num_lost} of {job.num_segments} segments have no labels; the first is {first.uri}: {first.message}"
    return Failure(error=first.error, message=message)
