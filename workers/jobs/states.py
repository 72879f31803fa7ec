"""Which state may follow which, and how a job's end follows from its segments. Pure tables and functions."""

from collections.abc import Mapping
from typing import Final

from schemas.api.jobs import JobState, SegmentState

J, S = JobState, SegmentState

# What a job may end as while its segments run. CANCELLING adds the two ends of a job that was stopped.
_ENDS: Final = frozenset({J.SUCCEEDED, J.PARTIAL, J.FAILED, J.CRASHED})
_STOPPED: Final = frozenset({J.CANCELLED, J.TIMED_OUT})

JOB_TRANSITIONS: Final[Mapping[JobState, frozenset[JobState]]] = {
    J.QUEUED: frozenset({J.RUNNING}) | _STOPPED,
    J.RUNNING: frozenset({J.CANCELLING}) | _ENDS,
    J.CANCELLING: _ENDS | _STOPPED,
    J.SUCCEEDED: frozenset(),
    J.PARTIAL: frozenset({J.QUEUED}),  # by a retry, as below
    J.FAILED: frozenset({J.QUEUED, J.RUNNING}),  # RUNNING: every segment has labels, only the manifest is missing
    J.CANCELLED: frozenset({J.QUEUED}),
    J.TIMED_OUT: frozenset({J.QUEUED}),
    J.CRASHED: frozenset({J.QUEUED}),
}

SEGMENT_TRANSITIONS: Final[Mapping[SegmentState, frozenset[SegmentState]]] = {
    S.QUEUED: frozenset({S.RUNNING, S.CANCELLED}),
    S.RUNNING: frozenset(set(S) - {S.RUNNING}),  # QUEUED: its claimant was lost, or gave it back
    S.SUCCEEDED: frozenset(),
    S.PARTIAL: frozenset(),  # its labels are published, and published labels stay
    S.FAILED: frozenset({S.QUEUED}),
    S.CANCELLED: frozenset({S.QUEUED}),
    S.CRASHED: frozenset({S.QUEUED}),
}

RETRYABLE_SEGMENTS: Final = frozenset(
    state for state, following in SEGMENT_TRANSITIONS.items() if state.is_ended and S.QUEUED in following
)


def state_after_lost_attempt(attempts: int, max_attempts: int, *, is_stopping: bool) -> SegmentState:
    """Return what a running segment becomes when its claimant is gone."""
    if is_stopping:
        return S.CANCELLED
    return S.QUEUED if attempts < max_attempts else S.CRASHED


def end_of_job(counts: Mapping[SegmentState, int], stop: JobState | None) -> JobState | None:
    """Return the state in which a job ends, or None while a segment is open.

    Args:
        counts: How many segments are in each state; a missing state counts zero.
        stop: CANCELLED or TIMED_OUT when the job was told to stop. It decides only when a segment was left undone.

    """
    present = {state for state, count in counts.items() if count}
    if any(not state.is_ended for state in present):
        return None
    if present == {S.SUCCEEDED}:
        return J.SUCCEEDED
    if S.CANCELLED in present:
        return stop or J.CANCELLED
    if present & {S.SUCCEEDED, S.PARTIAL}:
        return J.PARTIAL
    return J.FAILED if S.FAILED in present else J.CRASHED
