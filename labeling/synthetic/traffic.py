"""The street's road users: vehicles that follow each other, a parked row, cyclists, walkers, none through another."""

from collections.abc import Iterator
from typing import Final, NamedTuple

import numpy as np
import shapely

from labeling.geometry.boxes import bev_corners
from labeling.synthetic import shapes
from labeling.synthetic.scene import STEP_S, Mover, Path
from labeling.synthetic.shapes import Shape
from schemas.arrays import Float64Array
from schemas.objects import BOX_HEIGHT, BOX_LENGTH, BOX_WIDTH, BOX_YAW

_LANE_Y: Final = 1.75  # see the cross-section of the street
_STRIP_Y: Final = 4.45
_PARKED_Y: Final = 6.55
_TURN_RADIUS_M: Final = 6.0
_CLEARANCE_M: Final = 0.3
_CHECK_EVERY: Final = 2  # path rows between tests for collisions: 0.1 s
_NEAR_M: Final = 130.0  # from the ego vehicle: beyond, nobody looks
_EGO: Final = shapes.block(4.9, 2.0, 1.7)  # for clearance only; the lidar does not see it


class _Driver(NamedTuple):
    """One vehicle of a lane, before it is known how the others hold it up."""

    shape: Shape
    start_m: float  # along the lane
    desired_mps: float
    side_m: float  # offset within the lane
    stop_s: tuple[float, float] = (np.inf, np.inf)  # it stands, or brakes, in this interval
    exit_m: float = np.inf  # where it turns off


def drive_lanes(rng: np.random.Generator, times: Float64Array, crossings: list[float]) -> tuple[Path, list[Mover]]:
    """Return the ego vehicle's path and the vehicles of both lanes."""
    horizon_s = float(times[-1])
    turner_lane = int(rng.choice([-1, 1]))  # which lane's car turns off in front of the ego vehicle
    ego = _Driver(_EGO, 0.0, rng.uniform(6, 8.5), 0.0)
    own = [ego]
    ahead = float(rng.uniform(18, 24))
    if turner_lane == 1:
        own.append(_Driver(_draw_vehicle(rng, "car"), ahead, 7.0, 0.0, exit_m=_exit_m(1, crossings[1])))
        ahead += float(rng.uniform(16, 25))
    while ahead < 90:
        own.append(_Driver(_draw_vehicle(rng), ahead, rng.uniform(7, 14), rng.uniform(-0.2, 0.2)))
        ahead += float(rng.uniform(22, 45))
    behind = -float(rng.uniform(14, 25))
    while behind > -70:
        own.append(_Driver(_draw_vehicle(rng), behind, rng.uniform(7, 14), rng.uniform(-0.2, 0.2)))
        behind -= float(rng.uniform(20, 45))

    oncoming = []  # this lane's metres count along -x
    place = 60.0
    kinds = ["car", str(rng.choice(["truck", "bus"])), "car"]  # of those the ego vehicle meets first
    while place > -(95 + 22 * horizon_s):
        kind = kinds.pop(0) if kinds and place < 5 else None
        begin_s = float(rng.uniform(1.5, 3))
        stop_s = (begin_s, begin_s + float(rng.uniform(5.5, 7))) if -85 < place < -65 else (np.inf, np.inf)
        side_m = rng.uniform(-0.2, 0.2)
        oncoming.append(_Driver(_draw_vehicle(rng, kind), place, rng.uniform(7, 17), side_m, stop_s))
        place -= float(rng.uniform(20, 48))
    if turner_lane == -1:
        exit_m = _exit_m(-1, crossings[1])
        start = exit_m - float(rng.uniform(3, 8))
        oncoming = [driver for driver in oncoming if abs(driver.start_m - start) > 14]
        oncoming.append(_Driver(_draw_vehicle(rng, "car"), start, 6.5, 0.0, exit_m=exit_m))

    paths = {}
    for heading, lane in ((1, own), (-1, oncoming)):
        lane.sort(key=lambda driver: -driver.start_m)
        for driver, travelled in zip(lane, _follow(lane, times).T, strict=True):
            wobble_m = 0.25 if driver is ego else 0.08
            paths[driver] = _lane_path(rng, driver, heading, travelled, times, wobble_m)
    ego_path = paths.pop(ego)
    return ego_path, [Mover(driver.shape, path) for driver, path in paths.items()]


