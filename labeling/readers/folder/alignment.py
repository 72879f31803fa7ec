"""How poses and axes are meant: tried on two sweeps, in which what stands still has to lie in the same place."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Final, Literal

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from labeling.geometry.transforms import transform_points
from labeling.readers.folder.description import DIRECTIONS, METRES, STANDARD_AXES, Axes, Description, axes_matrix
from schemas.arrays import Float64Array
from schemas.errors import LabelingError

Cloud = NDArray[np.float64]  # (N, 3) as a file has it

MIN_WAY_M: Final = 2.0  # between two sweeps that are compared; with less, nothing is told
MAX_LOOK: Final = 40  # sweeps between them
_MAX_POINTS: Final = 2000
_MAX_RANGE_M: Final = 40.0
_GROUND_M: Final = 0.5  # above it stands what tells
_CLEAR: Final = 1.5  # times as far apart is clearly another reading


@dataclass(frozen=True, slots=True)
class Reading:
    """How axes and poses are meant, and how sure that is."""

    axes: Axes
    poses: dict[str, Any]  # more keys of `poses`
    sureness: Literal["sure", "likely", "a guess"]
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


def choose_reading(
    description: Description,
    poses_of: Callable[[Description], Float64Array | None],  # (T, 4, 4) world_from_ego; None: it cannot be read so
    points_of: Callable[[int], Cloud],
) -> Reading:
    """Return the reading of axes and poses with which two sweeps fit best.

    Args:
        description: What is known of the folder, the file of poses included.
        poses_of: Reads the poses as a description says.
        points_of: Reads the points of a sweep as the file has them.

    """
    straight = _as_sensor(description, STANDARD_AXES, inverse=False)
    poses = poses_of(straight)
    if poses is None:
        poses = poses_of(description)
    pair = None if poses is None else _distant_pair(poses)
    clouds = None if pair is None else _clouds(points_of, pair)
    if pair is None or clouds is None:
        why = f"the vehicle moves less than {MIN_WAY_M:g} m, so nothing tells" if poses is not None else "not readable"
        return Reading(STANDARD_AXES, {}, "a guess", f"taken as the vehicle's places; {why}", why)
    up = _unit(*up_axis_of(np.concatenate(clouds)))
    candidates = [c for inverse in (False, True) for c in _candidates(description, poses_of, up, inverse)]
    residuals = [_residual_m(candidate, poses_of, pair, clouds, up) for candidate in candidates]
    best = int(np.argmin(residuals))
    others = [r for r, c in zip(residuals, candidates, strict=True) if c is not candidates[best]]
    next_best = min(others, default=np.inf)
    chosen = candidates[best]
    sureness: Literal["sure", "likely"] = "sure" if next_best > _CLEAR * residuals[best] else "likely"
    why = f"sweeps {pair[0]} and {pair[1]} then lie {residuals[best]:.2f} m from each other" + (
        f", otherwise {next_best:.2f} m or more" if np.isfinite(next_best) else ""
    )
    extra = {key: value for key, value in (("of", chosen.poses.of), ("inverse", chosen.poses.inverse)) if value}
    way = "the vehicle drives ahead, and the ground is below"
    return Reading(chosen.axes, extra, sureness, why, way)


def _as_sensor(description: Description, axes: Axes, *, inverse: bool) -> Description:
    poses = description.poses.model_copy(update={"of": "sensor", "inverse": inverse})
    return description.model_copy(update={"axes": axes, "poses": poses})


def _candidates(
    description: Description, poses_of: Callable[[Description], Float64Array | None], up: Float64Array, inverse: bool
) -> list[Description]:
    """Return the readings under which the vehicle drives ahead."""
    said = description.poses.model_copy(update={"inverse": inverse})
    as_said = description.model_copy(update={"poses": said})  # of the camera where there is a calibration
    poses = poses_of(_as_sensor(description, STANDARD_AXES, inverse=inverse))
    found = []
    if poses is not None:
        steps = np.einsum("tji,tj->ti", poses[:-1, :3, :3], np.diff(poses[:, :3, 3], axis=0))
        way = np.nansum(steps, axis=0)
        axis = int(np.abs(way).argmax())
        forward = _unit(axis, 1 if way[axis] > 0 else -1)
        if up @ forward == 0:
            found.append(_as_sensor(description, axes_of(forward, up), inverse=inverse))
        if axis == 0 and way[0] > 0:  # poses of a vehicle with the usual axes, points of a lidar turned in it
            turned = [np.cross(up, forward), -forward, np.cross(forward, up)] if up @ forward == 0 else []
            ego = said.model_copy(update={"of": "ego"})
            found += [description.model_copy(update={"axes": axes_of(at, up), "poses": ego}) for at in turned]
            if found and found[0].axes == STANDARD_AXES:
                found[0] = as_said
    if as_said not in found:
        found.append(as_said)
    return found


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


def _clouds(points_of: Callable[[int], Cloud], pair: tuple[int, int]) -> list[Cloud] | None:
    try:
        clouds = [points_of(index) for index in pair]
    except LabelingError:
        return None
    return clouds if all(len(cloud) for cloud in clouds) else None


def _residual_m(
    candidate: Description,
    poses_of: Callable[[Description], Float64Array | None],
    pair: tuple[int, int],
    clouds: list[Cloud],
    up: Float64Array,
) -> float:
    """Return how far upright things of one sweep lie from those of the other, the median."""
    poses = poses_of(candidate)
    if poses is None or not np.isfinite(poses[list(pair)]).all():
        return np.inf
    scale = METRES[candidate.units]
    ego_from_points = axes_matrix(candidate.axes) @ np.diag([scale, scale, scale, 1.0])
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
