"""Whatever changes a state leaves an event, in the same transaction, with the next number of its job."""

import threading

import pytest
from sqlalchemy import func, select

from schemas.api.jobs import Failure, JobState, SegmentState
from schemas.errors import JobNotFound, StaleClaim
from schemas.manifest import SegmentEntry
from workers.jobs import events, rows
from workers.jobs.database import migrate_database, open_database
from workers.jobs.events import read_events
from workers.jobs.store import JobStore
from workers.jobs.tables import events as table

CRASH = Failure(error="WorkerLost", message="gone\0 with\nits machine")


@pytest.fixture
def told(database):
    """Return a function that tells (position, state, attempt) of each event of a job after one."""

    def run(job_id, after=0):
        found, _ = read_events(database, job_id, after)
        assert [event.sequence for event in found] == list(range(after + 1, after + 1 + len(found)))
        assert all((event.kind == "job") == (event.position is None) for event in found)
        return [(event.position, event.state, event.attempt) for event in found]

    return run


def succeed(queue, claim):
    entry = SegmentEntry(segment_id=f"s-{claim.position}", uri=claim.uri, state="SUCCEEDED")
    queue.finish(claim, SegmentState.SUCCEEDED, entry=entry)


def test_a_job_is_told_from_its_submission_to_its_end(database, store, queue, make_request, told):
    job = store.submit(make_request(2)).id
    first, second = queue.claim_segment("d", 60), queue.claim_segment("d", 60)
    queue.report_progress(first, "flow", 3, 10)  # no change of state
    assert queue.release(second, CRASH) == SegmentState.QUEUED
    succeed(queue, first)
    queue.finish(queue.claim_segment("d", 60), SegmentState.FAILED, failure=Failure(error="Bad", message="no sweeps"))
    assert read_events(database, job, 0)[1] is False
    assert [queue.end_job(ended) for ended in queue.list_finished_jobs()] == [JobState.PARTIAL]
    assert told(job) == [
        (None, "QUEUED", None),
        (None, "RUNNING", None),
        (0, "RUNNING", 1),
        (1, "RUNNING", 1),
        (1, "QUEUED", 1),
        (0, "SUCCEEDED", 1),
        (1, "RUNNING", 2),
        (1, "FAILED", 2),
        (None, "PARTIAL", None),
    ]
    found, is_last = read_events(database, job, 4)
    assert is_last
    assert [event.detail for event in found][:4] == ["WorkerLost: gone with its machine", None, None, "Bad: no sweeps"]
    assert found[-1].detail.startswith("1 of 2 segments have no labels")
    assert [event.at for event in found] == sorted(event.at for event in found)


def test_many_segments_at_once_are_one_event_of_the_job(database, store, queue, make_request, told):
    job = store.submit(make_request(300)).id
    claim = queue.claim_segment("d", 60)
    store.request_cancel(job)
    assert queue.release(claim) == SegmentState.CANCELLED
    queue.end_job(queue.list_finished_jobs()[0])
    store.retry_failed(job)
    states = ["QUEUED", "RUNNING", "RUNNING", "CANCELLING", "CANCELLED", "CANCELLED", "QUEUED"]
    assert [state for _, state, _ in told(job)] == states
    details = [event.detail for event in read_events(database, job, 0)[0]]
    assert details[0] == "segments that wait: 300"
    assert details[3] == "to become CANCELLED; segments that waited and are CANCELLED: 299"
    assert details[6] == "generation 2; segments that wait again: 300"


def test_a_claim_that_ran_out_is_told_once_and_a_stale_one_never(store, queue, make_request, told):
    job = store.submit(make_request(1)).id
    claim = queue.claim_segment("d", lease_s=-1)
    queue.expire()
    queue.expire()
    before = told(job)
    assert before[2:] == [(0, "RUNNING", 1), (0, "QUEUED", 1)]
    with pytest.raises(StaleClaim):
        succeed(queue, claim)
    assert told(job) == before


def test_a_job_keeps_its_newest_events(database, store, queue, make_request, monkeypatch):
    monkeypatch.setattr(rows, "MAX_EVENTS", 5)
    job, other = store.submit(make_request(1)).id, store.submit(make_request(1)).id
    for _ in range(4):
        queue.release(queue.claim_segment("d", 60))
    found, _ = read_events(database, job, 0)
    assert [event.sequence for event in found] == [6, 7, 8, 9, 10]
    assert len(read_events(database, other, 0)[0]) == 1
    with database.read() as connection:
        assert connection.scalar(select(func.count()).select_from(table)) == 6


def test_numbers_have_no_gaps_whoever_writes_at_once(store, queue, make_request, told):
    job = store.submit(make_request(12)).id
    start = threading.Barrier(3)

    def work():
        start.wait()
        while claim := queue.claim_segment("d", 60):
            succeed(queue, claim)

    threads = [threading.Thread(target=work) for _ in range(3)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(told(job)) == 2 + 2 * 12


def test_events_come_in_pages_and_the_last_one_ends_them(database, store, queue, make_request, monkeypatch):
    monkeypatch.setattr(events, "PAGE_EVENTS", 2)
    job = store.submit(make_request(1)).id
    succeed(queue, queue.claim_segment("d", 60))
    queue.end_job(queue.list_finished_jobs()[0])
    after, pages = 0, []
    while not pages or not pages[-1][1]:
        found, is_last = read_events(database, job, after)
        after = found[-1].sequence if found else after
        pages.append((len(found), is_last))
    assert pages == [(2, False), (2, False), (1, True)]
    assert read_events(database, job, 10**6) == ([], True)


def test_events_of_somebody_else_are_those_of_no_job(database, store, make_request):
    job = store.submit(make_request(1), owner="ann").id
    assert len(read_events(database, job, 0, owner="ann")[0]) == 1
    with pytest.raises(JobNotFound, match=f"no job {job}"):
        read_events(database, job, 0, owner="bob")


def test_jobs_of_an_old_store_begin_with_the_state_they_are_in(url, make_old_store):
    make_old_store(url)
    migrate_database(url)
    database = open_database(url)
    for job in ("ended", "begun"):
        (event,), is_last = read_events(database, job, 0)
        status = JobStore(database).get_job(job)
        assert (event.sequence, event.kind, event.state) == (1, "job", status.state)
        assert is_last == status.state.is_ended
    database.close()
