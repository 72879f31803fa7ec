"""Parts: tracks too low for a road user -> the vehicle that each rides along with.

Of a lorry ahead a lidar sees the rear and, beneath the body, the wheels at its far end: two things to a tracker, and a
lorry as short as its rear.
"""

from collections.abc import Sequence

import numpy as np

from labeling.geometry.boxes import to_box_frame
from labeling.geometry.times import median_period_s, seconds_between, sweeps_within
from labeling.stages.extent import LARGE_HEIGHT_M
from schemas.arrays import Float64Array, Int64Array
from schemas.objects import BOX_HEIGHT, BOX_LENGTH, LabeledTrack

MAX_PART_HEIGHT_M = 1.0  # nobody on the road is lower
MIN_WHOLE_LENGTH_M = 3.0  # of a vehicle that parts may belong to
LARGE_REACH_M = 10.0  # before and behind a large vehicle's box; what is near a car may be another car
MARGIN_M = 0.3  # about any vehicle's box
MAX_DRIFT_M = 0.5  # of a part within its vehicle
MIN_COMMON_S, MIN_COMMON_SWEEPS = 0.4, 3  # for which both must be seen; the latter at any rate


def parts_of_vehicles(labeled: Sequence[LabeledTrack]) -> list[tuple[int, int]]:
    """Return pairs (part, vehicle) of positions in the tracks; of several vehicles the nearest has a part."""
    pairs = []
    for part, low in enumerate(labeled):
        if low.boxes[0, BOX_HEIGHT] >= MAX_PART_HEIGHT_M:
            continue
        gaps_m = {k: _gap_m(low, other) for k, other in enumerate(labeled) if k != part}
        near = {k: gap_m for k, gap_m in gaps_m.items() if gap_m is not None}
        if near:
            pairs.append((part, min(near, key=near.__getitem__)))
    return pairs


def boxes_when(track: LabeledTrack, rows: Int64Array, other: LabeledTrack, rows_of_other: Int64Array) -> Float64Array:
    """Return (n, 7) boxes of a track in some sweeps, carried to when the other one was seen in them.

    A sweep takes as long as a turn: what lies at its seam is seen at its beginning and, elsewhere, at its end.
    """
    late_s = seconds_between(other.timestamp_ns[rows_of_other], track.timestamp_ns[rows])
    boxes = track.boxes[rows].copy()
    boxes[:, :3] += late_s[:, None] * track.velocity_mps[rows]
    return boxes


def _gap_m(part: LabeledTrack, vehicle: LabeledTrack) -> float | None:
    """Return how far before or behind a vehicle's box a low thing keeps its place; None where it does not."""
    length_m, width_m, height_m = vehicle.boxes[0, BOX_LENGTH : BOX_HEIGHT + 1]
    if height_m < MAX_PART_HEIGHT_M or max(length_m, width_m) < MIN_WHOLE_LENGTH_M:
        return None
    _, in_part, in_vehicle = np.intersect1d(part.sweep_index, vehicle.sweep_index, return_indices=True)
    if len(in_part) < max(MIN_COMMON_SWEEPS, sweeps_within(MIN_COMMON_S, median_period_s(part.timestamp_ns))):
        return None
    pairs = zip(part.boxes[in_part], boxes_when(vehicle, in_vehicle, part, in_part), strict=True)
    places = np.stack([to_box_frame(low[None, :3], box)[0, :2] for low, box in pairs])
    x_m, y_m = np.abs(np.median(places, axis=0))
    gap_m = max(0.0, float(x_m - length_m / 2))
    reach_m = LARGE_REACH_M if height_m >= LARGE_HEIGHT_M else MARGIN_M
    drift_m = np.ptp(np.quantile(places, [0.1, 0.9], axis=0), axis=0).max()
    is_near = gap_m <= reach_m and y_m <= width_m / 2 + MARGIN_M
    return gap_m if is_near and drift_m <= MAX_DRIFT_M else None
