"""A spinning lidar in a world of triangles: rolling shutter, occlusion, range noise, lost returns.

All fixed surfaces form one ray-casting scene, built once. Each moving part has a scene of its own in its own frame,
and the beams that may meet it are carried into that frame by its pose at their own capture time: the rolling shutter
is exact to the column, nothing is rebuilt, and a swinging leg is just one more part.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Final, Protocol

import numpy as np

from labeling.readers.synthetic_shapes import Mesh, Part, Shape, merge, swing_vertices
from schemas.arrays import BoolArray, Float64Array, Int64Array

PoseFunction = Callable[[Float64Array], Float64Array]  # (N,) s -> (N, 4, 4)

_AZIMUTH_MARGIN_RAD: Final = 0.04  # a pitched sensor's columns lean a little


@dataclass(frozen=True, slots=True)
class Lidar:
    """The sensor. Beams stand closest just below the horizon, where the street is far away."""

    num_beams: int = 32
    azimuth_steps: int = 900
    noise_m: float = 0.02  # standard deviation of a range
    dropout: float = 0.03  # share of returns lost near by; several times as many far away or at grazing incidence
    min_range_m: float = 2.0
    max_range_m: float = 100.0
    origin_ego_m: tuple[float, float, float] = (1.35, 0.0, 1.64)
    has_rolling_shutter: bool = True  # False: the whole turn is seen at the stamp

    def inclinations_rad(self) -> Float64Array:
        """Return (B,) angles above the horizon, ascending, from -25 to +15 degrees."""
        share = (np.arange(self.num_beams) + 0.5) / self.num_beams
        return np.deg2rad(np.interp(share, [0, 0.22, 0.86, 1], [-25, -8, 2.5, 15]))


@dataclass(frozen=True, slots=True, eq=False)
class Capture:
    """What one turn has seen, in the order of capture."""

    points_world: Float64Array  # (N, 3) where each point was when it was seen
    times_s: Float64Array  # (N,) capture time on the clock of the paths
    object_index: Int64Array  # (N,) which body, -1 for ground and structures
    is_ground: BoolArray  # (N,)


class PosedPath(Protocol):
    """A body's motion, as the caster needs it."""

    @property
    def path(self) -> Any:  # has is_still; the scene's Path, which this module need not know
        """Where it is over time."""

    def at(self, times_s: Float64Array) -> Float64Array:
        """Return (N, 4, 4) world_from_object."""

    def distance_at(self, times_s: Float64Array) -> Float64Array:
        """Return (N,) metres travelled."""


@dataclass(slots=True, eq=False)
class _Hits:
    """Nearest hit of each ray so far."""

    range_m: Float64Array  # (R,) inf where nothing
    cos_incidence: Float64Array  # (R,)
    geometry: Int64Array  # (R,) row of the fixed geometry or body; -1 where nothing


