"""The dispatcher as its own process, on the session's Ray or on one of its own, on a real job store."""

import contextlib
import os
import signal
import subprocess
import sys
import time

import psutil
import pytest
import ray
from sqlalchemy import select

from labeling.readers.reader import open_segment
from schemas.api.jobs import JobRequest, JobState, SegmentState
from workers.jobs.database import URL_VARIABLE, open_database
from workers.jobs.store import JobStore
from workers.jobs.tables import segments
from workers.processes import descendants, kill, kill_session, session_members

pytestmark = [pytest.mark.ray, pytest.mark.timeout(900)]

LEASE_S = 3.0  # not 15: what a pause does follows from its length in leases, and a test of a minute is long enough
WITH_SHORT_LEASES = (
    "import os, sys; from pathlib import Path; from workers.dispatcher import run; from workers.jobs.database import "
    f"URL_VARIABLE; sys.exit(run(os.environ[URL_VARIABLE], Path(sys.argv[1]), sys.argv[2], None, lease_s={LEASE_S}))"
)
# Starts what follows on two CPUs, whatever the machine has.
ON_TWO_CPUS = (
    sys.executable,
    "-c",
    "import os, sys; os.sched_setaffinity(0, sorted(os.sched_getaffinity(0))[:2]); os.execv(sys.argv[1], sys.argv[1:])",
)


@pytest.fixture
def url(tmp_path):
    return f"sqlite:///{tmp_path / 'jobs.sqlite3'}"


@pytest.fixture
def database(url):
    database = open_database(url)
    yield database
    database.close()


@pytest.fixture
def store(database):
    return JobStore(database)


@pytest.fixture
def submit(store, overrides, tmp_path):
    """Return a function that submits segments with the session's parameters and returns the job's id."""

    def run(output, *segments):
        output_uri = str(tmp_path / output)
        request = JobRequest(
            dataset="av2", segments=segments, output_uri=output_uri, overrides=overrides, write_points=True
        )
        return store.submit(request).id

    return run


@pytest.fixture
def wait_until(store):
    """Return a function that waits until a job satisfies ``condition``; the test's time limit ends it otherwise."""

    def wait(job_id, condition):
        while not condition(store.get_job(job_id)):
            time.sleep(0.1)

    return wait


@pytest.fixture
def wait_for_attempt(store, wait_until):
    """Return a function that waits until attempt ``number`` at a job's only segment has labelled a sweep."""

    def wait(job_id, number):
        wait_until(job_id, lambda _: store.list_segments(job_id).segments[0].attempts == number)
        wait_until(job_id, lambda status: status.progress > 0)
        assert store.get_job(job_id).state is JobState.RUNNING

    return wait


@pytest.fixture
def expire_leases(database):
    """Return a function that lets all leases run out."""

    def expire():
        with database.write() as connection:
            connection.exec_driver_sql("UPDATE segments SET lease_ms = 0 WHERE lease_ms IS NOT NULL")

    return expire


@pytest.fixture
def start(url, tmp_path):
    """Return a function that starts a command of motionlabel on the job store; its session is killed at the end."""
    processes = []

    def run(*command, prefix=(), **variables):
        with (tmp_path / "log").open("a") as log:
            process = subprocess.Popen(
                [*prefix, sys.executable, "-m", "service", *command, "--data-dir", tmp_path / "data"],
                env=os.environ | {URL_VARIABLE: url} | variables,
                stdout=log,
                stderr=log,
                start_new_session=True,
            )
        processes.append(process)
        return process

    yield run
    for process in processes:
        kill_session(process.pid)
        process.wait()


@pytest.fixture
def start_on_cluster(cluster, start):
    """Return a function that has a shell start a dispatcher on the session's Ray; it returns the shell, which ends."""
    variables = {"MOTIONLABEL_RAY_ADDRESS": ray.get_runtime_context().gcs_address, "RAY_AUTH_MODE": "token"}
    return lambda: start("dispatch", prefix=("sh", "-c", '"$@" & exit', "sh"), **variables)


@pytest.fixture
def start_with_short_leases(cluster, url, tmp_path, store):
    """Return a function that starts a dispatcher on the session's Ray and waits for its first word."""
    processes = []
    variables = {URL_VARIABLE: url, "RAY_AUTH_MODE": "token"}

    def run():
        address = ray.get_runtime_context().gcs_address
        command = [sys.executable, "-c", WITH_SHORT_LEASES, tmp_path / "data", address]
        with (tmp_path / "log").open("a") as log:
            process = psutil.Popen(command, env=os.environ | variables, stderr=log, start_new_session=True)
        processes.append(process)
        while process.pid not in {dispatcher.pid for dispatcher in store.status().dispatchers}:
            assert process.poll() is None
            time.sleep(0.05)
        return process

    yield run
    for process in processes:
        process.kill()
        process.wait()


@pytest.fixture
def stop(database):
    """Return a function that stops a process in mid-work, though not while it has the store locked: we have that."""

    def run(process):
        with database.write():
            process.suspend()
            while process.status() != psutil.STATUS_STOPPED:
                time.sleep(0.01)

    return run


@pytest.fixture
def next_dispatcher(store):
    """Return a function that waits until one more dispatcher reports and returns its pid. The end kills them all."""
    pids = []

    def wait():
        while not (new := {dispatcher.pid for dispatcher in store.status().dispatchers}.difference(pids)):
            time.sleep(0.1)
        pids.extend(new)
        return pids[-1]

    yield wait
    for pid in pids:
        kill_session(pid)


def members(session):
    """Return the ids of the living processes of a session."""
    return [process.pid for process in session_members(session)]


