"""Waymo Open Dataset v2: a Parquet file for each component and segment, ``{root}/{component}/{context}.parquet``.

A segment is called by its file of component ``lidar``; the other components lie beside that folder. The ego frame is
Waymo's vehicle frame, the world its global frame.

A frame has five lidars and two returns of each, as range images. Points come laser by laser (TOP, FRONT, SIDE_LEFT,
SIDE_RIGHT, REAR), of each the first return and then the second, row by row from the top beam; pixels without a return
are no points. Each pixel of TOP has a pose of the vehicle: its points are carried from there to the frame's pose. Of
the other lasers the format gives places in the frame of the vehicle as they are.

A frame's time stamp is when the turn of TOP begins, while its pose is about that of the middle of the turn, half a turn
later (Waymo's dataset.proto). Sweeps have the time stamp, and capture times count from the instant of the pose, so all
times of a segment are about 50 ms early alike. When a column of TOP is captured is told by the poses of its pixels
in the frames where the vehicle drives fastest; a vehicle that stands tells nothing, and capture times are zero then, as
they are for the lasers without such poses.
"""

import contextlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Final

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from scipy.spatial.transform import Rotation

from labeling.geometry.transforms import invert, transform_points, wrap_angle
from labeling.readers.files import read_file, require_finite_points
from labeling.readers.range_images import FRAME, LASER, Laser, RangeImages, Turn, damaged_is, fit_turn, require_columns
from labeling.readers.reader import READERS, SegmentReader, digest_of, segment_id_of
from labeling.storage import places
from labeling.storage.storage import Storage, open_storage
from schemas.arrays import Float32Array, Float64Array, Int64Array
from schemas.errors import InvalidInput, UnreadableSweep
from schemas.frames import Annotations, Sweep
from schemas.listing import SegmentListing

DATASET: Final = "wod"
_LIDAR: Final = "lidar"
_LIDAR_POSE: Final = "lidar_pose"
_VEHICLE_POSE: Final = "vehicle_pose"
_LIDAR_BOX: Final = "lidar_box"
_CALIBRATION: Final = READERS[DATASET].layout

_RETURNS: Final = ("[LiDARComponent].range_image_return1", "[LiDARComponent].range_image_return2")
_PIXEL_POSES: Final = "[LiDARPoseComponent].range_image_return1"
_WORLD_FROM_VEHICLE: Final = "[VehiclePoseComponent].world_from_vehicle.transform"
_EXTRINSIC: Final = "[LiDARCalibrationComponent].extrinsic.transform"
_INCLINATION: Final = "[LiDARCalibrationComponent].beam_inclination."
_OBJECT: Final = "key.laser_object_id"
_TYPE: Final = "[LiDARBoxComponent].type"
_BOX_PARTS: Final = ("center.x", "center.y", "center.z", "size.x", "size.y", "size.z", "heading")  # as a box of ours
_BOX: Final = tuple(f"[LiDARBoxComponent].box.{part}" for part in _BOX_PARTS)
_NUMBERS: Final = pa.list_(pa.float64())
_CALIBRATION_TYPES: Final = {
    LASER: pa.int64(),
    _EXTRINSIC: _NUMBERS,
    _INCLINATION + "min": pa.float64(),
    _INCLINATION + "max": pa.float64(),
    _INCLINATION + "values": _NUMBERS,
}
_BESIDE: Final = f"; a segment has one in each of {_LIDAR}, {_LIDAR_POSE}, {_CALIBRATION}, {_VEHICLE_POSE}"
_TYPES: Final = ("UNKNOWN", "VEHICLE", "PEDESTRIAN", "SIGN", "CYCLIST")

_TOP: Final = 1
_IMAGE_CHANNELS: Final = 4  # range in m, intensity, elongation, whether in a zone without labels
_POSE_CHANNELS: Final = 6  # roll, pitch, yaw in rad, x, y, z in m
_MAX_PLACE_M: Final = 1e9  # from the origin of any frame
_LATEST_MICROS: Final = 2**63 // 1000
_NUM_TURNS: Final = 5  # that tell when columns are captured; a jump of poses spoils two
_MIN_SPEED_MPS: Final = 1.0  # poses to the millimetre tell times to the millisecond


