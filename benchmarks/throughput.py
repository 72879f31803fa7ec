"""What Ray costs: the same sweeps labelled in one process, and on Ray with one worker and with two, in one run.

    python benchmarks/throughput.py SEGMENT --dataset av2 --sweeps 40

Each way labels a short and a long run of sweeps. What is counted: see README.md.
"""

import argparse
import hashlib
import os
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

from processes import run_measured
from records import ROOT, describe_run, write_result

WAYS = {"in-process": ["--in-process"], "workers-1": ["--workers", "1"], "workers-2": ["--workers", "2"]}
BASE = "in-process"


def main() -> None:
    options = read_options()
    load_average = os.getloadavg()[0]
    with tempfile.TemporaryDirectory() as folder:
        runs = []
        for num_sweeps in (options.short, options.sweeps):
            runs += [run_way(way, num_sweeps, options, Path(folder) / f"{way}-{num_sweeps}") for way in WAYS]
        num_points = read_num_points(Path(folder) / f"{BASE}-{options.sweeps}")
    different = different_shards(runs)
    result = {
        "segment": Path(options.segment).name,
        "dataset": options.dataset,
        "profile": options.profile,
        "sweeps": [options.short, options.sweeps],
        **describe_run(
            load_average,
            libraries=("torch", "numpy", "ray"),
            packages=("labeling", "schemas", "service", "workers"),
        ),
        "num_points": num_points,
        "has_equal_shards": not different,
        "different_shards": different,
        "ways": cost_of_ways(runs),
        "runs": runs,
    }
    write_result(result, options.output)
    print(table(result))
    if different:
        sys.exit(f"not the same labels: {', '.join(different)}")


def read_options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("segment", help="folder of one log, or synthetic:street?...")
    parser.add_argument("--dataset", required=True)
    parser.add_argument("--sweeps", type=int, required=True, metavar="N", help="of the long run, from the first on")
    parser.add_argument("--short", type=int, metavar="M", help="sweeps of the short run; default: a quarter of N")
    parser.add_argument("--profile", default="default", help="default: %(default)s")
    parser.add_argument("--output", type=Path, default=ROOT / "benchmarks/results/throughput.json")
    options = parser.parse_args()
    if options.short is None:
        options.short = options.sweeps // 4
    if not 0 < options.short < options.sweeps:
        parser.error(f"a short run of {options.short} and a long one of {options.sweeps} sweeps: expected 0 < M < N")
    return options


def run_way(way: str, num_sweeps: int, options: argparse.Namespace, folder: Path) -> dict[str, Any]:
    """Label the first sweeps in one way, measure it, and take down what it wrote."""
    command = [sys.executable, "-m", "service", "label", options.segment, "--dataset", options.dataset]
    command += ["--profile", options.profile, "--sweeps", f"0:{num_sweeps}", "--output", str(folder), *WAYS[way]]
    load_average = os.getloadavg()[0]
    try:
        usage = run_measured(command)
    except subprocess.CalledProcessError as error:
        sys.exit(f"{way} failed on {num_sweeps} sweeps:\n{error.output}")
    return {
        "way": way,
        "num_sweeps": num_sweeps,
        "load_average_before": load_average,
        "core_s": round(usage.core_s, 2),
        "wall_s": round(usage.wall_s, 1),
        "peak_pss_mb": round(usage.peak_pss_mb, 1),
        "num_processes": usage.num_processes,
        "shards_sha256": hash_shards(folder),
    }


def hash_shards(folder: Path) -> dict[str, str]:
    """Return the sha256 of each shard of a label folder, by its place there."""
    shards = sorted(folder.rglob("*.parquet"))
    return {shard.relative_to(folder).as_posix(): hashlib.sha256(shard.read_bytes()).hexdigest() for shard in shards}


def read_num_points(folder: Path) -> list[int]:
    """Return the points of each sweep labelled."""
    from labeling.folders.folder import LabelFolder

    labels = LabelFolder.open(folder)
    (segment_id,) = labels.segment_ids
    sweeps = labels.table("sweeps", segment_id)
    assert sweeps is not None  # every run writes it
    return sweeps["num_points"].to_pylist()


def different_shards(runs: list[dict[str, Any]]) -> list[str]:
    """Return way, sweeps and place of each shard that is not, byte for byte, that of the base."""
    of_base = {run["num_sweeps"]: run["shards_sha256"] for run in runs if run["way"] == BASE}
    different = []
    for run in runs:
        ours, theirs = run["shards_sha256"], of_base[run["num_sweeps"]]
        places = sorted(place for place in ours.keys() | theirs.keys() if ours.get(place) != theirs.get(place))
        different += [f"{run['way']} {run['num_sweeps']} {place}" for place in places]
    return different


def cost_of_ways(runs: list[dict[str, Any]]) -> dict[str, dict[str, Any]]:
    """Return for each way what its long run took, what one more sweep takes, and both as multiples of the base's."""
    rows = {}
    for way in dict.fromkeys(run["way"] for run in runs):
        short, long = sorted((run for run in runs if run["way"] == way), key=lambda run: run["num_sweeps"])
        per_sweep = (long["core_s"] - short["core_s"]) / (long["num_sweeps"] - short["num_sweeps"])
        rows[way] = {
            "core_s": long["core_s"],
            "core_s_per_sweep": per_sweep,
            "core_s_of_start": long["core_s"] - long["num_sweeps"] * per_sweep,
            "peak_pss_mb": long["peak_pss_mb"],
        }
    for row in rows.values():
        row["ratio_to_in_process"] = ratios(row, rows[BASE])
    return rows


def ratios(row: dict[str, Any], base: dict[str, Any]) -> dict[str, float | None]:
    """Return figures as multiples of those of the base."""
    names = ("core_s", "core_s_per_sweep", "peak_pss_mb")
    return {name: row[name] / base[name] if base[name] > 0 else None for name in names}


def table(result: dict[str, Any]) -> str:
    from labeling.evaluation.markdown import format_number, render_rows

    header = "way | core-s | of one more sweep | of start | peak MB | core-s / in-process | one more sweep / in-process"
    header += " | peak MB / in-process"
    rows = [
        (
            way,
            f"{row['core_s']:.1f}",
            f"{row['core_s_per_sweep']:.2f}",
            f"{row['core_s_of_start']:.1f}",
            f"{row['peak_pss_mb']:.0f}",
            *(format_number(ratio) for ratio in row["ratio_to_in_process"].values()),
        )
        for way, row in result["ways"].items()
    ]
    short, long = result["sweeps"]
    equal = "equal" if result["has_equal_shards"] else "NOT EQUAL"
    title = f"Labelling {long} sweeps of {result['segment']}; slope from {short}; shards are {equal} in bytes"
    return render_rows(title, header, rows)


if __name__ == "__main__":
    main()