def fill_street(
    rng: np.random.Generator,
    times: Float64Array,
    ego: Path,
    vehicles: list[Mover],
    blocks: list[tuple[float, float]],  # from crossing to crossing, m along x
) -> tuple[list[Mover], list[Mover]]:
    """Add parked cars, cyclists and walkers to the vehicles of the lanes.

    Returns:
        Who moves, the most various and nearest first, and who does not. No two of them, and none and the ego vehicle,
        ever touch while the ego vehicle is near.

    """
    end_m = blocks[-1][1]
    crowd = _Crowd(times, ego)
    moving = [mover for mover in vehicles if crowd.admit(mover)]
    moving += next(([mover] for mover in _draw_searchers(rng, times) if crowd.admit(mover)), [])
    still = [mover for mover in _draw_parked(rng, blocks) if crowd.admit(mover)]
    moving += [mover for mover in _draw_cyclists(rng, times, end_m) if crowd.admit(mover)]
    moving += [mover for mover in _draw_walkers(rng, times, end_m) if crowd.admit(mover)]
    still += [mover for mover in _draw_standing(rng, end_m) if crowd.admit(mover)]
    return _by_interest(moving), still


def _draw_vehicle(rng: np.random.Generator, kind: str | None = None) -> Shape:
    kind = kind or str(rng.choice(["car", "car", "car", "car", "car", "car", "van", "truck", "bus"]))
    if kind == "truck":
        return shapes.truck(rng.uniform(10, 11.5), rng.uniform(2.4, 2.55), rng.uniform(3.3, 3.8))
    if kind == "bus":
        return shapes.bus(rng.uniform(10.5, 12), 2.55, rng.uniform(2.9, 3.2))
    if kind == "van":
        return shapes.car(rng.uniform(4.9, 5.6), rng.uniform(1.95, 2.05), rng.uniform(2.0, 2.5), "van")
    style = str(rng.choice(["sedan", "hatchback", "estate"]))
    length = rng.uniform(3.7, 4.3) if style == "hatchback" else rng.uniform(4.3, 4.9)
    return shapes.car(length, rng.uniform(1.72, 1.9), rng.uniform(1.42, 1.75), style)


def _exit_m(heading: int, crossing_m: float) -> float:
    """Return where along its lane a car begins its right turn into a side street's right half."""
    return heading * crossing_m - 2.0 - _TURN_RADIUS_M


def _follow(drivers: list[_Driver], times: Float64Array) -> Float64Array:
    """Return (K, D) places along the lane of drivers, leader first, none running into the one ahead.

    Source: Treiber et al. 2000, the intelligent driver model, with a hard brake for the planned stops.
    """
    acceleration, braking, headway_s, gap_m = 1.6, 2.5, 1.1, 2.5
    place = np.array([driver.start_m for driver in drivers], dtype=np.float64)
    desired = np.array([driver.desired_mps for driver in drivers])
    length = np.array([driver.shape.size_m[0] for driver in drivers])
    exit_m = np.array([driver.exit_m for driver in drivers])
    stop = np.array([driver.stop_s for driver in drivers])
    speed = desired.copy()
    for i in range(1, len(drivers)):  # no one starts in an emergency
        speed[i] = min(speed[i], speed[i - 1] + 0.15 * (place[i - 1] - place[i] - length[i]))
    speed = np.maximum(speed, 1.0)
    places = np.empty((len(times), len(drivers)))
    order = np.arange(len(drivers))
    for k, time in enumerate(times):
        places[k] = place
        on_lane = place < exit_m + 9
        leader = np.concatenate([[-1], np.maximum.accumulate(np.where(on_lane, order, -1))[:-1]])
        gap = np.where(leader >= 0, place[leader] - length[leader] / 2 - place - length / 2, 1e3)
        closing = np.where(leader >= 0, speed - speed[leader], 0)
        wanted = np.where((place > exit_m - 22) & (place < exit_m + 12), np.minimum(desired, 5.0), desired)
        safe = gap_m + np.maximum(speed * headway_s + speed * closing / (2 * np.sqrt(acceleration * braking)), 0)
        change = acceleration * (1 - (speed / wanted) ** 4 - (safe / np.maximum(gap, 0.1)) ** 2)
        change = np.where((stop[:, 0] <= time) & (time < stop[:, 1]), np.minimum(change, -braking), change)
        before = speed
        speed = np.maximum(speed + np.clip(change, -8, 2) * STEP_S, 0)
        place = place + (before + speed) / 2 * STEP_S
    return places


