"""From records of the job store to what the pages say. Pure functions: times are told by the records alone."""

from collections.abc import Mapping
from dataclasses import dataclass
from datetime import datetime
from enum import StrEnum
from typing import Final, TypeVar
from urllib.parse import urlencode

from schemas.api.jobs import Failure, JobState, JobStatus, SegmentState, SegmentStatus
from schemas.api.status import DispatcherStatus, ServiceStatus
from service.dashboard import words
from service.dashboard.words import Advice
from workers.jobs.claims import MAX_ATTEMPTS
from workers.jobs.states import RETRYABLE_SEGMENTS

S = TypeVar("S", JobState, SegmentState)
_LABELLED: Final = (SegmentState.SUCCEEDED, SegmentState.PARTIAL)
_LOST: Final = (SegmentState.FAILED, SegmentState.CRASHED)
_UNKNOWN: Final = "unknown"


@dataclass(frozen=True, slots=True)
class Figure:
    """One number of the service, and what stands behind it."""

    name: str
    value: str
    note: str


@dataclass(frozen=True, slots=True)
class Choice:
    """One filter of a list, with how many it leaves."""

    name: str
    count: int
    url: str
    is_current: bool


@dataclass(frozen=True, slots=True)
class Pager:
    """Ways to other pages of a list; None: there is no such page."""

    first_url: str | None
    next_url: str | None


@dataclass(frozen=True, slots=True)
class Reason:
    """Why segments failed."""

    error: str
    num_segments: int
    last_job_id: str | None
    advice: Advice


@dataclass(frozen=True, slots=True)
class DispatcherRow:
    """One dispatcher."""

    name: str  # host and process id
    cpus: str
    started_at: datetime
    sign: str  # of life
    is_fresh: bool


@dataclass(frozen=True, slots=True)
class JobRow:
    """One job."""

    job: JobStatus
    meaning: str
    percent: int | None  # None: it has ended
    done: str  # how many of its segments
    time: str  # that it took, or that is left
    retries: str
    advice: Advice | None
    can_cancel: bool
    can_retry: bool


@dataclass(frozen=True, slots=True)
class SegmentRow:
    """One segment of a job."""

    segment: SegmentStatus
    attempts: str
    progress: str  # or the time it took
    percent: int | None  # None: nothing to measure
    advice: Advice | None


def figures(status: ServiceStatus) -> tuple[Figure, ...]:
    """Return the numbers at the head of the overview."""
    num_fresh = sum(dispatcher.is_fresh for dispatcher in status.dispatchers)
    age_s = status.oldest_queued_age_s
    stages = ", ".join(f"{count:,} in {stage}" for stage, count in sorted(status.running_by_stage.items()))
    return (
        Figure(
            "Segments waiting",
            f"{status.queued_segments:,}",
            "the queue is empty" if age_s is None else f"the oldest for {words.duration(age_s)}",
        ),
        Figure("Segments running", f"{status.running_segments:,}", stages or "nothing is at work"),
        Figure(
            "Segments done",
            f"{status.segments_per_hour:,}",
            f"in the last hour, with {words.count(status.sweeps_per_hour, 'sweep')}",
        ),
        _figure_of_time_left(time_left_s(status)),
        _figure_of_cost(core_s_per_sweep(status)),
        Figure("CPUs", f"{count_cpus(status):,}", f"of {words.count(num_fresh, 'dispatcher')}"),
    )


def _figure_of_time_left(seconds: float | None) -> Figure:
    name = "All done in"
    if seconds is None:
        return Figure(name, _UNKNOWN, "no segment ended lately")
    if seconds == 0:
        return Figure(name, "no work", "nothing waits or runs")
    return Figure(name, words.duration(seconds), "at the last hour's pace")


def _figure_of_cost(core_s: float | None) -> Figure:
    name = "Core-seconds a sweep"
    if core_s is None:
        return Figure(name, _UNKNOWN, "no sweep was labelled lately")
    return Figure(name, words.amount(core_s), "of all CPUs, idle ones too")


def count_cpus(status: ServiceStatus) -> int:
    """Return the CPUs of the dispatchers that have reported lately."""
    return sum(dispatcher.num_workers for dispatcher in status.dispatchers if dispatcher.is_fresh)


def time_left_s(status: ServiceStatus) -> float | None:
    """Return the seconds until all that waits or runs is done at the last hour's pace; None: there was none."""
    num_open = status.queued_segments + status.running_segments
    if not num_open:
        return 0.0
    if not (status.segments_per_hour and status.measured_s):
        return None
    return num_open * status.measured_s / status.segments_per_hour


def core_s_per_sweep(status: ServiceStatus) -> float | None:
    """Return what a sweep of the last hour cost: the time of all CPUs that dispatchers have now, idle ones too."""
    num_cpus = count_cpus(status)
    if not (num_cpus and status.sweeps_per_hour and status.measured_s):
        return None
    return num_cpus * status.measured_s / status.sweeps_per_hour


