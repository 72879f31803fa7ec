"""Extent: how large an object is, from its aggregated cloud and from what could not be seen of it."""

import numpy as np

from labeling.geometry.boxes import tight_box, to_box_frame
from labeling.geometry.transforms import transform_points
from schemas.arrays import Float64Array
from schemas.config import RefinementParams
from schemas.objects import BOX_HEIGHT, BOX_LENGTH, BOX_WIDTH, BOX_Z, AlignedTrack

MIN_SIDE_M = 0.3  # no moving thing is thinner: a walker seen edge on
SUPPORT_QUANTILES = (0.9, 0.85, 0.95)  # over views, of length, width, height: few views see the ends, most both sides
AGREEMENT_M, AGREEMENT_SHARE = 0.25, 0.1  # of views about where a side lies, the latter of the vehicle's size
TRIMMED_SHARE = 0.02  # of a view's points on each side
EDGE_NOISE = 2.5  # range noises, and mixed returns at edges; a wheel or an arm reaches farther and stays
MIN_TRIMMED_POINTS = 20
FACE_DEPTH = 7.5  # range noises: of a flat face, seen a little aslant
FACE_CONTRAST = 3  # points in it for each in as thick a layer behind it

# Proportions of road vehicles, by construction and by law, not learned from labels: the width of a lane bounds the
# width, 2.55 m in most codes plus mirrors; cars are 2.1 to 2.7 times as long as wide.
FACE_MIN_WIDTH_M, FACE_MAX_WIDTH_M, FACE_MIN_HEIGHT_M = 1.5, 3.6, 1.0  # a front or rear of this size is a vehicle's
FACE_MIN_COVERAGE = 0.75  # of its width in 0.25 m strips: two walkers side by side leave a gap
LENGTH_OF_WIDTH = 2.3
MIN_VEHICLE_LENGTH_M = 3.8
LARGE_HEIGHT_M, LARGE_LENGTH_M = 2.6, 7.5  # of a lorry or a bus
HIGH_M = 2.2  # over the ground: where the face of a lorry is still as wide as below
SIDE_MIN_LENGTH_M = 3.2  # a side at least this long belongs to a vehicle
MIN_CAR_WIDTH_M, MIN_TRUCK_WIDTH_M, TRUCK_LENGTH_M = 1.7, 2.4, 6.5

# Proportions of people, who swing arms and legs, and of the cycles they ride: of both a few beams see the trunk alone.
PERSON_MIN_HEIGHT_M, PERSON_MAX_HEIGHT_M, PERSON_MAX_WIDTH_M = 0.9, 2.3, 0.9
PERSON_SIDE_M = 0.6
CYCLE_LENGTH_M = 1.7  # wheels of 0.65 to 0.7 m, one metre apart
CYCLE_SPEED_MPS = 3.5  # median: hardly anybody keeps it on foot


def model_box(aligned: AlignedTrack, yaw: float, params: RefinementParams) -> Float64Array:
    """Return the (7,) amodal box of a track in its model frame, heading ``yaw``.

    The sides are those that most views support; the box reaches down to the ground; a side that no ray could reach is
    completed from the proportions of vehicles, away from the sensor. Each step is a parameter.

    Source: paper Algorithm 2, MinAreaBBoxAlongDirection around the aggregate; the rest is ours.
    """
    box = _supported_box(aligned, yaw) if params.has("robust_extent") else tight_box(aligned.model_points, yaw)
    if params.has("ground_anchor"):
        box = _reach_ground(aligned, box)
    box[BOX_LENGTH : BOX_HEIGHT + 1] = np.maximum(box[BOX_LENGTH : BOX_HEIGHT + 1], MIN_SIDE_M)
    return complete_person(aligned, complete_vehicle(aligned, box)) if params.has("completion") else box


