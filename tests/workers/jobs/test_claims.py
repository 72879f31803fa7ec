import contextlib
import json
import random
import subprocess
import sys
import threading
from collections import Counter
from pathlib import Path

import pytest
from sqlalchemy import select
from sqlalchemy.exc import SQLAlchemyError

from schemas.api.jobs import Failure, JobState, SegmentState
from schemas.config import LabelingConfig
from schemas.errors import JobConflict, LabelingError, StaleClaim
from schemas.manifest import SegmentEntry
from workers.jobs.claims import MAX_ATTEMPTS, FinishedJob, SegmentQueue
from workers.jobs.tables import segments

ROOT = Path(__file__).resolve().parents[3]
BAD = Failure(error="InvalidInput", message="no sweeps")
CRASH = Failure(error="WorkerCrashed", message="killed")
ALREADY_OVER_S = 1e-6  # a lease or a deadline that has passed when the next transaction looks


def labelled(claim, state=SegmentState.SUCCEEDED):
    return {"entry": SegmentEntry(segment_id=f"id-{claim.uri[-4:]}", uri=claim.uri, state=str(state))}


def states_of(store, job_id):
    return {state: count for state, count in store.get_job(job_id).segments.items() if count}


def test_a_claim_says_all_that_labelling_needs(store, queue, make_request):
    request = make_request(2, profile="fast", overrides={"flow.iterations": 7}, sweeps=[1, 4], output_uri="s3://b/out")
    job = store.submit(request)
    claim = queue.claim_segment("me", 60)
    assert (claim.job_id, claim.generation, claim.attempt, claim.fence) == (job.id, 1, 1, 1)
    assert (claim.dataset, claim.uri, claim.output_uri) == ("synthetic", "synthetic:street?seed=0000", "s3://b/out")
    assert LabelingConfig.model_validate(claim.config) == request.make_config()
    running = store.get_job(job.id)
    assert running.state == JobState.RUNNING
    assert running.started_at >= running.created_at


def test_urgent_jobs_first_then_old_ones_then_by_uri(store, queue, make_request):
    for name, priority in (("b", 0), ("c", 0), ("a", 1), ("d", -1)):
        store.submit(make_request(segments=[f"{name}2", f"{name}1"], priority=priority))
    order = []
    while claim := queue.claim_segment("me", 60):
        order.append(claim.uri)
    assert order == ["a1", "a2", "b1", "b2", "c1", "c2", "d1", "d2"]


@pytest.mark.parametrize("state", [SegmentState.SUCCEEDED, SegmentState.PARTIAL, SegmentState.FAILED])
def test_how_a_segment_ends(store, queue, make_request, state):
    job = store.submit(make_request(1))
    claim = queue.claim_segment("me", 60)
    has_labels = state is not SegmentState.FAILED
    queue.finish(claim, state, **(labelled(claim, state) if has_labels else {"failure": BAD}))
    segment = store.list_segments(job.id).segments[0]
    assert (segment.state, segment.failure) == (state, None if has_labels else BAD)
    assert segment.segment_id == ("id-0000" if has_labels else None)
    assert segment.finished_at >= segment.started_at
    assert store.get_job(job.id).state == JobState.RUNNING  # until its manifest is out
    (finished,) = queue.list_finished_jobs()
    assert (finished.job_id, finished.output_uri) == (job.id, "out")
    assert [queue.end_job(finished), queue.end_job(finished)] == [JobState(state), JobState(state)]
    assert queue.list_finished_jobs() == []


def test_a_failure_is_kept_as_one_bounded_line(store, queue, make_request):
    job = store.submit(make_request(1))
    text = "first\n  second\0\ud800" + "x" * 5000
    queue.finish(queue.claim_segment("me", 60), SegmentState.FAILED, failure=Failure(error="E", message=text))
    message = store.list_segments(job.id).segments[0].failure.message
    assert message.startswith("first second?xxx")
    assert len(message) == 2000


@pytest.mark.parametrize(
    ("state", "report"),
    [
        (SegmentState.SUCCEEDED, {}),
        (SegmentState.FAILED, {}),
        (SegmentState.CANCELLED, {"failure": BAD}),
        (SegmentState.QUEUED, {"failure": BAD}),
        (SegmentState.RUNNING, {"failure": BAD}),
    ],
)
def test_an_end_that_is_none_is_refused(store, queue, make_request, state, report):
    job = store.submit(make_request(1))
    claim = queue.claim_segment("me", 60)
    with pytest.raises(ValueError, match="segment"):
        queue.finish(claim, state, **report)
    assert states_of(store, job.id) == {SegmentState.RUNNING: 1}


