"""Fit the scores of boxes on random worlds whose truth is known, and judge them on others.

    python benchmarks/calibration.py CACHE

Worlds are kept in the folder CACHE, so that fitting again takes seconds. What is counted: see README.md.
"""

import argparse
import hashlib
import json
import os
import pickle
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from records import ROOT, describe_run, write_result
from scipy.optimize import minimize
from scipy.special import expit

from labeling.evaluation.box_ablation import rounded_rows
from labeling.evaluation.boxes import Matching, detection_curve, interval, match, resampled_curves, sweep_overlaps
from labeling.evaluation.evidence import BoxEvidence, gather_evidence, pool
from labeling.evaluation.markdown import format_number, format_percent, render_rows
from labeling.evaluation.truth import SegmentTruth, read_truth
from labeling.line import label_tracks, make_clock, observe_sweeps
from labeling.readers.reader import open_segment
from labeling.stages.refinement import SweepClock
from labeling.stages.scoring import INTERCEPT, TERMS, describe_rows
from labeling.threads import use_one_thread
from schemas.arrays import BoolArray, Float64Array, Int64Array
from schemas.config import LabelingConfig
from schemas.objects import AlignedTrack, LabeledTrack, Proposal

SEED = 20240607
NUM_WORLDS = 26
NUM_FOLDS = 5
PRIOR = 60.0  # inverse variance of a standardised weight, times the 20 rows or so that say the same of a track
DIGITS = 4
BIN_EDGES = tuple(round(0.1 * k, 1) for k in range(11))
CUTS = (0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9)
NAMES = tuple(term.name for term in TERMS)
AGAINST = ("heading", "outside", "oversize", "gap")  # the more there is of it, the less the box is believed

CONFIG = LabelingConfig()
# What a world keeps from before tracking does not depend on these, nor its labels on those that only score or write.
EARLY_PARAMS = ("seed", "ground", "static", "decomposition", "flow", "proposals")
LATE_STAGES = (
    "tracking",
    "registration",
    "icp",
    "joining",
    "parts",
    "adoption",
    "heading",
    "extent",
    "trajectory",
    "refinement",
    "attribution",
)
WITHOUT_SAY = ("stages/scoring.py", "shards/", "evaluation/", "pictures.py", "run.py", "in_process.py")
JUDGES = ("evaluation/truth.py", "evaluation/evidence.py")


@dataclass(frozen=True, slots=True, eq=False)
class SeenWorld:
    """What the line finds in a world before tracking, and the truth."""

    proposals: tuple[tuple[Proposal, ...], ...]  # of each sweep
    clock: SweepClock
    truth: SegmentTruth


@dataclass(frozen=True, slots=True, eq=False)
class LabeledWorld:
    """The labels of a world beside its truth. ``evidence.label_score`` numbers the rows of ``tracks``, end to end."""

    tracks: tuple[tuple[AlignedTrack, LabeledTrack], ...]
    evidence: BoxEvidence
    overlaps: tuple[Float64Array, ...]  # 3D IoU of each sweep


def draw_world(number: int) -> str:
    """Return the URI of a street of its own, as one of many kinds of lidar sees it."""
    rng = np.random.default_rng([SEED, number])
    beams = int(rng.choice([32, 64, 128], p=[0.35, 0.45, 0.2]))
    options = {
        "seed": int(rng.integers(1_000, 1_000_000)),
        "beams": beams,
        "azimuth_steps": int(rng.integers(9, 13 if beams == 128 else 20)) * 100,
        "noise_m": round(float(rng.uniform(0.01, 0.04)), 3),
        "dropout": round(float(rng.uniform(0.02, 0.15)), 2),
        "hz": float(rng.choice([10.0, 20.0], p=[0.75, 0.25])),
        "sweeps": int(rng.integers(20, 51)),
    }
    return "synthetic:street?" + "&".join(f"{name}={value}" for name, value in options.items())


def see_world(uri: str) -> SeenWorld:
    reader = open_segment("synthetic", uri)
    observations = list(observe_sweeps(reader, CONFIG))
    return SeenWorld(tuple(o.proposals for o in observations), make_clock(observations), read_truth(reader))


