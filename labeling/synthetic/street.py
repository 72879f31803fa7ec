"""The built-in street: a seeded Scene with houses, parked rows and traffic that nobody has to annotate.

Cross-section (m from the middle, both sides alike): lane 0-3.5, cycle strip to 5.4, parked row to 7.6, kerb, pavement
to 11.4, house fronts. The ego vehicle drives along +x on the right; side streets cross every 60 to 90 m.
"""

from collections.abc import Iterator
from typing import Final

import numpy as np

from labeling.synthetic import shapes
from labeling.synthetic.scene import STEP_S, Ground, Scene, Slab
from labeling.synthetic.shapes import Mesh
from labeling.synthetic.traffic import drive_lanes, fill_street

_HORIZON_S: Final = 30.0  # worlds are planned in multiples of this: the same seed starts the same, however long it runs
_REACH_M: Final = 115.0  # the street goes on this far beyond the ego vehicle's way
_KERB_Y: Final = 7.6
_FRONT_Y: Final = 11.4
_CROSSING_HALF_M: Final = 4.0  # of a side street's carriageway


def build_street(seed: int, duration_s: float, max_movers: int | None = None) -> Scene:
    """Return the street of this seed, planned for a segment of ``duration_s``.

    ``max_movers`` keeps this many of those that move, the most various first; None keeps all, 0 makes a still world
    through which the ego vehicle drives on.
    """
    horizon_s = _HORIZON_S * np.ceil((duration_s + 1) / _HORIZON_S)
    times = np.arange(0, horizon_s + STEP_S, STEP_S)
    rng = {
        purpose: np.random.default_rng([seed, number])
        for number, purpose in enumerate(("crossings", "lanes", "ground", "structures", "road users"))
    }
    crossings = _draw_crossings(rng["crossings"], 12.0 * horizon_s + _REACH_M)
    ego, vehicles = drive_lanes(rng["lanes"], times, crossings)
    end_m = float(ego.states[-1, 0]) + _REACH_M
    blocks = [
        (max(left + _CROSSING_HALF_M, -_REACH_M), min(right - _CROSSING_HALF_M, end_m))
        for left, right in zip([-np.inf, *crossings], [*crossings, np.inf], strict=True)
        if left + _CROSSING_HALF_M < end_m
    ]
    ground = _draw_ground(rng["ground"], blocks)
    moving, still = fill_street(rng["road users"], times, ego, vehicles, blocks)
    structures = tuple(_draw_structures(rng["structures"], blocks, ground))
    return Scene(ground, structures, (*moving[:max_movers], *still), ego)


def _draw_crossings(rng: np.random.Generator, end_m: float) -> list[float]:
    places = [float(rng.uniform(26, 38))]
    while places[-1] < end_m:
        places.append(places[-1] + float(rng.uniform(60, 90)))
    return [places[0] - float(rng.uniform(65, 85)), *places]


def _draw_ground(rng: np.random.Generator, blocks: list[tuple[float, float]]) -> Ground:
    slabs = []
    for block in blocks:
        for side in (-1, 1):
            y = sorted((side * _KERB_Y, side * (_FRONT_Y + 14)))
            slabs.append(Slab(block, (y[0], y[1])))
    return Ground(
        slope_x=float(rng.choice([-1, 1]) * rng.uniform(0.01, 0.025)),
        slope_y=float(rng.uniform(-0.01, 0.01)),
        crest_m=float(rng.uniform(0.3, 0.9)),
        crest_x_m=float(rng.uniform(20, 70)),
        crest_width_m=float(rng.uniform(30, 45)),
        x_m=(blocks[0][0], blocks[-1][1]),
        slabs=tuple(slabs),
    )


def _draw_structures(rng: np.random.Generator, blocks: list[tuple[float, float]], ground: Ground) -> Iterator[Mesh]:
    """Yield houses, side-street walls, poles, trees and bushes."""
    for left, right in blocks:
        for side in (-1, 1):
            flip = _mirror if side < 0 else _keep
            base = float(ground.base(np.array([(left + right) / 2]), np.array([side * 15.0]))[0])
            place = left + 2.2
            while place < right - 8:
                width = min(float(rng.uniform(7, 14)), right - 2.2 - place)
                if rng.random() < 0.85 or place < left + 3:
                    height = ground.base(np.array([place + width / 2]), np.array([side * 15.0]))[0]
                    yield flip(_draw_house(rng, place, width, float(height)))
                elif rng.random() < 0.6:  # a gap between houses, with a garden wall
                    yield flip(
                        shapes.cuboid((place, place + width), (12.2, 12.5), (base - 3, base + rng.uniform(0.8, 1.9)))
                    )
                place += width + (float(rng.uniform(0.5, 4)) if rng.random() < 0.25 else 0.0)
            for edge, inward in ((left, 1), (right, -1)):  # houses along the side street
                y = _FRONT_Y + 13
                while y < 85:
                    depth = float(rng.uniform(8, 14))
                    x = sorted((edge + inward * float(rng.uniform(2, 3.5)), edge + inward * 9))
                    yield flip(shapes.cuboid((x[0], x[1]), (y, y + depth), (base - 4, base + rng.uniform(5, 10))))
                    y += depth + float(rng.uniform(0, 3))
            for x in np.arange(left + 4, right - 3, 8.5) + rng.uniform(-1.5, 1.5):
                yield _draw_plant(rng, float(x), side, ground)


