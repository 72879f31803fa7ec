import base64
import itertools
import json
import threading

import pytest
from sqlalchemy import select, update

from schemas.api.jobs import Failure, JobState, SegmentState
from schemas.errors import InvalidInput, JobConflict, JobNotFound, QueueFull
from schemas.manifest import SegmentEntry
from workers.jobs.claims import Dispatcher
from workers.jobs.database import now_ms
from workers.jobs.labels import read_labels
from workers.jobs.rows import find_job, set_job_state
from workers.jobs.states import JOB_TRANSITIONS
from workers.jobs.store import JobStore
from workers.jobs.tables import jobs, segments

BAD = Failure(error="InvalidInput", message="no sweeps")


def finish_all(queue, state=SegmentState.SUCCEEDED):
    while claim := queue.claim_segment("d", 60):
        if state is SegmentState.SUCCEEDED:
            queue.finish(claim, state, entry=SegmentEntry(segment_id=claim.uri, uri=claim.uri, state="SUCCEEDED"))
        else:
            queue.finish(claim, state, failure=BAD)


def end_all(queue):
    return [queue.end_job(job) for job in queue.list_finished_jobs()]


def walk(list_page, **filters):
    token, items, sizes = None, [], []
    while True:
        page = list_page(page_token=token, **filters)
        found = getattr(page, "jobs", None) or getattr(page, "segments", ())
        items += found
        sizes.append(len(found))
        token = page.next_page_token
        if token is None:
            return items, sizes


def test_a_submitted_job_is_queued_whole(store, make_request):
    job = store.submit(make_request(3, priority=5, profile="fast", deadline_s=60))
    assert job == store.get_job(job.id)
    assert (job.state, job.generation, job.progress, job.eta_s) == (JobState.QUEUED, 1, 0, None)
    assert (job.priority, job.profile, job.num_segments, job.cancel_requested) == (5, "fast", 3, False)
    assert job.segments == {state: 3 * (state is SegmentState.QUEUED) for state in SegmentState}
    assert (job.deadline_at - job.created_at).total_seconds() == 60
    assert (job.started_at, job.finished_at, job.failure) == (None, None, None)


def test_a_job_has_the_owner_that_submitted_it(store, make_request):
    job = store.submit(make_request(), owner="night-shift")
    assert (job.owner, store.get_job(job.id).owner) == ("night-shift", "night-shift")
    assert store.submit(make_request()).owner == ""


def test_a_name_is_its_owners(store, make_request):
    request, other = make_request(client_job_id="night"), make_request(client_job_id="night", priority=1)
    ids = {owner: store.submit(request, owner=owner).id for owner in ("", "ann", "bob")}
    assert len(set(ids.values())) == 3
    assert {owner: store.submit(request, owner=owner).id for owner in ids} == ids
    with pytest.raises(JobConflict, match=f"night is job {ids['ann']}"):
        store.submit(other, owner="ann")


def test_behind_an_owners_door_are_the_owners_jobs_only(store, queue, database, make_request):
    mine, other = (store.submit(make_request(1, dataset="synthetic"), owner=owner).id for owner in ("ann", "bob"))
    door = JobStore(database, sees="ann")
    assert [job.id for job in door.list_jobs().jobs] == [mine]
    assert [job.id for job in door.list_jobs(state=JobState.QUEUED, dataset="synthetic").jobs] == [mine]
    calls = [door.get_job, door.list_segments, door.request_cancel, door.retry_failed]
    calls.append(lambda job_id: read_labels(database, job_id, owner="ann"))
    for call in calls:
        with pytest.raises(JobNotFound, match=f"^no job {other}$"):
            call(other)
    assert store.get_job(other).state is JobState.QUEUED
    assert door.get_job(mine) == store.get_job(mine)
    assert door.request_cancel(mine).state is JobState.CANCELLED
    assert {job.id for job in store.list_jobs().jobs} == {mine, other}