class RayWorld:
    """Everything a beam can meet, ready to be cast at."""

    def __init__(self, ground: Mesh, structures: Sequence[Mesh], bodies: Sequence[tuple[Shape, PosedPath]]) -> None:
        fixed = [(-2, ground)]
        if structures:
            fixed.append((-1, merge(structures)))
        self._moving: list[tuple[int, Shape, PosedPath, list[tuple[Part, Any]]]] = []
        for i, (shape, posed) in enumerate(bodies):
            if posed.path.is_still:
                fixed.append((i, _place(shape, posed)))
            else:
                scenes = [(part, _build_scene([part.mesh])) for part in shape.parts]
                self._moving.append((i, shape, posed, scenes))
        self._owner_of_geometry = np.array([owner for owner, _ in fixed])
        self._fixed_scene = _build_scene([mesh for _, mesh in fixed])

    def capture(
        self, lidar: Lidar, ego_poses: PoseFunction, start_s: float, period_s: float, rng: np.random.Generator
    ) -> Capture:
        """Turn once, anticlockwise from straight behind, and return what came back."""
        beams, columns = lidar.num_beams, lidar.azimuth_steps
        share = (np.arange(columns) + 0.5) / columns
        times = start_s + share * period_s * lidar.has_rolling_shutter  # (columns,)
        poses = ego_poses(times)
        origins = poses[:, :3, :3] @ np.array(lidar.origin_ego_m) + poses[:, :3, 3]
        azimuth = 2 * np.pi * share - np.pi
        incline = lidar.inclinations_rad()
        sensor_x = np.cos(azimuth)[:, None] * np.cos(incline)
        sensor_y = np.sin(azimuth)[:, None] * np.cos(incline)
        sensor_z = np.broadcast_to(np.sin(incline), (columns, beams))
        directions = np.stack([sensor_x, sensor_y, sensor_z], axis=-1) @ poses[:, :3, :3].transpose(0, 2, 1)

        rays = np.concatenate([np.broadcast_to(origins[:, None], directions.shape), directions], axis=-1)
        range_m, cosine, geometry = _cast(self._fixed_scene, rays.reshape(-1, 6))
        owner = np.where(geometry >= 0, self._owner_of_geometry[geometry], -1)
        hits = _Hits(range_m, cosine, owner)
        for index, shape, posed, scenes in self._moving:
            self._cast_moving(hits, rays, times, index, shape, posed, scenes, lidar.max_range_m)

        noise = rng.standard_normal(beams * columns) * lidar.noise_m
        far = np.minimum(hits.range_m / lidar.max_range_m, 1)
        lost = lidar.dropout * (1 + 6 * far**2 + 6 * (1 - hits.cos_incidence) ** 6)
        is_kept = (rng.random(beams * columns) >= lost) & (hits.range_m >= lidar.min_range_m)
        is_kept &= hits.range_m <= lidar.max_range_m
        rows = np.flatnonzero(is_kept)
        flat = rays.reshape(-1, 6)[rows]
        points = flat[:, :3] + flat[:, 3:] * (hits.range_m + noise)[rows, None]
        owner = hits.geometry[rows]
        return Capture(points, np.repeat(times, beams)[rows], np.maximum(owner, -1), owner == -2)

    @staticmethod
    def _cast_moving(
        hits: _Hits,
        rays: Float64Array,  # (columns, beams, 6)
        times: Float64Array,
        index: int,
        shape: Shape,
        posed: PosedPath,
        scenes: list[tuple[Part, Any]],
        max_range_m: float,
    ) -> None:
        """Cast at one moving body and keep what is nearer than what was hit before."""
        length, width, _ = shape.size_m
        radius = 0.6 * np.hypot(length, width) + 0.3  # limbs reach out of the mean box
        middle = posed.at(times[[0, len(times) // 2, -1]])[:, :3, 3] - rays[[0, len(times) // 2, -1], 0, :3]
        if (np.hypot(middle[:, 0], middle[:, 1]) > max_range_m + radius + 10).all():
            return
        poses = posed.at(times)
        offset = poses[:, :2, 3] - rays[:, 0, :2]
        distance = np.hypot(offset[:, 0], offset[:, 1])
        across = rays[:, 0, 3:5] / np.linalg.norm(rays[:, 0, 3:5], axis=1, keepdims=True)
        half_angle = np.arcsin(np.minimum(radius / np.maximum(distance, radius), 1)) + _AZIMUTH_MARGIN_RAD
        along = (across * offset).sum(axis=1)
        columns = np.flatnonzero(along >= distance * np.cos(np.minimum(half_angle, np.pi)))
        if not len(columns):
            return
        beams = rays.shape[1]
        rotation = poses[columns, :3, :3]
        origin = np.einsum("nji,nj->ni", rotation, rays[columns, 0, :3] - poses[columns, :3, 3])
        local = np.empty((len(columns), beams, 6))
        local[..., :3] = origin[:, None]
        local[..., 3:] = rays[columns, :, 3:] @ rotation
        flat_rows = (columns[:, None] * beams + np.arange(beams)).ravel()
        travelled = posed.distance_at(times[columns])
        for part, scene in scenes:
            range_m, cosine, geometry = _cast(scene, _swing_rays(part, local, travelled).reshape(-1, 6))
            is_nearer = (geometry >= 0) & (range_m < hits.range_m[flat_rows])
            rows = flat_rows[is_nearer]
            hits.range_m[rows], hits.cos_incidence[rows] = range_m[is_nearer], cosine[is_nearer]
            hits.geometry[rows] = index


def _swing_rays(part: Part, rays: Float64Array, travelled_m: Float64Array) -> Float64Array:
    """Carry (columns, beams, 6) rays from the object frame into the frame of a part at rest."""
    if part.swing_rad == 0:
        return rays
    angle = part.angle(travelled_m)
    cos, sin, zero = np.cos(angle), np.sin(angle), np.zeros(len(angle))
    object_from_part = np.stack(
        [np.stack([cos, zero, sin], -1), np.stack([zero, zero + 1, zero], -1), np.stack([-sin, zero, cos], -1)], axis=1
    )
    pivot = np.array([part.pivot_m[0], 0, part.pivot_m[1]])
    return np.concatenate(
        [(rays[..., :3] - pivot) @ object_from_part + pivot, rays[..., 3:] @ object_from_part], axis=-1
    )


def _place(shape: Shape, posed: PosedPath) -> Mesh:
    """Return a body that never moves as one mesh in the world."""
    pose = posed.at(np.zeros(1))[0]
    travelled = float(posed.distance_at(np.zeros(1))[0])
    meshes = [
        Mesh(swing_vertices(part, travelled) @ pose[:3, :3].T + pose[:3, 3], part.mesh.triangles)
        for part in shape.parts
    ]
    return merge(meshes)


def _build_scene(meshes: Sequence[Mesh]) -> Any:
    """Return an open3d scene whose geometry ids are the rows of ``meshes``."""
    import open3d  # 150 MB a process: only where a beam is really cast

    scene = open3d.t.geometry.RaycastingScene(nthreads=1)
    for mesh in meshes:
        scene.add_triangles(
            open3d.core.Tensor.from_numpy(mesh.vertices.astype(np.float32)),
            open3d.core.Tensor.from_numpy(mesh.triangles.astype(np.uint32)),
        )
    return scene


def _cast(scene: Any, rays: Float64Array) -> tuple[Float64Array, Float64Array, Int64Array]:
    """Return range (inf without a hit), |cos| of the incidence and geometry id (-1) of (R, 6) unit rays."""
    import open3d

    answer = scene.cast_rays(open3d.core.Tensor.from_numpy(rays.astype(np.float32)), nthreads=1)
    geometry = answer["geometry_ids"].numpy()
    normals = answer["primitive_normals"].numpy().astype(np.float64)
    size = np.linalg.norm(normals, axis=1)
    cosine = np.abs((rays[:, 3:] * normals).sum(axis=1)) / np.where(size > 0, size, 1)
    owner = np.where(geometry == np.iinfo(np.uint32).max, -1, geometry.astype(np.int64))
    return answer["t_hit"].numpy().astype(np.float64), np.minimum(cosine, 1), owner
