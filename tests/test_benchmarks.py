"""Benchmarks run and write what their page says. What they measure is not judged here."""

import importlib
import json
import subprocess
import sys
from pathlib import Path

import pytest

from labeling.readers.reader import open_segment

ROOT = Path(__file__).resolve().parents[1]
STREET = "synthetic:street?sweeps=3&beams=16&azimuth_steps=360"


@pytest.fixture
def load(monkeypatch):
    """Return a function that imports a module of benchmarks/, which is no package."""
    monkeypatch.syspath_prepend(ROOT / "benchmarks")
    return importlib.import_module


def test_files_changed_since_the_commit_are_named_whole(load, monkeypatch, tmp_path):
    def git(*arguments):
        subprocess.run(["git", "-c", "user.name=a", "-c", "user.email=a@b", *arguments], cwd=tmp_path, check=True)

    files = [tmp_path / name for name in ("labeling/a.py", "labeling/b.py", "schemas/c.py", "tests/d.py")]
    for file in files:
        file.parent.mkdir(exist_ok=True)
        file.write_text("before")
    git("init", "-q")
    git("add", ".")
    git("commit", "-q", "-m", "before")
    for file in files:
        file.write_text("after")
    records = load("records")
    monkeypatch.setattr(records, "ROOT", tmp_path)
    found = records.versions(["numpy"], ["labeling", "schemas"])
    assert found["changed_since_commit"] == ["labeling/a.py", "labeling/b.py", "schemas/c.py"]
    assert len(found["motionlabel_commit"]) == 40
    assert set(found) == {"python", "numpy", "motionlabel_commit", "changed_since_commit"}


def test_flow_writes_cost_accuracy_and_machine(tmp_path):
    command = [sys.executable, ROOT / "benchmarks/flow.py", STREET, "--dataset", "synthetic", "--sweeps", "0:2"]
    command += ["--methods", "nsfp", "--repeats", "2", "--set", "flow.iterations=1"]
    run = subprocess.run([*command, "--output", tmp_path / "flow.json"], capture_output=True, text=True, check=True)
    result = json.loads((tmp_path / "flow.json").read_text())
    nsfp = result["methods"]["nsfp"]
    assert "\n| nsfp " in run.stdout
    assert nsfp["config"]["flow"]["method"] == "nsfp"
    assert len(nsfp["core_s_of_repeats"]) == 2
    assert nsfp["core_s_of_fits_per_sweep"] < nsfp["core_s_per_sweep"]
    assert nsfp["peak_pss_mb"] > 0
    assert len(nsfp["num_points"]) == nsfp["flow"]["num_sweeps"] == 2
    assert nsfp["flow"]["num_points"] == result["zero_flow"]["flow"]["num_points"]
    assert set(nsfp["ratio_to_nsfp"].values()) == {1.0}
    assert result["machine"]["cores"] >= 1
    assert result["machine"]["fixed_work_core_s"] > 0
    assert len(result["versions"]["motionlabel_commit"]) == 40


def run_of(way, num_sweeps, core_s, peak_pss_mb=500.0, shards=None):
    shards = {"labels/a.parquet": "00"} if shards is None else shards
    cost = {"core_s": core_s, "wall_s": 9.0, "peak_pss_mb": peak_pss_mb, "num_processes": 1}
    return {"way": way, "num_sweeps": num_sweeps, "load_average_before": 0.5, **cost, "shards_sha256": shards}


RUNS = [
    run_of("in-process", 10, 26.0, 400.0),
    run_of("workers-1", 10, 40.0, 1100.0),
    run_of("in-process", 40, 86.0, 450.0),
    run_of("workers-1", 40, 115.0, 1350.0),
]


def test_cost_of_one_more_sweep_leaves_out_the_start(load):
    ways = load("throughput").cost_of_ways(RUNS)
    assert ways == {
        "in-process": {
            "core_s": 86.0,
            "core_s_per_sweep": 2.0,
            "core_s_of_start": 6.0,
            "peak_pss_mb": 450.0,
            "ratio_to_in_process": {"core_s": 1.0, "core_s_per_sweep": 1.0, "peak_pss_mb": 1.0},
        },
        "workers-1": {
            "core_s": 115.0,
            "core_s_per_sweep": 2.5,
            "core_s_of_start": 15.0,
            "peak_pss_mb": 1350.0,
            "ratio_to_in_process": {"core_s": 115 / 86, "core_s_per_sweep": 1.25, "peak_pss_mb": 3.0},
        },
    }


def test_a_slower_start_of_all_runs_changes_no_cost_of_a_sweep(load):
    later = [run | {"core_s": run["core_s"] + 30} for run in RUNS]
    before, after = (load("throughput").cost_of_ways(runs) for runs in (RUNS, later))
    for way in before:
        assert after[way]["core_s_per_sweep"] == before[way]["core_s_per_sweep"]
        assert after[way]["core_s_of_start"] == before[way]["core_s_of_start"] + 30