def test_pages_of_an_owner_hold_each_of_its_jobs_once(store, database, make_request):
    owners = itertools.islice(itertools.cycle(["ann", "bob", "bob"]), 21)
    ids = [store.submit(make_request(), owner=owner).id for owner in owners]
    door = JobStore(database, sees="ann")
    found, sizes = walk(lambda **page: door.list_jobs(page_size=3, **page))
    assert (sorted(job.id for job in found), sizes) == (sorted(ids[::3]), [3, 3, 1])
    token = JobStore(database, sees="bob").list_jobs(page_size=5).next_page_token
    assert {job.owner for job in door.list_jobs(page_token=token).jobs} == {"ann"}


def test_jobs_and_failures_are_counted_by_owner_and_the_queue_for_all(store, queue, database, make_request):
    for owner in ("ann", "ann", "bob"):
        store.submit(make_request(1), owner=owner)
    finish_all(queue, SegmentState.FAILED)
    end_all(queue)
    store.submit(make_request(5), owner="bob")
    seen = {owner: JobStore(database, sees=owner).status() for owner in ("ann", "bob", "eve", None)}
    assert {owner: status.jobs[JobState.FAILED] for owner, status in seen.items()} == {
        "ann": 2, "bob": 1, "eve": 0, None: 3,
    }  # fmt: skip
    failed = {owner: status.failures_by_error.get("InvalidInput") for owner, status in seen.items()}
    assert failed == {"ann": 2, "bob": 1, "eve": None, None: 3}
    assert {owner: status.queued_segments for owner, status in seen.items()} == dict.fromkeys(seen, 5)
    for owner, status in seen.items():
        for job in status.last_failed_job_by_error.values():
            assert owner in (None, store.get_job(job).owner)


def test_labels_made_with_parameters_that_are_gone_are_still_listed(store, queue, database, make_request):
    job = store.submit(make_request(1))
    finish_all(queue)
    known = read_labels(database, job.id)
    assert known.config_hash == make_request(1).make_config().config_hash
    with database.write() as connection:
        connection.execute(update(jobs).values(config={**known.config, "gone": 1}))
    old = read_labels(database, job.id)
    assert (old.segments, old.config["gone"]) == (known.segments, 1)
    assert old.config_hash != known.config_hash


def test_the_same_request_under_one_name_is_one_job(store, make_request):
    job = store.submit(make_request(2, client_job_id="night-1"))
    assert store.submit(make_request(2, client_job_id="night-1", priority=0)).id == job.id  # the default, spelled out
    with pytest.raises(JobConflict, match=f"client_job_id night-1 is job {job.id}, which asks for something else"):
        store.submit(make_request(2, client_job_id="night-1", priority=1))
    assert store.submit(make_request(2)).id != store.submit(make_request(2)).id
    assert len(store.list_jobs().jobs) == 3


