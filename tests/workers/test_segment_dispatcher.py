"""What the dispatcher promises, with fakes for Ray and a real job store: nothing is lost, and nothing waits."""

import sqlite3
from concurrent.futures import Future

import pytest
from sqlalchemy import select, update
from sqlalchemy.exc import DataError, OperationalError

from schemas.api.jobs import Failure, JobRequest, JobState, SegmentState
from schemas.errors import StageFailed, WorkerLost
from schemas.manifest import SegmentEntry, Shard
from workers.cluster import ClusterLost
from workers.jobs.claims import SegmentQueue
from workers.jobs.database import migrate_database, open_database
from workers.jobs.labels import read_labels
from workers.jobs.store import JobStore
from workers.jobs.tables import jobs, segments
from workers.segment_dispatcher import LEASE_S, SegmentDispatcher
from workers.segment_labeler import Progress, SegmentOutcome

AT_ONCE = 2  # segments, on the CPUs of FakeWorkers


class FakeAttempt:
    def __init__(self, claim):
        self.claim = claim
        self.is_ended, self.num_kills = False, 0
        self.said = Progress("id", "sweeps", 1, 4)

    def progress(self):
        return self.said

    def outcome(self):
        if isinstance(self.result, Exception):
            raise self.result
        return self.result

    @property
    def is_killed(self):
        return self.num_kills > 0

    def kill(self):
        self.num_kills += 1
        done = Future()
        done.set_result(None)
        return done

    def end(self, result):
        self.result, self.is_ended = result, True

    def succeed(self):
        shard = Shard(table="labels", path=f"labels/{self.claim.position}", rows=1, bytes=1, sha256="0" * 64)
        entry = {"segment_id": self.claim.uri, "uri": self.claim.uri, "num_sweeps": 4, "shards": (shard,)}
        self.end(SegmentOutcome(SegmentEntry(state="SUCCEEDED", **entry)))


class FakePublication:
    def __init__(self, job, entries):
        self.job, self.entries = job, entries
        self.is_ended = False
        self.result = None

    def outcome(self):
        if isinstance(self.result, Exception):
            raise self.result
        return self.result


class FakeProbe:
    def __init__(self):
        self.answer = False

    def is_answered(self):
        if isinstance(self.answer, Exception):
            raise self.answer
        return self.answer


class FakeWorkers:
    def __init__(self):
        self.attempts, self.publications, self.probes, self.kept = [], [], [], set()

    def num_cpus(self):
        return 3 * AT_ONCE

    def start(self, claim, config, limits):
        self.attempts.append(FakeAttempt(claim))
        return self.attempts[-1]

    def publish(self, job, config, entries):
        self.publications.append(FakePublication(job, entries))
        return self.publications[-1]

    def probe(self):
        self.probes.append(FakeProbe())
        return self.probes[-1]

    def keep(self, job_ids):
        self.kept = set(job_ids)


class Clock:
    """Time that passes when a test says so."""

    now_s = 1000.0

    def __call__(self):
        return self.now_s


@pytest.fixture
def path(tmp_path):
    return tmp_path / "jobs.sqlite3"


@pytest.fixture
def database(path):
    database = open_database(f"sqlite:///{path}", wait_s=0.02)
    yield database
    database.close()


@pytest.fixture
def store(database):
    return JobStore(database)


@pytest.fixture
def queue(database):
    return SegmentQueue(database)


@pytest.fixture
def clock():
    return Clock()


@pytest.fixture
def make_dispatcher(queue, clock):
    """Return a function that makes a dispatcher and its workers, both on the clock of the test."""

    def make(queue=queue):
        workers = FakeWorkers()
        return SegmentDispatcher(queue, workers, clock=clock), workers

    return make


@pytest.fixture
def submit(store):
    def run(num_segments=1, **fields):
        uris = [f"synthetic:street?seed={i}" for i in range(num_segments)]
        return store.submit(JobRequest(dataset="synthetic", segments=uris, output_uri="out", **fields)).id

    return run


@pytest.fixture
def segment(store):
    """Return a function that tells state and attempts of a job's segment."""

    def tell(job_id, position=0):
        found = store.list_segments(job_id).segments[position]
        return found.state, found.attempts

    return tell


