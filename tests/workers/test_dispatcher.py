"""The dispatcher as its own process, on the session's Ray or on one of its own, on a real job store."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
import ray

from labeling.readers.reader import open_segment
from schemas.api.jobs import JobRequest, JobState, SegmentState
from workers.jobs.database import URL_VARIABLE, open_database
from workers.jobs.store import JobStore

pytestmark = [pytest.mark.ray, pytest.mark.timeout(900)]

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


def kill_session(session):
    for pid in members(session):
        os.kill(pid, signal.SIGKILL)


def members(session):
    """Return the living processes of a session."""
    found = []
    for path in Path("/proc").glob("[0-9]*/stat"):
        try:
            state, _, _, its_session = path.read_text().rpartition(")")[2].split()[:4]
        except OSError:
            continue
        if int(its_session) == session and state != "Z":
            found.append(int(path.parent.name))
    return found


def labelers(session):
    return [pid for pid in members(session) if b"ray::SegmentLabeler" in command_line(pid)]


def command_line(pid):
    try:
        return Path(f"/proc/{pid}/cmdline").read_bytes()
    except OSError:
        return b""


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
    assert b"sqlite:" not in command_line(second)  # a URL may hold a password
    wait_until(job, lambda status: status.state.is_ended)
    assert store.get_job(job).state is JobState.PARTIAL
    states = {segment.uri: segment.state for segment in store.list_segments(job).segments}
    assert states == {logs[0]: SegmentState.SUCCEEDED, missing: SegmentState.FAILED}
    segment_id = open_segment("av2", logs[0]).segment_id
    assert shards(tmp_path / "out") == {path: oracle[path] for path in oracle if f"/{segment_id}-" in path}
    assert len(list((tmp_path / "out/manifests").iterdir())) == 1
    wait_for_attempt(long, 2)

    # A labeler dies, and the dispatcher does not. A job is cancelled, and the other goes on.
    while len(labelers(second)) > 1:  # that of the job that has ended
        time.sleep(0.05)
    os.kill(*labelers(second), signal.SIGKILL)
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
