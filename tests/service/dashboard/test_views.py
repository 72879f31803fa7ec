from datetime import UTC, datetime, timedelta

import pytest

from schemas.api.jobs import Failure, JobState, JobStatus, SegmentState, SegmentStatus
from schemas.api.status import DispatcherStatus, ServiceStatus
from service.dashboard import views

NOON = datetime(2026, 1, 2, 12, tzinfo=UTC)


def dispatcher(num_workers=8, age_s=1.0):
    return DispatcherStatus(
        id="a", host="h", pid=7, code_version="1", num_workers=num_workers, started_at=NOON, heartbeat_age_s=age_s
    )


def service(**changes):
    empty = {
        "jobs": dict.fromkeys(JobState, 0),
        "queued_segments": 0,
        "running_segments": 0,
        "oldest_queued_age_s": None,
        "running_by_stage": {},
        "segments_per_hour": 0,
        "sweeps_per_hour": 0,
        "measured_s": None,
        "failures_by_error": {},
        "dispatchers": (),
    }
    return ServiceStatus(**empty | changes)


def job(state=JobState.RUNNING, *, counts=None, **changes):
    counts = counts or {SegmentState.RUNNING: 1}
    body = {
        "id": "abc",
        "state": state,
        "dataset": "av2",
        "output_uri": "/labels",
        "profile": "default",
        "priority": 0,
        "client_job_id": None,
        "generation": 1,
        "cancel_requested": False,
        "num_segments": sum(counts.values()),
        "segments": dict.fromkeys(SegmentState, 0) | counts,
        "progress": 0.5,
        "eta_s": None,
        "created_at": NOON,
        "deadline_at": None,
        "started_at": NOON,
        "finished_at": None,
        "failure": None,
    }
    return JobStatus(**body | changes)


def segment(state, **changes):
    body = {"position": 0, "uri": "u", "segment_id": None, "attempts": 1, "stage": None}
    body |= {"sweeps_done": 0, "num_sweeps": None}
    times = {"started_at": NOON, "finished_at": None, "failure": None}
    return SegmentStatus(state=state, **body | times | changes)


def test_time_left_is_what_is_open_at_the_pace_of_the_last_hour():
    """20 segments in 30 minutes are one in 90 s; 50 are open."""
    status = service(queued_segments=45, running_segments=5, segments_per_hour=20, measured_s=1800.0)
    assert views.time_left_s(status) == 50 * 90
    assert views.figures(status)[3].value == "1 h 15 min"


@pytest.mark.parametrize(
    ("changes", "left_s"),
    [
        ({}, 0),
        ({"segments_per_hour": 7, "measured_s": 60.0}, 0),
        ({"queued_segments": 1}, None),
        ({"running_segments": 1}, None),
        ({"running_segments": 1, "segments_per_hour": 1, "measured_s": 0.0}, None),
    ],
)
def test_without_work_nothing_is_left_and_without_a_pace_nobody_knows(changes, left_s):
    assert views.time_left_s(service(**changes)) == left_s


def test_a_sweep_costs_the_time_of_all_cpus_that_report():
    """8 CPUs for 1,800 s are 14,400 core-seconds, for 9,000 sweeps; a dispatcher that is gone counts no more."""
    status = service(sweeps_per_hour=9000, measured_s=1800.0, dispatchers=(dispatcher(8), dispatcher(64, age_s=99.0)))
    assert views.core_s_per_sweep(status) == pytest.approx(1.6)
    assert [figure.value for figure in views.figures(status)[4:]] == ["1.6", "8"]


@pytest.mark.parametrize(
    "missing", [{"dispatchers": ()}, {"sweeps_per_hour": 0}, {"measured_s": None}, {"measured_s": 0.0}]
)
def test_a_cost_that_cannot_be_told_is_not_told(missing):
    known = {"sweeps_per_hour": 9, "measured_s": 9.0, "dispatchers": (dispatcher(),)}
    assert views.core_s_per_sweep(service(**known)) is not None
    assert views.core_s_per_sweep(service(**known | missing)) is None


def test_a_service_that_nobody_works_for_is_warned_of():
    assert "Jobs would wait" in views.warning(service())
    assert "Jobs wait" in views.warning(service(queued_segments=1, dispatchers=(dispatcher(age_s=99.0),)))
    assert views.warning(service(dispatchers=(dispatcher(),))) is None


def test_reasons_go_by_frequency_and_then_by_name():
    counts = {"WorkerLost": 2, "InvalidInput": 2, "StorageTrouble": 9}
    reasons = views.reasons(service(failures_by_error=counts, last_failed_job_by_error={"WorkerLost": "abc"}))
    found = [(reason.error, reason.num_segments, reason.last_job_id) for reason in reasons]
    assert found == [("StorageTrouble", 9, None), ("InvalidInput", 2, None), ("WorkerLost", 2, "abc")]