def warning(status: ServiceStatus) -> str | None:
    """Return what keeps the whole service from working; None: nothing does."""
    if any(dispatcher.is_fresh for dispatcher in status.dispatchers):
        return None
    waiting = "Jobs wait" if status.queued_segments or status.running_segments else "Jobs would wait"
    return f"No dispatcher has reported lately. {waiting} until one runs: motionlabel serve, or motionlabel dispatch."


def reasons(status: ServiceStatus) -> tuple[Reason, ...]:
    """Return why segments failed in the last day, most frequent first."""
    ranked = sorted(status.failures_by_error.items(), key=lambda item: (-item[1], item[0]))
    last = status.last_failed_job_by_error
    return tuple(Reason(error, number, last.get(error), words.advise(error)) for error, number in ranked)


def describe_dispatcher(dispatcher: DispatcherStatus) -> DispatcherRow:
    """Return what the list of workers says of a dispatcher."""
    is_fresh = dispatcher.is_fresh
    return DispatcherRow(
        name=f"{dispatcher.host}, process {dispatcher.pid}",
        cpus=words.count(dispatcher.num_workers, "CPU"),
        started_at=dispatcher.started_at,
        sign="reports" if is_fresh else f"silent for {words.duration(dispatcher.heartbeat_age_s)}",
        is_fresh=is_fresh,
    )


def describe_job(job: JobStatus) -> JobRow:
    """Return what lists, and a job's own page, say of it."""
    counts = job.segments
    num_lost = sum(counts[state] for state in _LOST)
    done = f"{sum(counts[state] for state in _LABELLED):,} of {words.count(job.num_segments, 'segment')}"
    # All labelled, but not published: FAILED without a segment to retry.
    has_work = any(counts[state] for state in RETRYABLE_SEGMENTS) or job.state is JobState.FAILED
    return JobRow(
        job=job,
        meaning=words.meaning(job.state),
        percent=None if job.state.is_ended else int(100 * job.progress),
        done=done + (f", {num_lost:,} failed" if num_lost else ""),
        time=_time_of_job(job),
        retries=words.count(job.generation - 1, "time") if job.generation > 1 else "",
        advice=_advise(job.failure),
        can_cancel=job.state in (JobState.QUEUED, JobState.RUNNING),
        can_retry=job.state.is_ended and has_work,
    )


def describe_segment(segment: SegmentStatus) -> SegmentRow:
    """Return what a job's page says of one of its segments."""
    sweeps = f"{segment.sweeps_done:,} of {words.count(segment.num_sweeps or 0, 'sweep')}"
    is_measured = segment.state is SegmentState.RUNNING and bool(segment.num_sweeps)
    return SegmentRow(
        segment=segment,
        attempts=f"attempt {segment.attempts} of {MAX_ATTEMPTS}" if segment.attempts else "",
        progress=f"stage {segment.stage}, {sweeps}" if is_measured else _took(segment.started_at, segment.finished_at),
        percent=100 * segment.sweeps_done // segment.num_sweeps if is_measured and segment.num_sweeps else None,
        advice=words.PARTIAL_LABELS if segment.state is SegmentState.PARTIAL else _advise(segment.failure),
    )


def choices(path: str, counts: Mapping[S, int], current: S | None) -> tuple[Choice, ...]:
    """Return the filters of a list: all, and each state that something is in, or that is looked at."""
    every = Choice("ALL", sum(counts.values()), path, current is None)
    return every, *(
        Choice(state, count, address(path, state=state), state is current)
        for state, count in counts.items()
        if count or state is current
    )


def turn_pages(path: str, state: StrEnum | None, token: str | None, next_token: str | None) -> Pager:
    """Return where the first and the next page of a list are. Pages follow keys, so there is no way to number them."""
    return Pager(
        first_url=address(path, state=state) if token else None,
        next_url=address(path, state=state, page_token=next_token) if next_token else None,
    )


def address(path: str, **query: str | None) -> str:
    """Return a path with the parameters that are given."""
    given = {name: value for name, value in query.items() if value}
    return f"{path}?{urlencode(given)}" if given else path


def announce_service(status: ServiceStatus) -> str:
    """Return what a screen reader is told when it changes: what people wait for, not each sweep."""
    failed = sum(status.failures_by_error.values())
    return _sentence(
        f"{status.queued_segments:,} waiting",
        f"{status.running_segments:,} running",
        *([f"{failed:,} failed in the last day"] if failed else []),
        *(["no dispatcher reports"] if warning(status) else []),
    )


def announce_job(row: JobRow) -> str:
    """Return what a screen reader is told of a job when it changes."""
    return _sentence(f"Job is {row.job.state}", row.done)


def _sentence(*parts: str) -> str:
    return ", ".join(parts) + "."


def _time_of_job(job: JobStatus) -> str:
    if job.state is JobState.RUNNING and job.eta_s is not None:
        return f"{words.duration(job.eta_s)} left"
    return _took(job.started_at, job.finished_at)


def _took(start: datetime | None, end: datetime | None) -> str:
    return f"took {words.duration((end - start).total_seconds())}" if start and end else ""


def _advise(failure: Failure | None) -> Advice | None:
    return words.advise(failure.error) if failure else None
