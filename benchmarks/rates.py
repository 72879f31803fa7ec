"""The same streets at several sweeps a second: how much of what moves is found at each, and how right its speed is.

    python benchmarks/rates.py

What is counted: see README.md.
"""

import argparse
import os
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from records import ROOT, describe_run, write_result

from labeling.evaluation.box_ablation import rounded_rows
from labeling.evaluation.boxes import Matching, detection_curve, match, sweep_overlaps
from labeling.evaluation.evidence import BoxEvidence, gather_evidence, pool
from labeling.evaluation.markdown import format_number, render_rows
from labeling.evaluation.tracks import hota_sums, track_figures
from labeling.evaluation.truth import read_truth
from labeling.line import label_tracks, make_clock, observe_sweeps
from labeling.readers.reader import open_segment
from labeling.threads import use_one_thread
from schemas.arrays import Float64Array
from schemas.config import LabelingConfig, resolve_config
from schemas.manifest import RECOMMENDED_MIN_SCORE

RATES_HZ = (2.0, 3.333, 5.0, 10.0, 20.0)
USUAL_HZ = 10.0
SEEDS = (41, 42, 43, 44)
DURATION_S = 8.0
MIN_SEEN_S = 2.0  # of an object that counts as one to find: fewer sweeps of a low rate tell nothing
MIN_FOUND_SHARE = 0.5  # of the sweeps in which it is to be found

Names = tuple[str, ...]  # "SEED kind-number", the same at each rate


@dataclass(frozen=True, slots=True, eq=False)
class LabeledStreet:
    """The labels of a street at one rate beside its truth."""

    evidence: BoxEvidence
    overlaps: tuple[Float64Array, ...]  # 3D IoU of each sweep
    hota: Float64Array  # (4, 19)
    object_ids: Names
    core_s: float  # reading left out


def uri_of(seed: int, rate_hz: float, duration_s: float) -> str:
    """Return the URI of a street: the same world, whatever the rate."""
    num_sweeps = round(duration_s * rate_hz)
    return f"synthetic:street?sweeps={num_sweeps}&seed={seed}&beams=32&azimuth_steps=900&hz={rate_hz:g}"


def label_street(uri: str, config: LabelingConfig) -> LabeledStreet:
    reader = open_segment("synthetic", uri)
    start_s = time.process_time()
    observations = list(observe_sweeps(reader, config))
    clock = make_clock(observations)
    tracks = label_tracks([o.proposals for o in observations], clock, config, reader.segment_id)
    core_s = time.process_time() - start_s
    truth = read_truth(reader)
    poses = {int(index): truth.world_from_ego[index] for index in clock.sweep_index}
    evidence = gather_evidence(truth, rounded_rows(tracks), poses, None)
    overlaps = sweep_overlaps(evidence, evidence.label_boxes)
    hota = hota_sums(evidence, match(evidence, overlaps, "L1"), overlaps, _is_kept(evidence))
    return LabeledStreet(evidence, tuple(overlaps), hota, truth.object_ids, core_s)


def _is_kept(evidence: BoxEvidence) -> Any:
    return evidence.label_score >= RECOMMENDED_MIN_SCORE


def found_objects(street: LabeledStreet, rate_hz: float) -> dict[str, bool]:
    """Return, of each object that is to be found for long enough, whether it was found in most of its sweeps."""
    evidence, matching = street.evidence, match(street.evidence, list(street.overlaps), "L1")
    is_found = np.zeros(len(evidence.truth_sweep), dtype=bool)
    is_found[matching.truth_of_label[matching.is_right & _is_kept(evidence)]] = True
    found = {}
    for number in np.unique(evidence.truth_object[matching.is_to_find]).tolist():
        rows = matching.is_to_find & (evidence.truth_object == number)
        if rows.sum() >= MIN_SEEN_S * rate_hz:
            found[street.object_ids[number]] = bool(is_found[rows].mean() >= MIN_FOUND_SHARE)
    return found


