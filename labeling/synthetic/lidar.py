"""Lidars in a world of triangles: rolling shutter, occlusion, range noise, lost returns.

All fixed surfaces form one ray-casting scene, built once. The moving parts lie at rest in a second one, each in a cell
of its own, and the beams that may meet a part are carried into its cell by its pose at their own capture time: the
rolling shutter is exact to the column, nothing is rebuilt, and a swinging leg is just one more part. (One open3d scene
a part would be simpler, but the process dies at about a thousand of them.)
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields
from typing import Any, Final, Protocol

import numpy as np

from labeling.synthetic.rigs import Sensor
from labeling.synthetic.shapes import Mesh, Part, Shape, merge, swing_vertices
from schemas.arrays import BoolArray, Float64Array, Int64Array, UInt8Array

PoseFunction = Callable[[Float64Array], Float64Array]  # (N,) s -> (N, 4, 4)

_GROUND: Final = -2
_NOBODY: Final = -1
_AZIMUTH_MARGIN_RAD: Final = 0.04  # a pitched sensor's columns lean a little
_CELL_RADII: Final = 3.0  # between moving parts in their scene, in radii: a ray that starts near one meets it first
_REACH_MARGIN_M: Final = 20.0  # bodies whose middle is that far beyond the range are not looked for


@dataclass(frozen=True, slots=True, eq=False)
class Capture:
    """What one sweep of a lidar has seen, in the order of capture."""

    points_world: Float64Array  # (N, 3) where each point was when it was seen
    times_s: Float64Array  # (N,) capture time on the clock of the paths
    object_index: Int64Array  # (N,) which body, -1 for ground, structures and the ego vehicle
    is_ground: BoolArray  # (N,)
    lidar: UInt8Array  # (N,) position in the rig

    @classmethod
    def merged(cls, captures: "Sequence[Capture]") -> "Capture":
        """Return what several lidars have seen together, in the order of capture."""
        order = np.argsort(np.concatenate([capture.times_s for capture in captures]), kind="stable")
        names = [column.name for column in fields(cls)]
        return cls(*(np.concatenate([getattr(capture, name) for capture in captures])[order] for name in names))


class Motion(Protocol):
    """What the caster asks of a body."""

    @property
    def is_still(self) -> bool:
        """True when it never moves."""
        ...

    def at(self, times_s: Float64Array) -> Float64Array:
        """Return (N, 4, 4) world_from_object at (N,) times."""
        ...

    def distance_at(self, times_s: Float64Array) -> Float64Array:
        """Return (N,) metres travelled at (N,) times."""
        ...


@dataclass(frozen=True, slots=True, eq=False)
class _Cell:
    """A moving part at rest in the scene of parts."""

    body: int
    part: Part
    corner_m: Float64Array  # (3,) where the object frame's origin lies in the scene of parts
    radius_m: float  # of the sphere about that origin that holds the part

    def mesh(self) -> Mesh:
        """Return the part where it lies."""
        return self.part.mesh.moved(*self.corner_m)


class RayWorld:
    """Everything a beam can meet, ready to be cast at."""

    def __init__(
        self,
        ground: Mesh,
        structures: Sequence[Mesh],
        bodies: Sequence[tuple[Shape, Motion]],
        ego_parts: Sequence[Mesh] = (),  # of the ego vehicle itself, ego frame
    ) -> None:
        fixed = [(_GROUND, ground)]
        if structures:
            fixed.append((_NOBODY, merge(structures)))
        fixed += [(i, _place(shape, motion)) for i, (shape, motion) in enumerate(bodies) if motion.is_still]
        moving = [i for i, (_, motion) in enumerate(bodies) if not motion.is_still]
        self._owner_of_geometry = np.array([owner for owner, _ in fixed])
        self._fixed_scene = _build_scene([mesh for _, mesh in fixed])
        self._motions = {i: bodies[i][1] for i in moving}
        parts = [(i, part, _reach(part)) for i in moving for part in bodies[i][0].parts]
        self._radii_m = {i: max(radius for body, _, radius in parts if body == i) for i in moving}
        pitch = _CELL_RADII * max(self._radii_m.values(), default=1.0)
        self._cells = [
            _Cell(i, part, pitch * np.array([k % 12, k // 12 % 12, k // 144], dtype=np.float64), radius)
            for k, (i, part, radius) in enumerate(parts)
        ]
        self._parts_scene = _build_scene([cell.mesh() for cell in self._cells]) if self._cells else None
        self._ego_scene = _build_scene(ego_parts) if ego_parts else None

    def capture(
        self,
        lidar: Sensor,
        number: int,  # of the lidar in its rig
        ego_poses: PoseFunction,
        start_s: float,
        period_s: float,
        rng: np.random.Generator,
    ) -> Capture:
        """Sweep once and return what came back."""
        aim = lidar.aim(start_s, period_s)
        columns, beams = aim.elevation.shape
        times = start_s + aim.share * period_s  # (columns,)
        poses = ego_poses(times)
        origins = poses[:, :3, :3] @ np.array(lidar.origin_ego_m) + poses[:, :3, 3]
        sensor_x = np.cos(aim.azimuth)[:, None] * np.cos(aim.elevation)
        sensor_y = np.sin(aim.azimuth)[:, None] * np.cos(aim.elevation)
        sensor_z = np.sin(aim.elevation)
        directions_ego = np.stack([sensor_x, sensor_y, sensor_z], axis=-1)
        directions = directions_ego @ poses[:, :3, :3].transpose(0, 2, 1)

        rays = np.concatenate([np.broadcast_to(origins[:, None], directions.shape), directions], axis=-1)
        range_m, cosine, geometry = _cast(self._fixed_scene, rays.reshape(-1, 6))
        owner = np.where(geometry >= 0, self._owner_of_geometry[geometry], _NOBODY)
        self._cast_at_parts(rays, times, lidar.max_range_m, range_m, cosine, owner)
        if self._ego_scene is not None:
            origin = np.broadcast_to(lidar.origin_ego_m, directions_ego.shape)
            own_range_m, own_cosine, _ = _cast(
                self._ego_scene, np.concatenate([origin, directions_ego], axis=-1).reshape(-1, 6)
            )
            nearer = own_range_m < range_m
            range_m[nearer], cosine[nearer], owner[nearer] = own_range_m[nearer], own_cosine[nearer], _NOBODY

        noise = rng.standard_normal(beams * columns) * lidar.noise_m
        far = np.minimum(range_m / lidar.max_range_m, 1)
        lost = lidar.dropout * (1 + 6 * far**2 + 6 * (1 - cosine) ** 6)
        is_kept = (range_m >= lidar.min_range_m) & (range_m <= lidar.max_range_m)
        rows = np.flatnonzero(is_kept & (rng.random(beams * columns) >= lost))
        flat = rays.reshape(-1, 6)[rows]
        points = flat[:, :3] + flat[:, 3:] * (range_m + noise)[rows, None]
        owner = owner[rows]
        numbers = np.full(len(rows), number, dtype=np.uint8)
        return Capture(points, np.repeat(times, beams)[rows], np.maximum(owner, _NOBODY), owner == _GROUND, numbers)

    def _cast_at_parts(
        self,
        rays: Float64Array,  # (columns, beams, 6) world
        times: Float64Array,  # (columns,)
        max_range_m: float,
        range_m: Float64Array,  # (columns * beams,) this and the next two: changed where a part is nearer
        cosine: Float64Array,
        owner: Int64Array,
    ) -> None:
        aimed = []  # (rows of rays, their start, rays in the scene of parts, part)
        local: dict[int, tuple[Int64Array, Float64Array, Float64Array]] = {}
        for number, cell in enumerate(self._cells):
            if cell.body not in local:
                motion, radius_m = self._motions[cell.body], self._radii_m[cell.body]
                local[cell.body] = _see_from(motion, radius_m, rays, times, max_range_m)
            columns, object_rays, travelled = local[cell.body]
            if len(columns):
                rows = (columns[:, None] * rays.shape[1] + np.arange(rays.shape[1])).ravel()
                part_rays = _swing_rays(cell.part, object_rays, travelled).reshape(-1, 6)
                nearest = -(part_rays[:, :3] * part_rays[:, 3:]).sum(axis=1)  # along the ray to its closest approach
                miss_m2 = (part_rays[:, :3] ** 2).sum(axis=1) - nearest**2
                kept = np.flatnonzero((miss_m2 < cell.radius_m**2) & (nearest > -cell.radius_m))
                start = np.maximum(nearest[kept] - cell.radius_m, 0)  # in the cell: no other part is in between
                part_rays = part_rays[kept]
                part_rays[:, :3] += start[:, None] * part_rays[:, 3:] + cell.corner_m
                aimed.append((rows[kept], start, part_rays, np.full(len(kept), number)))
        if not aimed:
            return
        rows, start, part_rays, part = (np.concatenate(column) for column in zip(*aimed, strict=True))
        beyond, part_cosine, hit = _cast(self._parts_scene, part_rays)
        reach = start + beyond
        nearer = np.flatnonzero((hit == part) & (reach < range_m[rows]))
        nearer = nearer[np.argsort(-reach[nearer], kind="stable")]  # of parts on one ray, the nearest is written last
        rows, part = rows[nearer], part[nearer]
        range_m[rows], cosine[rows] = reach[nearer], part_cosine[nearer]
        owner[rows] = np.array([cell.body for cell in self._cells])[part]


def _reach(part: Part) -> float:
    """Return the radius of the sphere about the object frame's origin that holds a part however it swings."""
    pivot = np.array([part.pivot_m[0], 0, part.pivot_m[1]])
    swung = np.linalg.norm(pivot) + np.linalg.norm(part.mesh.vertices - pivot, axis=1).max()
    return float(swung if part.swing_rad else np.linalg.norm(part.mesh.vertices, axis=1).max()) + 0.01