def label_world(seen: SeenWorld) -> LabeledWorld:
    scored: dict[str, AlignedTrack] = {}

    def remember(aligned: AlignedTrack, labeled: LabeledTrack) -> Float64Array:
        scored[labeled.track_id] = aligned  # a joined track comes after its pieces
        return np.zeros(len(labeled.boxes))

    labeled = label_tracks(seen.proposals, seen.clock, CONFIG, seen.truth.segment_id, remember)
    number = np.cumsum([0, *(len(track.boxes) for track in labeled)])
    numbered = [
        replace(track, score=start + np.arange(len(track.boxes), dtype=np.float64))
        for track, start in zip(labeled, number, strict=False)
    ]
    poses = {int(index): seen.truth.world_from_ego[index] for index in seen.clock.sweep_index}
    evidence = gather_evidence(seen.truth, rounded_rows(numbered), poses, None)
    overlaps = tuple(sweep_overlaps(evidence, evidence.label_boxes))
    return LabeledWorld(tuple((scored[track.track_id], track) for track in labeled), evidence, overlaps)


def cached_world(folder: Path, number: int) -> LabeledWorld:
    """Return a world from the cache; what has changed since, in code or parameters, is made again from there on."""
    uri = draw_world(number)
    early = json.dumps(CONFIG.model_dump(mode="json", include=set(EARLY_PARAMS)))
    late_files = ("schemas/config/refinement.py", *(f"labeling/stages/{stage}.py" for stage in LATE_STAGES))

    def seen() -> SeenWorld:
        key = f"{digest_of_source(without=late_files)} {early} {uri}"
        return cached(folder / f"{number:03d}-seen.pickle", key, lambda: see_world(uri))

    key = f"{digest_of_source(without=())} {CONFIG.config_hash} {uri}"
    return cached(folder / f"{number:03d}-labeled.pickle", key, lambda: label_world(seen()))


def cached(path: Path, key: str, make: Callable[[], Any]) -> Any:
    if path.exists():
        with path.open("rb") as file:
            if pickle.load(file) == key:
                return pickle.load(file)
    start_s = time.process_time()
    value = make()
    print(f"{path.name}: {time.process_time() - start_s:.0f} core-s", file=sys.stderr, flush=True)
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("wb") as file:
        pickle.dump(key, file)
        pickle.dump(value, file)
    return value


def digest_of_source(without: Sequence[str]) -> str:
    """Return a digest of the source that decides boxes and truth, without some files."""
    spared = tuple(f"labeling/{name}" for name in WITHOUT_SAY)
    judges = tuple(f"labeling/{name}" for name in JUDGES)
    digest = hashlib.sha256()
    for file in sorted(file for room in ("schemas", "labeling") for file in (ROOT / room).rglob("*.py")):
        name = file.relative_to(ROOT).as_posix()
        if name in judges or not name.startswith((*spared, *without)):
            digest.update(f"{name}\0".encode() + file.read_bytes() + b"\0")
    return digest.hexdigest()


@dataclass(frozen=True, slots=True, eq=False)
class Rows:
    """What the labels of all worlds in the evaluated region show, and what is right about them."""

    evidence: BoxEvidence  # of all worlds, pooled
    overlaps: list[Float64Array]
    world: Int64Array  # (A,) number of each row's world
    features: Float64Array  # (A, F) order of NAMES
    former: Float64Array  # (A,) scores by the formula before

    def matching(self, score: Float64Array) -> Matching:
        return match(replace(self.evidence, label_score=score), self.overlaps, "L1")


@dataclass(frozen=True, slots=True, eq=False)
class Fit:
    """A logistic function of standardised features."""

    intercept: float
    mean: Float64Array  # (F,)
    scale: Float64Array  # (F,)
    weight: Float64Array  # (F,)

    def chances(self, features: Float64Array) -> Float64Array:
        return expit(self.intercept + (features - self.mean) / self.scale @ self.weight)