def test_a_base_lost_in_noise_has_no_ratio(load):
    runs = [run | {"core_s": 26.0} if run["way"] == "in-process" else run for run in RUNS]
    ratio = load("throughput").cost_of_ways(runs)["workers-1"]["ratio_to_in_process"]
    assert ratio["core_s_per_sweep"] is None
    assert ratio["core_s"] == pytest.approx(115 / 26)


def test_shards_are_compared_byte_for_byte_with_those_of_as_many_sweeps(load, tmp_path):
    throughput = load("throughput")
    for name, labels in (("one", b"a"), ("same", b"a"), ("other", b"b")):
        for table in ("labels", "sweeps"):
            (tmp_path / name / table).mkdir(parents=True)
        (tmp_path / name / "labels/x.parquet").write_bytes(labels)
        (tmp_path / name / "manifest.json").write_text(name)  # dates may differ
    (tmp_path / "other/sweeps/x.parquet").write_bytes(b"")
    one, same, other = (throughput.hash_shards(tmp_path / name) for name in ("one", "same", "other"))
    assert one == {"labels/x.parquet": "ca978112ca1bbdcafac231b39a23dc4da786eff8147c4e72b9807785afee48bb"}
    long = [run_of("in-process", 40, 86.0, shards=other), run_of("workers-1", 40, 99.0, shards=other)]
    short = [run_of("in-process", 10, 26.0, shards=one), run_of("workers-1", 10, 33.0, shards=same)]
    assert throughput.different_shards([*short, *long]) == []
    wrong = run_of("workers-2", 10, 33.0, shards=other)
    names = ["workers-2 10 labels/x.parquet", "workers-2 10 sweeps/x.parquet"]
    assert throughput.different_shards([*short, *long, wrong]) == names


@pytest.fixture
def write_throughput(load, monkeypatch, tmp_path):
    """Return a function that runs the benchmark over made-up runs and returns what it wrote."""
    throughput = load("throughput")

    def run(*arguments, shards_of=lambda way: {"labels/a.parquet": "00"}):
        def run_way(way, num_sweeps, options, folder):
            return run_of(way, num_sweeps, 6.0 + 2.0 * num_sweeps, shards=shards_of(way))

        monkeypatch.setattr(throughput, "run_way", run_way)
        monkeypatch.setattr(throughput, "read_num_points", lambda folder: [100] * 8)
        output = ["--output", str(tmp_path / "results/throughput.json")]
        monkeypatch.setattr(sys, "argv", ["throughput.py", "logs/a", "--dataset", "av2", *arguments, *output])
        throughput.main()

    return run


def test_throughput_writes_cost_machine_and_loads(write_throughput, tmp_path, capsys):
    write_throughput("--sweeps", "8")
    result = json.loads((tmp_path / "results/throughput.json").read_text())
    assert (result["segment"], result["dataset"], result["profile"], result["sweeps"]) == (
        "a",
        "av2",
        "default",
        [2, 8],
    )
    assert (result["has_equal_shards"], result["different_shards"]) == (True, [])
    order = [(run["way"], run["num_sweeps"]) for run in result["runs"]]
    assert order == [(way, count) for count in (2, 8) for way in ("in-process", "workers-1", "workers-2")]
    assert all(run["load_average_before"] == 0.5 for run in result["runs"])
    assert set(result["machine"]) == {"cpu", "cores", "load_average_before", "fixed_work_core_s"}
    assert {"torch", "numpy", "ray", "motionlabel_commit", "changed_since_commit"} < set(result["versions"])
    assert result["date"].endswith("+00:00")
    printed = capsys.readouterr().out
    assert "shards are equal in bytes" in printed
    for way in ("in-process", "workers-1", "workers-2"):
        assert result["ways"][way]["core_s_per_sweep"] == 2.0
        assert f"\n| {way} " in printed


def test_throughput_with_other_labels_is_written_and_fails(write_throughput, tmp_path, capsys):
    def shards_of(way):
        return {"labels/a.parquet": "11" if way == "workers-2" else "00"}

    with pytest.raises(SystemExit, match=r"not the same labels: workers-2 4 labels/a\.parquet, workers-2 8 labels/a"):
        write_throughput("--sweeps", "8", "--short", "4", shards_of=shards_of)
    assert json.loads((tmp_path / "results/throughput.json").read_text())["has_equal_shards"] is False
    assert "shards are NOT EQUAL in bytes" in capsys.readouterr().out