def judge(streets: Sequence[LabeledStreet], duration_s: float) -> dict[str, Any]:
    """Return the figures of all streets at one rate, pooled."""
    evidence = pool([street.evidence for street in streets])
    overlaps = [iou for street in streets for iou in street.overlaps]
    matching = match(evidence, overlaps, "L1")
    found = detection_curve(evidence, matching, RECOMMENDED_MIN_SCORE)
    tracks = track_figures(evidence, matching, _is_kept(evidence), np.sum([street.hota for street in streets], axis=0))
    return {
        "num_truths": int(matching.is_to_find.sum()),
        "ap": found.average_precision,
        "precision": found.precision,
        "recall": found.recall,
        "completeness": tracks.completeness,
        "hota": tracks.hota,
        **_errors(evidence, matching),
        "core_s_per_second": sum(street.core_s for street in streets) / (len(streets) * duration_s),
    }


def _errors(evidence: BoxEvidence, matching: Matching) -> dict[str, float | None]:
    counted = matching.is_right & _is_kept(evidence)
    truth = matching.truth_of_label[counted]
    if not len(truth):
        return dict.fromkeys(("center_median_m", "speed_median_mps", "speed_p90_mps"))
    center_m = np.linalg.norm((evidence.label_boxes[counted] - evidence.truth_boxes[truth])[:, :3], axis=1)
    speed_mps = np.abs(evidence.label_speed_mps[counted] - evidence.truth_speed_mps[truth])
    return {
        "center_median_m": float(np.median(center_m)),
        "speed_median_mps": float(np.median(speed_mps)),
        "speed_p90_mps": float(np.quantile(speed_mps, 0.9)),
    }


def same_objects(found: dict[float, dict[str, bool]]) -> dict[str, Any]:
    """Return how many of the objects that are found at the usual rate each rate has to find, and how many it finds."""
    usual = {name for name, is_found in found.get(USUAL_HZ, {}).items() if is_found}
    counts = {}
    for rate_hz, of_rate in found.items():
        asked = usual & of_rate.keys()
        counts[f"{rate_hz:g}"] = {"num_objects": len(asked), "num_found": sum(of_rate[name] for name in asked)}
    return counts


def table(result: dict[str, Any]) -> str:
    """Return the table of docs/rates.md."""
    rows = []
    keys = ("ap", "precision", "recall", "completeness", "center_median_m", "speed_median_mps", "speed_p90_mps")
    for rate, figures in result["rates"].items():
        same = result["same_objects"][rate]
        numbers = [format_number(figures[key]) for key in keys]
        rows.append((rate, str(figures["num_truths"]), *numbers, f"{same['num_found']} of {same['num_objects']}"))
    header = "Hz | to find | AP | precision | recall | completeness | centre m | speed m/s | speed, 90 % | objects"
    return render_rows("Rates", header, rows)


def main() -> None:
    options = read_options()
    load_average = os.getloadavg()[0]
    use_one_thread()
    config = resolve_config(options.profile)
    result = describe_run(load_average, libraries=("numpy", "scipy"), packages=("labeling", "schemas"))
    result |= {"profile": options.profile, "seeds": options.seeds, "duration_s": options.seconds, "rates": {}}
    found: dict[float, dict[str, bool]] = {}
    for rate_hz in options.rates:
        streets = [label_street(uri_of(seed, rate_hz, options.seconds), config) for seed in options.seeds]
        result["rates"][f"{rate_hz:g}"] = judge(streets, options.seconds)
        found[rate_hz] = {
            f"{seed} {name}": is_found
            for seed, street in zip(options.seeds, streets, strict=True)
            for name, is_found in found_objects(street, rate_hz).items()
        }
    result["same_objects"] = same_objects(found)
    write_result(result, options.output)
    print(table(result))


def read_options() -> argparse.Namespace:
    def numbers(kind: type) -> Any:
        return lambda text: [kind(part) for part in text.split(",")]

    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rates", type=numbers(float), default=list(RATES_HZ), metavar="HZ,...")
    parser.add_argument("--seeds", type=numbers(int), default=list(SEEDS), metavar="N,...")
    parser.add_argument("--seconds", type=float, default=DURATION_S)
    parser.add_argument("--profile", default="fast")
    parser.add_argument("--output", type=Path, default=ROOT / "benchmarks/results/rates.json")
    return parser.parse_args()


if __name__ == "__main__":
    main()
