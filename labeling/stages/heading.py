"""Heading: which way an object points, from its motion and from its shape."""

import numpy as np

from labeling.geometry.boxes import to_box_frame
from labeling.geometry.times import bridged_s
from labeling.geometry.voxels import spread_rows
from labeling.stages.registration import MIN_STIFF_LENGTH_M, longest_view_m
from schemas.arrays import Float64Array, FloatArray
from schemas.config import RefinementParams
from schemas.objects import AlignedTrack

TRAVEL_SPAN_S = 0.5  # travel over this time on either side gives the direction of motion
REACHED_PERIODS = 1.6  # where sweeps are rare: the next one on either side
SIDEWAYS_ERROR_M = 1.0  # how far the end of a travel may be off to its side
VEHICLE_SIDEWAYS_ERROR_M = 3.0  # a flat rear slides sideways unseen, and one view that is turned turns what follows
MAX_TURN_RAD = np.deg2rad(25.0)
TURN_STEP_RAD = np.deg2rad(0.25)
MIN_SIDE_M = 1.2  # smaller things have no flat side to go by
EDGE_NOISE = 1.5  # range noises: points this near to an edge lie on it
MAX_SHAPE_POINTS = 1500


def model_heading(
    aligned: AlignedTrack,
    world_from_model: Float64Array,
    times_s: Float64Array,
    params: RefinementParams,
    center: Float64Array | None = None,  # (3,) the point of the model whose travel counts; None: its points' mean
) -> float:
    """Return the model's yaw: the direction its views travelled, turned to its flat sides as far as travel is unsure.

    In a turn each point of a vehicle travels its own way, and only the rear axle where the vehicle points.

    Source: ours. The paper takes the mean flow of the target view (without step ``travel_heading``); the shape term is
    the closeness criterion of L-shape fitting (Zhang et al. 2017).
    """
    center = aligned.model_points.mean(axis=0, dtype=np.float64) if center is None else center
    path = np.einsum("tab,b->ta", world_from_model[:, :3, :3], center) + world_from_model[:, :3, 3]
    travel = _mean_travel(path, aligned.model_from_world, times_s)
    travel_m = float(np.hypot(*travel))
    has_travel = params.has("travel_heading") and travel_m > 1e-6
    yaw = float(np.arctan2(travel[1], travel[0])) if has_travel else aligned.model_yaw
    if not params.has("shape_heading"):
        return yaw
    total_m = float(np.linalg.norm(np.ptp(path[:, :2], axis=0)))
    is_vehicle = longest_view_m(aligned.track) >= MIN_STIFF_LENGTH_M
    error_m = VEHICLE_SIDEWAYS_ERROR_M if is_vehicle else SIDEWAYS_ERROR_M
    reach = min(MAX_TURN_RAD, float(np.arctan2(error_m, total_m)))
    return _turn_to_sides(aligned.model_points, yaw, reach, EDGE_NOISE * aligned.track.range_noise_m)


def _mean_travel(path: Float64Array, model_from_world: Float64Array, times_s: Float64Array) -> Float64Array:
    """Return the (2,) sum of short travels along a (T, 3) path, seen from the model: far ones weigh more."""
    travel = np.zeros(2)
    span_s = bridged_s(TRAVEL_SPAN_S, float(np.median(np.diff(times_s))) if len(times_s) > 1 else 0.0, REACHED_PERIODS)
    for k, time_s in enumerate(times_s):
        near = np.flatnonzero(np.abs(times_s - time_s) <= span_s)
        travel += (model_from_world[k, :3, :3] @ (path[near[-1]] - path[near[0]]))[:2]
    return travel


def _turn_to_sides(points: FloatArray, yaw: float, reach_rad: float, edge_m: float) -> float:
    """Return the yaw within reach along which most points lie close to a side of their box."""
    points = points[spread_rows(len(points), MAX_SHAPE_POINTS)]
    steps = int(reach_rad / TURN_STEP_RAD)
    turns = np.arange(-steps, steps + 1) * TURN_STEP_RAD
    closeness = np.zeros(len(turns))
    for k, turn in enumerate(turns):
        local = to_box_frame(points, np.array([0, 0, 0, 0, 0, 0, yaw + turn]))[:, :2]
        low, high = np.quantile(local, [0.02, 0.98], axis=0)
        if turn == 0 and (high - low).max() < MIN_SIDE_M:
            return yaw
        to_edge = np.minimum(np.abs(local - low), np.abs(high - local)).min(axis=1)
        closeness[k] = (1 / np.maximum(to_edge, edge_m)).mean()
    prior = np.exp(-0.5 * (turns / max(reach_rad / 2, TURN_STEP_RAD)) ** 2)
    return float(yaw + turns[(closeness * (0.5 + 0.5 * prior)).argmax()])