def _see_from(
    motion: Motion,
    radius_m: float,
    rays: Float64Array,  # (columns, beams, 6) world
    times: Float64Array,  # (columns,)
    max_range_m: float,
) -> tuple[Int64Array, Float64Array, Float64Array]:
    """Return the columns that may meet a body, their rays in its frame, and how far it has travelled."""
    ends = [0, len(times) // 2, -1]
    if (np.hypot(*(motion.at(times[ends])[:, :2, 3] - rays[ends, 0, :2]).T) > max_range_m + _REACH_MARGIN_M).all():
        return np.zeros(0, dtype=np.int64), np.zeros((0, rays.shape[1], 6)), np.zeros(0)
    poses = motion.at(times)
    offset = poses[:, :2, 3] - rays[:, 0, :2]
    distance = np.hypot(offset[:, 0], offset[:, 1])
    heading = rays[:, 0, 3:5] / np.linalg.norm(rays[:, 0, 3:5], axis=1, keepdims=True)
    half_angle = np.arcsin(radius_m / np.maximum(distance, radius_m)) + _AZIMUTH_MARGIN_RAD
    half_angle[distance <= radius_m] = np.pi  # alongside a bus, it may be anywhere
    columns = np.flatnonzero((heading * offset).sum(axis=1) >= distance * np.cos(half_angle))
    rotation = poses[columns, :3, :3]
    origin = np.einsum("nji,nj->ni", rotation, rays[columns, 0, :3] - poses[columns, :3, 3])
    local = np.empty((len(columns), rays.shape[1], 6))
    local[..., :3] = origin[:, None]
    local[..., 3:] = rays[columns, :, 3:] @ rotation
    return columns, local, motion.distance_at(times[columns])


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


def _place(shape: Shape, motion: Motion) -> Mesh:
    """Return a body that never moves as one mesh in the world."""
    pose = motion.at(np.zeros(1))[0]
    travelled = float(motion.distance_at(np.zeros(1))[0])
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
