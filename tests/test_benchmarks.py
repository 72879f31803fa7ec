"""Benchmarks run and write what their page says. What they measure is not judged here."""

import importlib
import json
import subprocess
import sys
from pathlib import Path

import pytest

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
    assert len(result["versions"]["motionlabel_commit"]) == 40
