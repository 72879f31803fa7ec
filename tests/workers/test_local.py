"""Labelling on a Ray of our own: the same shards, whoever dies."""

import json
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
import ray

from labeling.folders.entries import prepare_folder
from labeling.in_process import label_in_process
from labeling.readers.reader import open_segment
from labeling.storage.storage import open_storage
from workers.aggregator import Aggregator
from workers.attempts import Attempt
from workers.local import label_readers
from workers.pipeline import plan_limits
from workers.segment_labeler import Assignment

pytestmark = [pytest.mark.ray, pytest.mark.timeout(900)]


@pytest.fixture
def label(cluster, config, tmp_path):
    """Return a function that labels logs, or readers, on the session's Ray and returns entries by segment id."""

    def run(*uris, on_progress=lambda _: None, **options):
        readers = [open_segment("av2", uri) if isinstance(uri, str) else uri for uri in uris]
        entries = label_readers(2, readers, open_storage(tmp_path / "out"), config, on_progress, **options)
        return {entry.segment_id: entry for entry in entries}

    return run


def test_two_segments_at_once_give_the_shards_of_one_process(label, logs, shards, oracle, tmp_path):
    steps = []
    entries = label(*logs, on_progress=steps.append)
    assert {entry.state for entry in entries.values()} == {"SUCCEEDED"}
    assert shards(tmp_path / "out") == oracle
    for segment_id in entries:
        done = [step.sweeps_done for step in steps if step.segment_id == segment_id and step.stage == "sweeps"]
        assert done == list(range(len(done)))  # each sweep was told once
    assert label(*logs) == entries  # published shards are not made again


def test_a_segment_without_a_cpu_for_tasks_gives_the_same_shards(cluster, config, logs, shards, oracle, tmp_path):
    """Its actor does everything itself: other segments' actors hold all other CPUs."""

    @ray.remote(num_cpus=1)
    class Idle:
        def begin(self):
            pass

    idle = Idle.remote()
    ray.get(idle.begin.remote())
    aggregator = Aggregator.remote("av2", str(tmp_path / "out"), config)
    attempt = Attempt(Assignment("av2", logs[0], str(tmp_path / "out"), config, plan_limits(2, 1)), aggregator)
    entry = attempt.outcome().entry
    ray.kill(idle)
    assert entry.state == "SUCCEEDED"
    assert shards(tmp_path / "out") == {path: oracle[path] for path in oracle if f"/{entry.segment_id}-" in path}


def test_nets_on_a_gpu_that_is_not_there_are_refused_in_one_line(cluster, config, logs, tmp_path):
    config = config.model_copy(update={"flow": config.flow.model_copy(update={"device": "cuda"})})
    readers = [open_segment("av2", logs[0])]
    (entry,) = label_readers(2, readers, open_storage(tmp_path / "out"), config, lambda _: None)
    assert entry.state == "FAILED"
    assert entry.reason == "flow.device is cuda, but the Ray cluster has no GPU: expected one, or flow.device=cpu"


def test_a_log_that_is_still_being_copied_is_labelled_as_it_was_listed(label, config, logs, shards, tmp_path):
    """One sweep comes just after opening, one goes."""
    log = Path(shutil.copytree(logs[0], tmp_path / "log"))
    names = open_segment("av2", str(log)).listing.names
    late = (log / names[1]).rename(log / "late")
    reader = open_segment("av2", str(log))
    late.rename(log / names[1])
    (log / names[4]).unlink()
    entries = label(reader)
    assert [(entry.state, entry.num_sweeps) for entry in entries.values()] == [("PARTIAL", 5)]
    assert entries[reader.segment_id].reason.endswith(f"{names[4]}: no such file")
    storage = open_storage(tmp_path / "again")
    prepare_folder(storage, config)
    assert list(label_in_process([reader], storage, config, lambda _: None)) == list(entries.values())
    assert shards(tmp_path / "again") == shards(tmp_path / "out")


@pytest.mark.parametrize("seed", [0, 1], ids=["equal", "other settings"])
def test_two_jobs_at_once_leave_one_set_of_labels(cluster, config, logs, shards, oracle, tmp_path, seed):
    configs = [config, config.model_copy(update={"seed": seed})]
    aggregators = [Aggregator.remote("av2", str(tmp_path / "out"), each) for each in configs]
    limits, output = plan_limits(2, 2), str(tmp_path / "out")
    attempts = [
        Attempt(Assignment("av2", logs[0], output, each, limits), aggregators[number])
        for number, each in enumerate(configs)
    ]
    outcomes = [attempt.outcome() for attempt in attempts]
    if seed == 0:
        assert outcomes[0].entry == outcomes[1].entry
        segment_id = outcomes[0].entry.segment_id
        assert shards(tmp_path / "out") == {path: oracle[path] for path in oracle if f"/{segment_id}-" in path}
    else:
        assert sorted(outcome.entry.state for outcome in outcomes) == ["FAILED", "SUCCEEDED"]
        (failure,) = [outcome.failure for outcome in outcomes if outcome.failure]
        assert failure.error == "ShardConflict"
        assert "made with other settings (seed=" in failure.message
    assert [path.split("/")[0] for path in sorted(shards(tmp_path / "out"))] == ["labels", "points", "sweeps"]


def test_the_command_line_takes_workers(overrides, logs, shards, oracle, tmp_path):
    code = "import sys; from service.cli import main; sys.exit(main(sys.argv[1:]))"
    options = ["--dataset", "av2", "--output", "out", "--points", "--workers", "1"]
    options += [text for name, value in overrides.items() for text in ("--set", f"{name}={json.dumps(value)}")]
    run = subprocess.run(
        [sys.executable, "-c", code, "label", logs[0], *options],
        cwd=tmp_path, capture_output=True, text=True, start_new_session=True,
    )  # fmt: skip
    assert (run.returncode, run.stderr) == (0, "")
    summary, cost = run.stdout.splitlines()
    assert summary.startswith("out: 1 of 1 segment labelled, 6 sweeps (0 rejected)")
    assert cost.endswith("core-seconds a sweep")
    labelled = shards(tmp_path / "out")
    assert len(labelled) == 3
    assert labelled.items() <= oracle.items()