def _keep(mesh: Mesh) -> Mesh:
    return mesh


def _mirror(mesh: Mesh) -> Mesh:
    return Mesh(mesh.vertices * [1, -1, 1], mesh.triangles)


def _draw_house(rng: np.random.Generator, x: float, width: float, ground_m: float) -> Mesh:
    """Return a house on the +y side: front wall with sills, pilasters, a door step, and a bay or balconies."""
    front = _FRONT_Y + float(rng.uniform(0, 1.4))
    storeys = int(rng.integers(2, 5))
    top = ground_m + 3.1 * storeys + 0.6
    meshes = [shapes.cuboid((x, x + width), (front, front + 12), (ground_m - 3, top))]
    roof = np.array(
        [[x, front - 0.3, top], [x + width, front - 0.3, top], [x + width, front + 12, top], [x, front + 12, top]]
    )
    ridge = np.array([[x, front + 5.5, top + 2.5], [x + width, front + 5.5, top + 2.5]])
    meshes.append(shapes.loft(roof, ridge[[0, 1, 1, 0]] + [[0, 0, 0], [0, 0, 0], [0, 0.5, 0], [0, 0.5, 0]]))
    has_bay = rng.random() < 0.4
    windows = np.arange(x + 1.4, x + width - 1, float(rng.uniform(2.2, 3)))
    for storey in range(storeys):
        z = ground_m + 1.0 + 3.1 * storey
        for window in windows:
            sill = (window - 0.65, window + 0.65)
            meshes.append(shapes.cuboid(sill, (front - 0.18, front), (z - 0.1, z)))
            meshes.append(shapes.cuboid(sill, (front - 0.12, front), (z + 1.5, z + 1.65)))
        if has_bay and storey:
            meshes.append(
                shapes.cuboid((x + width / 2 - 1.5, x + width / 2 + 1.5), (front - 0.9, front), (z - 1, z + 2))
            )
    for edge in (x + 0.15, x + width - 0.15):
        meshes.append(shapes.cuboid((edge - 0.15, edge + 0.15), (front - 0.15, front), (ground_m - 1, top)))
    return shapes.merge(meshes)


def _draw_plant(rng: np.random.Generator, x: float, side: int, ground: Ground) -> Mesh:
    """Return a tree, a lamp, a sign or a bush at a place along the pavement."""
    kind = rng.choice(["tree", "tree", "lamp", "sign", "bush", "bush"])
    y = side * (10.95 if kind == "bush" else 8.05)
    z = float(ground.height(np.array([x]), np.array([y]))[0])
    if kind == "tree":
        trunk = float(rng.uniform(2.4, 3.4))
        crown = shapes.foliage(rng, rng.uniform(1.2, 2.1, 3), int(rng.integers(250, 420)), 0.16)
        meshes = [shapes.rod((0, 0, -0.3), (0.1, 0, trunk + 0.8), float(rng.uniform(0.11, 0.24)), 9)]
        meshes.append(crown.moved(0, 0, trunk + 1.5))
    elif kind == "lamp":
        meshes = [shapes.rod((0, 0, -0.3), (0, 0, 6), 0.08), shapes.rod((0, 0, 6), (0, -side * 1.6, 6.3), 0.06)]
    elif kind == "sign":
        plate = shapes.cuboid((-0.02, 0.02), (-0.3, 0.3), (2.1, 2.7))
        meshes = [shapes.rod((0, 0, -0.3), (0, 0, 2.8), 0.035, 6), plate]
    else:
        bush = shapes.foliage(rng, [rng.uniform(0.5, 1.0), 0.35, 0.5], int(rng.integers(120, 220)), 0.07)
        meshes = [bush.moved(0, 0, 0.55)]
    return shapes.merge(meshes).moved(x, y, z)