def _lane_path(
    rng: np.random.Generator,
    driver: _Driver,
    heading: int,
    travelled: Float64Array,
    times: Float64Array,
    wobble_m: float,
) -> Path:
    """Lay places along a lane into the world: straight with a slight weave, or off to the right at a crossing."""
    wobble = wobble_m if np.isinf(driver.exit_m) else 0.0
    wave, phase = 2 * np.pi / rng.uniform(45, 80), rng.uniform(0, 6)
    turn = np.clip((travelled - driver.exit_m) / _TURN_RADIUS_M, 0, np.pi / 2)
    beyond = np.maximum(travelled - driver.exit_m - _TURN_RADIUS_M * np.pi / 2, 0)
    forward = np.minimum(travelled, driver.exit_m) + _TURN_RADIUS_M * np.sin(turn)
    left = -_LANE_Y + driver.side_m + wobble * np.sin(wave * travelled + phase)
    left = left - _TURN_RADIUS_M * (1 - np.cos(turn)) - beyond
    yaw = np.arctan(wobble * wave * np.cos(wave * travelled + phase)) - turn
    # the other direction is the same street seen from the far end
    states = np.column_stack([heading * forward, heading * left, yaw + (heading < 0) * np.pi, travelled])
    return Path(times, states)


def _draw_searchers(rng: np.random.Generator, times: Float64Array) -> Iterator[Mover]:
    """Yield tries at a car on the cycle strip that looks for a place to park; one is enough."""
    for start_m in rng.permutation([9.0, 14.0, 19.0, 24.0, -9.0]):
        shape = shapes.car(rng.uniform(3.7, 4.2), rng.uniform(1.68, 1.76), rng.uniform(1.45, 1.6), "hatchback")
        yield _stroll(shape, rng, times, (float(start_m), -_STRIP_Y - 0.1), 0.0, rng.uniform(1.6, 2.4), 0.0)


def _draw_cyclists(rng: np.random.Generator, times: Float64Array, end_m: float) -> Iterator[Mover]:
    for place in np.arange(-40, end_m + 6 * times[-1], 17.0):
        heading = int(rng.choice([-1, 1]))
        start = (float(place + rng.uniform(-6, 6)), -heading * (_STRIP_Y + float(rng.uniform(-0.35, 0.35))))
        yaw = 0.0 if heading > 0 else np.pi
        yield _stroll(shapes.cyclist(rng.uniform(1.65, 1.85)), rng, times, start, yaw, rng.uniform(3, 6.5), 0.12)


def _draw_walkers(rng: np.random.Generator, times: Float64Array, end_m: float) -> Iterator[Mover]:
    """Yield walkers on both pavements, some in pairs, and a few who cross the street."""
    for place in np.arange(-50, end_m, 9.0):
        heading, side = int(rng.choice([-1, 1])), int(rng.choice([-1, 1]))
        start = (float(place + rng.uniform(-4, 4)), side * float(rng.uniform(9.1, 10.3)))
        yaw, speed = (0.0 if heading > 0 else np.pi), rng.uniform(0.9, 1.9)
        yield _stroll(shapes.walker(rng.uniform(1.5, 1.9)), rng, times, start, yaw, speed, 0.1)
        if rng.random() < 0.3:  # a companion, in step
            beside = (
                start[0] + float(rng.uniform(-0.2, 0.2)),
                start[1] + (0.95 if abs(start[1]) < 9.6 else -0.95) * side,
            )
            yield _stroll(shapes.walker(rng.uniform(1.5, 1.9)), rng, times, beside, yaw, speed, 0.0)
    for place in np.arange(12, end_m, 24.0):
        side = int(rng.choice([-1, 1]))
        start = (float(place + rng.uniform(-8, 8)), side * float(rng.uniform(4.0, 8.5)))
        yield _stroll(
            shapes.walker(rng.uniform(1.5, 1.9)), rng, times, start, -side * np.pi / 2, rng.uniform(1.1, 1.9), 0.0, 18.0
        )


def _stroll(
    shape: Shape,
    rng: np.random.Generator,
    times: Float64Array,
    start_m: tuple[float, float],
    yaw: float,
    speed_mps: float,
    weave_m: float,
    reach_m: float = np.inf,
) -> Mover:
    """Return a mover on a straight, slightly weaving way with a slightly uneven pace, up to ``reach_m``."""
    pace = 1 + 0.08 * np.sin(2 * np.pi * times / rng.uniform(4, 9) + rng.uniform(0, 6))
    travelled = np.minimum(np.concatenate([[0.0], np.cumsum(speed_mps * pace[1:] * STEP_S)]), reach_m)
    wave, phase = 2 * np.pi / rng.uniform(12, 25), rng.uniform(0, 6)
    left = weave_m * (np.sin(wave * travelled + phase) - np.sin(phase))
    turn = np.arctan(weave_m * wave * np.cos(wave * travelled + phase))
    cos, sin = np.cos(yaw), np.sin(yaw)
    x, y = start_m[0] + cos * travelled - sin * left, start_m[1] + sin * travelled + cos * left
    return Mover(shape, Path(times, np.column_stack([x, y, yaw + turn, travelled])))