def test_the_same_request_from_many_threads_at_once_is_one_job(store, make_request):
    request, found, start = make_request(300, client_job_id="x"), [], threading.Barrier(4)

    def submit():
        start.wait()
        found.append(store.submit(request).id)

    threads = [threading.Thread(target=submit) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(found) == 4
    assert len(set(found)) == 1
    assert store.get_job(found[0]).segments[SegmentState.QUEUED] == 300


def test_a_large_job_is_stored_in_order_of_uri(store, make_request):
    uris = [f"s3://bucket/{i:05}" for i in range(2500)]
    job = store.submit(make_request(segments=uris[::-1]))
    assert job.segments[SegmentState.QUEUED] == 2500
    found, sizes = walk(lambda **page: store.list_segments(job.id, page_size=200, **page))
    assert [segment.uri for segment in found] == uris
    assert sizes == [200] * 12 + [100]


def test_pages_of_jobs_are_newest_first_even_when_born_in_one_millisecond(store, database, make_request):
    ids = [store.submit(make_request()).id for _ in range(7)]
    with database.write() as connection:
        connection.execute(update(jobs).where(jobs.c.id.in_(ids[:5])).values(created_ms=1_700_000_000_000))
    found, sizes = walk(lambda **page: store.list_jobs(page_size=3, **page))
    assert sorted(job.id for job in found) == sorted(ids)
    assert [job.created_at for job in found] == sorted((job.created_at for job in found), reverse=True)
    assert sizes == [3, 3, 1]


def test_a_job_submitted_between_two_pages_moves_nothing(store, make_request):
    ids = [store.submit(make_request()).id for _ in range(4)]
    first = store.list_jobs(page_size=2)
    store.submit(make_request())
    second = store.list_jobs(page_size=2, page_token=first.next_page_token)
    assert {job.id for job in (*first.jobs, *second.jobs)} == set(ids)
    assert second.next_page_token is None


def test_filters(store, queue, make_request):
    done = store.submit(make_request(1))
    finish_all(queue)
    end_all(queue)
    waiting = store.submit(make_request(3, dataset="av2"))
    assert [job.id for job in store.list_jobs(state=JobState.SUCCEEDED).jobs] == [done.id]
    assert [job.id for job in store.list_jobs(dataset="av2").jobs] == [waiting.id]
    assert store.list_jobs(state=JobState.SUCCEEDED, dataset="av2").jobs == ()
    queue.claim_segment("d", 60)
    found, sizes = walk(lambda **page: store.list_segments(waiting.id, page_size=1, **page), state=SegmentState.QUEUED)
    assert [segment.state for segment in found] == [SegmentState.QUEUED] * 2
    assert sizes == [1, 1]


@pytest.mark.parametrize("token", ["", "?", "AAAA", "WzBd", "WyJhIiwgMV0", "e30", "W1tb" * 2000])
def test_a_foreign_page_token_is_refused(store, make_request, token):
    store.submit(make_request())
    with pytest.raises(InvalidInput, match="is not one that this listing returned"):
        store.list_jobs(page_token=token)


@pytest.mark.parametrize("size", [0, -1, 201])
def test_page_sizes_have_bounds(store, make_request, size):
    job = store.submit(make_request())
    for list_page in (store.list_jobs, lambda **page: store.list_segments(job.id, **page)):
        with pytest.raises(InvalidInput, match=f"page_size must be 1 to 200, got {size}"):
            list_page(page_size=size)


def test_an_unknown_job_is_named(store):
    for ask in (store.get_job, store.list_segments, store.request_cancel, store.retry_failed):
        with pytest.raises(JobNotFound, match="no job nope"):
            ask("nope")


def test_a_job_that_never_ran_is_cancelled_at_once(store, queue, make_request):
    job = store.submit(make_request(2))
    cancelled = store.request_cancel(job.id)
    assert (cancelled.state, cancelled.cancel_requested) == (JobState.CANCELLED, True)
    assert cancelled.segments[SegmentState.CANCELLED] == 2
    assert cancelled.progress == 0
    assert cancelled.finished_at is not None
    assert cancelled.failure is None
    assert store.request_cancel(job.id) == cancelled
    assert queue.claim_segment("d", 60) is None
    assert queue.list_finished_jobs() == []


def test_cancelling_a_running_job_waits_for_what_runs(store, queue, make_request):
    job = store.submit(make_request(3))
    claim = queue.claim_segment("d", 60)
    assert queue.renew(claim) is False
    stopping = store.request_cancel(job.id)
    assert (stopping.state, stopping.cancel_requested) == (JobState.CANCELLING, True)
    assert stopping.segments[SegmentState.CANCELLED] == 2
    assert store.request_cancel(job.id).state == JobState.CANCELLING
    assert queue.renew(claim) is True
    assert queue.report_progress(claim, "sweeps", 1, 4) is True
    assert queue.list_finished_jobs() == []
    assert queue.release(claim) == SegmentState.CANCELLED
    assert end_all(queue) == [JobState.CANCELLED]


def test_a_cancel_that_comes_too_late_for_every_segment_changes_nothing(store, queue, make_request):
    job = store.submit(make_request(1))
    claim = queue.claim_segment("d", 60)
    store.request_cancel(job.id)
    queue.finish(claim, SegmentState.SUCCEEDED, entry=SegmentEntry(segment_id="s", uri=claim.uri, state="SUCCEEDED"))
    assert end_all(queue) == [JobState.SUCCEEDED]
    with pytest.raises(JobConflict, match="has ended SUCCEEDED: there is nothing to cancel"):
        store.request_cancel(job.id)


def test_retry_reopens_what_has_no_labels_and_starts_the_deadline_again(store, queue, make_request):
    job = store.submit(make_request(3, deadline_s=3600))
    first = queue.claim_segment("d", 60)
    queue.finish(first, SegmentState.SUCCEEDED, entry=SegmentEntry(segment_id="s", uri=first.uri, state="SUCCEEDED"))
    with pytest.raises(JobConflict, match="is RUNNING: wait until it has ended"):
        store.retry_failed(job.id)
    finish_all(queue, SegmentState.FAILED)
    (ended,) = queue.list_finished_jobs()
    assert queue.end_job(ended) == JobState.PARTIAL
    partial = store.get_job(job.id)
    assert partial.progress == 1
    assert partial.failure.error == "InvalidInput"
    assert partial.failure.message.startswith("2 of 3 segments have no labels; the first is synthetic:street?seed=0001")

    again = store.retry_failed(job.id)
    assert (again.state, again.generation, again.failure) == (JobState.QUEUED, 2, None)
    assert (again.segments[SegmentState.QUEUED], again.segments[SegmentState.SUCCEEDED]) == (2, 1)
    assert again.deadline_at >= partial.deadline_at
    assert (again.started_at, again.finished_at) == (None, None)
    with pytest.raises(JobConflict, match="is in generation 2, not 1"):
        queue.end_job(ended)
    claim = queue.claim_segment("d", 60)
    assert (claim.generation, claim.attempt, claim.uri) == (2, 1, "synthetic:street?seed=0001")
    assert claim.fence == 2
    queue.release(claim)
    finish_all(queue)
    assert end_all(queue) == [JobState.SUCCEEDED]
    with pytest.raises(JobConflict, match="every segment has labels, there is nothing to retry"):
        store.retry_failed(job.id)


@pytest.mark.parametrize("how", ["cancelled", "crashed"])
def test_cancelled_and_crashed_jobs_can_be_retried(store, queue, make_request, how):
    job = store.submit(make_request(2))
    if how == "cancelled":
        store.request_cancel(job.id)
    else:
        finish_all(queue, SegmentState.CRASHED)
        assert end_all(queue) == [JobState.CRASHED]
    again = store.retry_failed(job.id)
    assert (again.state, again.cancel_requested, again.segments[SegmentState.QUEUED]) == (JobState.QUEUED, False, 2)
    finish_all(queue)
    assert end_all(queue) == [JobState.SUCCEEDED]


def test_a_manifest_that_could_not_be_published_fails_the_job_until_a_retry(store, queue, make_request):
    job = store.submit(make_request(1))
    finish_all(queue)
    full = Failure(error="OSError", message="no space left")
    (finished,) = queue.list_finished_jobs()
    assert queue.end_job(finished, full) == JobState.FAILED
    assert store.get_job(job.id).failure == full
    assert store.retry_failed(job.id).state == JobState.RUNNING
    assert queue.claim_segment("d", 60) is None
    assert end_all(queue) == [JobState.SUCCEEDED]
    assert store.get_job(job.id).failure is None


def test_progress_counts_parts_of_running_segments(store, queue, make_request):
    job = store.submit(make_request(4))
    finished, running = queue.claim_segment("d", 60), queue.claim_segment("d", 60)
    queue.finish(finished, SegmentState.FAILED, failure=BAD)
    queue.report_progress(running, "sweeps", 5, 10, "street-1")
    half = store.get_job(job.id)
    assert half.progress == pytest.approx(1.5 / 4)
    assert half.eta_s >= 0
    segment = store.list_segments(job.id, state=SegmentState.RUNNING).segments[0]
    assert (segment.stage, segment.sweeps_done, segment.num_sweeps) == ("sweeps", 5, 10)
    assert (segment.segment_id, segment.attempts) == ("street-1", 1)


def test_time_left_is_judged_by_this_generation_alone(store, queue, database, make_request):
    job = store.submit(make_request(4))
    for state in (SegmentState.SUCCEEDED, SegmentState.SUCCEEDED, SegmentState.FAILED, SegmentState.FAILED):
        claim = queue.claim_segment("d", 60)
        entry = SegmentEntry(segment_id=claim.uri, uri=claim.uri, state="SUCCEEDED")
        queue.finish(claim, state, **({"entry": entry} if state is SegmentState.SUCCEEDED else {"failure": BAD}))
    end_all(queue)
    store.retry_failed(job.id)
    claim = queue.claim_segment("d", 60)
    assert store.get_job(job.id).eta_s is None  # two of four have labels, but none in this generation
    queue.report_progress(claim, "sweeps", 5, 10)
    with database.write() as connection:
        started = connection.scalar(select(jobs.c.started_ms))
        connection.execute(update(jobs).values(started_ms=started - 60_000))
    assert 180 <= store.get_job(job.id).eta_s < 200  # half a segment a minute, one and a half to go


def test_every_change_of_state_that_the_table_forbids_is_refused(store, database, make_request):
    job_id = store.submit(make_request()).id
    for state, target in itertools.product(JobState, JobState):
        with database.write() as connection:
            connection.execute(update(jobs).values(state=state))
            job = find_job(connection, job_id, lock=True)
            if target in JOB_TRANSITIONS[state]:
                set_job_state(connection, job, target, 1)
            else:
                with pytest.raises(JobConflict, match=f"is {state} and cannot become {target}"):
                    set_job_state(connection, job, target, 1)


def test_status_counts(store, queue, make_request):
    empty = store.status()
    assert set(empty.jobs.values()) == {0}
    assert (empty.oldest_queued_age_s, empty.dispatchers, empty.failures_by_error) == (None, (), {})
    store.submit(make_request(1))
    store.submit(make_request(5))
    claims = [queue.claim_segment("d", 60) for _ in range(4)]
    entry = SegmentEntry(segment_id="s", uri="u", state="PARTIAL", reason="r")
    queue.report_progress(claims[0], "sweeps", 7, 9)
    queue.finish(claims[0], SegmentState.PARTIAL, entry=entry)
    queue.finish(claims[1], SegmentState.FAILED, failure=BAD)
    queue.report_progress(claims[2], "tracks", 9, 9)
    end_all(queue)
    status = store.status()
    assert status.jobs == {state: int(state in (JobState.PARTIAL, JobState.RUNNING)) for state in JobState}
    assert (status.queued_segments, status.running_segments) == (2, 2)
    assert status.running_by_stage == {"tracks": 1, "starting": 1}
    assert (status.segments_per_hour, status.sweeps_per_hour) == (1, 7)
    assert status.failures_by_error == {"InvalidInput": 1}
    assert status.oldest_queued_age_s >= 0


def test_dispatchers_are_listed_while_they_live(store, queue):
    one, two = Dispatcher("one", "host", 11, "1.0", 2), Dispatcher("two", "host", 12, "1.0", 4)
    for dispatcher in (one, two, one):
        queue.heartbeat(dispatcher)
    listed = {dispatcher.id: dispatcher for dispatcher in store.status().dispatchers}
    assert {name: (found.pid, found.num_workers) for name, found in listed.items()} == {"one": (11, 2), "two": (12, 4)}
    assert all(found.heartbeat_age_s >= 0 for found in listed.values())
    queue.sign_off("one")
    assert [dispatcher.id for dispatcher in store.status().dispatchers] == ["two"]


def test_the_hour_is_measured_from_the_first_start_to_the_last_end(store, queue, database, make_request):
    """Segments of (start, end) minutes ago; while another runs, the end is now."""

    def end(*spans_min):
        with database.write() as connection:
            now = now_ms(connection)
            for position, (start, stop) in enumerate(spans_min):
                is_it = segments.c.position == position
                moved = {"started_ms": now - 60_000 * start, "finished_ms": now - 60_000 * stop}
                connection.execute(update(segments).where(is_it).values(**moved))

    assert store.status().measured_s is None
    store.submit(make_request(3))
    for _ in range(2):
        claim = queue.claim_segment("d", 60)
        entry = SegmentEntry(segment_id=claim.uri, uri=claim.uri, state="SUCCEEDED")
        queue.finish(claim, SegmentState.SUCCEEDED, entry=entry)
    end((30, 20), (25, 10))
    assert store.status().measured_s == pytest.approx(20 * 60)
    end((90, 50), (50, 10))
    assert store.status().measured_s == pytest.approx(50 * 60, abs=60)  # the hour, without its last ten minutes
    queue.claim_segment("d", 60)
    assert store.status().measured_s == pytest.approx(60 * 60)
    end((90, 70), (80, 61))
    assert store.status().measured_s is None


def test_each_reason_leads_to_the_job_that_it_struck_last(store, queue, database, make_request):
    """At 5 ms job one fails for want of a disk, and at 9 ms of a worker; two fails at 9 ms for want of a disk."""
    one, two = store.submit(make_request(3)), store.submit(make_request(2))
    disk, worker = Failure(error="StorageTrouble", message="full"), Failure(error="WorkerLost", message="dead")
    moments = {}
    for failure, after_ms in ((disk, 5), (worker, 9), (None, 20), (disk, 9)):
        claim = queue.claim_segment("d", 60)
        moments[claim.job_id, claim.position] = after_ms
        if failure:
            queue.finish(claim, SegmentState.FAILED, failure=failure)
        else:
            entry = SegmentEntry(segment_id=claim.uri, uri=claim.uri, state="SUCCEEDED")
            queue.finish(claim, SegmentState.SUCCEEDED, entry=entry)
    with database.write() as connection:
        now = now_ms(connection)
        for (job_id, position), after_ms in moments.items():
            is_it = (segments.c.job_id == job_id) & (segments.c.position == position)
            connection.execute(update(segments).where(is_it).values(finished_ms=now - 1000 + after_ms))
    status = store.status()
    assert status.failures_by_error == {"StorageTrouble": 2, "WorkerLost": 1}
    assert status.last_failed_job_by_error == {"StorageTrouble": two.id, "WorkerLost": one.id}


@pytest.mark.parametrize("position", [2**31, 2**63 - 1, 2**63, -1, True, "a"])
def test_a_token_that_no_database_holds_is_no_token(store, make_request, position):
    job = store.submit(make_request()).id
    token = base64.urlsafe_b64encode(json.dumps([position]).encode()).decode()
    with pytest.raises(InvalidInput, match="not one that this listing returned"):
        store.list_segments(job, page_token=token)
    last = base64.urlsafe_b64encode(json.dumps([2**31 - 1]).encode()).decode()
    assert store.list_segments(job, page_token=last).segments == ()


def open_segments(store):
    return sum(job.segments[SegmentState.QUEUED] + job.segments[SegmentState.RUNNING] for job in store.list_jobs().jobs)


def test_an_owner_has_so_many_open_segments_and_no_more(database, queue, make_request):
    store = JobStore(database, max_open_segments=3)
    named = store.submit(make_request(2, client_job_id="first"), owner="ann")
    with pytest.raises(QueueFull, match=r"^4 segments would wait or run, 2 without this request, .* may have 3 "):
        store.submit(make_request(2), owner="ann")
    assert store.submit(make_request(2, client_job_id="first"), owner="ann").id == named.id  # asks for nothing more
    store.submit(make_request(3), owner="bob")  # others are not in the way
    store.submit(make_request(1), owner="ann")
    assert queue.claim_segment("d", 60).job_id == named.id  # what runs is open too
    with pytest.raises(QueueFull):
        store.submit(make_request(1), owner="ann")
    store.request_cancel(named.id)
    store.submit(make_request(1), owner="ann")
    assert open_segments(store) == 6


def test_a_retry_that_would_pass_the_limit_changes_nothing(database, make_request):
    store = JobStore(database, max_open_segments=3)
    job = store.submit(make_request(2))
    store.request_cancel(job.id)
    other = store.submit(make_request(2))
    before = store.get_job(job.id)
    with pytest.raises(QueueFull, match="4 segments would wait or run, 2 without"):
        store.retry_failed(job.id)
    assert store.get_job(job.id) == before
    store.request_cancel(other.id)
    assert store.retry_failed(job.id).segments[SegmentState.QUEUED] == 2
