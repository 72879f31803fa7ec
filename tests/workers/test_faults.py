"""What dies in mid-segment changes nothing: the shards are those of one process."""

import os
import time
from pathlib import Path

import pyarrow.parquet as pq
import pytest
import ray

from labeling.readers.reader import open_segment
from labeling.storage.storage import open_storage
from schemas.errors import WorkerLost
from workers.aggregator import Aggregator
from workers.attempts import Attempt
from workers.local import label_readers
from workers.pipeline import plan_limits
from workers.processes import descendants
from workers.schedule import Kind
from workers.segment_labeler import Assignment

pytestmark = [pytest.mark.ray, pytest.mark.timeout(900)]


@pytest.fixture
def label(cluster, config, logs, tmp_path):
    """Return a function that labels the first log on the session's Ray and returns its entry."""

    def run(on_progress=lambda _: None, hook=None):
        readers = [open_segment("av2", logs[0])]
        (entry,) = label_readers(2, readers, open_storage(tmp_path / "out"), config, on_progress, hook=hook)
        return entry

    return run


def kill_actor(name):
    """Kill -9 what runs an actor of class ``name``: one process, and those of former segments that are just ending."""
    found = [process for process in descendants() if (process.cmdline() or [""])[0].startswith(f"ray::{name}")]
    assert found
    for process in found:
        process.kill()


def of_segment(oracle, entry):
    return {path: oracle[path] for path in oracle if f"/{entry.segment_id}-" in path}


def killer(kinds, folder):
    """Return a hook that ends the first process that takes a step of each kind, whether actor or task."""
    names = {int(kind): f"{folder}/killed-{kind.name}" for kind in kinds}

    def hook(step):  # runs elsewhere, by value: as little as possible with it
        name = names.get(int(step.kind))
        if name is not None:
            try:
                os.close(os.open(name, os.O_CREAT | os.O_EXCL))
            except FileExistsError:
                return
            os.kill(os.getpid(), 9)

    return hook


@pytest.mark.parametrize("kinds", [list(Kind)[:6], list(Kind)[6:]], ids=["early", "late"])
def test_a_process_dies_once_in_a_step_of_every_kind(label, shards, oracle, tmp_path, kinds):
    entry = label(hook=killer(kinds, tmp_path))
    assert (entry.state, entry.reason) == ("SUCCEEDED", "")
    assert {path.name for path in tmp_path.glob("killed-*")} == {f"killed-{kind.name}" for kind in kinds}
    assert shards(tmp_path / "out") == of_segment(oracle, entry)


@pytest.mark.parametrize("name", ["StaticRemoval", "SegmentLabeler", "Aggregator"])
@pytest.mark.parametrize("sweep", [1, 4])
def test_an_actor_is_killed_in_mid_segment(label, shards, oracle, tmp_path, name, sweep):
    """The sweep is not finished before that: its last step waits at a gate."""
    gate, killed = tmp_path / "gate", []
    path = str(gate)

    def hook(step):
        while step.kind == 6 and step.number == sweep and not os.path.exists(path):  # noqa: PTH110
            time.sleep(0.01)

    def on_progress(step):
        if step.stage == "sweeps" and step.sweeps_done >= sweep and not killed:
            killed.append(step.sweeps_done)
            kill_actor(name)
            gate.touch()

    entry = label(on_progress, hook)
    assert (entry.state, entry.reason) == ("SUCCEEDED", "")
    assert killed
    assert shards(tmp_path / "out") == of_segment(oracle, entry)


@pytest.mark.parametrize("kind", [Kind.VOTE, Kind.FIT], ids=["votes", "fits"])
def test_a_poison_cluster_is_found_and_counted_and_the_rest_goes_on(label, tmp_path, kind):
    number = int(kind)

    def hook(step):
        if step.kind == number and step.number == 3 and step.batch == 0 and step.start <= 0 < step.stop:
            os.kill(os.getpid(), 9)

    entry = label(hook=hook)
    assert (entry.state, entry.num_failed_fits, entry.reason) == ("PARTIAL", 1, "1 flow fits failed")
    (sweeps,) = (tmp_path / "out/sweeps").iterdir()
    assert pq.ParquetFile(sweeps).read()["num_failed_fits"].to_pylist() == [0, 0, 0, 1, 0, 0]


def test_what_a_killed_labeler_has_started_is_killed_with_it(cluster, config, logs, tmp_path):
    started = str(tmp_path / "pid")

    def hook(step):
        if step.kind == 5:  # a fit
            with open(started, "w") as file:  # noqa: PTH123
                file.write(str(os.getpid()))
            time.sleep(600)

    assignment = Assignment("av2", logs[0], str(tmp_path / "out"), config, plan_limits(2, 1), hook)
    aggregator = Aggregator.remote("av2", str(tmp_path / "out"), config)
    attempt = Attempt(assignment, aggregator)
    while not (Path(started).exists() and Path(started).read_text()):
        assert not attempt.is_ended
        time.sleep(0.05)
    attempt.kill()
    ray.wait([attempt.running])
    with pytest.raises(WorkerLost, match="labeler died"):
        attempt.outcome()
    pid = int(Path(started).read_text())
    while pid in {process.pid for process in descendants()}:  # until the test's time limit
        time.sleep(0.05)
    ray.kill(aggregator)