def _draw_parked(rng: np.random.Generator, blocks: list[tuple[float, float]]) -> Iterator[Mover]:
    for left, right in blocks:
        for side in (-1, 1):
            place = left + 5.0 + float(rng.uniform(0, 3))
            while place < right - 8:
                shape = _draw_vehicle(rng, "van" if rng.random() < 0.1 else "car")
                place += shape.size_m[0] / 2
                yaw = (0.0 if (side < 0) != (rng.random() < 0.1) else np.pi) + float(rng.normal(0, 0.02))
                state = [place, side * (_PARKED_Y + float(rng.uniform(-0.1, 0.05))), yaw, 0.0]
                if rng.random() < 0.75:
                    yield Mover(shape, Path(np.zeros(1), np.array([state])))
                place += shape.size_m[0] / 2 + float(rng.uniform(0.8, 1.8))


def _draw_standing(rng: np.random.Generator, end_m: float) -> Iterator[Mover]:
    for place in np.arange(-40, end_m, 21.0):
        state = [
            place + rng.uniform(-8, 8),
            rng.choice([-1, 1]) * rng.uniform(8.6, 10.9),
            rng.uniform(-np.pi, np.pi),
            0,
        ]
        yield Mover(shapes.walker(rng.uniform(1.5, 1.9), is_walking=False), Path(np.zeros(1), np.array([state])))


class _Crowd:
    """Who is in the street, and when where: newcomers must not touch them while the ego vehicle is near."""

    def __init__(self, times: Float64Array, ego: Path) -> None:
        self._times = times[::_CHECK_EVERY]
        self._ego_xy = ego.at(self._times)[:, :2]
        self._still: list[Float64Array] = []  # each (1, 7), grown by the clearance, heights unused
        self._moving: list[Float64Array] = [_grown_boxes(_EGO, ego.at(self._times))]  # each (K, 7)

    def admit(self, mover: Mover) -> bool:
        """Add the mover unless it would touch another, or is never seen; say whether it was added."""
        states = mover.path.states[:1] if mover.path.is_still else mover.path.at(self._times)
        near = np.flatnonzero(np.hypot(*(states[:, :2] - self._ego_xy).T) < _NEAR_M)
        if not len(near):
            return False
        boxes = _grown_boxes(mover.shape, states)
        watched = boxes if mover.path.is_still else boxes[near]
        if self._still and _is_touching(watched, np.array(self._still)):
            return False
        if _is_touching(watched, np.array([others[near] for others in self._moving])):
            return False
        (self._still if mover.path.is_still else self._moving).append(boxes)
        return True


def _grown_boxes(shape: Shape, states: Float64Array) -> Float64Array:
    boxes = np.zeros((len(states), 7))
    boxes[:, :2], boxes[:, BOX_YAW] = states[:, :2], states[:, 2]
    boxes[:, BOX_LENGTH : BOX_HEIGHT + 1] = np.array(shape.size_m) + _CLEARANCE_M
    return boxes


def _is_touching(
    boxes: Float64Array,  # (1 or K, 7) of one road user over time
    others: Float64Array,  # (B, 1 or K, 7)
) -> bool:
    gap_m2 = (others[..., 0] - boxes[:, 0]) ** 2 + (others[..., 1] - boxes[:, 1]) ** 2
    radii = [np.hypot(size[..., BOX_LENGTH], size[..., BOX_WIDTH]) / 2 for size in (boxes[0], others[:, 0])]
    other, time = np.nonzero(gap_m2 < (radii[0] + radii[1][:, None]) ** 2)
    if not len(other):
        return False
    ours = np.broadcast_to(boxes, (len(gap_m2[0]), 7))[time]
    theirs = np.broadcast_to(others, (*gap_m2.shape, 7))[other, time]
    return bool(shapely.intersects(shapely.polygons(bev_corners(ours)), shapely.polygons(bev_corners(theirs))).any())


def _by_interest(movers: list[Mover]) -> list[Mover]:
    """Order movers so that the first few are near the start and of many kinds."""

    def distance(mover: Mover) -> float:
        return float(np.hypot(mover.path.states[0, 0] - 15, mover.path.states[0, 1]))

    seen: dict[str, int] = {}
    keyed = []
    for mover in sorted(movers, key=distance):
        rank = seen[mover.shape.kind] = seen.get(mover.shape.kind, -1) + 1
        keyed.append((rank, distance(mover), mover))
    return [mover for _, _, mover in sorted(keyed, key=lambda entry: entry[:2])]