@pytest.fixture
def expire_leases(database):
    def run():
        with database.write() as connection:
            connection.execute(update(segments).where(segments.c.lease_ms.is_not(None)).values(lease_ms=0))

    return run


@pytest.fixture
def lock(path):
    """A connection that can keep everybody from writing: ``BEGIN IMMEDIATE`` to ``ROLLBACK``."""
    connection = sqlite3.connect(path, isolation_level=None)
    yield connection
    connection.close()


@pytest.fixture
def pass_time(clock):
    """Return a function that ticks dispatchers four times a second."""

    def run(seconds, *dispatchers):
        for _ in range(int(4 * seconds)):
            clock.now_s += 0.25
            for dispatcher in dispatchers:
                dispatcher.tick()

    return run


class Refusing(SegmentQueue):
    """A queue that does not take words on one segment."""

    position, error, num_refused = None, None, 0

    def _refuse(self, claim):
        if claim.position == self.position:
            self.num_refused += 1
            raise self.error("UPDATE", {}, Exception("refused"))

    def renew(self, claim):
        self._refuse(claim)
        return super().renew(claim)

    def report_progress(self, claim, *progress):
        self._refuse(claim)
        return super().report_progress(claim, *progress)

    def finish(self, claim, *end, **more):
        self._refuse(claim)
        return super().finish(claim, *end, **more)


# A store that is away


def test_an_outcome_is_kept_until_a_locked_store_takes_it(make_dispatcher, submit, segment, store, lock, pass_time):
    job = submit()
    dispatcher, workers = make_dispatcher()
    dispatcher.tick()
    (attempt,) = workers.attempts
    lock.execute("BEGIN IMMEDIATE")
    attempt.succeed()
    pass_time(3, dispatcher)
    lock.execute("ROLLBACK")
    assert segment(job) == (SegmentState.RUNNING, 1)
    pass_time(1.25, dispatcher)
    assert segment(job) == (SegmentState.SUCCEEDED, 1)
    assert store.list_segments(job).segments[0].sweeps_done == 4
    assert len(workers.attempts) == 1


def test_a_locked_store_is_waited_for_once_a_tick(make_dispatcher, submit, lock, database, clock):
    submit(AT_ONCE)
    queue = Refusing(database)
    queue.position, queue.error = 0, OperationalError
    dispatcher, workers = make_dispatcher(queue)
    dispatcher.tick()
    queue._refuse = lambda claim: setattr(queue, "num_refused", queue.num_refused + 1)  # count all that is told
    clock.now_s += 1
    lock.execute("BEGIN IMMEDIATE")
    dispatcher.tick()
    assert (queue.num_refused, len(workers.attempts)) == (1, AT_ONCE)
    clock.now_s += 0.25
    dispatcher.tick()
    assert queue.num_refused == 2  # and now the other had its turn
    lock.execute("ROLLBACK")


def test_after_a_lock_longer_than_the_lease_nobody_takes_back_what_is_its_own(
    make_dispatcher, submit, segment, lock, expire_leases, pass_time, clock
):
    job = submit(AT_ONCE)
    dispatcher, workers = make_dispatcher()
    dispatcher.tick()
    lock.execute("BEGIN IMMEDIATE")
    pass_time(LEASE_S + 5, dispatcher)
    lock.execute("ROLLBACK")
    expire_leases()
    pass_time(3, dispatcher)
    assert [segment(job, position) for position in range(AT_ONCE)] == [(SegmentState.RUNNING, 1)] * AT_ONCE
    assert not any(attempt.is_killed for attempt in workers.attempts)


def test_what_the_store_refuses_of_one_segment_holds_up_no_other(make_dispatcher, submit, segment, database, pass_time):
    job = submit(AT_ONCE + 1)
    queue = Refusing(database)
    queue.position, queue.error = 0, OperationalError
    dispatcher, workers = make_dispatcher(queue)
    dispatcher.tick()
    for attempt in workers.attempts:
        attempt.succeed()
    pass_time(2, dispatcher)
    assert [segment(job, position)[0] for position in range(3)] == ["RUNNING", "SUCCEEDED", "RUNNING"]
    assert [attempt.claim.position for attempt in workers.attempts] == [0, 1, 2]
    assert 1 <= queue.num_refused <= 3  # once a second
    queue.position = None
    pass_time(1, dispatcher)
    assert segment(job) == (SegmentState.SUCCEEDED, 1)


