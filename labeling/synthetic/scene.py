"""Scenes with known answers: a ground, fixed structures, road users on paths, an ego vehicle, a lidar.

    scene = Scene(structures=(wall((15, -8), (15, 8)),), movers=(drive(car(), (8, 4), speed_mps=10),))
    reader = scene.reader(num_sweeps=5)

The reader stands behind the same protocol as every data set. The built-in street is nothing but a seeded Scene.
"""

from dataclasses import dataclass, field
from typing import Final

import numpy as np

from labeling.geometry.boxes import transform_boxes
from labeling.geometry.times import seconds_between
from labeling.geometry.transforms import invert, rotate_vectors, transform_points, wrap_angle
from labeling.readers.reader import SegmentReader, make_segment_id
from labeling.synthetic.lidar import Capture, RayWorld
from labeling.synthetic.options import START_NS
from labeling.synthetic.rigs import Rig, Sensor, SpinningLidar
from labeling.synthetic.shapes import Mesh, Shape, curtain, merge, surface
from schemas.arrays import Float64Array, Int64Array
from schemas.errors import InvalidInput
from schemas.frames import Annotations, PointTruth, Sweep
from schemas.lidars import Lidar
from schemas.listing import SegmentListing

STEP_S: Final = 0.05  # of path tables; motion is linear between
_EGO_HEIGHT_M: Final = 0.33  # the ego origin is the middle of the rear axle
_AXLE_TO_NOSE_M: Final = 2.8  # over this length the ego takes the slope of the ground
_KERB_RAMP_M: Final = 0.3  # road users climb a kerb over this length


@dataclass(frozen=True, slots=True)
class Slab:
    """A raised pavement."""

    x_m: tuple[float, float]
    y_m: tuple[float, float]
    rise_m: float = 0.12


@dataclass(frozen=True, slots=True)
class Ground:
    """z = slope_x x + slope_y y + a crest across x, and pavements upon it. World frame."""

    slope_x: float = 0.0
    slope_y: float = 0.0
    crest_m: float = 0.0  # height of the crest
    crest_x_m: float = 0.0
    crest_width_m: float = 40.0  # standard deviation
    x_m: tuple[float, float] = (-110.0, 110.0)  # extent
    y_m: tuple[float, float] = (-110.0, 110.0)
    slabs: tuple[Slab, ...] = ()

    def base(self, x: Float64Array, y: Float64Array) -> Float64Array:
        """Return the height of the carriageway at (N,) places."""
        bump = np.exp(-(((x - self.crest_x_m) / self.crest_width_m) ** 2) / 2)
        height: Float64Array = self.slope_x * x + self.slope_y * y + self.crest_m * bump
        return height

    def height(self, x: Float64Array, y: Float64Array) -> Float64Array:
        """Return the height that carries a road user at (N,) places: kerbs are short ramps."""
        rise = np.zeros(np.broadcast(x, y).shape)
        for slab in self.slabs:
            if slab.x_m[0] - x.max() > _KERB_RAMP_M or x.min() - slab.x_m[1] > _KERB_RAMP_M:
                continue
            outside_x = np.maximum(slab.x_m[0] - x, x - slab.x_m[1])
            outside_y = np.maximum(slab.y_m[0] - y, y - slab.y_m[1])
            outside = np.maximum(np.maximum(outside_x, outside_y), 0)
            rise = np.maximum(rise, slab.rise_m * np.clip(1 - outside / _KERB_RAMP_M, 0, 1))
        return self.base(x, y) + rise

    def mesh(self) -> Mesh:
        """Return carriageway, pavements and kerbs."""
        meshes = [surface(_steps(self.x_m, 2.5), _steps(self.y_m, 20.0), self.base)]
        for slab in self.slabs:
            x, y = _steps(slab.x_m, 2.5), _steps(slab.y_m, 20.0)
            rise = slab.rise_m
            meshes.append(surface(x, y, lambda x, y, rise=rise: self.base(x, y) + rise))  # type: ignore[misc]
            for edge in (
                *(np.column_stack([x, np.full(len(x), at)]) for at in slab.y_m),
                *(np.column_stack([np.full(len(y), at), y]) for at in slab.x_m),
            ):
                low = self.base(edge[:, 0], edge[:, 1])
                meshes.append(curtain(edge, low - 0.02, low + rise))
        return merge(meshes)


