"""Argoverse 2 sensor logs: ``sensors/lidar/{timestamp_ns}.feather`` with poses, calibration and annotations beside.

Sweeps are in the ego frame and compensated for ego motion to the time stamp of their file name, which is the START of
the turn: ``offset_ns`` counts from it and is positive (measured on a real log: 2.6 to 106.1 ms at 10 Hz). The world is
the city frame.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Final

import numpy as np
import pyarrow as pa

from labeling.geometry.transforms import invert, rotate_vectors, transform_points
from labeling.readers.files import (
    POSE_TYPES,
    Columns,
    cuboids_of,
    read_columns,
    read_cuboids,
    require_finite_points,
    require_folder,
    transforms_of,
)
from labeling.readers.reader import segment_id_of
from schemas.arrays import Float32Array, Float64Array, Int64Array, UInt8Array
from schemas.errors import InvalidInput, UnreadableSweep
from schemas.frames import Annotations, PointTruth, Sweep

DATASET: Final = "av2"
_POSES: Final = "city_SE3_egovehicle.feather"
_POSE_COLUMNS: Final = {"timestamp_ns": pa.int64(), **POSE_TYPES}
_CALIBRATION: Final = "calibration/egovehicle_SE3_sensor.feather"
_LASERS_PER_LIDAR: Final = 32
_DIRECTIONS: Final = 72  # of 5 degrees
_MIN_PHASE: Final = 0.1  # of a turn, between two lidars that see a place at different times
_NOMINAL_ORIGIN_M: Final = (1.35, 0.0, 1.64)  # of up_lidar in the fleet; stands in for a missing calibration


def open_segment(uri: str) -> "Argoverse2Segment":
    """Open one log folder. Lists sweeps, reads poses and calibration; no points.

    Without a calibration, beams are taken to start at the nominal place on the roof.

    Raises:
        InvalidInput: Not a log folder, no sweeps, or poses that are missing or cover none of the sweeps.

    """
    folder = Path(uri)
    require_folder(folder, DATASET)
    paths = _sweep_paths(folder / "sensors" / "lidar")
    timestamps_ns = np.array(list(paths), dtype=np.int64)
    return Argoverse2Segment(
        uri=uri,
        segment_id=segment_id_of(DATASET, uri),
        timestamps_ns=timestamps_ns,
        folder=folder,
        paths=tuple(paths.values()),
        world_from_ego=_read_poses(folder / _POSES, timestamps_ns),
        sensor_origins_ego=_read_sensor_origins(folder / _CALIBRATION),
    )


@dataclass(eq=False)
class Argoverse2Segment:
    """One log behind the SegmentReader protocol."""

    uri: str
    segment_id: str
    timestamps_ns: Int64Array  # (T,)
    folder: Path
    paths: tuple[Path, ...]  # T
    world_from_ego: dict[int, Float64Array]  # by time stamp, of the sweeps that have a pose
    sensor_origins_ego: Float32Array  # (S, 3)
    dataset: str = DATASET

    def read_sweep(self, index: int) -> Sweep:
        """Read one sweep; raises UnreadableSweep."""
        path, timestamp_ns = self.paths[index], int(self.timestamps_ns[index])
        columns = read_columns(
            path,
            dict.fromkeys("xyz", pa.float32()),
            UnreadableSweep,
            optional={"offset_ns": pa.int64(), "laser_number": pa.int64()},
        )
        points = np.stack([columns[axis] for axis in "xyz"], axis=1)
        require_finite_points(points, path)
        if timestamp_ns not in self.world_from_ego:
            raise UnreadableSweep(f"{path}: {self.folder / _POSES} has no finite pose at {timestamp_ns}")
        offset_ns = columns.get("offset_ns", np.zeros(len(points), np.int64))
        return Sweep(
            index=index,
            timestamp_ns=timestamp_ns,
            points_ego=points,
            capture_offset_s=(offset_ns * 1e-9).astype(np.float32),
            world_from_ego=self.world_from_ego[timestamp_ns],
            sensor_origins_ego=self.sensor_origins_ego,
            scan_of_point=_scan_of_point(points, offset_ns, columns.get("laser_number")),
        )

    def read_annotations(self, index: int) -> Annotations | None:
        """Return the cuboids that carry exactly this sweep's time stamp, None when no row does."""
        if self._cuboids is None:
            return None
        is_here = self._cuboids["timestamp_ns"] == self.timestamps_ns[index]
        return cuboids_of(self._cuboids, is_here) if is_here.any() else None

    def read_annotations_between(self) -> Iterator[tuple[int, Float64Array, Annotations]]:
        """Yield stamp, pose and cuboids of annotated instants whose sweep is not in the folder."""
        if self._cuboids is None:
            return
        annotated_ns = self._cuboids["timestamp_ns"]
        between_ns = np.setdiff1d(annotated_ns, self.timestamps_ns)
        poses = _poses_at(read_columns(self.folder / _POSES, _POSE_COLUMNS, InvalidInput), between_ns)
        for timestamp_ns, pose in sorted(poses.items()):
            yield timestamp_ns, pose, cuboids_of(self._cuboids, annotated_ns == timestamp_ns)

    def read_point_truth(self, index: int) -> PointTruth | None:
        """Return the truth of ``flow_labels.feather``, which belongs to the FIRST sweep of a log.

        Its flow is (where the point is at the next sweep, in the next ego frame) - (where it is now, in this ego
        frame), so it includes ego motion: with T = ego_1 from ego_0, a point p at rest has flow T p - p. What is left
        after taking that away is the object's own motion in the axes of ego_1, turned back to those of ego_0. The
        labels were made with float16 poses: points at rest come out below 1 mm, not at zero.

        Raises:
            InvalidInput: The labels do not fit the sweep.
            UnreadableSweep: The sweep itself cannot be read.

        """
        path = self.folder / "flow_labels.feather"
        if index != 0 or not path.is_file():
            return None
        names = ("flow_tx_m", "flow_ty_m", "flow_tz_m")
        columns = read_columns(path, {**dict.fromkeys(names, pa.float64()), "is_ground_0": pa.bool_()}, InvalidInput)
        sweep = self.read_sweep(0)
        if len(columns["is_ground_0"]) != sweep.num_points:
            raise InvalidInput(
                f"{path}: {len(columns['is_ground_0'])} rows, expected one a point of the log's first sweep "
                f"({sweep.num_points}, {self.paths[0].name})"
            )
        flow_m = np.full((sweep.num_points, 3), np.nan)
        world_from_next = self.world_from_ego.get(int(self.timestamps_ns[1])) if len(self.paths) > 1 else None
        if world_from_next is not None:
            next_from_ego = invert(world_from_next) @ sweep.world_from_ego
            flow_label_m = np.stack([columns[name] for name in names], axis=1)
            points_next = sweep.points_ego + flow_label_m  # where each point goes, in the next ego frame
            flow_next_m = points_next - transform_points(next_from_ego, sweep.points_ego)
            flow_m = rotate_vectors(invert(next_from_ego), flow_next_m)
        return PointTruth(flow_ref_m=flow_m.astype(np.float32), is_ground=columns["is_ground_0"])

    @cached_property
    def _cuboids(self) -> Columns | None:
        return read_cuboids(self.folder / "annotations.feather", "timestamp_ns")