def test_a_cancelled_attempt_is_killed_once_and_its_end_told_when_the_store_is_back(
    make_dispatcher, submit, store, segment, lock, pass_time
):
    job = submit()
    dispatcher, workers = make_dispatcher()
    dispatcher.tick()
    (attempt,) = workers.attempts
    store.request_cancel(job)
    pass_time(3, dispatcher)
    assert attempt.num_kills == 1
    lock.execute("BEGIN IMMEDIATE")
    pass_time(2, dispatcher)
    attempt.end(WorkerLost("killed"))
    pass_time(2, dispatcher)
    lock.execute("ROLLBACK")
    pass_time(2, dispatcher)
    assert segment(job) == (SegmentState.CANCELLED, 0)
    assert workers.probes == []  # we killed it
    assert store.get_job(job).state is JobState.CANCELLED


def test_an_end_that_the_store_can_never_hold_is_a_crash(make_dispatcher, submit, store, database, pass_time):
    job = submit()
    queue = Refusing(database)
    dispatcher, workers = make_dispatcher(queue)
    dispatcher.tick()
    queue.position, queue.error = 0, DataError
    for number in range(1, 4):
        pass_time(3, dispatcher)
        assert len(workers.attempts) == number
        workers.attempts[-1].succeed()
    pass_time(3, dispatcher)
    found = store.list_segments(job).segments[0]
    assert (found.state, found.attempts, found.failure.error) == (SegmentState.CRASHED, 3, "DataError")
    assert found.failure.message == "the job store cannot hold how it ended: refused"


# A dispatcher that was stopped for a while


def test_alone_a_pause_costs_nothing(make_dispatcher, submit, segment, expire_leases, clock, pass_time):
    job = submit(AT_ONCE)
    dispatcher, workers = make_dispatcher()
    dispatcher.tick()
    workers.attempts[0].succeed()
    clock.now_s += 40
    expire_leases()
    pass_time(2, dispatcher)
    assert segment(job, 0) == (SegmentState.SUCCEEDED, 1)
    assert segment(job, 1) == (SegmentState.RUNNING, 1)
    assert not workers.attempts[1].is_killed


@pytest.mark.parametrize("paused", ["running", "ended", "dead"])
def test_a_pause_beside_another_costs_one_attempt_and_changes_no_row(
    make_dispatcher, submit, segment, database, expire_leases, clock, pass_time, paused
):
    job = submit()
    slow, slow_workers = make_dispatcher()
    fast, fast_workers = make_dispatcher()
    slow.tick()
    expire_leases()
    clock.now_s += 40
    fast.tick()
    (former,), (present,) = slow_workers.attempts, fast_workers.attempts
    assert segment(job) == (SegmentState.RUNNING, 2)
    if paused == "ended":
        former.end(StageFailed("late and wrong"))
    elif paused == "dead":
        former.end(WorkerLost("killed"))
    pass_time(1, slow, fast)
    assert (former.is_killed, present.is_killed) == (True, False)
    present.succeed()
    pass_time(1, fast)
    with database.read() as connection:
        ended = connection.execute(select(segments)).all()
    former.end(StageFailed("later still"))
    pass_time(3, slow, fast)
    with database.read() as connection:
        assert connection.execute(select(segments)).all() == ended
    assert segment(job) == (SegmentState.SUCCEEDED, 2)
    submit()
    slow.tick()
    pass_time(1, slow)
    assert len(slow_workers.attempts) == 2  # it works on


def test_a_stopped_dispatcher_that_has_the_store_locked_holds_nobody_up_for_good(
    make_dispatcher, submit, segment, lock, pass_time, clock
):
    job = submit()
    other, workers = make_dispatcher()
    other.tick()
    lock.execute("BEGIN IMMEDIATE")  # in mid-transaction
    pass_time(40, other)
    lock.execute("COMMIT")
    pass_time(2, other)
    assert segment(job) == (SegmentState.RUNNING, 1)
    workers.attempts[0].succeed()
    pass_time(1, other)
    assert segment(job) == (SegmentState.SUCCEEDED, 1)


# Deaths


