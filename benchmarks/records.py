"""What a result says of its run: date, machine, versions, and how fast the machine is; and how it is written."""

import json
import os
import platform
import statistics
import subprocess
import time
from collections.abc import Sequence
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

ROOT = Path(__file__).resolve().parents[1]
NUM_FIXED_POINTS = 100_000
NUM_FIXED_REPEATS = 5


def describe_run(load_average: float, *, libraries: Sequence[str], packages: Sequence[str]) -> dict[str, Any]:
    """Return what every result holds.

    Args:
        load_average: Of the last minute before the run.
        libraries: Whose versions count.
        packages: Folders of this project that are measured: files of them changed since the commit are named.

    """
    return {
        "date": datetime.now(UTC).isoformat(timespec="seconds"),
        "machine": {
            "cpu": cpu_model(),
            "cores": os.cpu_count(),
            "load_average_before": load_average,
            "fixed_work_core_s": fixed_work_core_s(),
        },
        "versions": versions(libraries, packages),
    }


def fixed_work_core_s() -> float:
    """Return what a tree of 100,000 points, asked for the nearest of 100,000 others, takes here: the median of five.

    Machines differ by two: costs of different ones are compared as multiples of it.
    """
    points, others = np.random.default_rng(0).random((2, NUM_FIXED_POINTS, 3))
    spent_s = []
    for _ in range(NUM_FIXED_REPEATS):
        start_s = time.process_time()
        cKDTree(points).query(others)
        spent_s.append(time.process_time() - start_s)
    return statistics.median(spent_s)


def cpu_model() -> str:
    lines = Path("/proc/cpuinfo").read_text().splitlines()
    return next((line.partition(":")[2].strip() for line in lines if line.startswith("model name")), platform.machine())


def versions(libraries: Sequence[str], packages: Sequence[str]) -> dict[str, Any]:
    def git(*arguments: str) -> str:
        return subprocess.run(["git", *arguments], cwd=ROOT, capture_output=True, text=True, check=True).stdout

    changed = [line[3:] for line in git("status", "--porcelain", "--", *packages).splitlines()]
    return {
        "python": platform.python_version(),
        **{library: version(library) for library in libraries},
        "motionlabel_commit": git("rev-parse", "HEAD").strip(),
        "changed_since_commit": changed,
    }


def write_result(result: dict[str, Any], path: Path) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(result, indent=2) + "\n")