def _steps(bounds: tuple[float, float], step: float) -> Float64Array:
    return np.linspace(*bounds, max(2, round((bounds[1] - bounds[0]) / step) + 1))


@dataclass(frozen=True, slots=True, eq=False)
class Path:
    """Where something is over time; linear between rows. One row: it never moves."""

    times_s: Float64Array  # (K,) ascending, 0 at the first sweep's stamp
    states: Float64Array  # (K, 4) world x, y in m, yaw in rad (unwrapped), distance travelled in m

    @property
    def is_still(self) -> bool:
        """True when it never moves."""
        return bool((self.states == self.states[0]).all())

    def at(self, times_s: Float64Array) -> Float64Array:
        """Return (N, 4) states at (N,) times."""
        return np.column_stack([np.interp(times_s, self.times_s, column) for column in self.states.T])


@dataclass(frozen=True, slots=True, eq=False)
class Mover:
    """A road user: what it looks like and where it is. Parked cars are movers that never do."""

    shape: Shape
    path: Path


def drive(
    shape: Shape,
    start_m: tuple[float, float] = (0.0, 0.0),
    yaw: float = 0.0,
    speed_mps: float | tuple[tuple[float, float], ...] = 0.0,
    yaw_rate_radps: float = 0.0,
    duration_s: float = 30.0,
) -> Mover:
    """Return a road user that starts at world (x, y) with heading ``yaw``.

    ``speed_mps`` is one number, or a schedule of (time in s, speed) joined by straight lines: a stop and a new start
    is ((0, 8), (2, 0), (4, 0), (6, 8)). After ``duration_s`` it stands still.
    """
    times = np.arange(0, duration_s + STEP_S, STEP_S)
    schedule = np.array(speed_mps if isinstance(speed_mps, tuple) else ((0.0, speed_mps),), dtype=np.float64)
    speed = np.interp((times[1:] + times[:-1]) / 2, schedule[:, 0], schedule[:, 1])
    if not speed.any():
        return Mover(shape, Path(np.zeros(1), np.array([[*start_m, yaw, 0.0]])))
    heading = yaw + yaw_rate_radps * times
    middle = (heading[1:] + heading[:-1]) / 2
    step = STEP_S * np.column_stack([speed * np.cos(middle), speed * np.sin(middle), speed])
    moved = np.vstack([np.zeros(3), np.cumsum(step, axis=0)])
    return Mover(shape, Path(times, np.column_stack([moved[:, :2] + start_m, heading, moved[:, 2]])))


def wall(
    start_m: tuple[float, float], stop_m: tuple[float, float], height_m: float = 3.0, base_m: float = -1.0
) -> Mesh:
    """Return a thin upright wall between two world (x, y)."""
    return curtain(np.array([start_m, stop_m], dtype=np.float64), np.full(2, base_m), np.full(2, height_m))


@dataclass(frozen=True, slots=True, eq=False)
class Scene:
    """A world. ``ego`` is the path of the ego vehicle, of which its lidars see ``ego_parts`` (ego frame)."""

    ground: Ground = field(default_factory=Ground)
    structures: tuple[Mesh, ...] = ()
    movers: tuple[Mover, ...] = ()
    ego: Path = field(default_factory=lambda: Path(np.zeros(1), np.zeros((1, 4))))
    ego_parts: tuple[Mesh, ...] = ()

    def reader(
        self,
        num_sweeps: int = 10,
        hz: float = 10.0,
        lidar: Sensor | Rig | None = None,
        *,
        seed: int = 0,
        name: str = "scene",
        uri: str = "synthetic:scene",
        start_ns: int = START_NS,
    ) -> "SceneReader":
        """Return a reader of this world; without ``lidar``, one of 32 beams and 900 steps a turn."""
        stamps = sweep_stamps(num_sweeps, hz, start_ns)
        listing = SegmentListing("synthetic", uri, make_segment_id(name, uri), stamps)
        rig = lidar if isinstance(lidar, tuple) else (lidar or SpinningLidar(),)
        return SceneReader(self, listing, hz, rig, seed)