def test_a_former_holder_is_refused_whatever_it_says(store, queue, make_request):
    job = store.submit(make_request(1))
    stale = queue.claim_segment("slow", ALREADY_OVER_S)
    holder = queue.claim_segment("fast", 60)
    assert (holder.uri, holder.attempt, holder.fence) == (stale.uri, 2, 2)
    for say in (
        lambda: queue.renew(stale),
        lambda: queue.report_progress(stale, "sweeps", 1, 2),
        lambda: queue.finish(stale, SegmentState.SUCCEEDED, **labelled(stale)),
        lambda: queue.finish(stale, SegmentState.FAILED, failure=BAD),
        lambda: queue.release(stale),
        lambda: queue.release(stale, CRASH),
    ):
        with pytest.raises(StaleClaim, match="drop the result"):
            say()
    assert states_of(store, job.id) == {SegmentState.RUNNING: 1}
    queue.finish(holder, SegmentState.SUCCEEDED, **labelled(holder))
    with pytest.raises(StaleClaim):
        queue.finish(holder, SegmentState.FAILED, failure=BAD)
    assert states_of(store, job.id) == {SegmentState.SUCCEEDED: 1}


def test_a_lease_that_ran_out_still_counts_until_somebody_takes_the_segment_back(store, queue, make_request):
    job = store.submit(make_request(1))
    late = queue.claim_segment("me", ALREADY_OVER_S)
    queue.finish(late, SegmentState.SUCCEEDED, **labelled(late))
    assert states_of(store, job.id) == {SegmentState.SUCCEEDED: 1}


def test_a_renewed_lease_is_not_taken_back(store, queue, make_request):
    store.submit(make_request(1))
    claim = queue.claim_segment("me", 60)
    for keep in (lambda: queue.renew(claim), lambda: queue.report_progress(claim, "sweeps", 0, 1)):
        assert keep() is False
        queue.expire()
        assert queue.claim_segment("other", 60) is None


def test_a_segment_that_loses_every_claimant_is_crashed(store, queue, make_request):
    job = store.submit(make_request(1))
    for attempt in range(1, MAX_ATTEMPTS + 1):
        assert queue.claim_segment("me", ALREADY_OVER_S).attempt == attempt
    assert queue.claim_segment("me", 60) is None
    segment = store.list_segments(job.id).segments[0]
    assert (segment.state, segment.attempts, segment.failure.error) == (SegmentState.CRASHED, 3, "ClaimantLost")
    assert [queue.end_job(job) for job in queue.list_finished_jobs()] == [JobState.CRASHED]


def test_a_crash_counts_as_an_attempt_and_a_clean_stop_does_not(store, queue, make_request):
    job = store.submit(make_request(1))
    for _ in range(2 * MAX_ATTEMPTS):
        assert queue.release(queue.claim_segment("me", 60)) == SegmentState.QUEUED
    outcomes = [queue.release(queue.claim_segment("me", 60), CRASH) for _ in range(MAX_ATTEMPTS)]
    assert outcomes == [SegmentState.QUEUED] * (MAX_ATTEMPTS - 1) + [SegmentState.CRASHED]
    assert store.list_segments(job.id).segments[0].failure == CRASH


def test_a_job_past_its_deadline_stops(store, queue, make_request):
    never = store.submit(make_request(2, deadline_s=ALREADY_OVER_S))
    assert queue.claim_segment("me", 60) is None
    waited = store.get_job(never.id)
    assert (waited.state, waited.cancel_requested) == (JobState.TIMED_OUT, False)
    assert waited.failure.error == "DeadlineExceeded"
    assert waited.failure.message == "0 of 2 segments were labelled within 1e-06 s"


def test_a_running_job_past_its_deadline_keeps_the_labels_it_has(store, queue, database, make_request):
    job = store.submit(make_request(3, deadline_s=3600))
    done, running = queue.claim_segment("me", 60), queue.claim_segment("me", ALREADY_OVER_S)
    queue.finish(done, SegmentState.SUCCEEDED, **labelled(done))
    with database.write() as connection:
        connection.exec_driver_sql("UPDATE jobs SET deadline_ms = created_ms")
    assert queue.claim_segment("me", 60) is None  # stops the job, and takes the lost segment back: it is not repeated
    assert store.get_job(job.id).state == JobState.CANCELLING
    assert states_of(store, job.id) == {SegmentState.SUCCEEDED: 1, SegmentState.CANCELLED: 2}
    with pytest.raises(StaleClaim):
        queue.renew(running)
    (finished,) = queue.list_finished_jobs()
    assert queue.end_job(finished) == JobState.TIMED_OUT
    assert store.get_job(job.id).failure.message.startswith("1 of 3 segments were labelled")
    results = list(queue.iterate_results(job.id))
    assert [result.state for result in results] == ["SUCCEEDED", "CANCELLED", "CANCELLED"]
    assert results[0].entry == labelled(done)["entry"]


