"""Where the time goes: core-seconds of each stage a sweep, in one process, on a log and on a dense made-up street.

    python benchmarks/stages.py LOG --dataset av2

What is counted: see README.md.
"""

import argparse
import os
import statistics
import time
from collections import defaultdict
from collections.abc import Callable
from pathlib import Path
from typing import Any

from records import ROOT, describe_run, write_result

from labeling import line, window
from labeling.evaluation.flow_ablation import TimedReader
from labeling.evaluation.markdown import render_rows
from labeling.evidence import places
from labeling.geometry import visibility
from labeling.readers.reader import open_segment
from labeling.stages import flow
from labeling.threads import use_one_thread
from schemas.config import resolve_config

DENSE_STREET = "synthetic:street?azimuth_steps=1700&beams=128&movers=40&seed=1&sweeps=90"
WARM_UP = "synthetic:street?sweeps=2&beams=16&azimuth_steps=360"
# Stage -> module that calls it, and the name it is called by.
EARLY = {
    "ground": (window, "segment_ground"),
    "range image": (places, "make_range_image"),
    "static": (window, "remove_static"),
    "static: trees": (places, "build_tree"),
    "static: nearest": (places, "nearest_distance_m"),
    "rays": (visibility, "is_seen_through"),
    "decomposition": (line, "decompose"),
    "flow: plan": (line, "plan_flow"),
    "flow: vote": (flow, "vote_motion"),
    "flow: nets": (line, "fit_nets"),
    "proposals": (line, "propose_boxes"),
}
LATE = {
    "tracking": (line, "link_proposals"),
    "registration": (line, "register_track"),
    "refinement": (line, "refine_track"),
    "joining": (line, "join_tracks"),
    "adoption": (line, "adopt_strays"),
}
NEAREST = ("static: trees", "static: nearest")


class Stopwatch:
    """Core-seconds by name. What a part spends in another one counts for that one alone."""

    def __init__(self) -> None:
        self.core_s: dict[str, float] = defaultdict(float)
        self._inner_s = [0.0]

    def wrap(self, name: str, function: Callable[..., Any]) -> Callable[..., Any]:
        def timed(*arguments: Any, **options: Any) -> Any:
            self._inner_s.append(0.0)
            start_s = time.process_time()
            try:
                return function(*arguments, **options)
            finally:
                spent_s = time.process_time() - start_s
                self.core_s[name] += spent_s - self._inner_s.pop()
                self._inner_s[-1] += spent_s

        return timed


def main() -> None:
    options = read_options()
    load_average = os.getloadavg()[0]
    use_one_thread()
    label(open_segment("synthetic", WARM_UP), resolve_config(options.profile))
    watch = Stopwatch()
    for name, (module, function) in (EARLY | LATE).items():
        setattr(module, function, watch.wrap(name, getattr(module, function)))
    config = resolve_config(options.profile, {"sweeps": (0, options.sweeps)} if options.sweeps else {})
    log, street = (
        measure(dataset, segment, config, watch)
        for dataset, segment in ((options.dataset, options.log), ("synthetic", options.street))
    )
    result = {
        "profile": options.profile,
        **describe_run(load_average, libraries=("torch", "numpy", "scipy"), packages=("labeling", "schemas")),
        "log": log,
        "street": street,
        "street_to_log": street["labeling_core_s_per_sweep"] / log["labeling_core_s_per_sweep"],
    }
    write_result(result, options.output)
    print(table(log), table(street), f"street / log: {result['street_to_log']:.2f}", sep="\n")


def read_options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("log", help="folder of one log, or synthetic:street?...")
    parser.add_argument("--dataset", required=True)
    parser.add_argument("--street", default=DENSE_STREET, metavar="URI", help="default: %(default)s")
    parser.add_argument("--profile", default="default")
    parser.add_argument("--sweeps", type=int, metavar="N", help="the first N of either; default: all")
    parser.add_argument("--output", type=Path, default=ROOT / "benchmarks/results/stages.json")
    return parser.parse_args()


def measure(dataset: str, segment: str, config: Any, watch: Stopwatch) -> dict[str, Any]:
    """Label a segment and return what each part of it took."""
    watch.core_s.clear()
    reader = TimedReader(open_segment(dataset, segment))
    start_s = time.process_time()
    num_points = label(reader, config)
    total_s = time.process_time() - start_s
    core_s = {"reading": reader.core_s, **{name: watch.core_s[name] for name in EARLY | LATE}}
    core_s["all else"] = total_s - sum(core_s.values())
    per_sweep = {name: spent_s / len(num_points) for name, spent_s in core_s.items()}
    labeling_s = total_s - reader.core_s  # to read a made-up street is to cast its rays
    return {
        "segment": Path(segment).name,
        "dataset": dataset,
        "num_sweeps": len(num_points),
        "num_points_median": statistics.median(num_points),
        "core_s_per_sweep": {"total": total_s / len(num_points), **per_sweep},
        "labeling_core_s_per_sweep": labeling_s / len(num_points),
        "floor_core_s_per_sweep": per_sweep["reading"] + sum(per_sweep[name] for name in NEAREST),
        "share_after_flow": sum(core_s[name] for name in LATE) / labeling_s,
    }


def label(reader: Any, config: Any) -> list[int]:
    """Label a log and return the number of points of each sweep."""
    observations = list(line.observe_sweeps(reader, config))
    proposals = [observation.proposals for observation in observations]
    line.label_tracks(proposals, line.make_clock(observations), config, reader.segment_id)
    return [observation.num_points for observation in observations]


def table(measured: dict[str, Any]) -> str:
    costs = measured["core_s_per_sweep"]
    labeling_s = measured["labeling_core_s_per_sweep"]
    rows = [(name, f"{cost:.3f}", f"{100 * cost / labeling_s:.0f}") for name, cost in costs.items()]
    rows.append(("all but reading", f"{labeling_s:.3f}", "100"))
    rows.append(
        ("after flow", f"{measured['share_after_flow'] * labeling_s:.3f}", f"{100 * measured['share_after_flow']:.0f}")
    )
    rows.append(("floor", f"{measured['floor_core_s_per_sweep']:.3f}", "-"))
    title = f"{measured['segment']}, {measured['num_sweeps']} sweeps of {measured['num_points_median']:.0f} points"
    return render_rows(title, "part | core-s a sweep | % of all but reading", rows)


if __name__ == "__main__":
    main()
