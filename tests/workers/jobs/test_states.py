import itertools

import pytest
from hypothesis import given
from hypothesis import strategies as st

from schemas.api.jobs import JobState, SegmentState
from workers.jobs.states import (
    JOB_TRANSITIONS,
    RETRYABLE_SEGMENTS,
    SEGMENT_TRANSITIONS,
    end_of_job,
    state_after_lost_attempt,
)

J, S = JobState, SegmentState
STOPS = [None, J.CANCELLED, J.TIMED_OUT]


def reachable(table, start):
    found, todo = set(), {start}
    while todo:
        state = todo.pop()
        todo |= table[state] - found
        found |= table[state]
    return found


@pytest.mark.parametrize("table", [JOB_TRANSITIONS, SEGMENT_TRANSITIONS], ids=["jobs", "segments"])
def test_every_pair_of_states(table):
    states = type(next(iter(table)))
    assert set(table) == set(states)
    for state, following in itertools.product(states, states):
        allowed = following in table[state]
        if state is following or state is states.SUCCEEDED:
            assert not allowed
        elif state.is_ended and allowed:  # only a retry leaves an end
            assert following is states.QUEUED or (state, following) == (J.FAILED, J.RUNNING)
        elif allowed and following is states.QUEUED:  # a job is queued again only by a retry
            assert state is S.RUNNING
    assert reachable(table, states.QUEUED) >= set(states)
    for state in states:
        assert state.is_ended or any(following.is_ended for following in table[state])


def test_segments_with_labels_stay_and_all_others_can_be_retried():
    assert {S.FAILED, S.CANCELLED, S.CRASHED} == RETRYABLE_SEGMENTS


@pytest.mark.parametrize(
    ("present", "stop", "end"),
    [
        ([S.SUCCEEDED], None, J.SUCCEEDED),
        ([S.SUCCEEDED], J.CANCELLED, J.SUCCEEDED),  # the request came too late to change anything
        ([S.SUCCEEDED, S.CANCELLED], J.CANCELLED, J.CANCELLED),
        ([S.SUCCEEDED, S.CANCELLED], J.TIMED_OUT, J.TIMED_OUT),
        ([S.FAILED, S.CANCELLED], J.TIMED_OUT, J.TIMED_OUT),
        ([S.SUCCEEDED, S.PARTIAL], None, J.PARTIAL),
        ([S.PARTIAL], None, J.PARTIAL),
        ([S.PARTIAL, S.CRASHED], None, J.PARTIAL),
        ([S.SUCCEEDED, S.FAILED, S.CRASHED], None, J.PARTIAL),
        ([S.FAILED], None, J.FAILED),
        ([S.FAILED, S.CRASHED], None, J.FAILED),
        ([S.CRASHED], None, J.CRASHED),
        ([S.SUCCEEDED, S.RUNNING], J.CANCELLED, None),
        ([S.FAILED, S.QUEUED], None, None),
    ],
)
def test_known_ends(present, stop, end):
    assert end_of_job(dict.fromkeys(present, 3), stop) is end


@given(st.dictionaries(st.sampled_from(S), st.integers(0, 3)), st.sampled_from(STOPS))
def test_a_job_ends_when_its_segments_have_and_in_a_state_that_may_follow(counts, stop):
    if stop is None:
        counts.pop(S.CANCELLED, None)  # nobody cancels a segment of a job that was not stopped
    if not any(counts.values()):
        counts = {S.SUCCEEDED: 1}
    end = end_of_job(counts, stop)
    is_open = any(counts.get(state, 0) for state in (S.QUEUED, S.RUNNING))
    assert (end is None) == is_open
    if end is not None:
        assert end in JOB_TRANSITIONS[J.CANCELLING if stop else J.RUNNING]
        assert (end in (J.CANCELLED, J.TIMED_OUT)) == bool(counts.get(S.CANCELLED))


@pytest.mark.parametrize(
    ("attempts", "is_stopping", "state"),
    [(1, False, S.QUEUED), (2, False, S.QUEUED), (3, False, S.CRASHED), (1, True, S.CANCELLED), (3, True, S.CANCELLED)],
)
def test_a_lost_attempt_is_repeated_while_attempts_are_left(attempts, is_stopping, state):
    assert state_after_lost_attempt(attempts, 3, is_stopping=is_stopping) is state
    assert state in SEGMENT_TRANSITIONS[S.RUNNING]
