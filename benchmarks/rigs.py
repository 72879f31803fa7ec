"""How good labels are by lidar, and what they cost: the same made-up streets, each seen by several rigs, one config.

    python benchmarks/rigs.py --seeds 1,2 --sweeps 20 --profile fast

What is counted: see README.md.
"""

import argparse
import os
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

from processes import run_measured
from records import ROOT, describe_run, write_result

# Rows of the table: what is said of a rig, and the options of its streets.
RIGS = {
    "16 beams": "beams=16",
    "32 beams": "beams=32",
    "64 beams": "beams=64",
    "128 beams": "beams=128",
    "two of 32 beams, half a turn apart": "beams=64&rig=pair",
    "64 beams and four short ones at the corners": "beams=64&rig=taxi",
    "solid-state rosette, 70 degrees": "beams=64&rig=rosette",
}


def main() -> None:
    options = read_options()
    load_average = os.getloadavg()[0]
    with tempfile.TemporaryDirectory() as folder:
        rows = {name: measure(RIGS[name], options, Path(folder) / str(k)) for k, name in enumerate(options.rigs)}
    result = {
        "seeds": options.seeds,
        "sweeps": options.sweeps,
        "profile": options.profile,
        "set": options.changes,
        **describe_run(load_average, libraries=("torch", "numpy", "scipy"), packages=("labeling", "schemas")),
        "rigs": rows,
    }
    write_result(result, options.output)
    print(table(result))


def read_options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=split, default=["1", "2", "3"], metavar="A,B", help="of the streets")
    parser.add_argument("--sweeps", type=int, default=40, metavar="N", help="of each street; default: %(default)s")
    parser.add_argument("--profile", default="default", help="default: %(default)s")
    parser.add_argument("--rigs", type=lambda text: text.split(";"), default=list(RIGS), metavar="A;B")
    parser.add_argument("--options", default="", metavar="NAME=VALUE&...", help="more options of all streets")
    parser.add_argument("--set", action="append", default=[], dest="changes", metavar="KEY=VALUE", help="for all rigs")
    parser.add_argument("--output", type=Path, default=ROOT / "benchmarks/results/rigs.json")
    options = parser.parse_args()
    if unknown := [name for name in options.rigs if name not in RIGS]:
        parser.error(f"unknown rig {unknown[0]!r}: expected {'; '.join(RIGS)}")
    return options


def split(text: str) -> list[str]:
    return text.split(",")


def measure(street: str, options: argparse.Namespace, folder: Path) -> dict[str, Any]:
    """Label the streets of all seeds as one rig sees them, and judge the labels."""
    more = f"&{options.options}" if options.options else ""
    streets = [f"synthetic:street?sweeps={options.sweeps}&seed={seed}&{street}{more}" for seed in options.seeds]
    command = [sys.executable, "-m", "service", "label", *streets, "--dataset", "synthetic", "--in-process"]
    command += ["--profile", options.profile, "--output", str(folder)]
    for change in options.changes:
        command += ["--set", change]
    try:
        usage = run_measured(command)
    except subprocess.CalledProcessError as error:
        sys.exit(f"{street} failed:\n{error.output}")
    num_sweeps = len(streets) * options.sweeps
    return {"street": street, "core_s_per_sweep": usage.core_s / num_sweeps, **judge(folder, streets)}


def judge(folder: Path, streets: list[str]) -> dict[str, Any]:
    """Return the figures of 3D boxes over all streets."""
    from labeling.evaluation.report import evaluate_segments
    from labeling.folders.folder import LabelFolder
    from labeling.readers.reader import open_segment

    labels, readers = LabelFolder.open(folder), [open_segment("synthetic", street) for street in streets]
    boxes = evaluate_segments(labels, readers, azimuth_deg=None, min_score=None).pooled.boxes
    assert boxes is not None  # a street is annotated
    tables = [labels.table("sweeps", reader.segment_id) for reader in readers]
    num_points = [count for sweeps in tables if sweeps is not None for count in sweeps["num_points"].to_pylist()]
    of_level = {row.level: row for row in boxes.detection if row.overlap == "3D"}
    figures = {level: row.model_dump(mode="json") for level, row in of_level.items()}
    return {"num_points_mean": sum(num_points) / len(num_points), "num_objects": boxes.num_objects, "boxes_3d": figures}


def table(result: dict[str, Any]) -> str:
    from labeling.evaluation.markdown import format_interval, format_percent, render_rows

    header = "lidars | points a sweep | boxes to find | AP % | 90 % of AP | P % | R % | core-s a sweep"
    rows = []
    for name, row in result["rigs"].items():
        boxes = row["boxes_3d"]["L1"]
        rows.append(
            (
                name,
                f"{row['num_points_mean']:.0f}",
                str(boxes["num_truths"]),
                format_percent(boxes["ap"]),
                format_interval(boxes["ap_interval"]),
                format_percent(boxes["precision"]),
                format_percent(boxes["recall"]),
                f"{row['core_s_per_sweep']:.2f}",
            )
        )
    title = f"{len(result['seeds'])} streets of {result['sweeps']} sweeps, profile {result['profile']}"
    return render_rows(title, header, rows)


if __name__ == "__main__":
    main()
