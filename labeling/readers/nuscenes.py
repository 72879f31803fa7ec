"""nuScenes scenes, ``{root}/{version}/{scene}``, as ``nuscenes/v1.0-mini/scene-0061``.

The version's folder holds the tables, the root the sweeps; a scene is no folder, but a row of ``scene.json``. All
sweeps of LIDAR_TOP are read, about 20 a second, key frames and those between. The ego frame is nuScenes' ego vehicle
frame, the world its global frame, in which the ego vehicle is always at height zero. Each sweep has its own pose.

A sweep's time stamp is when its turn is over, and its points are compensated for ego motion to then (its makers in
forum.nuscenes.org, topic 245). Its rows are the firings of an HDL-32E one after the other, all 32 rings of each
(measured on a real sweep), so capture times count back from the stamp, a firing cycle each; they are zero where rings
are in another order.

Objects are annotated in key frames, twice a second. Between two key frames that both have an object its box is
interpolated, for evaluation only.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from typing import Final

import numpy as np
from pydantic import TypeAdapter, ValidationError

from labeling.geometry.boxes import transform_boxes
from labeling.geometry.times import seconds_between
from labeling.geometry.transforms import invert, rotation_from_quaternion, transform_points, wrap_angle, yaw_of
from labeling.readers.files import read_file, require_finite_points
from labeling.readers.json_tables import Record, RecordT, Span, find_records
from labeling.readers.reader import SegmentReader, segment_id_of
from labeling.storage import places
from labeling.storage.storage import Storage, open_storage
from schemas.arrays import Float32Array, Float64Array, Int64Array
from schemas.errors import InvalidInput, UnreadableSweep, quote
from schemas.frames import Annotations, Sweep
from schemas.listing import SegmentListing

DATASET: Final = "nuscenes"
_CHANNEL: Final = "LIDAR_TOP"
_COLUMNS: Final = 5  # float32 x, y, z, intensity, ring
_RINGS: Final = 32
_FIRING_CYCLE_S: Final = 46.08e-6  # of all rings once; Velodyne HDL-32E user's manual
_MAX_PLACE_M: Final = 1e9  # from the origin of any frame
_LATEST_MICROS: Final = 2**63 // 1000

_Vector = tuple[float, float, float]
_Quaternion = tuple[float, float, float, float]  # w, x, y, z


class _Scene(Record):
    token: str
    name: str


class _Sample(Record):
    token: str
    timestamp: int  # us


class _Sensor(Record):
    token: str
    channel: str


class _Placed(Record):
    """A pose in another frame: row of calibrated_sensor or ego_pose."""

    token: str
    translation: _Vector
    rotation: _Quaternion


class _SampleData(Record):
    calibrated_sensor_token: str
    ego_pose_token: str
    filename: str
    timestamp: int  # us


class _Annotation(Record):
    sample_token: str
    instance_token: str
    translation: _Vector  # of the centre, global frame
    size: _Vector  # width, length, height
    rotation: _Quaternion


class _Instance(Record):
    token: str
    category_token: str


class _Category(Record):
    token: str
    name: str


def list_segment(uri: str) -> SegmentListing:
    """Find the sweeps of a scene and where their poses stand: the tables are searched here, and not again.

    Raises:
        InvalidInput: Not a scene, a table is missing or broken, or the scene has no sweeps.

    """
    storage, version, name = _open(uri)
    samples = _find_samples(storage, version, name)
    sensors = {row.token for row in _read_table(storage, f"{version}/sensor.json", _Sensor) if row.channel == _CHANNEL}
    lidars = {
        row.token: span
        for span, row in find_records(storage, f"{version}/calibrated_sensor.json", _Placed, "sensor_token", sensors)
    }
    table = f"{version}/sample_data.json"
    found = find_records(storage, table, _SampleData, "sample_token", set(samples))
    sweeps = sorted((row for _, row in found if row.calibrated_sensor_token in lidars), key=lambda row: row.timestamp)
    _check(storage.place(table), uri, sweeps)
    poses = _find_poses(storage, version, {row.ego_pose_token for row in sweeps})
    names = (
        *(row.filename for row in sweeps),
        *(str(poses.get(row.ego_pose_token, "")) for row in sweeps),
        str(lidars[sweeps[0].calibrated_sensor_token]),
    )
    stamps_ns = np.array([row.timestamp for row in sweeps], dtype=np.int64) * 1000
    return SegmentListing(DATASET, uri, segment_id_of(DATASET, uri), stamps_ns, names)


def read_segment(listing: SegmentListing) -> "NuscenesSegment":
    """Read where the lidar is; no points.

    Raises:
        InvalidInput: Its calibration has changed or cannot be read.

    """
    storage, version, name = _open(listing.uri)
    span = Span.parse(listing.names[-1])
    ego_from_lidar = _transform(span.read(storage, _Placed, InvalidInput))
    if not np.isfinite(ego_from_lidar).all():
        raise InvalidInput(f"{storage.place(span.path)}: byte {span.start}: this is no place of {_CHANNEL}")
    return NuscenesSegment(listing, storage, version, name, ego_from_lidar)


def segments_in(storage: Storage, folder: str) -> Iterator[str]:
    """Yield the paths of the scenes of all versions whose tables lie in a folder.

    Raises:
        InvalidInput: A version's ``scene.json`` is no such table.

    """
    for version in storage.list_folders(folder):
        if storage.size(f"{version}/scene.json") is not None:
            for scene in _read_table(storage, f"{version}/scene.json", _Scene):
                yield f"{version}/{scene.name}"


@dataclass(frozen=True, slots=True, eq=False)
class _Object:
    """The boxes of one instance, one a key frame, ascending."""

    category: str
    key_frame: Int64Array  # (K,) position among the scene's key frames
    boxes_world: Float64Array  # (K, 7)


@dataclass(eq=False)
class NuscenesSegment(SegmentReader):
    """One scene behind the SegmentReader protocol."""

    listing: SegmentListing
    storage: Storage
    version: str
    scene: str  # its name
    ego_from_lidar: Float64Array  # (4, 4)

    def read_sweep(self, index: int) -> Sweep:
        """Read one sweep; raises UnreadableSweep."""
        points, offset_s = _read_points(self.storage, self.listing.names[index])
        with np.errstate(over="ignore"):  # infinity is what is looked for
            points_ego = transform_points(self.ego_from_lidar, points).astype(np.float32)
        require_finite_points(points_ego, self.storage.place(self.listing.names[index]))
        return Sweep(
            index=index,
            timestamp_ns=int(self.timestamps_ns[index]),
            points_ego=points_ego,
            capture_offset_s=offset_s,
            world_from_ego=self._read_pose(index),
            sensor_origins_ego=self.ego_from_lidar[None, :3, 3].astype(np.float32),
            lidar_of_point=np.zeros(len(points), dtype=np.uint8),
        )

    def read_annotations(self, index: int) -> Annotations | None:
        """Return the cuboids at a sweep's time stamp; None before the first key frame, after the last, without a pose.

        An object that only one of the two key frames about a sweep has is left out.
        """
        key_frames_ns, objects = self._annotated
        timestamp_ns = int(self.timestamps_ns[index])
        if not objects or not key_frames_ns[0] <= timestamp_ns <= key_frames_ns[-1]:
            return None
        try:
            ego_from_world = invert(self._read_pose(index))
        except UnreadableSweep:
            return None
        after = int(np.searchsorted(key_frames_ns, timestamp_ns))  # the first key frame that is not before the sweep
        before = after if key_frames_ns[after] == timestamp_ns else after - 1
        gap_s = seconds_between(int(key_frames_ns[after]), int(key_frames_ns[before]))
        share = seconds_between(timestamp_ns, int(key_frames_ns[before])) / gap_s if gap_s else 0.0
        boxes = {name: _box_between(one, before, after, share) for name, one in objects.items()}
        names = [name for name, box in boxes.items() if box is not None]
        boxes_world = np.array([boxes[name] for name in names], dtype=np.float64).reshape(-1, 7)
        categories = tuple(objects[name].category for name in names)
        return Annotations(tuple(names), categories, transform_boxes(ego_from_world, boxes_world))

    def _read_pose(self, index: int) -> Float64Array:
        name = self.listing.names[len(self.timestamps_ns) + index]
        if not name:
            table = self.storage.place(f"{self.version}/ego_pose.json")
            raise UnreadableSweep(f"{table}: no pose of {self.listing.names[index]}")
        span = Span.parse(name)
        pose = _transform(span.read(self.storage, _Placed))
        if not np.isfinite(pose).all():
            raise UnreadableSweep(f"{self.storage.place(span.path)}: byte {span.start}: this is no pose")
        return pose

    @cached_property
    def _annotated(self) -> tuple[Int64Array, dict[str, _Object]]:
        """Time stamps of the key frames, and all objects by instance; the large table is searched for them once."""
        table = f"{self.version}/sample_annotation.json"
        if self.storage.size(table) is None:
            return np.zeros(0, np.int64), {}
        samples = _find_samples(self.storage, self.version, self.scene)
        order = sorted(samples, key=lambda token: samples[token])
        position = {token: k for k, token in enumerate(order)}
        rows: dict[str, list[_Annotation]] = {}
        for span, row in find_records(self.storage, table, _Annotation, "sample_token", set(samples)):
            if min(row.size) <= 0 or not any(row.rotation):
                place = f"{self.storage.place(table)}: byte {span.start}"
                raise InvalidInput(f"{place}: a box needs a rotation and sizes above zero")
            rows.setdefault(row.instance_token, []).append(row)
        categories = self._categories(set(rows))
        objects = {}
        for name, boxes in sorted(rows.items()):
            boxes.sort(key=lambda row: position[row.sample_token])
            key_frame = np.array([position[row.sample_token] for row in boxes], dtype=np.int64)
            objects[name] = _Object(categories.get(name, ""), key_frame, np.array([_box(row) for row in boxes]))
        return np.array([samples[token] for token in order], dtype=np.int64) * 1000, objects

    def _categories(self, instances: set[str]) -> dict[str, str]:
        names = {row.token: row.name for row in _read_table(self.storage, f"{self.version}/category.json", _Category)}
        found = find_records(self.storage, f"{self.version}/instance.json", _Instance, "token", instances)
        return {row.token: names.get(row.category_token, "") for _, row in found}


def _box(row: _Annotation) -> list[float]:
    width, length, height = row.size
    turn = np.eye(4)
    turn[:3, :3] = rotation_from_quaternion(*np.array([row.rotation]).T)[0]
    return [*row.translation, length, width, height, yaw_of(turn)]


def _box_between(one: _Object, before: int, after: int, share: float) -> Float64Array | None:
    """Return the (7,) box ``share`` of the way between two key frames; None unless both have one."""
    rows = np.searchsorted(one.key_frame, [before, after])
    if rows[1] >= len(one.key_frame) or (one.key_frame[rows] != [before, after]).any():
        return None
    first, last = one.boxes_world[rows]
    step = last - first
    step[6] = wrap_angle(step[6])  # the short way round
    box: Float64Array = first + share * step
    return np.append(box[:6], wrap_angle(box[6]))


def _read_points(storage: Storage, path: str) -> tuple[Float32Array, Float32Array]:
    """Return (N, 3) points in the frame of the lidar and (N,) capture times after the stamp."""
    place, content = storage.place(path), read_file(storage, path, UnreadableSweep)
    if len(content) % (4 * _COLUMNS):
        raise UnreadableSweep(f"{place}: {len(content)} bytes are not whole points of {4 * _COLUMNS} bytes, truncated?")
    rows = np.frombuffer(content, dtype="<f4").reshape(-1, _COLUMNS).astype(np.float32)
    cycles: Int64Array = np.zeros(len(rows), dtype=np.int64)
    if len(rows) % _RINGS == 0 and (rows[:, 4].reshape(-1, _RINGS) == np.arange(_RINGS)).all():
        cycles = np.repeat(np.arange(1 - len(rows) // _RINGS, 1), _RINGS)
    return rows[:, :3], (cycles * _FIRING_CYCLE_S).astype(np.float32)


def _open(uri: str) -> tuple[Storage, str, str]:
    """Return the storage of the data set, the version's folder in it, and the name of the scene."""
    folder, name = places.split(uri)
    root, version = places.split(folder)
    storage = open_storage(root)
    if not version or storage.size(f"{version}/scene.json") is None:
        tables = next((inner for inner in ("", "/v1.0-mini") if open_storage(uri + inner).size("scene.json")), None)
        hint = "" if tables is None else f"; its scenes are called as {uri}{tables}/scene-0061"
        raise InvalidInput(f"{uri}: expected a scene of dataset {DATASET}, as ROOT/v1.0-mini/scene-0061{hint}")
    return storage, version, name