def _supported_box(aligned: AlignedTrack, yaw: float) -> Float64Array:
    """Return the box whose sides most views support: quantiles over views of each view's own extremes.

    Each view of a vehicle lies a few cm off, and a high quantile of them as far outside: the views that agree with it
    decide by their median. Smaller things bend, and a few beams seldom meet their ends: there the quantile stays.
    """
    local = to_box_frame(aligned.model_points, np.array([0, 0, 0, 0, 0, 0, yaw]))
    views = [local[aligned.model_view == view] for view in range(len(aligned.track.proposals))]
    noises_m = [proposal.range_noise_m for proposal in aligned.track.proposals]
    lows = np.stack([_low_side(view, noise_m) for view, noise_m in zip(views, noises_m, strict=True)])
    highs = -np.stack([_low_side(-view, noise_m) for view, noise_m in zip(views, noises_m, strict=True)])
    low, high = -_reach(-lows), _reach(highs)
    if (high - low)[0] >= SIDE_MIN_LENGTH_M:
        tolerance_m = np.minimum(AGREEMENT_M, AGREEMENT_SHARE * (high - low))
        low, high = -_agreed(-lows, -low, tolerance_m), _agreed(highs, high, tolerance_m)
    return _shift_in_own_frame(np.array([0, 0, 0, *(high - low), yaw]), (low + high) / 2)


def _reach(extremes: Float64Array) -> Float64Array:
    """Return (3,) how far most of (V, 3) views reach."""
    return np.array([np.quantile(extremes[:, axis], support) for axis, support in enumerate(SUPPORT_QUANTILES)])


def _agreed(extremes: Float64Array, reach: Float64Array, tolerance_m: Float64Array) -> Float64Array:
    """Return (3,) medians over the views that reach about as far; ``reach`` lies between two of (V, 3) extremes."""
    is_near = np.abs(extremes - reach) <= tolerance_m
    return np.array([np.median(e[n]) if n.any() else r for e, n, r in zip(extremes.T, is_near.T, reach, strict=True)])


def _low_side(points: Float64Array, noise_m: float) -> Float64Array:
    """Return (3,) low sides of a view: the middle of a flat face, else minima without range noise.

    Half of a flat face's points lie outside of it, by their noise. Elsewhere a few points are noise, but never more
    than the noise is deep.
    """
    lowest = points.min(axis=0)
    if len(points) < MIN_TRIMMED_POINTS:
        return lowest
    trimmed = lowest + np.minimum(np.quantile(points, TRIMMED_SHARE, axis=0) - lowest, EDGE_NOISE * noise_m)
    layer = np.floor((points - lowest) / (FACE_DEPTH * noise_m))
    num_in_face, num_behind = (layer == 0).sum(axis=0), (layer == 1).sum(axis=0)
    is_flat = num_in_face >= np.maximum(FACE_CONTRAST * num_behind, MIN_TRIMMED_POINTS)
    face = [np.median(column[in_face]) for column, in_face in zip(points.T, (layer == 0).T, strict=True)]
    return np.where(is_flat, np.maximum(face, trimmed), trimmed)


def _reach_ground(aligned: AlignedTrack, box: Float64Array) -> Float64Array:
    beneath = [np.append(p.points_world[:, :2].mean(axis=0), p.ground_z_m) for p in aligned.track.proposals]
    poses = zip(aligned.model_from_world, beneath, strict=True)
    ground_z = np.median([transform_points(transform, place[None])[0, 2] for transform, place in poses])
    top = box[BOX_Z] + box[BOX_HEIGHT] / 2
    bottom = min(float(ground_z), top - MIN_SIDE_M)
    reaching = box.copy()
    reaching[BOX_Z], reaching[BOX_HEIGHT] = (top + bottom) / 2, top - bottom
    return reaching