@pytest.mark.parametrize("arguments", [["--sweeps", "8", "--short", "8"], ["--sweeps", "3"], ["--sweeps", "-4"]])
def test_throughput_needs_two_lengths(write_throughput, arguments, capsys):
    with pytest.raises(SystemExit) as ended:
        write_throughput(*arguments)
    assert ended.value.code == 2
    assert "expected 0 < M < N" in capsys.readouterr().err


def test_stages_add_up(tmp_path):
    command = [sys.executable, ROOT / "benchmarks/stages.py", STREET, "--dataset", "synthetic", "--sweeps", "2"]
    command += ["--street", f"{STREET}&seed=1", "--output", tmp_path / "out.json"]
    run = subprocess.run(command, capture_output=True, text=True, check=True)
    result = json.loads((tmp_path / "out.json").read_text())
    assert run.stdout.count("\n| ground ") == 2
    for part in ("log", "street"):
        measured = result[part]
        costs = measured["core_s_per_sweep"]
        assert measured["num_sweeps"] == 2
        assert costs["total"] == pytest.approx(sum(cost for name, cost in costs.items() if name != "total"))
        assert all(costs[name] > 0 for name in ("ground", "static", "static: nearest", "flow: vote", "reading"))
        assert measured["labeling_core_s_per_sweep"] == pytest.approx(costs["total"] - costs["reading"])
        assert 0 < measured["floor_core_s_per_sweep"] < costs["total"]
        assert 0 <= measured["share_after_flow"] < 1
    log_s, street_s = (result[part]["labeling_core_s_per_sweep"] for part in ("log", "street"))
    assert result["street_to_log"] == pytest.approx(street_s / log_s)


def test_the_dense_street_is_one_of_options_that_anybody_may_give(load):
    reader = open_segment("synthetic", load("stages").DENSE_STREET)
    assert len(reader.timestamps_ns) == 90
    assert sum(not mover.path.is_still for mover in reader.scene.movers) == 40
    assert reader.read_sweep(0).num_points == pytest.approx(200_000, rel=0.05)


def test_time_spent_in_an_inner_part_counts_once(load, monkeypatch):
    stages = load("stages")
    now_s = [0.0]
    monkeypatch.setattr(stages.time, "process_time", lambda: now_s[0])

    def spend(core_s):
        now_s[0] += core_s

    watch = stages.Stopwatch()
    inner = watch.wrap("inner", spend)

    def both():
        spend(2.0)
        inner(5.0)
        inner(1.0)

    watch.wrap("outer", both)()
    assert dict(watch.core_s) == {"inner": 6.0, "outer": 2.0}


def test_scale_writes_how_well_clusters_are_used(tmp_path):
    command = [sys.executable, ROOT / "benchmarks/scale.py", "--max-segments", "2", "--output", tmp_path / "out.json"]
    runs = []
    for _ in range(2):
        printed = subprocess.run(command, capture_output=True, text=True, check=True).stdout
        runs.append(json.loads((tmp_path / "out.json").read_text())["runs"])
    assert runs[0] == runs[1]  # simulated time: the same on any machine
    assert [(run["cpus"], run["segments"]) for run in runs[0]] == [(1, 2), (2, 2)]
    assert all(0.5 < run["utilisation"] <= 1 for run in runs[0])
    assert printed.count("\n|") == 4
    assert all(run["in_process_share"] < run["utilisation"] for run in runs[0])
    committed = json.loads((ROOT / "benchmarks/results/scale.json").read_text())
    assert set(committed["runs"][0]) == set(runs[0][0])


def test_rigs_are_judged_on_the_same_streets(tmp_path):
    command = [sys.executable, ROOT / "benchmarks/rigs.py", "--seeds", "1", "--sweeps", "5", "--profile", "fast"]
    command += ["--rigs", "solid-state rosette, 70 degrees", "--options", "azimuth_steps=450&movers=4"]
    run = subprocess.run([*command, "--output", tmp_path / "rigs.json"], capture_output=True, text=True, check=True)
    result = json.loads((tmp_path / "rigs.json").read_text())
    (row,) = result["rigs"].values()
    assert "\n| solid-state rosette, 70 degrees " in run.stdout
    assert row["street"] == "beams=64&rig=rosette"
    assert row["core_s_per_sweep"] > 0
    assert row["boxes_3d"]["L1"]["num_truths"] <= row["boxes_3d"]["L2"]["num_truths"]
    assert row["num_points_mean"] > 3_000
    assert len(result["versions"]["motionlabel_commit"]) == 40


def test_an_unknown_rig_is_refused_in_one_line():
    command = [sys.executable, ROOT / "benchmarks/rigs.py", "--rigs", "17 beams"]
    run = subprocess.run(command, capture_output=True, text=True)
    assert run.returncode == 2
    assert "unknown rig '17 beams': expected 16 beams; 32 beams" in run.stderr