class _Posed:
    """A path on its ground: (N, 4, 4) world_from_object at any times."""

    def __init__(self, path: Path, ground: Ground, rise_m: float = 0.0, wheelbase_m: float = 0.0) -> None:
        self.path = path
        x, y, yaw, _ = path.states.T
        self._z = ground.height(x, y) + rise_m
        self._pitch = np.zeros(len(x))
        if wheelbase_m:
            nose = ground.height(x + wheelbase_m * np.cos(yaw), y + wheelbase_m * np.sin(yaw)) + rise_m
            self._pitch = -np.arctan2(nose - self._z, wheelbase_m)

    @property
    def is_still(self) -> bool:
        """True when it never moves."""
        return self.path.is_still

    def at(self, times_s: Float64Array) -> Float64Array:
        """Return (N, 4, 4) poses at (N,) times."""
        x, y, yaw, _ = self.path.at(times_s).T
        pitch = np.interp(times_s, self.path.times_s, self._pitch)
        cos, sin, cos_pitch, sin_pitch = np.cos(yaw), np.sin(yaw), np.cos(pitch), np.sin(pitch)
        pose = np.zeros((len(times_s), 4, 4))
        pose[:, 0, :3] = np.column_stack([cos * cos_pitch, -sin, cos * sin_pitch])
        pose[:, 1, :3] = np.column_stack([sin * cos_pitch, cos, sin * sin_pitch])
        pose[:, 2, :3] = np.column_stack([-sin_pitch, np.zeros(len(x)), cos_pitch])
        pose[:, :3, 3] = np.column_stack([x, y, np.interp(times_s, self.path.times_s, self._z)])
        pose[:, 3, 3] = 1
        return pose

    def distance_at(self, times_s: Float64Array) -> Float64Array:
        """Return (N,) metres travelled at (N,) times."""
        return np.interp(times_s, self.path.times_s, self.path.states[:, 3])


def sweep_stamps(num_sweeps: int, hz: float, start_ns: int) -> Int64Array:
    """Return (T,) when the sweeps of an even recording begin."""
    if num_sweeps < 1:
        raise InvalidInput(f"num_sweeps must be 1 or more, got {num_sweeps}")
    return start_ns + np.round(np.arange(num_sweeps) * 1e9 / hz).astype(np.int64)


