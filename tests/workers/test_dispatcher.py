"""The dispatcher as its own process, with a Ray of its own, on a real job store."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from labeling.readers.reader import open_segment
from schemas.jobs import JobRequest, JobState, SegmentState
from workers.jobs.database import open_database
from workers.jobs.store import JobStore

pytestmark = pytest.mark.ray


@pytest.fixture
def store(tmp_path):
    database = open_database(f"sqlite:///{tmp_path / 'jobs.sqlite3'}")
    yield JobStore(database)
    database.close()


@pytest.fixture
def submit(store, config, tmp_path):
    """Return a function that submits segments with the session's parameters and returns the job's id."""

    def run(output, *segments):
        overrides = {"flow.iterations": config.flow.iterations, "flow.hidden_units": config.flow.hidden_units}
        request = JobRequest(
            dataset="synthetic",
            segments=segments,
            output_uri=str(tmp_path / output),
            overrides=overrides,
            write_points=config.write_points,
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
def start(tmp_path):
    """Return a function that starts a dispatcher in a session of its own; all sessions are killed at the end."""
    processes = []

    def run():
        command = [sys.executable, "-m", "workers.dispatcher", "--database-url"]
        command += [f"sqlite:///{tmp_path / 'jobs.sqlite3'}", "--data-dir", tmp_path / "data"]
        with (tmp_path / "log").open("a") as log:
            process = subprocess.Popen(
                [*command, "--workers", "2", "--lease-s", "4"], stderr=log, stdout=log, start_new_session=True
            )
        processes.append(process)
        return process

    yield run
    for process in processes:
        for pid in members(process.pid):
            os.kill(pid, signal.SIGKILL)
        process.wait()


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


def command_line(pid):
    try:
        return Path(f"/proc/{pid}/cmdline").read_bytes()
    except OSError:
        return b""


def test_a_life_of_two_dispatchers(start, store, submit, wait_until, streets, oracle, shards, tmp_path):
    first = start()
    job = submit("out", *streets)
    wait_until(job, lambda status: status.progress > 0)
    assert store.get_job(job).state is JobState.RUNNING
    first.kill()  # in mid-segment: no lease is given back

    second = start()
    wait_until(job, lambda status: status.state.is_ended)
    assert store.get_job(job).state is JobState.SUCCEEDED
    assert max(segment.attempts for segment in store.list_segments(job).segments) == 2
    assert shards(tmp_path / "out") == oracle

    # Two jobs at once: one has a segment that cannot be read, the other is cancelled while it runs.
    partial = submit("partial", streets[0], "synthetic:nowhere")
    long = submit("long", "synthetic:street?azimuth_steps=450&beams=16&seed=3&sweeps=400")
    wait_until(long, lambda status: status.progress > 0)
    wait_until(partial, lambda status: status.state.is_ended)
    assert store.get_job(partial).state is JobState.PARTIAL
    assert store.get_job(long).state is JobState.RUNNING
    states = {segment.uri: segment.state for segment in store.list_segments(partial).segments}
    assert states == {streets[0]: SegmentState.SUCCEEDED, "synthetic:nowhere": SegmentState.FAILED}
    segment_id = open_segment("synthetic", streets[0]).segment_id
    assert shards(tmp_path / "partial") == {path: oracle[path] for path in oracle if f"/{segment_id}-" in path}
    assert len(list((tmp_path / "partial/manifests").iterdir())) == 1

    (labeler,) = [pid for pid in members(second.pid) if b"ray::SegmentLabeler" in command_line(pid)]
    os.kill(labeler, signal.SIGKILL)
    wait_until(long, lambda _: store.list_segments(long).segments[0].attempts == 2)
    wait_until(long, lambda status: status.progress > 0)
    assert second.poll() is None

    store.request_cancel(long)
    wait_until(long, lambda status: status.state.is_ended)
    assert store.get_job(long).state is JobState.CANCELLED
    assert shards(tmp_path / "long") == {}

    # Told to end while it works, it gives its segment back and leaves no process.
    left = submit("left", "synthetic:street?azimuth_steps=450&beams=16&seed=3&sweeps=400")
    wait_until(left, lambda status: status.progress > 0)
    second.terminate()
    assert second.wait() == 0
    assert members(second.pid) == []
    (segment,) = store.list_segments(left).segments
    assert (segment.state, segment.attempts) == (SegmentState.QUEUED, 0)
    assert store.status().dispatchers[0].pid == first.pid  # the one that was killed could not sign off