def _read_table(storage: Storage, path: str, model: type[RecordT]) -> list[RecordT]:
    """Return all rows of a small table."""
    content = read_file(storage, path, InvalidInput)
    try:
        return TypeAdapter(list[model]).validate_json(content)  # type: ignore[valid-type]
    except ValidationError as problem:
        first = problem.errors()[0]
        where = ".".join(map(str, first["loc"])) or "table"
        raise InvalidInput(f"{storage.place(path)}: {where}: {first['msg']}") from None


def _find_samples(storage: Storage, version: str, scene: str) -> dict[str, int]:
    """Return the time stamps of a scene's key frames by their tokens, us; it is called by its name."""
    table = f"{version}/scene.json"
    scenes = {row.name: row.token for row in _read_table(storage, table, _Scene)}
    if scene not in scenes:
        known = f"it has {len(scenes)}, from {min(scenes)} to {max(scenes)}" if scenes else "it has none"
        raise InvalidInput(f"{storage.place(table)}: no scene {quote(scene)}; {known}")
    rows = find_records(storage, f"{version}/sample.json", _Sample, "scene_token", {scenes[scene]})
    return {row.token: row.timestamp for _, row in rows}


def _find_poses(storage: Storage, version: str, tokens: set[str]) -> dict[str, Span]:
    """Return where poses stand in their table, which is read as far as the last of them."""
    poses: dict[str, Span] = {}
    for span, row in find_records(storage, f"{version}/ego_pose.json", _Placed, "token", tokens):
        poses[row.token] = span
        if len(poses) == len(tokens):
            break
    return poses


