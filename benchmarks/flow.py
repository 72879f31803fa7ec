"""Accuracy and cost of four ways to find flow, on the same sweeps of one log, in one run.

    python benchmarks/flow.py LOG --dataset av2

Each method runs in a process of its own. What is counted: see README.md.
"""

import argparse
import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
from processes import run_measured
from records import ROOT, describe_run, write_result

METHODS = ("nsfp", "rigid", "paper", "default")  # rows of `motionlabel ablate flow`
BASE = "nsfp"
WARM_UP = "synthetic:street?sweeps=2&beams=16&azimuth_steps=360"


def main() -> None:
    options = read_options()
    if options.method is not None:
        measure(options)
        return
    load_average = os.getloadavg()[0]
    with tempfile.TemporaryDirectory() as folder:
        costs = {method: run_method(method, options, Path(folder)) for method in options.methods.split(",")}
        figures = judge(options, Path(folder), list(costs))  # its imports and truth are in no method's memory
    rows = {method: cost | figures[method] for method, cost in costs.items()}
    for row in rows.values():
        row["ratio_to_nsfp"] = ratios(row, rows[BASE]) if BASE in rows else None
    result = {
        "log": Path(options.log).name,
        "dataset": options.dataset,
        "sweeps": options.sweeps,
        "set": options.changes,
        **describe_run(load_average, libraries=("torch", "numpy"), packages=("labeling", "schemas")),
        "zero_flow": figures["zero"],
        "methods": rows,
    }
    write_result(result, options.output)
    print(table(result))


def read_options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("log", help="folder of one log, or synthetic:street?...")
    parser.add_argument("--dataset", required=True)
    parser.add_argument("--sweeps", metavar="START:STOP", help="default: all of the log")
    parser.add_argument("--methods", default=",".join(METHODS), help="default: %(default)s")
    parser.add_argument("--repeats", type=int, default=1, help="of each method; the median counts")
    parser.add_argument(
        "--set", action="append", default=[], dest="changes", metavar="KEY=VALUE", help="for all methods"
    )
    parser.add_argument("--output", type=Path, default=ROOT / "benchmarks/results/flow.json")
    parser.add_argument("--method", help=argparse.SUPPRESS)  # measure this one here
    return parser.parse_args()


def run_method(method: str, options: argparse.Namespace, folder: Path) -> dict[str, Any]:
    """Measure one method in a process of its own; its flow stays in ``folder``."""
    command = [sys.executable, __file__, options.log, "--dataset", options.dataset, "--method", method]
    command += ["--repeats", str(options.repeats), "--output", str(folder / f"{method}.npz")]
    command += [] if options.sweeps is None else ["--sweeps", options.sweeps]
    for change in options.changes:
        command += ["--set", change]
    try:
        usage = run_measured(command)
    except subprocess.CalledProcessError as error:
        sys.exit(f"{method} failed:\n{error.output}")
    with np.load(folder / f"{method}.npz") as file:
        cost: dict[str, Any] = json.loads(str(file["cost"]))
    return cost | {"peak_pss_mb": round(usage.peak_pss_mb, 1), "wall_s": round(usage.wall_s, 1)}


def measure(options: argparse.Namespace) -> None:
    """Run one method on the sweeps and write what it costs and the flow it finds."""
    from labeling.line import observe_sweeps
    from labeling.readers.reader import open_segment
    from labeling.threads import use_one_thread

    use_one_thread()
    config, warm_up = config_of(options), config_of(options, {"flow.iterations": 1})
    reader = open_segment(options.dataset, options.log)
    list(observe_sweeps(open_segment("synthetic", WARM_UP), warm_up.model_copy(update={"sweeps": None})))
    runs = [observe(reader, config) for _ in range(options.repeats)]
    observations, _ = runs[-1]
    num_sweeps = len(observations)
    cost = {
        "core_s_per_sweep": statistics.median(sum(s[part] for part in ("prepare", "fit")) for _, s in runs)
        / num_sweeps,
        "core_s_of_fits_per_sweep": statistics.median(s["fit"] for _, s in runs) / num_sweeps,
        "core_s_of_repeats": [s["prepare"] + s["fit"] for _, s in runs],
        "core_s_of_reading_per_sweep": statistics.median(s["read"] for _, s in runs) / num_sweeps,
        "num_points": [o.num_points for o in observations],
        "num_dynamic_points": [int(o.points.is_dynamic.sum()) if o.points else 0 for o in observations],
        "num_clusters": [o.num_clusters for o in observations],
        "num_failed_fits": [o.num_failed_fits for o in observations],
        "config": config.model_dump(mode="json"),
    }
    flows = {}
    for observation in observations:
        points = observation.points.only_dynamic() if observation.points else None
        if points is not None and points.flow_world_m is not None:
            flows[f"rows_{observation.sweep_index}"] = points.point_index
            flows[f"flow_{observation.sweep_index}"] = points.flow_world_m
    np.savez(options.output, cost=json.dumps(cost), **flows)