def test_a_screen_reader_hears_of_states_and_not_of_sweeps():
    one = service(running_segments=1, running_by_stage={"sweeps": 1}, dispatchers=(dispatcher(),))
    two = service(running_segments=1, running_by_stage={"tracks": 1}, dispatchers=(dispatcher(age_s=2.0),))
    assert views.announce_service(one) == views.announce_service(two) == "0 waiting, 1 running."
    lost = service(failures_by_error={"InvalidInput": 2})
    assert views.announce_service(lost) == "0 waiting, 0 running, 2 failed in the last day, no dispatcher reports."
    rows = [views.describe_job(job(progress=progress)) for progress in (0.1, 0.9)]
    assert {views.announce_job(row) for row in rows} == {"Job is RUNNING, 0 of 1 segment."}


S = SegmentState


@pytest.mark.parametrize(
    ("state", "counts", "can_cancel", "can_retry"),
    [
        (JobState.QUEUED, {S.QUEUED: 1}, True, False),
        (JobState.RUNNING, {S.RUNNING: 1, S.FAILED: 1}, True, False),
        (JobState.CANCELLING, {S.RUNNING: 1, S.CANCELLED: 1}, False, False),
        (JobState.SUCCEEDED, {S.SUCCEEDED: 2}, False, False),
        (JobState.PARTIAL, {S.PARTIAL: 2}, False, False),  # it has labels, which stay
        (JobState.PARTIAL, {S.SUCCEEDED: 1, S.FAILED: 1}, False, True),
        (JobState.FAILED, {S.FAILED: 1}, False, True),
        (JobState.FAILED, {S.SUCCEEDED: 1}, False, True),  # the manifest is missing
        (JobState.CANCELLED, {S.CANCELLED: 1}, False, True),
        (JobState.CRASHED, {S.CRASHED: 1}, False, True),
    ],
)
def test_buttons_are_there_when_the_call_would_be_taken(state, counts, can_cancel, can_retry):
    row = views.describe_job(job(state, counts=counts))
    assert (row.can_cancel, row.can_retry) == (can_cancel, can_retry)


def test_a_job_in_words():
    counts = {S.SUCCEEDED: 1000, S.PARTIAL: 1, S.FAILED: 2, S.RUNNING: 1}
    row = views.describe_job(job(counts=counts, progress=0.999, eta_s=61.0, generation=3))
    assert (row.percent, row.done, row.time) == (99, "1,001 of 1,004 segments, 2 failed", "1 min left")
    assert row.retries == "2 times"
    ended = job(JobState.SUCCEEDED, counts={S.SUCCEEDED: 1}, progress=1.0, finished_at=NOON + timedelta(seconds=75))
    row = views.describe_job(ended)
    assert (row.percent, row.done, row.time, row.retries) == (None, "1 of 1 segment", "took 1 min", "")
    never_ran = job(JobState.CANCELLED, counts={S.CANCELLED: 1}, started_at=None, finished_at=NOON)
    assert views.describe_job(never_ran).time == ""


def test_a_segment_in_words():
    running = views.describe_segment(segment(S.RUNNING, stage="tracks", sweeps_done=50, num_sweeps=150, attempts=2))
    assert (running.percent, running.progress) == (33, "stage tracks, 50 of 150 sweeps")
    assert running.attempts == "attempt 2 of 3"
    assert views.describe_segment(segment(S.RUNNING)).percent is None
    waiting = views.describe_segment(segment(S.QUEUED, attempts=0, started_at=None))
    assert (waiting.attempts, waiting.progress, waiting.advice) == ("", "", None)
    failure = Failure(error="StorageTrouble", message="disk full")
    failed = views.describe_segment(segment(S.FAILED, finished_at=NOON + timedelta(seconds=8), failure=failure))
    assert (failed.progress, failed.percent) == ("took 8 s", None)
    assert "space" in failed.advice.action
    assert "labels" in views.describe_segment(segment(S.PARTIAL)).advice.action


def test_filters_show_what_is_there_and_what_is_looked_at():
    counts = dict.fromkeys(JobState, 0) | {JobState.RUNNING: 2, JobState.FAILED: 1}
    shown = views.choices("/here", counts, JobState.QUEUED)
    assert [(choice.name, choice.count, choice.is_current) for choice in shown] == [
        ("ALL", 3, False),
        ("QUEUED", 0, True),
        ("RUNNING", 2, False),
        ("FAILED", 1, False),
    ]
    assert [choice.url for choice in shown[:2]] == ["/here", "/here?state=QUEUED"]


def test_pages_lead_to_the_first_and_the_next():
    assert views.turn_pages("/here", None, None, None) == views.Pager(None, None)
    middle = views.turn_pages("/here", JobState.FAILED, "a b", "c&d")
    assert middle == views.Pager("/here?state=FAILED", "/here?state=FAILED&page_token=c%26d")