def complete_vehicle(aligned: AlignedTrack, box: Float64Array) -> Float64Array:
    """Lengthen a vehicle seen from behind or ahead only, widen one seen from the side only; the seen face stays.

    A following car shows its rear for minutes and its length never: a box as deep as the points says a car is 0.5 m
    long. What is completed is at least what any vehicle with that face has.
    """
    length, width, height = box[BOX_LENGTH : BOX_HEIGHT + 1]
    missing = np.zeros(2)
    if (
        FACE_MIN_WIDTH_M <= width <= FACE_MAX_WIDTH_M
        and height >= FACE_MIN_HEIGHT_M
        and _coverage(aligned, box) >= FACE_MIN_COVERAGE
    ):
        is_large = height >= LARGE_HEIGHT_M and _coverage(aligned, box, HIGH_M) >= FACE_MIN_COVERAGE
        shortest_m = LARGE_LENGTH_M if is_large else MIN_VEHICLE_LENGTH_M
        missing[0] = max(0.0, max(shortest_m, LENGTH_OF_WIDTH * width) - length)
    if length >= SIDE_MIN_LENGTH_M and height >= FACE_MIN_HEIGHT_M:
        missing[1] = max(0.0, (MIN_TRUCK_WIDTH_M if length >= TRUCK_LENGTH_M else MIN_CAR_WIDTH_M) - width)
    away = -np.sign(_sensor_in_box_frame(aligned, box)[:2])
    completed = box.copy()
    completed[BOX_LENGTH : BOX_WIDTH + 1] += missing
    return _shift_in_own_frame(completed, np.array([*(away * missing / 2), 0.0]))


def complete_person(aligned: AlignedTrack, box: Float64Array) -> Float64Array:
    """Grow what is upright and narrow about its centre to the size of a walker, or of a cycle where it is too fast."""
    if box[BOX_WIDTH] > PERSON_MAX_WIDTH_M or not PERSON_MIN_HEIGHT_M <= box[BOX_HEIGHT] <= PERSON_MAX_HEIGHT_M:
        return box
    speed_mps = np.median([np.linalg.norm(proposal.velocity_mps[:2]) for proposal in aligned.track.proposals])
    completed = box.copy()
    length_m = CYCLE_LENGTH_M if speed_mps >= CYCLE_SPEED_MPS else PERSON_SIDE_M
    completed[BOX_LENGTH : BOX_WIDTH + 1] = np.maximum(box[BOX_LENGTH : BOX_WIDTH + 1], [length_m, PERSON_SIDE_M])
    return completed


def _sensor_in_box_frame(aligned: AlignedTrack, box: Float64Array) -> Float64Array:
    """Return where the sensor mostly stood, views with more points weighing more."""
    origins = np.stack(
        [
            transform_points(transform, proposal.sensor_origin_world[None])[0]
            for proposal, transform in zip(aligned.track.proposals, aligned.model_from_world, strict=True)
        ]
    )
    weights = np.array([len(proposal.points_world) for proposal in aligned.track.proposals], dtype=np.float64)
    return np.average(to_box_frame(origins, box), axis=0, weights=weights)


def _coverage(aligned: AlignedTrack, box: Float64Array, above_m: float = 0.0) -> float:
    """Return which share of 0.25 m strips across the width has points so high above the box's bottom."""
    local = to_box_frame(aligned.model_points, box)
    across = local[local[:, 2] + box[BOX_HEIGHT] / 2 >= above_m, 1] / box[BOX_WIDTH] + 0.5
    num_strips = max(1, round(float(box[BOX_WIDTH]) / 0.25))
    strips = np.unique(np.floor(across[(across >= 0) & (across < 1)] * num_strips))
    return len(strips) / num_strips


def _shift_in_own_frame(box: Float64Array, offset: Float64Array) -> Float64Array:
    """Return the box moved by (3,) along its own axes."""
    cos, sin = np.cos(box[6]), np.sin(box[6])
    moved = box.copy()
    moved[:3] += [offset[0] * cos - offset[1] * sin, offset[0] * sin + offset[1] * cos, offset[2]]
    return moved