def test_a_dispatcher_that_claims_nothing_learns_of_a_deadline(store, queue, database, make_request):
    store.submit(make_request(1, deadline_s=3600))
    claim = queue.claim_segment("me", 60)
    with database.write() as connection:
        connection.exec_driver_sql("UPDATE jobs SET deadline_ms = created_ms")
    queue.expire()
    assert queue.renew(claim) is True
    assert queue.release(claim) == SegmentState.CANCELLED
    assert [queue.end_job(job) for job in queue.list_finished_jobs()] == [JobState.TIMED_OUT]


def test_results_come_sorted_page_by_page(store, queue, make_request, monkeypatch):
    monkeypatch.setattr("workers.jobs.claims._PAGE_ROWS", 3)
    job = store.submit(make_request(7))
    while claim := queue.claim_segment("me", 60):
        queue.finish(claim, SegmentState.FAILED, failure=BAD)
    results = list(queue.iterate_results(job.id))
    assert [result.uri for result in results] == [f"synthetic:street?seed={i:04}" for i in range(7)]
    assert {(result.state, result.failure, result.entry) for result in results} == {(SegmentState.FAILED, BAD, None)}


def test_a_job_with_an_open_segment_cannot_be_ended(store, queue, make_request):
    job = store.submit(make_request(1))
    claim = queue.claim_segment("me", 60)
    assert queue.list_finished_jobs() == []
    with pytest.raises(JobConflict, match="some of its segments are still open"):
        queue.end_job(FinishedJob(job.id, 1, claim.dataset, claim.output_uri, claim.config))


CLAIM_ALL = """
import json, sys
from schemas.api.jobs import Failure, SegmentState
from workers.jobs.claims import SegmentQueue
from workers.jobs.database import open_database
queue, claimed = SegmentQueue(open_database(sys.argv[1])), []
print("ready", flush=True)
sys.stdin.readline()
while claim := queue.claim_segment(sys.argv[2], 60):
    queue.report_progress(claim, "sweeps", 1, 2)
    queue.finish(claim, SegmentState.FAILED, failure=Failure(error="E", message=sys.argv[2]))
    claimed.append(f"{claim.job_id} {claim.uri}")
print(json.dumps(claimed))
"""


def test_processes_share_the_queue_without_doubling_or_losing_a_segment(url, store, queue, make_request):
    ids = [store.submit(make_request(100)).id for _ in range(2)]
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True, "cwd": ROOT}
    processes = [subprocess.Popen([sys.executable, "-c", CLAIM_ALL, url, f"d{i}"], **pipes) for i in range(3)]
    assert [process.stdout.readline() for process in processes] == ["ready\n"] * 3
    answers = [process.communicate("go\n")[0] for process in processes]
    claimed = Counter(name for answer in answers for name in json.loads(answer))
    assert set(claimed.values()) == {1}
    assert set(claimed) == {f"{job_id} synthetic:street?seed={i:04}" for job_id in ids for i in range(100)}
    assert [queue.end_job(job) for job in queue.list_finished_jobs()] == [JobState.FAILED] * 2


def test_claims_cancels_and_retries_at_once_leave_no_job_behind(store, database, make_request):
    ids = [store.submit(make_request(12)).id for _ in range(4)]
    troubles, stop = [], threading.Event()

    def end(queue, claim, rng):
        ways = [
            lambda: queue.finish(claim, SegmentState.SUCCEEDED, **labelled(claim)),
            lambda: queue.finish(claim, SegmentState.FAILED, failure=BAD),
            lambda: queue.release(claim),
            lambda: queue.release(claim, CRASH),
        ]
        with contextlib.suppress(StaleClaim):
            rng.choice(ways)()

    def dispatch(seed):
        rng, queue = random.Random(seed), SegmentQueue(database)
        try:
            while not stop.is_set():
                claim = queue.claim_segment(f"d{seed}", rng.choice([ALREADY_OVER_S, 60]))
                if claim is not None:
                    end(queue, claim, rng)
                for job in queue.list_finished_jobs():
                    with contextlib.suppress(JobConflict):  # retried in between
                        queue.end_job(job)
        except (SQLAlchemyError, LabelingError) as error:  # a deadlock, a transition that must not be
            troubles.append(error)

    threads = [threading.Thread(target=dispatch, args=(seed,)) for seed in range(3)]
    for thread in threads:
        thread.start()
    rng = random.Random(99)
    for _ in range(60):
        with contextlib.suppress(JobConflict):
            rng.choice([store.request_cancel, store.retry_failed])(rng.choice(ids))
    for job_id in ids:
        with contextlib.suppress(JobConflict):
            store.request_cancel(job_id)
    while not troubles and not all(store.get_job(job_id).state.is_ended for job_id in ids):
        stop.wait(0.01)
    stop.set()
    for thread in threads:
        thread.join()
    assert troubles == []
    with database.read() as connection:
        left = connection.execute(select(segments.c.state, segments.c.holder, segments.c.lease_ms)).all()
    assert all(SegmentState(row.state).is_ended and row.holder is None and row.lease_ms is None for row in left)
    assert len(left) == 48
