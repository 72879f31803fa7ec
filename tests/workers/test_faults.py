"""What dies in mid-segment changes nothing: the shards are those of one process."""

import os
import time
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest
import ray

from labeling.line import prepare_sweeps
from labeling.readers.reader import open_segment
from labeling.storage.storage import open_storage
from schemas.objects import SweepObservation
from workers.aggregator import Aggregator
from workers.attempts import Attempt
from workers.local import label_readers
from workers.pipeline import Limits, plan_limits
from workers.processes import descendants
from workers.segment_labeler import Assignment

pytestmark = [pytest.mark.ray, pytest.mark.timeout(900)]


@pytest.fixture
def label(cluster, config, logs, tmp_path):
    """Return a function that labels the first log on the session's Ray and returns its entry."""

    def run(on_progress=lambda _: None, fit=None):
        readers = [open_segment("av2", logs[0])]
        (entry,) = label_readers(2, readers, open_storage(tmp_path / "out"), config, on_progress, fit=fit)
        return entry

    return run


def kill_actor(name):
    """Kill -9 the one process that runs an actor of class ``name``."""
    (process,) = [process for process in descendants() if process.cmdline()[:1] == [name]]
    process.kill()


def test_a_worker_and_each_actor_is_killed_once(label, logs, shards, oracle, truck_x_m, monkeypatch, tmp_path):
    deaths = {2: "ray::StaticRemoval", 3: "ray::SegmentLabeler", 4: "ray::Aggregator"}  # by sweeps done
    gates = {sweep: (str(tmp_path / f"gate-{sweep}"), truck_x_m(sweep - 0.5)) for sweep in deaths}
    flag = str(tmp_path / "killed")
    # So few that StaticRemoval has something left to do when it dies, and that no two fits wait at gates: that would be
    # both CPUs, and no sweep could be finished.
    monkeypatch.setattr("workers.local.plan_limits", lambda *_: Limits(1, None, sweeps_ahead=2, fits_in_flight=4))

    def fit(problems, params):  # runs elsewhere, by value: as little as possible with it
        import labeling.stages.nsfp

        if not os.path.exists(flag):  # noqa: PTH110
            os.close(os.open(flag, os.O_CREAT))
            os.kill(os.getpid(), 9)
        x_m = problems[0].points[:, 0].mean()
        for gate, from_x_m in gates.values():
            while len(problems[0].points) > 500 and x_m > from_x_m and not os.path.exists(gate):  # noqa: PTH110
                time.sleep(0.01)
        return labeling.stages.nsfp.fit_nets(problems, params)

    def on_progress(step):
        if step.stage == "sweeps" and step.sweeps_done in deaths:
            kill_actor(deaths.pop(step.sweeps_done))
            Path(gates[step.sweeps_done][0]).touch()

    entry = label(on_progress, fit)
    assert Path(flag).exists()
    assert not deaths
    assert entry.state == "SUCCEEDED"
    assert shards(tmp_path / "out") == {path: oracle[path] for path in oracle if f"/{entry.segment_id}-" in path}


def test_a_poison_cluster_is_found_and_counted_and_the_rest_goes_on(label, config, logs, tmp_path):
    (work,) = prepare_sweeps(open_segment("av2", logs[0]), config, range(3, 4))
    assert not isinstance(work, SweepObservation)
    first, second = work.plan.batches
    assert (len(first), len(second) > 0) == (3, True)
    poison = np.array(first[0].points)

    def fit(problems, params):
        import labeling.stages.nsfp

        if any(np.array_equal(problem.points, poison) for problem in problems):
            os.kill(os.getpid(), 9)
        return labeling.stages.nsfp.fit_nets(problems, params)

    entry = label(fit=fit)
    assert (entry.state, entry.num_failed_fits, entry.reason) == ("PARTIAL", 1, "1 flow fits failed")
    (sweeps,) = (tmp_path / "out/sweeps").iterdir()
    assert pq.ParquetFile(sweeps).read()["num_failed_fits"].to_pylist() == [0, 0, 0, 1, 0, 0]


def test_stopping_kills_running_fits(cluster, config, logs, tmp_path):
    started = str(tmp_path / "pid")

    def fit(problems, params):
        import time

        with open(started, "w") as file:  # noqa: PTH123
            file.write(str(os.getpid()))
        time.sleep(600)

    assignment = Assignment("av2", logs[0], "the only one", config, plan_limits(2, 1), fit)
    aggregator = Aggregator.remote("av2", str(tmp_path / "out"), config)
    attempt = Attempt(assignment, aggregator)
    while not (Path(started).exists() and Path(started).read_text()):
        assert not attempt.is_ended
        time.sleep(0.05)
    attempt.stop()
    ray.wait([attempt.running])
    assert attempt.outcome() is None
    pid = int(Path(started).read_text())
    while pid in {process.pid for process in descendants()}:  # until the test's time limit
        time.sleep(0.05)
    attempt.kill()
    ray.kill(aggregator)