def labelers(processes):
    """Return those of the processes that label a segment."""
    found = []
    for process in processes:
        with contextlib.suppress(psutil.NoSuchProcess):
            if " ".join(process.cmdline()).startswith("ray::SegmentLabeler"):
                found.append(process)
    return found


def test_a_dispatcher_ends_when_told_and_not_with_its_parent(start_on_cluster, next_dispatcher, store):
    shell = start_on_cluster()
    assert shell.wait() == 0
    pid = next_dispatcher()
    assert [dispatcher.num_workers for dispatcher in store.status().dispatchers] == [2]
    os.kill(pid, signal.SIGTERM)
    while store.status().dispatchers:
        time.sleep(0.05)
    while members(shell.pid):
        time.sleep(0.05)


def test_a_dispatcher_is_killed_and_the_next_one_is_orphaned(
    start, start_on_cluster, next_dispatcher, expire_leases, submit, wait_until, wait_for_attempt,
    store, logs, long_log, oracle, shards, tmp_path,
):  # fmt: skip
    long = submit("long", long_log)
    shell = start_on_cluster()
    first = next_dispatcher()
    wait_for_attempt(long, 1)
    os.kill(first, signal.SIGKILL)  # in mid-segment: no lease is given back
    while members(shell.pid):
        time.sleep(0.05)
    expire_leases()

    # The next one takes the segment over, beside a job of which one segment cannot be read.
    missing = str(tmp_path / "missing")
    job = submit("out", logs[0], missing)
    serve = start("serve", "--port", "0", prefix=ON_TWO_CPUS)
    second = next_dispatcher()
    assert "sqlite:" not in " ".join(psutil.Process(second).cmdline())  # a URL may hold a password
    wait_until(job, lambda status: status.state.is_ended)
    assert store.get_job(job).state is JobState.PARTIAL
    states = {segment.uri: segment.state for segment in store.list_segments(job).segments}
    assert states == {logs[0]: SegmentState.SUCCEEDED, missing: SegmentState.FAILED}
    segment_id = open_segment("av2", logs[0]).segment_id
    assert shards(tmp_path / "out") == {path: oracle[path] for path in oracle if f"/{segment_id}-" in path}
    assert len(list((tmp_path / "out/manifests").iterdir())) == 1
    wait_for_attempt(long, 2)

    # A labeler dies, and the dispatcher does not. A job is cancelled, and the other goes on.
    while len(labelers(session_members(second))) > 1:  # that of the job that has ended
        time.sleep(0.05)
    kill(labelers(session_members(second)))
    wait_until(long, lambda _: store.list_segments(long).segments[0].attempts == 3)
    cancelled = submit("cancelled", long_log)
    wait_until(cancelled, lambda status: status.state is JobState.RUNNING)
    store.request_cancel(cancelled)
    wait_until(cancelled, lambda status: status.state.is_ended)
    assert store.get_job(cancelled).state is JobState.CANCELLED
    assert shards(tmp_path / "cancelled") == {}
    wait_for_attempt(long, 3)

    # Orphaned while it works, the dispatcher gives its segment back, which is no attempt, and leaves no process.
    serve.kill()
    while second in members(second):
        time.sleep(0.05)
    assert members(second) == []
    (segment,) = store.list_segments(long).segments
    assert (segment.state, segment.attempts) == (SegmentState.QUEUED, 2)
    assert [dispatcher.pid for dispatcher in store.status().dispatchers] == [first]  # who could not sign off


def test_a_dispatcher_that_was_stopped_costs_one_attempt_and_changes_no_row(
    start_with_short_leases, stop, submit, wait_until, wait_for_attempt, store, database, logs, long_log, oracle,
    shards, tmp_path,
):  # fmt: skip
    def is_working(process):
        (found,) = [dispatcher for dispatcher in store.status().dispatchers if dispatcher.pid == process.pid]
        return found.heartbeat_age_s < LEASE_S

    # It is stopped with a segment in hand, whose labeler goes on and publishes. The other finds the labels there.
    first = start_with_short_leases()
    job = submit("out", logs[0])
    while not labelers(descendants()):
        time.sleep(0.05)
    stop(first)
    second = start_with_short_leases()
    wait_until(job, lambda status: status.state.is_ended)
    assert [(segment.state, segment.attempts) for segment in store.list_segments(job).segments] == [("SUCCEEDED", 2)]
    segment_id = open_segment("av2", logs[0]).segment_id
    expected = {path: oracle[path] for path in oracle if f"/{segment_id}-" in path}
    assert shards(tmp_path / "out") == expected
    with database.read() as connection:
        ended = connection.execute(select(segments)).all()
    assert not is_working(first)
    first.resume()
    while not is_working(first):
        time.sleep(0.05)
    with database.read() as connection:
        assert connection.execute(select(segments)).all() == ended
    assert shards(tmp_path / "out") == expected

    # The other is stopped, and wakes while its segment is at work elsewhere: it ends its own attempt, and no other.
    long = submit("long", long_log)
    wait_for_attempt(long, 1)
    holder, other = (first, second) if _is_held_by(database, long, first) else (second, first)
    stop(holder)
    wait_until(long, lambda _: store.list_segments(long).segments[0].attempts == 2)
    assert _is_held_by(database, long, other)
    while len(labelers(descendants())) < 2:
        time.sleep(0.05)
    holder.resume()
    while len(labelers(descendants())) > 1:
        time.sleep(0.05)
    wait_for_attempt(long, 2)
    store.request_cancel(long)
    wait_until(long, lambda status: status.state.is_ended)
    assert first.is_running()
    assert second.is_running()


def _is_held_by(database, job_id, process):
    with database.read() as connection:
        holder = connection.scalar(select(segments.c.holder).where(segments.c.job_id == job_id))
    return f"-{process.pid}-" in holder