def list_segment(uri: str) -> SegmentListing:
    """List the frames of a segment: those of component ``lidar`` and those that have a pose.

    Raises:
        InvalidInput: Not the file of a segment, a component is missing or broken, or poses are of other frames.

    """
    storage, context = _open(uri)
    images, poses = RangeImages(storage, _path(_LIDAR, context), _RETURNS[:1], _BESIDE), _read_poses(storage, context)
    if not images.frames & poses.keys():
        known = f"lie in {min(poses)} to {max(poses)}" if poses else "are none"
        frames = f"lie in {min(images.frames)} to {max(images.frames)}" if images.frames else "are none"
        raise InvalidInput(
            f"{storage.place(_path(_VEHICLE_POSE, context))}: poses do not cover the sweeps: poses {known}, frames of "
            f"{uri} {frames} us; a file of another segment?"
        )
    frames_us = np.array(sorted(images.frames | poses.keys()), dtype=np.int64)
    if frames_us[0] < 0 or frames_us[-1] >= _LATEST_MICROS:
        raise InvalidInput(f"{uri}: frames lie in {frames_us[0]} to {frames_us[-1]}: expected microseconds since 1970")
    files = [storage.place(_path(component, context)) for component in (_VEHICLE_POSE, _CALIBRATION)]
    common = tuple((place, digest_of(place)) for place in files)
    return SegmentListing(DATASET, uri, segment_id_of(DATASET, uri), frames_us * 1000, common=common)


def read_segment(listing: SegmentListing) -> "WaymoSegment":
    """Read poses, calibration and where the rows of each frame are; no points.

    Raises:
        InvalidInput: A component is missing or broken.

    """
    storage, context = _open(listing.uri)
    return WaymoSegment(
        listing,
        storage,
        context,
        RangeImages(storage, _path(_LIDAR, context), _RETURNS[:1], _BESIDE),
        RangeImages(storage, _path(_LIDAR_POSE, context), [_PIXEL_POSES], _BESIDE),
        _read_poses(storage, context),
        _read_lasers(storage, context),
    )