def test_a_death_is_judged_while_the_rest_goes_on(make_dispatcher, submit, segment, database, pass_time):
    job = submit(AT_ONCE)
    dispatcher, workers = make_dispatcher()
    dispatcher.tick()
    dead, alive = workers.attempts
    dead.end(WorkerLost("killed"))
    pass_time(1, dispatcher)
    (probe,) = workers.probes
    with database.write() as connection:
        connection.execute(update(segments).values(lease_ms=segments.c.lease_ms - 10_000))
        before = connection.scalars(select(segments.c.lease_ms)).all()
    pass_time(2, dispatcher)  # whoever waited for the answer would renew no lease
    with database.read() as connection:
        after = connection.scalars(select(segments.c.lease_ms)).all()
    assert [late - early > 5_000 for early, late in zip(before, after, strict=True)] == [True, True]
    alive.succeed()
    pass_time(1, dispatcher)
    assert segment(job, 1) == (SegmentState.SUCCEEDED, 1)
    probe.answer = True
    pass_time(1, dispatcher)
    assert segment(job, 0) == (SegmentState.RUNNING, 2)  # the death counted, and the segment was claimed again
    assert len(workers.probes) == 1


def test_a_death_after_the_question_waits_for_the_next_answer(make_dispatcher, submit, store, pass_time):
    job = submit(AT_ONCE)
    dispatcher, workers = make_dispatcher()
    dispatcher.tick()
    first, second = workers.attempts
    first.end(WorkerLost("killed"))
    pass_time(0.5, dispatcher)
    second.end(WorkerLost("killed later"))
    workers.probes[0].answer = True
    pass_time(0.5, dispatcher)
    assert [attempt.claim.position for attempt in workers.attempts] == [0, 1, 0]
    assert [found.attempts for found in store.list_segments(job).segments] == [2, 1]
    assert len(workers.probes) == 2
    workers.probes[1].answer = True
    pass_time(0.5, dispatcher)
    assert [found.attempts for found in store.list_segments(job).segments] == [2, 2]


def test_the_death_of_the_cluster_is_no_attempt(make_dispatcher, submit, segment):
    job = submit(AT_ONCE)
    dispatcher, workers = make_dispatcher()
    dispatcher.tick()
    workers.attempts[0].end(WorkerLost("killed"))
    workers.attempts[1].succeed()
    workers.probe = FakeProbe  # which never answers at once
    dispatcher.tick()
    dispatcher._probe.answer = ClusterLost("gone")
    with pytest.raises(ClusterLost):
        dispatcher.tick()
    dispatcher.close()
    assert segment(job, 0) == (SegmentState.QUEUED, 0)
    assert segment(job, 1) == (SegmentState.SUCCEEDED, 1)


# The end of a job, and of the dispatcher


def test_an_end_of_a_job_is_kept_until_a_locked_store_takes_it(make_dispatcher, submit, store, lock, pass_time):
    job = submit()
    dispatcher, workers = make_dispatcher()
    dispatcher.tick()
    workers.attempts[0].succeed()
    pass_time(2, dispatcher)
    (publication,) = workers.publications
    assert [entry.segment_id for entry in publication.entries] == ["synthetic:street?seed=0"]
    assert workers.kept == {job}
    publication.is_ended = True
    lock.execute("BEGIN IMMEDIATE")
    pass_time(3, dispatcher)
    lock.execute("ROLLBACK")
    assert store.get_job(job).state is JobState.RUNNING
    pass_time(2, dispatcher)
    assert store.get_job(job).state is JobState.SUCCEEDED
    assert len(workers.publications) == 1
    assert workers.kept == set()


def test_a_manifest_whose_writer_died_is_published_again(make_dispatcher, submit, store, pass_time):
    job = submit()
    dispatcher, workers = make_dispatcher()
    dispatcher.tick()
    workers.attempts[0].succeed()
    pass_time(2, dispatcher)
    workers.publications[0].result, workers.publications[0].is_ended = WorkerLost("killed"), True
    pass_time(2, dispatcher)
    workers.probes[0].answer = True
    workers.publications[1].result = Failure(error="OSError", message="disk full")
    workers.publications[1].is_ended = True
    pass_time(2, dispatcher)
    assert (store.get_job(job).state, store.get_job(job).failure.message) == (JobState.FAILED, "disk full")


