"""Scoring: a finished track -> the chance that each of its boxes is right.

Right means what the evaluation means by it: the box overlaps a mover's true one by an IoU of at least 0.4 in 3D. The
chance is a logistic function of a few things that a track shows about itself, each of which can only speak for the box
or only against it. Their weights were fitted on streets of the built-in world, whose truth is known, never on recorded
logs: ``benchmarks/calibration.py`` does that and prints the table below; docs/scores.md says how well it holds.

Source: ours; the paper has no scores for its labels.
"""

from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy.special import expit

from labeling.geometry.boxes import to_box_frame
from labeling.geometry.times import seconds_between
from schemas.arrays import Float64Array
from schemas.objects import BOX_HEIGHT, BOX_LENGTH, BOX_YAW, AlignedTrack, LabeledTrack

MARGIN_NOISE: Final = 5.0  # range noises, by which a box is grown before its points count as outside
SEEN_QUANTILE: Final = 0.9  # over views, of how far they reach: a side that a tenth of them shows is seen
LOOK_S: Final = 0.1  # views nearer in time show the same errors: each is worth as much less of a look
MAX_LOOKS: Final = 40  # more make no track surer: the worlds of the fit have hardly more
MAX_TRAVEL: Final = 3.0  # in diagonals of the box: what has left its place that clearly moves
MAX_OUTSIDE: Final = 0.2  # share of points
FREE_TURN: Final = 0.15  # |sin|: less costs hardly any overlap, and the heading of a walker is no surer
MAX_GAP_S: Final = 2.0
NUM_DIRECTIONS: Final = 16  # in which the extent of a way is measured
# Hardly any road user is larger, by law or by construction: a bus without a joint, its mirrors, what fits under
# bridges.
LARGEST_M: Final = np.array([12.0, 2.9, 4.2])
# Walkers and cycles are narrow, and no higher than this: what is higher and narrow is the edge of something hidden.
NARROW_M, NARROW_HEIGHT_M = 1.2, 2.3


@dataclass(frozen=True, slots=True)
class Term:
    """One thing that a score looks at; it adds ``weight * (value - mean) / scale`` to the log-odds."""

    name: str  # key of describe_rows
    mean: float  # over the rows of the fit
    scale: float  # their standard deviation
    weight: float


INTERCEPT: Final = 4.4193
TERMS: Final = (
    Term("points", 4.6062, 1.826, 0.2349),
    Term("best_view", 5.5822, 1.8971, 0.1711),
    Term("views", 3.2742, 0.4388, 0.259),
    Term("travel", 1.2658, 0.2267, 0.5048),
    Term("width_in_view", 0.8217, 0.1591, 0.9919),
    Term("seen_height", 0.8374, 0.1303, 0.0384),
    Term("heading", 0.0081, 0.0625, -0.186),
    Term("outside", 0.0064, 0.0247, -0.2281),
    Term("oversize", 0.0098, 0.062, -0.8324),
    Term("gap", 0.0022, 0.0149, -0.1112),
)


def score_rows(aligned: AlignedTrack, labeled: LabeledTrack) -> Float64Array:
    """Return the (R,) chances that the boxes of a track are right, in [0, 1]."""
    return chances(describe_rows(aligned, labeled))


def chances(evidence: dict[str, Float64Array]) -> Float64Array:
    """Return (R,) chances from what ``describe_rows`` says of R rows."""
    log_odds = INTERCEPT + sum(term.weight * (evidence[term.name] - term.mean) / term.scale for term in TERMS)
    chance: Float64Array = expit(log_odds)
    return chance


