"""Trajectories: noisy poses over time -> smooth ones with velocity, at any time between."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from schemas.arrays import Float64Array

WINDOW_S = 0.6  # half width of the local fit: longer than registration noise, shorter than a manoeuvre
ROBUST_SCALE_M = 0.15  # residuals beyond weigh less: one bad alignment does not bend the path
ROBUST_ROUNDS = 3
MAX_FLOW_RESIDUAL_M = 0.9  # over FLOW_BASE_S: what differs by 3 m/s from how the object went is not its flow
FLOW_BASE_S = 0.3  # a flow counts as a displacement over it: it decides at the ends of a track, not in its middle
LONG_SILENCE_S = 1.0  # over a longer one the way between is taken straight


@dataclass(frozen=True, slots=True, eq=False)
class Trajectory:
    """Poses of one object over time, world frame."""

    times_s: Float64Array  # (T,) ascending
    centers: Float64Array  # (T, 3)
    yaws: Float64Array  # (T,) unwrapped
    velocities: Float64Array  # (T, 3)


def smooth_trajectory(
    times_s: Float64Array, centers: Float64Array, yaws: Float64Array, flows_mps: Float64Array, *, is_smoothed: bool
) -> Trajectory:
    """Return the trajectory through (T, 3) centres and (T,) yaws, T >= 1, of an object with (T, 3) flows.

    Smoothed: at each time a robust local parabola through the centres within ``WINDOW_S`` (a line when few), its slope
    the velocity; flows are slopes that it should have. Not smoothed: the poses as they are, velocity by central
    differences.
    """
    yaws = np.unwrap(yaws)
    if len(times_s) < 2:
        return Trajectory(times_s, centers, yaws, np.zeros_like(centers))
    if not is_smoothed:
        return Trajectory(times_s, centers, yaws, _central_differences(times_s, centers))
    smooth, velocity, smooth_yaw = np.empty_like(centers), np.empty_like(centers), np.empty_like(yaws)
    for k, time_s in enumerate(times_s):
        near = np.flatnonzero(np.abs(times_s - time_s) <= WINDOW_S)
        if len(near) < 3:
            near = np.argsort(np.abs(times_s - time_s), kind="stable")[:3]
        degree = 2 if len(near) >= 5 else 1
        smooth[k], velocity[k] = _local_fit(times_s[near] - time_s, centers[near], degree, flows_mps[near])
        smooth_yaw[k] = _local_fit(times_s[near] - time_s, yaws[near, None], 1)[0][0]
    return Trajectory(times_s, smooth, smooth_yaw, velocity)


def _central_differences(times_s: Float64Array, centers: Float64Array) -> Float64Array:
    """Return (T, 3) velocities between the neighbours on either side, one-sided at the ends.

    Nearer than half a sweep is no neighbour: at the seam of two turns an object is met twice within milliseconds.
    """
    apart_s = np.median(np.diff(times_s)) / 2
    before = np.searchsorted(times_s, times_s - apart_s, side="right") - 1
    after = np.searchsorted(times_s, times_s + apart_s, side="left")
    own = np.arange(len(times_s))
    before, after = np.where(before < 0, own, before), np.where(after == len(own), own, after)
    span_s = np.where(after > before, times_s[after] - times_s[before], np.inf)
    return np.asarray((centers[after] - centers[before]) / span_s[:, None])


def _local_fit(
    dt: Float64Array, values: Float64Array, degree: int, slopes: Float64Array | None = None
) -> tuple[Float64Array, Float64Array]:
    """Return (D,) value and (D,) slope at dt = 0 of a robust polynomial through (n, D) values, with (n, D) slopes."""
    powers = np.stack([dt**power for power in range(degree + 1)], axis=1)
    near = np.exp(-((dt / WINDOW_S) ** 2))
    if slopes is not None:
        slope_of_powers = np.stack([power * dt ** max(power - 1, 0) for power in range(degree + 1)], axis=1)
        powers = np.concatenate([powers, FLOW_BASE_S * slope_of_powers])
        values = np.concatenate([values, FLOW_BASE_S * slopes])
        near = np.tile(near, 2)
    weight = np.where(np.arange(len(near)) < len(dt), near, 0.0)  # the values alone say which slopes to believe
    coefficients: Any = np.zeros((degree + 1, values.shape[1]))  # lstsq widens the type
    for design in (powers[:, :2], *[powers] * ROBUST_ROUNDS):  # a wrong end bends a parabola, not a line
        root = np.sqrt(weight)[:, None]
        coefficients, *_ = np.linalg.lstsq(design * root, values * root, rcond=None)
        residual = np.linalg.norm(values - design @ coefficients, axis=1)
        weight = near / (1 + (residual / ROBUST_SCALE_M) ** 2) ** 2  # Geman-McClure
        weight[len(dt) :][residual[len(dt) :] > MAX_FLOW_RESIDUAL_M] = 0.0
    return coefficients[0], coefficients[1]


def interpolate_trajectory(trajectory: Trajectory, times_s: Float64Array) -> Trajectory:
    """Return the trajectory at other times; ends are held.

    Cubic in position (Hermite; straight over long silences), linear in yaw and velocity.
    """
    own = trajectory.times_s
    times_s = np.clip(times_s, own[0], own[-1])
    if len(own) == 1:
        index = np.zeros(len(times_s), dtype=np.int64)
        return Trajectory(times_s, trajectory.centers[index], trajectory.yaws[index], trajectory.velocities[index])
    left = np.clip(np.searchsorted(own, times_s, side="right") - 1, 0, len(own) - 2)
    span = (own[left + 1] - own[left])[:, None]
    u = (times_s - own[left])[:, None] / span
    p0, p1 = trajectory.centers[left], trajectory.centers[left + 1]
    is_straight = (span > LONG_SILENCE_S) & (u > 0) & (u < 1)  # at its ends an object has the velocity it had
    v0 = np.where(is_straight, p1 - p0, trajectory.velocities[left] * span)
    v1 = np.where(is_straight, p1 - p0, trajectory.velocities[left + 1] * span)
    centers = (
        (2 * u**3 - 3 * u**2 + 1) * p0 + (u**3 - 2 * u**2 + u) * v0 + (3 * u**2 - 2 * u**3) * p1 + (u**3 - u**2) * v1
    )
    velocities = (v0 * (1 - u) + v1 * u) / span
    return Trajectory(times_s, centers, np.interp(times_s, own, trajectory.yaws), velocities)
