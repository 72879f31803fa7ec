"""Where the time goes: core-seconds of each stage a sweep, in one process, on one log.

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
    reader = TimedReader(open_segment(options.dataset, options.log))
    config = resolve_config(options.profile, {"sweeps": (0, options.sweeps)} if options.sweeps else {})
    start_s = time.process_time()
    num_points = label(reader, config)
    total_s = time.process_time() - start_s
    core_s = {"reading": reader.core_s, **{name: watch.core_s[name] for name in EARLY | LATE}}
    per_sweep = {name: spent_s / len(num_points) for name, spent_s in core_s.items()}
    per_sweep["all else"] = total_s / len(num_points) - sum(per_sweep.values())
    result = {
        "log": Path(options.log).name,
        "dataset": options.dataset,
        "profile": options.profile,
        **describe_run(load_average, libraries=("torch", "numpy", "scipy"), packages=("labeling", "schemas")),
        "num_sweeps": len(num_points),
        "num_points_median": statistics.median(num_points),
        "core_s_per_sweep": {"total": total_s / len(num_points), **per_sweep},
        "floor_core_s_per_sweep": per_sweep["reading"] + sum(per_sweep[name] for name in NEAREST),
    }
    write_result(result, options.output)
    print(table(result))


def read_options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("log", help="folder of one log, or synthetic:street?...")
    parser.add_argument("--dataset", required=True)
    parser.add_argument("--profile", default="default")
    parser.add_argument("--sweeps", type=int, metavar="N", help="the first N; default: all of the log")
    parser.add_argument("--output", type=Path, default=ROOT / "benchmarks/results/stages.json")
    return parser.parse_args()


def label(reader: Any, config: Any) -> list[int]:
    """Label a log and return the number of points of each sweep."""
    observations = list(line.observe_sweeps(reader, config))
    proposals = [observation.proposals for observation in observations]
    line.label_tracks(proposals, line.make_clock(observations), config, reader.segment_id)
    return [observation.num_points for observation in observations]


def table(result: dict[str, Any]) -> str:
    costs = result["core_s_per_sweep"]
    rows = [(name, f"{cost:.3f}", f"{100 * cost / costs['total']:.0f}") for name, cost in costs.items()]
    rows.append(("floor", f"{result['floor_core_s_per_sweep']:.3f}", "-"))
    title = f"{result['log']}, {result['num_sweeps']} sweeps of {result['num_points_median']:.0f} points"
    return render_rows(title, "part | core-s a sweep | % of all", rows)


if __name__ == "__main__":
    main()