class SceneReader(SegmentReader):
    """A scene behind the SegmentReader protocol. Any sweep can be read alone and in any order.

    The sweep's stamp is the start of its turn; each column of beams sees the world at its own time, and its points
    are carried to the stamp by the ego motion alone: what moves stays where it was when it was seen.
    """

    def __init__(self, scene: Scene, listing: SegmentListing, hz: float, rig: Rig, seed: int) -> None:
        self.listing = listing
        self.scene = scene
        self._rig, self._seed, self._period_s = rig, seed, 1 / hz
        self._reach_m = max(lidar.max_range_m for lidar in rig)
        self._ego = _Posed(scene.ego, scene.ground, _EGO_HEIGHT_M, _AXLE_TO_NOSE_M)
        self._movers = [_Posed(mover.path, scene.ground) for mover in scene.movers]
        self._world: RayWorld | None = None
        self._latest: tuple[int, Capture] | None = None  # sweep, annotations and truth of one index share a capture

    @property
    def lidars(self) -> tuple[Lidar, ...]:
        """What its lidars are."""
        return tuple(lidar.describe(self._period_s) for lidar in self._rig)

    def world_from_ego(self, index: int) -> Float64Array:
        """Return the (4, 4) pose at the stamp of sweep ``index``."""
        return self._ego.at(np.array([self._time_s(index)]))[0]

    def read_sweep(self, index: int) -> Sweep:
        """Return sweep ``index``, points in the order of their capture."""
        capture = self._capture(index)
        pose = self.world_from_ego(index)
        return Sweep(
            index=index,
            timestamp_ns=int(self.timestamps_ns[index]),
            points_ego=transform_points(invert(pose), capture.points_world).astype(np.float32),
            capture_offset_s=(capture.times_s - self._time_s(index)).astype(np.float32),
            world_from_ego=pose,
            sensor_origins_ego=np.array([lidar.origin_ego_m for lidar in self._rig], dtype=np.float32),
            lidar_of_point=capture.lidar,
        )

    def read_annotations(self, index: int) -> Annotations:
        """Return all road users within the lidars' reach, moving or not, seen or hidden.

        A box is where its object was at the mean capture time of its points; at the stamp when it has none.
        """
        capture, pose = self._capture(index), self.world_from_ego(index)
        seen = capture.object_index >= 0
        owner = capture.object_index[seen]
        count = np.bincount(owner, minlength=len(self._movers))
        total = np.bincount(owner, weights=capture.times_s[seen] - self._time_s(index), minlength=len(self._movers))
        boxes, ids, categories = [], [], []
        for i, mover in enumerate(self.scene.movers):
            time_s = self._time_s(index) + total[i] / max(count[i], 1)
            box = self.box_at(i, time_s)
            if np.hypot(*(box[:2] - pose[:2, 3])) <= self._reach_m:
                boxes.append(box)
                ids.append(f"{mover.shape.kind}-{i:04d}")
                categories.append(mover.shape.category)
        boxes_world = np.array(boxes).reshape(-1, 7)
        return Annotations(tuple(ids), tuple(categories), transform_boxes(invert(pose), boxes_world))

    def read_point_truth(self, index: int) -> PointTruth:
        """Return the exact flow to the next sweep and which points are road, pavement or kerb.

        A point of an object that was seen at time t gets the rigid motion of the object's box from t to
        t + (next stamp - this stamp), which is where an equal sweep would look for it; the swing of limbs is left
        out, so the meaning is that of data sets whose truth flow comes from boxes. All else has flow zero, the ego
        vehicle too. The last sweep has no next one: NaN.
        """
        capture = self._capture(index)
        flow_world = np.zeros((len(capture.points_world), 3))
        if index == len(self.timestamps_ns) - 1:
            flow_world[:] = np.nan
            return PointTruth(flow_world.astype(np.float32), capture.is_ground)
        gap_s = self._time_s(index + 1) - self._time_s(index)
        for i in np.unique(capture.object_index[capture.object_index >= 0]):
            if not self._movers[i].is_still:
                rows = np.flatnonzero(capture.object_index == i)
                times = capture.times_s[rows]
                before, after = self._movers[i].at(times), self._movers[i].at(times + gap_s)
                local = np.einsum("nji,nj->ni", before[:, :3, :3], capture.points_world[rows] - before[:, :3, 3])
                moved = np.einsum("nij,nj->ni", after[:, :3, :3], local) + after[:, :3, 3]
                has_moved = (before != after).any(axis=(1, 2))  # a pause is zero to the last bit
                flow_world[rows] = (moved - capture.points_world[rows]) * has_moved[:, None]
        flow_ego = rotate_vectors(invert(self.world_from_ego(index)), flow_world)
        return PointTruth(flow_ego.astype(np.float32), capture.is_ground)

    def box_at(self, mover_index: int, time_s: float) -> Float64Array:
        """Return the (7,) world box of a road user ``time_s`` after the first stamp."""
        pose = self._movers[mover_index].at(np.array([time_s]))[0]
        length, width, height = self.scene.movers[mover_index].shape.size_m
        yaw = float(wrap_angle(np.arctan2(pose[1, 0], pose[0, 0])))
        return np.array([*pose[:2, 3], pose[2, 3] + height / 2, length, width, height, yaw])

    def object_index(self, index: int) -> Int64Array:
        """Return (N,) the row of ``scene.movers`` each point of sweep ``index`` lies on, -1 for the rest."""
        return self._capture(index).object_index

    def _time_s(self, index: int) -> float:
        if not 0 <= index < len(self.timestamps_ns):
            raise InvalidInput(f"sweep {index} is outside {self.uri}: it has {len(self.timestamps_ns)} sweeps")
        return seconds_between(int(self.timestamps_ns[index]), int(self.timestamps_ns[0]))

    def _capture(self, index: int) -> Capture:
        start_s = self._time_s(index)
        if self._latest is None or self._latest[0] != index:
            if self._world is None:
                scene = self.scene
                self._world = RayWorld(scene.ground.mesh(), scene.structures, self._bodies(), scene.ego_parts)
            captures = []
            for k, lidar in enumerate(self._rig):
                rng = np.random.default_rng([self._seed, 0x11DA, index, *([k] if k else [])])
                captures.append(self._world.capture(lidar, k, self._ego.at, start_s, self._period_s, rng))
            self._latest = (index, Capture.merged(captures))
        return self._latest[1]

    def _bodies(self) -> list[tuple[Shape, _Posed]]:
        return [(mover.shape, posed) for mover, posed in zip(self.scene.movers, self._movers, strict=True)]