def gather_rows(worlds: Sequence[LabeledWorld]) -> Rows:
    features, former = [], []
    for world in worlds:
        described = [describe_rows(*track) for track in world.tracks]
        of_world = [np.concatenate([np.zeros(0), *(of_track[name] for of_track in described)]) for name in NAMES]
        row = world.evidence.label_score.astype(np.int64)
        features.append(np.stack(of_world, axis=1)[row])
        former.append(np.concatenate([np.zeros(0), *(former_scores(*track) for track in world.tracks)])[row])
    return Rows(
        evidence=pool([world.evidence for world in worlds]),
        overlaps=[iou for world in worlds for iou in world.overlaps],
        world=np.repeat(np.arange(len(worlds)), [len(part) for part in features]),
        features=np.concatenate(features),
        former=np.concatenate(former),
    )


def former_scores(aligned: AlignedTrack, labeled: LabeledTrack) -> Float64Array:
    """Return (R,) scores by the formula that the fit replaced: no chances, but falling with what makes a box worse."""
    num_views, boxes = len(aligned.track.proposals), labeled.boxes
    travel_m = float(np.linalg.norm(boxes[-1, :2] - boxes[0, :2]))
    length_m = float(np.hypot(*boxes[0, 3:5]))
    error_m = float(np.nanmean(aligned.error_m)) if num_views > 1 else 1.0
    of_track = (
        (1 - np.exp(-num_views / 10))
        * (1 - np.exp(-travel_m / max(1.0, 0.5 * length_m)))
        * np.exp(-((error_m / 0.4) ** 2))
    )
    return np.clip(of_track * (1 - 0.6 * np.exp(-labeled.num_points / 15)), 0.0, 1.0)


def fit_chances(features: Float64Array, is_right: BoolArray) -> Fit:
    """Return the most likely weights, each of the sign that its feature must have, held down by a normal prior."""
    mean, scale = features.mean(axis=0), features.std(axis=0)
    scale = np.where(scale > 0, scale, 1.0)
    standard = (features - mean) / scale

    def loss(parameters: Float64Array) -> tuple[float, Float64Array]:
        weight = parameters[1:]
        log_odds = parameters[0] + standard @ weight
        missing = expit(log_odds) - is_right
        value = np.logaddexp(0, log_odds).sum() - log_odds[is_right].sum() + PRIOR * (weight**2).sum() / 2
        return value, np.append(missing.sum(), missing @ standard + PRIOR * weight)

    bounds = [(None, None), *((None, 0) if name in AGAINST else (0, None) for name in NAMES)]
    solved = minimize(loss, np.zeros(len(NAMES) + 1), jac=True, bounds=bounds, method="L-BFGS-B")
    if not solved.success:
        sys.exit(f"the fit did not converge: {solved.message}")
    return Fit(float(solved.x[0]), mean, scale, solved.x[1:])


def held_out_chances(rows: Rows, is_right: BoolArray, is_ignored: BoolArray) -> Float64Array:
    """Return (A,) chances, each by a fit on worlds other than the row's own."""
    chance = np.zeros(len(rows.world))
    for fold in range(NUM_FOLDS):
        is_here = rows.world % NUM_FOLDS == fold
        used = ~is_here & ~is_ignored
        chance[is_here] = fit_chances(rows.features[used], is_right[used]).chances(rows.features[is_here])
    return chance


def judge(rows: Rows, score: Float64Array) -> dict[str, Any]:
    """Return how good a score is: as a chance, and as an order."""
    matching = rows.matching(score)
    evidence = replace(rows.evidence, label_score=score)
    counted = ~matching.is_ignored
    chance, is_right = score[counted], matching.is_right[counted]
    table = []
    for low, high in pairwise(BIN_EDGES):
        inside = (chance >= low) & ((chance < high) | (high == BIN_EDGES[-1]))
        table.append(
            {
                "low": low,
                "high": high,
                "num_rows": int(inside.sum()),
                "mean_score": float(chance[inside].mean()) if inside.any() else None,
                "share_right": float(is_right[inside].mean()) if inside.any() else None,
            }
        )
    off = [row["num_rows"] * abs(row["mean_score"] - row["share_right"]) for row in table if row["num_rows"]]
    curves = resampled_curves(evidence, matching, 0.0, np.random.default_rng(SEED))
    cuts = []
    for cut in CUTS:
        found = detection_curve(evidence, matching, cut)
        around = resampled_curves(evidence, matching, cut, np.random.default_rng(SEED))
        cuts.append(
            {
                "min_score": cut,
                "precision": found.precision,
                "precision_interval": interval([curve.precision for curve in around]),
                "recall": found.recall,
                "recall_interval": interval([curve.recall for curve in around]),
            }
        )
    return {
        "brier": float(((chance - is_right) ** 2).mean()),
        "expected_calibration_error": float(sum(off) / len(chance)),
        "ap": detection_curve(evidence, matching, 0.0).average_precision,
        "ap_interval": interval([curve.average_precision for curve in curves]),
        "reliability": table,
        "cuts": cuts,
    }