def test_a_manifest_of_an_earlier_generation_does_not_stay(make_dispatcher, submit, store, pass_time):
    job = submit(2)
    slow, slow_workers = make_dispatcher()
    fast, fast_workers = make_dispatcher()
    slow.tick()
    slow_workers.attempts[0].succeed()
    slow_workers.attempts[1].end(StageFailed("our bug"))
    pass_time(2, slow)
    (early,) = slow_workers.publications  # and now it is stopped, while another ends the job, and its retry
    pass_time(2, fast)
    fast_workers.publications[0].is_ended = True
    pass_time(1, fast)
    store.retry_failed(job)
    pass_time(2, fast)
    fast_workers.attempts[0].succeed()
    pass_time(2, fast)
    fast_workers.publications[1].is_ended = True
    pass_time(1, fast)
    assert store.get_job(job).state is JobState.SUCCEEDED
    early.is_ended = True
    pass_time(1, slow)
    late = slow_workers.publications[1]
    assert late.job.generation == 2
    assert [entry.state for entry in late.entries] == ["SUCCEEDED", "SUCCEEDED"]
    late.is_ended = True
    pass_time(2, slow)
    assert store.get_job(job).state is JobState.SUCCEEDED
    assert len(slow_workers.publications) == 2


def test_parameters_of_another_version_fail_the_job_and_not_the_dispatcher(
    make_dispatcher, submit, store, database, pass_time
):
    job = submit(2)
    dispatcher, workers = make_dispatcher()
    dispatcher.tick()
    workers.attempts[0].succeed()
    workers.attempts[1].end(WorkerLost("killed"))
    pass_time(1, dispatcher)
    with database.write() as connection:
        config = connection.scalar(select(jobs.c.config))
        connection.execute(update(jobs).values(config=config | {"gone": 1}))
    workers.probes[0].answer = True
    pass_time(4, dispatcher)
    message = "this version cannot use what another stored of the job: gone: there is no such option"
    found = store.list_segments(job).segments
    assert [segment.state for segment in found] == [SegmentState.SUCCEEDED, SegmentState.FAILED]
    assert (found[1].failure.error, found[1].failure.message) == ("InvalidInput", message)
    assert (store.get_job(job).state, store.get_job(job).failure.message) == (JobState.FAILED, message)
    assert [entry.state for entry in read_labels(database, job).segments] == ["SUCCEEDED"]


def test_closing_settles_what_has_ended_and_gives_back_the_rest(make_dispatcher, submit, segment, store, pass_time):
    job = submit(AT_ONCE)
    dispatcher, workers = make_dispatcher()
    dispatcher.tick()
    workers.attempts[0].succeed()
    dispatcher.close()
    assert all(attempt.is_killed for attempt in workers.attempts)
    assert segment(job, 0) == (SegmentState.SUCCEEDED, 1)
    assert segment(job, 1) == (SegmentState.QUEUED, 0)
    assert store.status().dispatchers == ()


def test_closing_with_the_store_away_ends_all_the_same(make_dispatcher, submit, segment, lock):
    job = submit(AT_ONCE)
    dispatcher, workers = make_dispatcher()
    dispatcher.tick()
    lock.execute("BEGIN IMMEDIATE")
    dispatcher.close()
    lock.execute("ROLLBACK")
    assert all(attempt.is_killed for attempt in workers.attempts)
    assert segment(job, 0) == (SegmentState.RUNNING, 1)  # until the lease runs out


# A store of the first version


def test_the_half_done_job_of_an_old_store_is_finished(tmp_path, make_old_store, clock, pass_time):
    url = f"sqlite:///{tmp_path}/old.sqlite3"
    make_old_store(url)
    migrate_database(url)
    database = open_database(url)
    store = JobStore(database)
    ended = store.get_job("ended")
    workers = FakeWorkers()
    dispatcher = SegmentDispatcher(SegmentQueue(database), workers, clock=clock)
    dispatcher.tick()
    assert [(attempt.claim.uri, attempt.claim.attempt) for attempt in workers.attempts] == [("c", 2), ("d", 1)]
    for attempt in workers.attempts:
        attempt.succeed()
    pass_time(2, dispatcher)
    (publication,) = workers.publications
    assert [entry.uri for entry in publication.entries] == ["b", "c", "d"]
    publication.is_ended = True
    pass_time(1, dispatcher)
    assert store.get_job("begun").state is JobState.SUCCEEDED
    assert store.get_job("ended") == ended
    database.close()