def _check(place: str, uri: str, sweeps: list[_SampleData]) -> None:
    if not sweeps:
        raise InvalidInput(f"{place}: no sweeps of {_CHANNEL} in {uri}")
    if len({row.calibrated_sensor_token for row in sweeps}) > 1:
        raise InvalidInput(f"{place}: sweeps of {uri} have several calibrations, expected one a scene")
    if sweeps[0].timestamp < 0 or sweeps[-1].timestamp >= _LATEST_MICROS:
        raise InvalidInput(f"{place}: time stamps of {uri} lie in {sweeps[0].timestamp} to {sweeps[-1].timestamp} us")
    for row, following in pairwise(sweeps):
        if row.timestamp == following.timestamp:
            raise InvalidInput(f"{place}: {following.filename}: same time stamp as {row.filename}")
    for row in sweeps:
        if row.filename.startswith("/") or ".." in row.filename.split("/"):
            raise InvalidInput(f"{place}: {quote(row.filename)}: expected a path below the folder of the data set")


def _transform(row: _Placed) -> Float64Array:
    """Return (4, 4), NaN where the rotation is none or the place is none on Earth."""
    transform = np.eye(4)
    transform[:3, :3] = rotation_from_quaternion(*np.array([row.rotation]).T)[0]
    transform[:3, 3] = np.where(np.abs(row.translation) < _MAX_PLACE_M, row.translation, np.nan)
    return transform