@dataclass(eq=False)
class WaymoSegment(SegmentReader):
    """One segment behind the SegmentReader protocol."""

    listing: SegmentListing
    storage: Storage
    context: str
    images: RangeImages
    pixel_poses: RangeImages
    world_from_ego: dict[int, Float64Array]  # by frame, us
    lasers: dict[int, Laser]

    def read_sweep(self, index: int) -> Sweep:
        """Read one sweep; raises UnreadableSweep."""
        frame = int(self.timestamps_ns[index]) // 1000
        if frame not in self.world_from_ego:
            place = self.storage.place(_path(_VEHICLE_POSE, self.context))
            raise UnreadableSweep(f"{place}: no finite pose of frame {frame}")
        images = self.images.read(frame, list(self.lasers), _RETURNS, _IMAGE_CHANNELS)
        points, offsets_s, lidar_of_point = [], [], []
        for number, name in enumerate(self.lasers):
            poses = self._read_pixel_poses(frame) if name == _TOP else None
            for image in images[name]:
                returns, times_s = self._points_of(image, name, frame, poses)
                points.append(returns)
                offsets_s.append(times_s)
                lidar_of_point.append(np.full(len(returns), number, dtype=np.uint8))
        with np.errstate(over="ignore"):  # infinity is what is looked for
            points_ego = np.concatenate([np.zeros((0, 3)), *points]).astype(np.float32)
        require_finite_points(points_ego, f"{self.images.place}: frame {frame}")
        return Sweep(
            index=index,
            timestamp_ns=int(self.timestamps_ns[index]),
            points_ego=points_ego,
            capture_offset_s=np.concatenate(offsets_s).astype(np.float32),
            world_from_ego=self.world_from_ego[frame],
            sensor_origins_ego=np.array([a.ego_from_lidar[:3, 3] for a in self.lasers.values()], dtype=np.float32),
            lidar_of_point=np.concatenate(lidar_of_point),
        )

    def read_annotations(self, index: int) -> Annotations | None:
        """Return the cuboids of component ``lidar_box``, None without that component.

        It speaks for all frames: one without rows holds no objects.
        """
        if self._cuboids is None:
            return None
        frames, ids, categories, boxes = self._cuboids
        rows = np.flatnonzero(frames == self.timestamps_ns[index] // 1000)
        return Annotations(tuple(ids[row] for row in rows), tuple(categories[row] for row in rows), boxes[rows])

    def _read_pixel_poses(self, frame: int) -> Float64Array:
        """Return (H, W, 6) poses of the vehicle at the pixels of TOP."""
        images = self.pixel_poses.read(frame, [_TOP], [_PIXEL_POSES], _POSE_CHANNELS)
        return images[_TOP][0].astype(np.float64)

    def _points_of(
        self, image: Float32Array, name: int, frame: int, poses: Float64Array | None
    ) -> tuple[Float64Array, Float64Array]:
        """Return the (N, 3) returns of an image at the frame's pose, and when they were captured after it."""
        laser, what = self.lasers[name], f"{self.images.place}: frame {frame}, laser {name}"
        if laser.inclinations_rad is not None and len(laser.inclinations_rad) != len(image):
            raise UnreadableSweep(f"{what}: {len(image)} rows, but {len(laser.inclinations_rad)} beams are calibrated")
        num_bad = int((~np.isfinite(image[..., 0])).sum())
        if num_bad:
            raise UnreadableSweep(f"{what}: {num_bad} of {image[..., 0].size} ranges are NaN or infinite")
        points, rows, columns = laser.points_ego(image[..., 0])
        if poses is None:
            return points, np.zeros(len(points))
        if poses.shape[:2] != image.shape[:2]:
            raise UnreadableSweep(f"{what}: an image of {image.shape[:2]} pixels, but {poses.shape[:2]} have a pose")
        poses = poses[rows, columns]
        num_bad = int((~(np.isfinite(poses).all(axis=1) & poses.any(axis=1))).sum())
        if num_bad:
            raise UnreadableSweep(f"{what}: {num_bad} of {len(points)} returns have no finite pose in {_LIDAR_POSE}")
        points_world = Rotation.from_euler("ZYX", poses[:, 2::-1]).apply(points) + poses[:, 3:]
        points = transform_points(invert(self.world_from_ego[frame]), points_world)
        return points, self._turn.times_s(columns)

    @cached_property
    def _turn(self) -> Turn:
        """When TOP looks: the median of what the fastest frames tell, for a jump of poses is fast, too."""
        frames = np.array([us for us in (self.timestamps_ns // 1000).tolist() if us in self.world_from_ego])
        if len(frames) < 2:
            return Turn()
        places_m = np.array([self.world_from_ego[frame][:3, 3] for frame in frames.tolist()])
        velocities_mps = np.gradient(places_m, (frames - frames[0]) * 1e-6, axis=0)
        speeds_mps = np.linalg.norm(velocities_mps, axis=1)
        turns: list[tuple[float, float]] = []
        for row in np.argsort(-speeds_mps, kind="stable"):
            if speeds_mps[row] < _MIN_SPEED_MPS or len(turns) == _NUM_TURNS:
                break
            with contextlib.suppress(UnreadableSweep):
                poses, pose = self._read_pixel_poses(int(frames[row])), self.world_from_ego[int(frames[row])]
                turn = fit_turn(poses, pose, velocities_mps[row])
                turns.append((turn.first_s, turn.step_s))
        return Turn(*np.median(turns, axis=0).tolist()) if turns else Turn()

    @cached_property
    def _cuboids(self) -> tuple[Int64Array, list[str], list[str], Float64Array] | None:
        """Frames, object ids, categories and (R, 7) boxes of all rows."""
        path = _path(_LIDAR_BOX, self.context)
        if self.storage.size(path) is None:
            return None
        types = {FRAME: pa.int64(), _OBJECT: pa.string(), _TYPE: pa.int64(), **dict.fromkeys(_BOX, pa.float64())}
        rows = _read_rows(self.storage, path, types)
        boxes = np.array([[row[name] for name in _BOX] for row in rows], dtype=np.float64).reshape(-1, 7)
        is_whole = np.array([None not in row.values() for row in rows], dtype=bool) & np.isfinite(boxes).all(axis=1)
        is_bad = ~(is_whole & (boxes[:, 3:6] > 0).all(axis=1))
        if is_bad.any():
            place, row_at_fault = self.storage.place(path), int(is_bad.argmax())
            raise InvalidInput(
                f"{place}: row {row_at_fault}: a box needs an object, finite numbers and sizes above zero"
            )
        boxes[:, 6] = wrap_angle(boxes[:, 6])
        categories = [_TYPES[row[_TYPE]] if row[_TYPE] in range(len(_TYPES)) else _TYPES[0] for row in rows]
        return (
            np.array([row[FRAME] for row in rows], dtype=np.int64),
            [row[_OBJECT] for row in rows],
            categories,
            boxes,
        )


def _open(uri: str) -> tuple[Storage, str]:
    """Return the storage of all components, and the name of the segment's files."""
    folder, context = places.split(uri)
    root, component = places.split(folder)
    if component == _LIDAR and context.endswith(".parquet"):
        return open_storage(root), context
    storage = open_storage(uri)
    files = storage.list_files("" if context == _LIDAR else _LIDAR)
    first = min((path for path in files if path.endswith(".parquet")), default=None)
    hint = f"; it holds such segments: pass one of them, as {storage.place(first)}" if first else ""
    raise InvalidInput(f"{uri}: expected a segment of dataset {DATASET}, as ROOT/{_LIDAR}/CONTEXT.parquet{hint}")


def segments_in(storage: Storage, folder: str) -> Iterator[str]:
    """Yield the paths of the segments whose components lie in a folder."""
    return (path for path in storage.list_files(f"{folder}/{_LIDAR}".lstrip("/")) if path.endswith(".parquet"))


def _path(component: str, context: str) -> str:
    return f"{component}/{context}"


def _read_rows(storage: Storage, path: str, types: Mapping[str, pa.DataType]) -> list[Mapping[str, Any]]:
    """Return the rows of a small file, which is read whole, with columns cast to the types asked for."""
    place = storage.place(path)
    content = read_file(storage, path, InvalidInput, _BESIDE)
    with damaged_is(InvalidInput, place):
        file = pq.ParquetFile(pa.BufferReader(content))
        require_columns(place, file.schema_arrow.names, list(types))
        table = file.read(columns=list(types), use_threads=False).select(list(types))
        rows: list[Mapping[str, Any]] = table.cast(pa.schema(list(types.items()))).to_pylist()
    return rows


def _read_poses(storage: Storage, context: str) -> dict[int, Float64Array]:
    """Return the finite (4, 4) poses by frame."""
    types = {FRAME: pa.int64(), _WORLD_FROM_VEHICLE: _NUMBERS}
    poses = {}
    for row in _read_rows(storage, _path(_VEHICLE_POSE, context), types):
        pose = _transform(row[_WORLD_FROM_VEHICLE])
        if pose is not None and row[FRAME] is not None:
            poses[int(row[FRAME])] = pose
    return poses


def _read_lasers(storage: Storage, context: str) -> dict[int, Laser]:
    """Return the calibrated lasers by number, ascending."""
    path = _path(_CALIBRATION, context)
    place = storage.place(path)
    lasers = {}
    for row in _read_rows(storage, path, _CALIBRATION_TYPES):
        extrinsic, given = _transform(row[_EXTRINSIC]), row[_INCLINATION + "values"]
        limits_rad = np.array([row[_INCLINATION + end] for end in ("min", "max")], dtype=np.float64)  # None becomes NaN
        beams_rad = np.array(given, dtype=np.float64) if given else None
        if (
            row[LASER] is None
            or extrinsic is None
            or not np.isfinite(limits_rad if beams_rad is None else beams_rad).all()
        ):
            raise InvalidInput(f"{place}: laser {row[LASER]}: expected 16 numbers that place it, and its beams")
        lasers[row[LASER]] = Laser(extrinsic, (float(limits_rad[0]), float(limits_rad[1])), beams_rad)
    if _TOP not in lasers:
        raise InvalidInput(f"{place}: no laser {_TOP} (TOP); it has {sorted(lasers) or 'none'}")
    return dict(sorted(lasers.items()))


def _transform(numbers: Sequence[float] | None) -> Float64Array | None:
    """Return the rigid (4, 4) of 16 numbers row by row, None when they are none."""
    if numbers is None or len(numbers) != 16:
        return None
    transform = np.array(numbers, dtype=np.float64).reshape(4, 4)
    rotation = transform[:3, :3]
    is_rigid = (np.abs(transform) < _MAX_PLACE_M).all() and np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-3)
    return transform if is_rigid else None
