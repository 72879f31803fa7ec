"""How poses and axes are meant: tried on two sweeps, in which what stands still has to lie in the same place."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import product
from typing import Any, Final, Literal

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from labeling.geometry.transforms import transform_points
from labeling.readers.folder.description import DIRECTIONS, METRES, STANDARD_AXES, Axes, Description, axes_matrix
from schemas.arrays import Float64Array
from schemas.errors import LabelingError

Cloud = NDArray[np.float64]  # (N, 3) as a file has it
PosesOf = Callable[[Description], Float64Array]  # (T, 4, 4) world_from_ego, NaN where there is none
PointsOf = Callable[[int], Cloud]
Sureness = Literal["sure", "likely", "a guess"]

CAMERA_AXES: Final[Axes] = ("right", "down", "forward")
MIN_AHEAD: Final = 0.8  # share of its way that a vehicle goes straight ahead
MIN_WAY_M: Final = 2.0  # between two sweeps that are compared; with less, nothing is told
MAX_LOOK: Final = 40  # sweeps between them
_MAX_POINTS: Final = 2000
_MAX_RANGE_M: Final = 40.0
_GROUND_M: Final = 0.5  # above it stands what tells
_CLOSE_M: Final = 0.25  # between upright things of two sweeps that fit: as far apart as points on them lie
_FAR_M: Final = 0.5  # with more they do not fit
_CLEAR: Final = 1.5  # times as far apart is clearly another reading


@dataclass(frozen=True, slots=True)
class Reading:
    """How axes and poses are meant, and how sure that is."""

    axes: Axes
    poses: dict[str, Any]  # more keys of `poses`
    sureness: Sureness
    why: str
    why_axes: str


def up_axis_of(points: Cloud) -> tuple[int, int]:
    """Return which axis is upright, and its sign: the one that spreads least; the ground is dense, and at its end."""
    low, high = np.quantile(points, [0.05, 0.95], axis=0)
    axis = int(np.argmin(high - low))
    heights = points[:, axis]
    bottom, top = np.quantile(heights, [0.01, 0.99])
    count, edges = np.histogram(heights, bins=60, range=(bottom, max(top, bottom + 1e-6)))
    densest = edges[int(count.argmax())]
    return axis, 1 if densest - bottom <= top - densest else -1


def _unit(axis: int, sign: int) -> Float64Array:
    vector = np.zeros(3)
    vector[axis] = sign
    return vector


def axes_of(forward: Float64Array, up: Float64Array) -> Axes:
    """Return which way x, y and z point, of two unit vectors along axes of the points."""
    ego_from_points = np.stack([forward, np.cross(up, forward), up])
    names: dict[tuple[int, ...], str] = {vector: name for name, vector in DIRECTIONS.items()}
    x, y, z = (names[tuple(column)] for column in ego_from_points.T.round().astype(int).tolist())
    return x, y, z  # type: ignore[return-value]


def choose_reading(description: Description, poses_of: PosesOf, points_of: PointsOf) -> Reading:
    """Return the reading of axes and poses with which two sweeps fit best.

    Args:
        description: What is known of the folder, the file of poses included.
        poses_of: Reads the poses as a description says; may raise LabelingError.
        points_of: Reads the points of a sweep as the file has them; may raise LabelingError.

    """
    try:
        pair = _distant_pair(poses_of(_of_sensor(description, STANDARD_AXES, inverse=False)))
        clouds = [points_of(index) for index in pair or ()]
    except LabelingError as error:
        return Reading(STANDARD_AXES, {}, "a guess", str(error), "poses tell nothing")
    if pair is None or not all(len(cloud) for cloud in clouds):
        why = f"the vehicle moves less than {MIN_WAY_M:g} m, which tells nothing"
        return Reading(STANDARD_AXES, {}, "a guess", f"taken as the vehicle's places; {why}", why)
    up = _unit(*up_axis_of(np.concatenate(clouds)))
    readings = [reading for reading in _readings(description, up) if _drives_ahead(reading, poses_of)]
    if not readings:
        return Reading(
            STANDARD_AXES, {}, "a guess", "however they are meant, the vehicle does not drive ahead", "no way"
        )
    residuals_m = np.array([_residual_m(reading, poses_of, pair, clouds, up) for reading in readings]).round(6)
    best = int(residuals_m.argmin())  # of equal ones, the simplest: the first
    others_m = residuals_m[residuals_m > residuals_m[best]]
    return _judged(readings[best], float(residuals_m[best]), float(others_m.min(initial=np.inf)), pair)


def _judged(reading: Description, residual_m: float, next_m: float, pair: tuple[int, int]) -> Reading:
    sureness: Sureness = "sure" if residual_m < _CLOSE_M and next_m > _CLEAR * residual_m else "likely"
    why = f"sweeps {pair[0]} and {pair[1]} then lie {residual_m:.2f} m from each other"
    if next_m < np.inf:
        why += f", otherwise {next_m:.2f} m or more"
    if residual_m > _FAR_M:
        sureness, why = "a guess", f"NO READING FITS: {why}; poses of another recording?"
    said = reading.poses
    extra = {"of": said.of, "inverse": said.inverse or None, "axes": said.axes and list(said.axes)}
    known = {key: value for key, value in extra.items() if value is not None}
    return Reading(reading.axes, known, sureness, why, "the vehicle drives ahead, and the ground is below")


def _of_sensor(description: Description, axes: Axes, *, inverse: bool) -> Description:
    poses = description.poses.model_copy(update={"of": "sensor", "inverse": inverse})
    return description.model_copy(update={"axes": axes, "poses": poses})


def _readings(description: Description, up: Float64Array) -> Iterator[Description]:
    """Yield ways to read points and poses of which the ground is below, the simplest first."""
    level = _unit(int(np.argmin(np.abs(up))), 1)
    ahead = [level, np.cross(up, level), -level, np.cross(level, up)]
    all_axes = sorted((axes_of(forward, up) for forward in ahead), key=lambda axes: axes != STANDARD_AXES)
    meant: tuple[dict[str, Any], ...] = ({}, {"of": "ego"}, {"of": "sensor"}, {"of": "sensor", "axes": CAMERA_AXES})
    for inverse, axes, said in product((False, True), all_axes, meant):
        poses = description.poses.model_copy(update={"inverse": inverse, **said})
        yield description.model_copy(update={"axes": axes, "poses": poses})


def _drives_ahead(reading: Description, poses_of: PosesOf) -> bool:
    poses = poses_of(reading)
    poses = poses[np.isfinite(poses).all(axis=(1, 2))]
    steps_m = np.einsum("tji,tj->ti", poses[:-1, :3, :3], np.diff(poses[:, :3, 3], axis=0))  # ego axes
    ahead_m, *_ = way_m = steps_m.sum(axis=0)
    return bool(ahead_m > MIN_AHEAD * np.linalg.norm(way_m))


def _distant_pair(poses: Float64Array) -> tuple[int, int] | None:
    """Return two sweeps with some way between, in the middle of the recording where that can be."""
    has_pose = np.asarray(np.isfinite(poses).all(axis=(1, 2)))
    for start in (len(poses) // 2, len(poses) // 4, 0):
        for stop in range(start + 1, min(start + MAX_LOOK, len(poses))):
            if has_pose[start] and has_pose[stop]:
                way_m = np.linalg.norm(poses[stop, :3, 3] - poses[start, :3, 3])
                if way_m >= MIN_WAY_M:
                    return start, stop
    return None


def _residual_m(
    reading: Description, poses_of: PosesOf, pair: tuple[int, int], clouds: list[Cloud], up: Float64Array
) -> float:
    """Return how far upright things of one sweep lie from those of the other, the median."""
    poses = poses_of(reading)
    scale = METRES[reading.units]
    ego_from_points = axes_matrix(reading.axes) @ np.diag([scale, scale, scale, 1.0])
    source, target = (
        transform_points(poses[index] @ ego_from_points, _upright(cloud, up, scale))
        for index, cloud in zip(pair, clouds, strict=True)
    )
    if not len(source) or not len(target):
        return np.inf
    step = max(1, len(source) // _MAX_POINTS)
    return float(np.median(cKDTree(target).query(source[::step])[0]))


def _upright(cloud: Cloud, up: Float64Array, scale: float) -> Cloud:
    """Return what is near, and above the ground: the densest height."""
    height_m = cloud @ up * scale
    bottom, top = np.quantile(height_m, [0.01, 0.99])
    count, edges = np.histogram(height_m, bins=60, range=(bottom, max(top, bottom + 1e-6)))
    is_upright = height_m > edges[int(count.argmax()) + 1] + _GROUND_M
    range_m = np.linalg.norm(cloud, axis=1) * scale
    return cloud[is_upright & (range_m < _MAX_RANGE_M)]