def calibrate(worlds: Sequence[LabeledWorld], uris: Sequence[str]) -> dict[str, Any]:
    rows = gather_rows(worlds)
    nearest = rows.matching(np.zeros(len(rows.world)))  # of equal scores: the box that overlaps more is the right one
    used = ~nearest.is_ignored
    fit = fit_chances(rows.features[used], nearest.is_right[used])
    terms = zip(NAMES, fit.mean, fit.scale, fit.weight, strict=True)
    in_use = expit(INTERCEPT + sum(t.weight * (rows.features[:, k] - t.mean) / t.scale for k, t in enumerate(TERMS)))
    return {
        "worlds": list(uris),
        "num_sweeps": rows.evidence.num_sweeps,
        "num_tracks": len(np.unique(rows.evidence.label_track)),
        "num_rows": len(rows.world),
        "num_ignored": int(nearest.is_ignored.sum()),
        "num_right": int(nearest.is_right.sum()),
        "num_to_find": int(nearest.is_to_find.sum()),
        "intercept": round(fit.intercept, DIGITS),
        "terms": [
            {
                "name": name,
                **{key: round(float(v), DIGITS) for key, v in zip(("mean", "scale", "weight"), of, strict=True)},
            }
            for name, *of in terms
        ],
        "held_out": judge(rows, held_out_chances(rows, nearest.is_right, nearest.is_ignored)),
        "in_use": judge(rows, in_use),
        "former": judge(rows, rows.former),
    }


def tables(result: dict[str, Any]) -> list[str]:
    """Return the tables of docs/scores.md."""
    held_out, former = result["held_out"], result["former"]
    reliability = [
        (
            f"{row['low']:.1f} to {row['high']:.1f}",
            str(row["num_rows"]),
            *map(format_number, (row["mean_score"], row["share_right"])),
        )
        for row in held_out["reliability"]
    ]
    keys = ("brier", "expected_calibration_error", "ap")
    worth = [
        (name, *(format_number(of[key]) for key in keys))
        for name, of in (("chances, of held-out worlds", held_out), ("formula before", former))
    ]
    cuts = [
        (
            f"{ours['min_score']:.1f}",
            *(format_percent(of[key]) for of in (ours, before) for key in ("precision", "recall")),
        )
        for ours, before in zip(held_out["cuts"], former["cuts"], strict=True)
    ]
    return [
        render_rows("Reliability", "score | rows | mean score | share right", reliability),
        render_rows("Worth", "score | Brier score | calibration error | AP", worth),
        render_rows("Cuts", "cut | precision % | recall % | precision before % | recall before %", cuts),
    ]


def code_of(result: dict[str, Any]) -> str:
    """Return the lines that labeling/stages/scoring.py takes over."""
    terms = [f'    Term("{t["name"]}", {t["mean"]}, {t["scale"]}, {t["weight"]}),' for t in result["terms"]]
    return "\n".join([f"INTERCEPT: Final = {result['intercept']}", "TERMS: Final = (", *terms, ")"])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("cache", type=Path, help="folder that keeps the worlds")
    parser.add_argument("--worlds", type=int, default=NUM_WORLDS)
    parser.add_argument("--output", type=Path, default=ROOT / "benchmarks/results/calibration.json")
    options = parser.parse_args()
    load_average = os.getloadavg()[0]
    use_one_thread()
    worlds = [cached_world(options.cache, number) for number in range(options.worlds)]
    result = describe_run(load_average, libraries=("numpy", "scipy"), packages=("labeling", "schemas"))
    result |= calibrate(worlds, [draw_world(number) for number in range(options.worlds)])
    write_result(result, options.output)
    print("\n\n".join([*tables(result), "For labeling/stages/scoring.py:", code_of(result)]))


if __name__ == "__main__":
    main()