def _scan_of_point(points: Float32Array, offset_ns: Int64Array, laser_number: Int64Array | None) -> UInt8Array | None:
    """Return (N,) the lidar of each point, None when both look the same way at the same time.

    The lidars of the fleet turn half a turn apart: what moves lies at two places of one sweep.
    """
    if laser_number is None or not len(points) or not np.ptp(offset_ns):
        return None
    scan = (laser_number >= _LASERS_PER_LIDAR).astype(np.uint8)
    direction = np.floor(np.arctan2(points[:, 1], points[:, 0]) * (_DIRECTIONS / (2 * np.pi))).astype(np.int64)
    key = (direction + _DIRECTIONS) * 2 + scan
    count = np.bincount(key, minlength=4 * _DIRECTIONS).reshape(-1, 2)
    mean_ns = np.bincount(key, weights=offset_ns, minlength=4 * _DIRECTIONS).reshape(-1, 2) / np.maximum(count, 1)
    apart = np.abs(mean_ns[:, 0] - mean_ns[:, 1])[(count > 0).all(axis=1)] / np.ptp(offset_ns)  # of a turn
    is_apart = len(apart) and np.median(np.minimum(apart, 1 - apart)) > _MIN_PHASE
    return scan if is_apart else None


def _sweep_paths(folder: Path) -> dict[int, Path]:
    paths: dict[int, Path] = {}
    for path in folder.glob("[!.]*.feather"):
        if not path.stem.isdecimal():
            raise InvalidInput(f"{path}: a sweep's name must be its time stamp in nanoseconds")
        if int(path.stem) in paths:
            raise InvalidInput(f"{path}: same time stamp as {paths[int(path.stem)].name}")
        paths[int(path.stem)] = path
    if not paths:
        raise InvalidInput(f"{folder}: no sweeps, expected files {{timestamp_ns}}.feather")
    return dict(sorted(paths.items()))


def _read_poses(path: Path, timestamps_ns: Int64Array) -> dict[int, Float64Array]:
    columns = read_columns(path, _POSE_COLUMNS, InvalidInput)
    poses = _poses_at(columns, timestamps_ns)
    if not poses:
        known_ns = columns["timestamp_ns"]
        known = f"lie in {known_ns.min()} to {known_ns.max()}" if len(known_ns) else "are none"
        raise InvalidInput(
            f"{path}: poses do not cover the sweeps: no finite pose at any sweep's time stamp; poses {known}, "
            f"sweeps in {timestamps_ns[0]} to {timestamps_ns[-1]} ns; files of another log?"
        )
    return poses


def _poses_at(columns: Columns, timestamps_ns: Int64Array) -> dict[int, Float64Array]:
    """Return the finite poses at these time stamps."""
    poses = transforms_of(columns)
    is_wanted = np.isin(columns["timestamp_ns"], timestamps_ns) & np.isfinite(poses).all(axis=(1, 2))
    return dict(zip(columns["timestamp_ns"][is_wanted].tolist(), poses[is_wanted], strict=True))


def _read_sensor_origins(path: Path) -> Float32Array:
    if path.is_file():
        columns = read_columns(path, {"sensor_name": pa.string(), **POSE_TYPES}, InvalidInput)
        is_lidar = np.isin(columns["sensor_name"].astype(str), ["up_lidar", "down_lidar"])
        origins = transforms_of(columns)[is_lidar, :3, 3]
        if not np.isfinite(origins).all():
            raise InvalidInput(f"{path}: a lidar's place is NaN or infinite")
        if len(origins):
            return origins.astype(np.float32)
    return np.array([_NOMINAL_ORIGIN_M], dtype=np.float32)
