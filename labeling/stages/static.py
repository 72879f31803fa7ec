"""Static points: what stood still while other sweeps looked."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from labeling.evidence.places import GroundedSweep, PlaceEvidence, look_at_places
from labeling.geometry.neighbors import connected_components
from labeling.stages.sliding import MIN_LENGTH_M, slides
from schemas.arrays import BoolArray, Float32Array, Float64Array, Int64Array
from schemas.config import StaticParams
from schemas.frames import MotionMask


def remove_static(current: GroundedSweep, window: Sequence[GroundedSweep], params: StaticParams) -> MotionMask:
    """Mark the points of ``current`` that stand still, judged by the other sweeps of the window.

    Method ``none`` keeps every point (whole-scene baselines).

    Method ``chamfer``: a point with a neighbour nearer than ``max_speed_mps`` times the time gap in an earlier sweep.

    Method ``visibility``: sweeps up to seconds before and after vote for each point: occupied (a neighbour there),
    empty (its rays went through the place), or nothing (occluded, out of view). A point with enough occupied votes is
    static. Then objects decide as a whole: a free-standing component of an object's size whose points are to a fair
    part dynamic keeps them all (long flat sides slide along themselves and look static), and one that hardly has any
    dynamic point loses them all. A long object whose ends come and go is dynamic whatever its side says (``sliding``).

    What a sweep shows of the recording vehicle itself is static.

    Args:
        current: The sweep to judge.
        window: Other sweeps in any order, ``current`` may be among them; ``Neighborhood.voters`` says which matter.
        params: Thresholds; distances grow with the gap, and with range as rays spread.

    Returns:
        ``is_static`` (N,), False on ground points. With no other sweep nothing but the vehicle is static, and no place
        was vacated.

    Source: paper section 3.1, "Identifying Static Points". Chamfer over ``num_chamfer_sweeps`` earlier sweeps is the
    paper's; votes of later sweeps, visibility and whole objects are ours.

    """
    rows = np.flatnonzero(current.is_standing)
    others = [other for other in window if other.sweep.timestamp_ns != current.sweep.timestamp_ns]
    is_static, is_vacated = current.is_vehicle.copy(), np.zeros(current.sweep.num_points, dtype=bool)
    if others and len(rows) and params.method != "none":
        points = current.sweep.points_ego[rows]
        evidence = look_at_places(current, rows, others, params)
        is_vacated[rows] = evidence.is_through.any(axis=0)
        if params.method == "chamfer":
            is_static[rows] = evidence.is_occupied.any(axis=0)
        else:
            is_static[rows] = _decide(points, evidence, params)
    return MotionMask(is_static, ~is_static & ~current.ground.is_ground, is_vacated)


def _decide(points: Float32Array, evidence: PlaceEvidence, params: StaticParams) -> BoolArray:
    num_occupied, num_empty = evidence.is_occupied.sum(axis=0), evidence.is_empty.sum(axis=0)
    is_known = num_occupied >= max(1.0, params.min_known_share * len(evidence.gap_s))
    is_static = is_known & (num_occupied >= params.min_vote_share * (num_occupied + num_empty))
    if not params.has("whole_objects"):
        return is_static
    objects = _find_objects(points, params)
    is_slider = np.zeros(len(objects.is_object), dtype=bool)
    for k in np.flatnonzero(objects.is_object & (objects.length_m > MIN_LENGTH_M)):
        is_slider[k] = slides(points, np.flatnonzero(objects.of_point == k), evidence)
    return _decide_by_object(is_static, objects, params) & ~is_slider[objects.of_point]


@dataclass(frozen=True, slots=True, eq=False)
class _Objects:
    """Connected components of a sweep's points above the ground."""

    of_point: Int64Array  # (N,) in [0, K)
    length_m: Float64Array  # (K,) diagonal seen from above
    is_object: BoolArray  # (K,) of a road user's size


def _find_objects(points: Float32Array, params: StaticParams) -> _Objects:
    component = connected_components(points, params.object_radius_m)
    num_components = int(component.max()) + 1
    low, high = np.full((num_components, 3), np.inf), np.full((num_components, 3), -np.inf)
    np.minimum.at(low, component, points)
    np.maximum.at(high, component, points)
    length_m, height_m = np.hypot(*(high - low)[:, :2].T), (high - low)[:, 2]
    is_object = (length_m < params.max_object_length_m) & (height_m < params.max_object_height_m)
    return _Objects(component, length_m, is_object)


def _decide_by_object(is_static: BoolArray, objects: _Objects, params: StaticParams) -> BoolArray:
    dynamic_share = np.bincount(objects.of_point, weights=~is_static) / np.bincount(objects.of_point)
    is_kept = objects.is_object & (dynamic_share >= params.min_dynamic_share)
    is_dropped = objects.is_object & (dynamic_share < params.max_stray_share)
    return (is_static & ~is_kept[objects.of_point]) | is_dropped[objects.of_point]
