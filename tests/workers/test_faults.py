"""What dies in mid-segment changes nothing: the shards are those of one process."""

import os
import signal
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest
import ray

from labeling.readers.reader import open_segment
from labeling.shards.storage import open_storage
from labeling.stages.pipeline import prepare_sweeps
from schemas.objects import SweepObservation
from workers.aggregator import Aggregator
from workers.attempts import Attempt
from workers.cluster import descendants
from workers.local import label_readers
from workers.pipeline import plan_limits
from workers.segment_labeler import Assignment

pytestmark = pytest.mark.ray


@pytest.fixture
def label(cluster, config, streets, tmp_path):
    """Return a function that labels the first street on the session's Ray and returns its entry."""

    def run(on_progress=lambda _: None, fit=None):
        readers = [open_segment("synthetic", streets[0])]
        (entry,) = label_readers(2, readers, open_storage(tmp_path / "out"), config, on_progress, fit=fit)
        return entry

    return run


@pytest.fixture
def oracle_of_first(oracle, streets):
    segment_id = open_segment("synthetic", streets[0]).segment_id
    return {path: content for path, content in oracle.items() if f"/{segment_id}-" in path}


def kill_actor(name):
    """Kill -9 the one process that runs an actor of class ``name``."""
    (pid,) = [pid for pid in descendants() if Path(f"/proc/{pid}/cmdline").read_bytes().startswith(name)]
    os.kill(pid, signal.SIGKILL)


@pytest.mark.parametrize("name", [b"ray::StaticRemoval", b"ray::SegmentLabeler", b"ray::Aggregator"])
def test_an_actor_is_killed(name, label, shards, oracle_of_first, tmp_path):
    killed = []

    def on_progress(step):
        if step.stage == "sweeps" and step.sweeps_done == 2 and not killed:
            killed.append(step)
            kill_actor(name)

    entry = label(on_progress)
    assert killed
    assert entry.state == "SUCCEEDED"
    assert shards(tmp_path / "out") == oracle_of_first


def test_a_fit_worker_is_killed(label, shards, oracle_of_first, tmp_path):
    flag = str(tmp_path / "killed")

    def fit(problems, params):
        import labeling.stages.nsfp

        if not os.path.exists(flag):  # noqa: PTH110 - runs elsewhere, by value: as little as possible with it
            os.close(os.open(flag, os.O_CREAT))
            os.kill(os.getpid(), 9)
        return labeling.stages.nsfp.fit_nets(problems, params)

    entry = label(fit=fit)
    assert Path(flag).exists()
    assert entry.state == "SUCCEEDED"
    assert shards(tmp_path / "out") == oracle_of_first


def test_a_poison_cluster_is_found_and_counted_and_the_rest_goes_on(label, config, streets, tmp_path):
    reader = open_segment("synthetic", streets[0])
    (work,) = prepare_sweeps(reader, config, range(3, 4))
    assert not isinstance(work, SweepObservation)
    batch = work.plan.batches[0]
    assert len(batch) > 3
    poison = np.array(batch[2].points)

    def fit(problems, params):
        import labeling.stages.nsfp

        if any(np.array_equal(problem.points, poison) for problem in problems):
            os.kill(os.getpid(), 9)
        return labeling.stages.nsfp.fit_nets(problems, params)

    entry = label(fit=fit)
    assert (entry.state, entry.num_failed_fits, entry.reason) == ("PARTIAL", 1, "1 flow fits failed")
    (sweeps,) = (tmp_path / "out/sweeps").iterdir()
    assert pq.ParquetFile(sweeps).read()["num_failed_fits"].to_pylist() == [0, 0, 0, 1, 0, 0, 0, 0]


def test_stopping_kills_running_fits(cluster, config, streets, tmp_path):
    started = str(tmp_path / "pid")

    def fit(problems, params):
        import time

        with open(started, "w") as file:  # noqa: PTH123
            file.write(str(os.getpid()))
        time.sleep(600)

    assignment = Assignment("synthetic", streets[0], "the only one", config, plan_limits(2, 1), fit)
    aggregator = Aggregator.remote("synthetic", str(tmp_path / "out"), config)
    attempt = Attempt(assignment, aggregator)
    while not (Path(started).exists() and Path(started).read_text()):
        assert not attempt.is_ended
    attempt.stop()
    ray.wait([attempt.running])
    assert attempt.outcome() is None
    pid = int(Path(started).read_text())
    while pid in descendants():  # until the test's time limit
        pass
    attempt.kill()
    ray.kill(aggregator)