def describe_rows(aligned: AlignedTrack, labeled: LabeledTrack) -> dict[str, Float64Array]:
    """Return what a track shows about each of its boxes, (R,) arrays by name.

    Speaking for a row, the more of it there is:

    * ``points``: logarithm of the number of points in this sweep, plus one; an interpolated row has none.
    * ``views``: logarithm of the number of sweeps with points, up to MAX_LOOKS; of sweeps less than LOOK_S apart each
      counts as that share of one.
    * ``best_view``: the same logarithm of the number of points in the sweep that has most.
    * ``travel``: logarithm of the farthest way between two rows in diagonals of the box, plus one, up to MAX_TRAVEL.
    * ``width_in_view``: mean share of the box's width that the points of one sweep span.
    * ``seen_height``: share of the box's height that was seen in any sweep, not completed.

    Speaking against it:

    * ``heading``: mean |sin| of the angle between heading and way beyond FREE_TURN, faster rows weighing more.
    * ``outside``: mean share of the points of a sweep outside of the box, up to MAX_OUTSIDE.
    * ``oversize``: logarithm of the factor by which the box is larger than LARGEST_M, or higher than NARROW_HEIGHT_M
      when no wider than NARROW_M; zero where it is not.
    * ``gap``: time to the nearest row with points, in seconds, up to MAX_GAP_S.
    """
    boxes, num_rows = labeled.boxes, len(labeled.boxes)
    size_m = boxes[0, BOX_LENGTH : BOX_HEIGHT + 1]
    seen = np.flatnonzero(labeled.is_observed)
    views = [to_box_frame(p.points_world, boxes[k]) for p, k in zip(aligned.track.proposals, seen, strict=True)]
    lows = np.maximum([view.min(axis=0) for view in views], -size_m / 2)  # (T, 3)
    highs = np.minimum([view.max(axis=0) for view in views], size_m / 2)
    spans_m = np.maximum(highs - lows, 0.0)
    seen_m = np.quantile(highs, SEEN_QUANTILE, axis=0) - np.quantile(lows, 1 - SEEN_QUANTILE, axis=0)
    grown_m = size_m / 2 + MARGIN_NOISE * aligned.track.range_noise_m
    outside = np.mean([(np.abs(view) > grown_m).any(axis=1).mean() for view in views])
    of_track = {
        "best_view": np.log1p(labeled.num_points.max()),
        "views": np.log(min(_num_looks(aligned), MAX_LOOKS)),
        "travel": np.log1p(min(_farthest_m(boxes) / np.hypot(*size_m[:2]), MAX_TRAVEL)),
        "width_in_view": spans_m[:, 1].mean() / size_m[1],
        "seen_height": max(seen_m[2], 0.0) / size_m[2],
        "heading": max(_off_the_way(labeled) - FREE_TURN, 0.0),
        "outside": min(outside, MAX_OUTSIDE),
        "oversize": np.log(np.maximum(size_m / _largest_m(size_m), 1.0)).max(),
    }
    return {
        "points": np.log1p(labeled.num_points.astype(np.float64)),
        "gap": np.minimum(_gaps_s(labeled), MAX_GAP_S),
        **{name: np.full(num_rows, float(value)) for name, value in of_track.items()},
    }


def _num_looks(aligned: AlignedTrack) -> float:
    stamps_ns = np.array([proposal.timestamp_ns for proposal in aligned.track.proposals])
    return 1 + float(np.clip(np.abs(seconds_between(stamps_ns[1:], stamps_ns[:-1])) / LOOK_S, 0, 1).sum())


def _largest_m(size_m: Float64Array) -> Float64Array:
    """Return the (3,) length, width and height that a road user of this width may have."""
    is_narrow = size_m[1] <= NARROW_M
    return np.minimum(LARGEST_M, [np.inf, np.inf, NARROW_HEIGHT_M if is_narrow else np.inf])


def _gaps_s(labeled: LabeledTrack) -> Float64Array:
    """Return (R,) times to the nearest row with points."""
    times_s = seconds_between(labeled.timestamp_ns, int(labeled.timestamp_ns[0]))
    last = np.maximum.accumulate(np.where(labeled.is_observed, times_s, -np.inf))
    following = np.minimum.accumulate(np.where(labeled.is_observed, times_s, np.inf)[::-1])[::-1]
    gap_s: Float64Array = np.minimum(times_s - last, following - times_s)
    return gap_s


def _farthest_m(boxes: Float64Array) -> float:
    """Return the farthest way between two rows, to half a percent: the greatest extent in any of some directions."""
    angles = np.arange(NUM_DIRECTIONS) * np.pi / NUM_DIRECTIONS
    return float(np.ptp(boxes[:, :2] @ np.stack([np.cos(angles), np.sin(angles)]), axis=0).max())


def _off_the_way(labeled: LabeledTrack) -> float:
    velocity = labeled.velocity_mps[:, :2]
    speed = np.linalg.norm(velocity, axis=1)
    yaw = labeled.boxes[:, BOX_YAW]
    across = np.abs(velocity[:, 1] * np.cos(yaw) - velocity[:, 0] * np.sin(yaw))  # speed times |sin|
    return float(across.sum() / speed.sum()) if speed.sum() > 0 else 0.0
