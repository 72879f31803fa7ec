"""Rows of the job store as bodies of the REST API."""

from collections.abc import Sequence
from datetime import UTC, datetime
from typing import Any

from sqlalchemy import Connection, Row, func, select

from schemas.api.jobs import Failure, JobEvent, JobState, JobStatus, SegmentState, SegmentStatus
from schemas.api.status import DispatcherStatus
from workers.jobs.database import now_ms
from workers.jobs.rows import count_segments, find_job
from workers.jobs.tables import segments


def describe_job(connection: Connection, job_id: str, *, owner: str | None = None) -> JobStatus:
    """Return the body of one job.

    Raises:
        JobNotFound: As ``find_job``.

    """
    return describe_jobs(connection, [find_job(connection, job_id, owner=owner)])[0]


def describe_jobs(connection: Connection, rows: Sequence[Row[Any]]) -> list[JobStatus]:
    """Return the bodies of jobs whose rows are at hand; the segments of all are counted together."""
    job_ids = [row.id for row in rows]
    counts = count_segments(connection, job_ids)
    in_part = (
        select(segments.c.job_id, func.sum(1.0 * segments.c.sweeps_done / segments.c.num_sweeps))
        .where(segments.c.job_id.in_(job_ids), segments.c.state == SegmentState.RUNNING, segments.c.num_sweeps > 0)
        .group_by(segments.c.job_id)
    )
    sums: dict[str, float] = dict(connection.execute(in_part).all())
    now = now_ms(connection)
    statuses = []
    for row in rows:
        num_ended = sum(count for state, count in counts[row.id].items() if state.is_ended)
        num_done = num_ended - counts[row.id][SegmentState.CANCELLED] + float(sums.get(row.id, 0))
        statuses.append(
            JobStatus(
                id=row.id,
                state=JobState(row.state),
                dataset=row.dataset,
                output_uri=row.output_uri,
                profile=row.profile,
                priority=row.priority,
                client_job_id=row.client_job_id,
                owner=row.owner,
                generation=row.generation,
                cancel_requested=row.stop == JobState.CANCELLED,
                num_segments=row.num_segments,
                segments=counts[row.id],
                progress=min(1.0, num_done / row.num_segments),
                eta_s=_estimate_remaining_s(row, num_done, now),
                created_at=_moment(row.created_ms),
                deadline_at=_moment_or_none(row.deadline_ms),
                started_at=_moment_or_none(row.started_ms),
                finished_at=_moment_or_none(row.finished_ms),
                failure=Failure.model_validate(row.failure) if row.failure else None,
            )
        )
    return statuses


def _estimate_remaining_s(row: Row[Any], num_done: float, now: int) -> float | None:
    if row.state != JobState.RUNNING or num_done <= row.num_kept:
        return None
    elapsed_s = max(0, now - row.started_ms) / 1000
    return elapsed_s * (row.num_segments - num_done) / (num_done - row.num_kept)


def describe_segment(row: Row[Any]) -> SegmentStatus:
    """Return the body of one row of ``segments``."""
    return SegmentStatus(
        position=row.position,
        uri=row.uri,
        segment_id=row.segment_id,
        state=SegmentState(row.state),
        attempts=row.attempts,
        stage=row.stage,
        sweeps_done=row.sweeps_done,
        num_sweeps=row.num_sweeps,
        started_at=_moment_or_none(row.started_ms),
        finished_at=_moment_or_none(row.finished_ms),
        failure=Failure(error=row.error, message=row.message) if row.error else None,
    )


def describe_event(row: Row[Any]) -> JobEvent:
    """Return the body of one row of ``events``."""
    return JobEvent(
        sequence=row.sequence,
        at=_moment(row.at_ms),
        kind="job" if row.position is None else "segment",
        position=row.position,
        state=row.state,
        attempt=row.attempt,
        detail=row.detail,
    )


def describe_dispatcher(row: Row[Any], now: int) -> DispatcherStatus:
    """Return the body of one row of ``dispatchers``."""
    return DispatcherStatus(
        id=row.id,
        host=row.host,
        pid=row.pid,
        code_version=row.code_version,
        num_workers=row.num_workers,
        started_at=_moment(row.started_ms),
        heartbeat_age_s=max(0, now - row.heartbeat_ms) / 1000,
    )


def _moment(time_ms: int) -> datetime:
    return datetime.fromtimestamp(time_ms / 1000, UTC)


def _moment_or_none(time_ms: int | None) -> datetime | None:
    return None if time_ms is None else _moment(time_ms)