def config_of(options: argparse.Namespace, more: dict[str, Any] | None = None) -> Any:
    from labeling.evaluation.flow_ablation import choose_flow_rows
    from service.options import parse_overrides, parse_sweeps

    changes = parse_overrides(options.changes)
    if options.sweeps is not None:
        changes["sweeps"] = parse_sweeps(options.sweeps)
    (row,) = choose_flow_rows([options.method])
    return row.config(changes | (more or {}))


def observe(reader: Any, config: Any) -> tuple[list[Any], dict[str, float]]:
    """Return the observations of a run and its core-seconds: reading, up to the nets, and the nets."""
    from labeling.evaluation.flow_ablation import TimedReader
    from labeling.line import finish_sweep, fit_plan, prepare_sweeps, vote_and_plan
    from labeling.readers.reader import sweep_range
    from schemas.objects import SweepObservation

    timed = TimedReader(reader)
    works = prepare_sweeps(timed, config, sweep_range(reader, config))
    observations = []
    seconds = {"prepare": 0.0, "fit": 0.0}
    while True:
        start_s = time.process_time() - timed.core_s
        work = next(works, None)
        if work is None:
            return observations, seconds | {"read": timed.core_s}
        if isinstance(work, SweepObservation):
            sys.exit(f"sweep {work.sweep_index} cannot be used: {work.reason}")
        plan = vote_and_plan(work, config)
        prepared_s = time.process_time() - timed.core_s
        fits = fit_plan(plan, config)
        seconds["prepare"] += prepared_s - start_s
        seconds["fit"] += time.process_time() - timed.core_s - prepared_s
        observations.append(finish_sweep(work, plan, fits, config))


def judge(options: argparse.Namespace, folder: Path, methods: list[str]) -> dict[str, dict[str, Any]]:
    """Return the figures of each method's flow, and of zero flow, over the sweeps with truth."""
    from labeling.evaluation.flow import FlowSums, flow_figures
    from labeling.evaluation.report import judge_sweep
    from labeling.evaluation.truth import read_truth, sweep_point_truth
    from labeling.readers.reader import open_segment

    reader = open_segment(options.dataset, options.log)
    truth = read_truth(reader)
    sums = dict.fromkeys([*methods, "zero"], FlowSums())
    files = {method: np.load(folder / f"{method}.npz") for method in methods}
    for index in range(len(reader.timestamps_ns)):
        if any(f"rows_{index}" not in file for file in files.values()):
            continue
        sweep = reader.read_sweep(index)
        point_truth = sweep_point_truth(truth, sweep, reader.read_point_truth(index), None)
        if point_truth is None:
            continue
        for method, file in files.items():
            rows, flow_world_m = file[f"rows_{index}"], file[f"flow_{index}"]
            flow, zero, _ = judge_sweep(sweep, point_truth, rows, flow_world_m, truth.gap_s(index))
            sums[method] += flow
        sums["zero"] += zero
    return {name: {"flow": flow_figures(value).model_dump(mode="json")} for name, value in sums.items()}


def ratios(row: dict[str, Any], base: dict[str, Any]) -> dict[str, float | None]:
    """Return figures as multiples of those of the base."""
    pairs = {"core_s_per_sweep": (row["core_s_per_sweep"], base["core_s_per_sweep"])}
    for name in ("epe3d_m", "moving_epe_m", "standing_epe_m"):
        pairs[name] = (row["flow"][name], base["flow"][name])
    return {name: mine / theirs if mine is not None and theirs else None for name, (mine, theirs) in pairs.items()}


def table(result: dict[str, Any]) -> str:
    from labeling.evaluation.markdown import format_number, render_rows

    header = "method | core-s a sweep | of them nets | peak MB | clusters | EPE3D m | moving EPE m | standing EPE m"
    header += " | core-s / nsfp | EPE3D / nsfp"
    rows = []
    for name, row in result["methods"].items():
        ratio = row["ratio_to_nsfp"] or {}
        rows.append(
            (
                name,
                f"{row['core_s_per_sweep']:.2f}",
                f"{row['core_s_of_fits_per_sweep']:.2f}",
                f"{row['peak_pss_mb']:.0f}",
                f"{statistics.mean(row['num_clusters']):.0f}",
                *(format_number(row["flow"][key]) for key in ("epe3d_m", "moving_epe_m", "standing_epe_m")),
                *(format_number(ratio.get(key)) for key in ("core_s_per_sweep", "epe3d_m")),
            )
        )
    zero = result["zero_flow"]["flow"]
    blank = ("-",) * 4
    rows.append(
        (
            "zero flow",
            *blank,
            *(format_number(zero[key]) for key in ("epe3d_m", "moving_epe_m", "standing_epe_m")),
            "-",
            "-",
        )
    )
    return render_rows(f"Flow on {result['log']}", header, rows)


if __name__ == "__main__":
    main()
