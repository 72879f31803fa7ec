"""Shapes of the synthetic world, all built from one primitive: a loft between two convex polygons.

Object frame: origin on the ground under the box centre, x along the heading, z up, metres.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from schemas.arrays import Float64Array, Int64Array

_GAIT_PHASES: Final = np.linspace(0, 2 * np.pi, 32, endpoint=False)


@dataclass(frozen=True, slots=True, eq=False)
class Mesh:
    """Triangles of any surface; both sides are visible."""

    vertices: Float64Array  # (V, 3) m
    triangles: Int64Array  # (F, 3) rows of vertices

    def moved(self, x: float, y: float, z: float) -> "Mesh":
        """Return the same surface elsewhere."""
        return Mesh(self.vertices + np.array([x, y, z]), self.triangles)


@dataclass(frozen=True, slots=True, eq=False)
class Part:
    """A rigid part of a shape that may swing with the distance travelled, about an axis across the heading."""

    mesh: Mesh  # object frame at rest
    swing_rad: float = 0.0  # amplitude
    pivot_m: tuple[float, float] = (0.0, 0.0)  # x and z of the axis
    stride_m: float = 1.0  # distance of a full swing
    phase: float = 0.0

    def angle(self, distance_m: Float64Array) -> Float64Array:
        """Return the swing in radians after each distance; positive carries a hanging leg backwards."""
        swing: Float64Array = self.swing_rad * np.sin(2 * np.pi * distance_m / self.stride_m + self.phase)
        return swing


@dataclass(frozen=True, slots=True, eq=False)
class Shape:
    """What a road user looks like. ``size_m`` is the tight box; for walkers the mean over a stride."""

    kind: str
    category: str  # as Argoverse 2 names it
    parts: tuple[Part, ...]
    size_m: tuple[float, float, float]  # length, width, height


def merge(meshes: Sequence[Mesh]) -> Mesh:
    """Join meshes into one."""
    offsets = np.cumsum([0, *(len(mesh.vertices) for mesh in meshes[:-1])])
    return Mesh(
        np.concatenate([mesh.vertices for mesh in meshes]),
        np.concatenate([mesh.triangles + offset for mesh, offset in zip(meshes, offsets, strict=True)]),
    )


def loft(start: Float64Array, stop: Float64Array) -> Mesh:
    """Join two convex polygons (K, 3) of equal corner count by a closed hull of quads and two caps."""
    count = len(start)
    here = np.arange(count)
    after = np.roll(here, -1)
    fan = np.stack([np.zeros(count - 2, dtype=np.int64), here[1:-1], here[2:]], axis=1)
    triangles = [
        np.stack([here, after, after + count], axis=1),
        np.stack([here, after + count, here + count], axis=1),
        fan,
        fan + count,
    ]
    return Mesh(np.concatenate([start, stop]).astype(np.float64), np.concatenate(triangles))


def _rectangle(x: tuple[float, float], y: tuple[float, float], z: float) -> Float64Array:
    return np.array([[x[0], y[0], z], [x[1], y[0], z], [x[1], y[1], z], [x[0], y[1], z]], dtype=np.float64)


def cuboid(x: tuple[float, float], y: tuple[float, float], z: tuple[float, float]) -> Mesh:
    """Return the box between the given bounds."""
    return loft(_rectangle(x, y, z[0]), _rectangle(x, y, z[1]))


def rod(start: Sequence[float], stop: Sequence[float], radius_m: float, sides: int = 8) -> Mesh:
    """Return a cylinder between two points."""
    axis = np.subtract(stop, start) / np.linalg.norm(np.subtract(stop, start))
    across = np.cross(axis, [1.0, 0, 0] if abs(axis[0]) < 0.9 else [0, 1.0, 0])
    across /= np.linalg.norm(across)
    angle = np.arange(sides)[:, None] * 2 * np.pi / sides
    ring = radius_m * (np.cos(angle) * across + np.sin(angle) * np.cross(axis, across))
    return loft(ring + start, ring + stop)


def foliage(rng: np.random.Generator, radii_m: Sequence[float] | Float64Array, num_leaves: int, leaf_m: float) -> Mesh:
    """Return loose leaves filling a lumpy ellipsoid about the origin: beams stop inside it or pass."""
    direction = rng.normal(size=(num_leaves, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    lumps = 1 + 0.25 * np.sin(direction @ rng.normal(0, 3, (3, 3)) + rng.uniform(0, 6, 3)).sum(axis=1) / 1.7
    centre = direction * (rng.uniform(0.25, 1, (num_leaves, 1)) ** (1 / 3) * lumps[:, None]) * np.asarray(radii_m)
    corners = centre[:, None] + rng.normal(0, leaf_m, (num_leaves, 3, 3))
    return Mesh(corners.reshape(-1, 3), np.arange(3 * num_leaves).reshape(-1, 3))


def surface(
    x_m: Float64Array,  # (X,)
    y_m: Float64Array,  # (Y,)
    height: Callable[[Float64Array, Float64Array], Float64Array],
) -> Mesh:
    """Return the height field over a grid."""
    grid_x, grid_y = (grid.ravel() for grid in np.meshgrid(x_m, y_m, indexing="ij"))
    corner = (np.arange(len(x_m) - 1)[:, None] * len(y_m) + np.arange(len(y_m) - 1)).ravel()
    right, up = corner + len(y_m), corner + 1
    triangles = np.concatenate([np.stack([corner, right, right + 1], 1), np.stack([corner, right + 1, up], 1)])
    return Mesh(np.stack([grid_x, grid_y, height(grid_x, grid_y)], axis=1), triangles)


def curtain(xy_m: Float64Array, low_m: Float64Array, high_m: Float64Array) -> Mesh:
    """Return the upright strip over a polyline (K, 2) between two heights (K,)."""
    count = len(xy_m)
    here = np.arange(count - 1)
    vertices = np.concatenate([np.column_stack([xy_m, low_m]), np.column_stack([xy_m, high_m])])
    triangles = np.concatenate(
        [np.stack([here, here + 1, here + count], 1), np.stack([here + 1, here + count + 1, here + count], 1)]
    )
    return Mesh(vertices, triangles)


def swing_vertices(part: Part, distance_m: float) -> Float64Array:
    """Return (V, 3) vertices of a part after ``distance_m``, object frame."""
    if part.swing_rad == 0:
        return part.mesh.vertices
    angle = float(part.angle(np.array(distance_m)))
    pivot = np.array([part.pivot_m[0], 0, part.pivot_m[1]])
    cos, sin = np.cos(angle), np.sin(angle)
    return (part.mesh.vertices - pivot) @ np.array([[cos, 0, sin], [0, 1, 0], [-sin, 0, cos]]).T + pivot


def _shape(kind: str, category: str, parts: Sequence[Part]) -> Shape:
    """Measure the parts over a stride and shift them so that the box centre is over the origin."""
    lows, highs = [], []
    for phase in _GAIT_PHASES:
        corners = np.concatenate([swing_vertices(part, phase / (2 * np.pi) * part.stride_m) for part in parts])
        lows.append(corners.min(axis=0))
        highs.append(corners.max(axis=0))
        if not any(part.swing_rad for part in parts):
            break
    low, high = np.mean(lows, axis=0), np.mean(highs, axis=0)
    shift = np.array([*(low + high)[:2] / 2, 0.0])
    moved = tuple(
        Part(
            Mesh(part.mesh.vertices - shift, part.mesh.triangles),
            part.swing_rad,
            (part.pivot_m[0] - shift[0], part.pivot_m[1]),
            part.stride_m,
            part.phase,
        )
        for part in parts
    )
    return Shape(kind, category, moved, (float(high[0] - low[0]), float(high[1] - low[1]), float(high[2])))


def _wheels(axles_x: Sequence[float], width_m: float, radius_m: float) -> list[Mesh]:
    half, thick = width_m / 2, 0.22
    return [
        rod((x, side * (half - thick - 0.02), radius_m), (x, side * (half - 0.02), radius_m), radius_m, 12)
        for x in axles_x
        for side in (-1, 1)
    ]


_CABINS: Final = {  # rear bottom, rear top, front top, front bottom, as shares of the length
    "sedan": (-0.38, -0.24, 0.04, 0.21),
    "hatchback": (-0.49, -0.40, 0.07, 0.24),
    "estate": (-0.49, -0.45, 0.05, 0.22),
    "van": (-0.49, -0.485, 0.24, 0.40),
}


def car(length_m: float = 4.5, width_m: float = 1.85, height_m: float = 1.55, style: str = "sedan") -> Shape:
    """Return a car: body with a falling bonnet, cabin with sloped screens, four wheels."""
    half, waist = width_m / 2, (0.48 if style == "van" else 0.57)
    profile = [(-0.49, 0.14), (0.48, 0.14), (0.5, 0.25), (0.5, 0.42), (0.22, waist), (-0.47, waist), (-0.5, 0.48)]
    body = np.array([[x * length_m, 0, z * height_m] for x, z in profile])
    sill = np.array([0, half, 0])
    rear, rear_top, front_top, front = (share * length_m for share in _CABINS[style])
    cabin = loft(
        _rectangle((rear, front), (-0.95 * half, 0.95 * half), waist * height_m),
        _rectangle((rear_top, front_top), (-0.78 * half, 0.78 * half), height_m),
    )
    wheels = _wheels((-0.31 * length_m, 0.31 * length_m), width_m, 0.32)
    return _shape("car", "REGULAR_VEHICLE", [Part(merge([loft(body - sill, body + sill), cabin, *wheels]))])


def truck(length_m: float = 10.0, width_m: float = 2.5, height_m: float = 3.5) -> Shape:
    """Return a truck: cab, gap, cargo box, chassis and wheels."""
    front, half = length_m / 2, width_m / 2
    meshes = [
        loft(
            _rectangle((front - 2.1, front), (-0.96 * half, 0.96 * half), 0.5),
            _rectangle((front - 2.1, front - 0.25), (-0.92 * half, 0.92 * half), 0.86 * height_m),
        ),
        cuboid((-front, front - 2.5), (-half, half), (1.05, height_m)),
        cuboid((-front + 0.3, front - 1.5), (-0.35 * half, 0.35 * half), (0.55, 1.05)),
        *_wheels((front - 1.4, -front + 1.4, -front + 2.8), width_m, 0.48),
    ]
    return _shape("truck", "TRUCK", [Part(merge(meshes))])


def bus(length_m: float = 12.0, width_m: float = 2.55, height_m: float = 3.1) -> Shape:
    """Return a bus: one long body with a rounded nose, and wheels."""
    front, half = length_m / 2, np.array([0, width_m / 2, 0])
    profile = [(-front, 0.35), (front - 0.1, 0.35), (front, 1.0), (front - 0.25, height_m - 0.2)]
    profile += [(front - 0.6, height_m), (-front + 0.2, height_m), (-front, height_m - 0.2)]
    body = np.array([[x, 0, z] for x, z in profile])
    wheels = _wheels((front - 2.7, -front + 3.2), width_m, 0.48)
    return _shape("bus", "BUS", [Part(merge([loft(body - half, body + half), *wheels]))])


def cyclist(height_m: float = 1.75) -> Shape:
    """Return a rider on a bicycle; the legs go up and down as the pedals turn."""
    hip, shoulder = (-0.18, 0.56 * height_m), (0.18, 0.82 * height_m)
    wheels = [rod((x, -0.025, 0.34), (x, 0.025, 0.34), 0.34, 16) for x in (-0.53, 0.53)]
    frame = [
        rod((-0.53, 0, 0.34), (-0.15, 0, 0.85), 0.03, 6),
        rod((-0.15, 0, 0.85), (0.4, 0, 0.9), 0.03, 6),
        rod((0.53, 0, 0.34), (0.4, 0, 1.02), 0.03, 6),
        rod((0.42, -0.28, 1.02), (0.42, 0.28, 1.02), 0.03, 6),
    ]
    rider = [
        loft(
            _rectangle((hip[0] - 0.11, hip[0] + 0.11), (-0.16, 0.16), hip[1]),
            _rectangle((shoulder[0] - 0.11, shoulder[0] + 0.11), (-0.21, 0.21), shoulder[1]),
        ),
        rod((shoulder[0] + 0.05, 0, shoulder[1] + 0.02), (shoulder[0] + 0.08, 0, height_m), 0.1),
        *(rod((shoulder[0], 0.2 * s, shoulder[1] - 0.06), (0.42, 0.25 * s, 1.05), 0.05, 6) for s in (-1, 1)),
    ]
    legs = [
        Part(rod((hip[0], y, hip[1]), (-0.02, y, 0.2), 0.07, 6), 0.22, hip, 5.0, phase)
        for y, phase in ((0.12, 0.0), (-0.12, np.pi))
    ]
    return _shape("cyclist", "BICYCLIST", [Part(merge([*wheels, *frame, *rider])), *legs])


def walker(height_m: float = 1.72, *, is_walking: bool = True) -> Shape:
    """Return a person whose legs and arms swing with the distance walked."""
    hip, shoulder = 0.5 * height_m, 0.8 * height_m
    swing = 0.45 if is_walking else 0.0
    trunk = [
        loft(
            _rectangle((-0.11, 0.11), (-0.17, 0.17), 0.47 * height_m),
            _rectangle((-0.11, 0.11), (-0.22, 0.22), 0.83 * height_m),
        ),
        rod((0, 0, 0.83 * height_m), (0.02, 0, height_m), 0.09),
    ]
    limbs = [
        Part(rod((0, 0.1 * s, hip), (0.02, 0.1 * s, 0.0), 0.075, 6), swing, (0.0, hip), 1.45, phase)
        for s, phase in ((1, 0.0), (-1, np.pi))
    ]
    limbs += [
        Part(
            rod((0, 0.26 * s, shoulder), (0.04, 0.26 * s, 0.44 * height_m), 0.05, 6), swing, (0, shoulder), 1.45, phase
        )
        for s, phase in ((1, np.pi), (-1, 0.0))
    ]
    return _shape("walker", "PEDESTRIAN", [Part(merge(trunk)), *limbs])


EGO_PARTS: Final = {  # what a vehicle's own lidar may see of it: ego frame, about a lidar at (1.35, 0, 1.64)
    "bonnet": (loft(_rectangle((2.3, 3.7), (-0.85, 0.85), 0.7), _rectangle((2.3, 3.6), (-0.8, 0.8), 0.95)),),
    "cab": (cuboid((5.0, 5.6), (-1.1, 1.1), (0.0, 1.2)),),
    "roof": (
        cuboid((-0.6, 2.3), (-0.75, 0.75), (1.25, 1.3)),
        *(cuboid((x, x + 0.06), (-0.5, 0.5), (1.5, 1.56)) for x in (0.99, 1.65)),
    ),
}


def block(length_m: float = 4.0, width_m: float = 2.0, height_m: float = 1.5) -> Shape:
    """Return a plain cuboid: the road user of tests that need exact faces."""
    mesh = cuboid((-length_m / 2, length_m / 2), (-width_m / 2, width_m / 2), (0, height_m))
    return _shape("block", "REGULAR_VEHICLE", [Part(mesh)])
