"""Argoverse 2 sensor logs: ``sensors/lidar/{timestamp_ns}.feather`` with poses, calibration and annotations beside.

Sweeps are in the ego frame and compensated for ego motion to the time stamp of their file name, which is the START of
the turn: ``offset_ns`` counts from it and is positive (measured on a real log: 2.6 to 106.1 ms at 10 Hz). The world is
the city frame.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import Final

import numpy as np
import pyarrow as pa

from labeling.geometry.transforms import invert, rotate_vectors, transform_points, yaw_translation
from labeling.readers.files import (
    POSE_TYPES,
    Columns,
    cuboids_of,
    open_folder,
    read_columns,
    read_cuboids,
    require_finite_points,
    transforms_of,
)
from labeling.readers.reader import READERS, SegmentReader, digest_of, segment_id_of
from labeling.storage.storage import Storage, open_storage
from schemas.arrays import Float32Array, Float64Array, Int64Array
from schemas.errors import InvalidInput, UnreadableSweep
from schemas.frames import Annotations, PointTruth, Sweep
from schemas.listing import SegmentListing

DATASET: Final = "av2"
_SWEEPS: Final = READERS[DATASET].layout
_POSES: Final = "city_SE3_egovehicle.feather"
_POSE_COLUMNS: Final = {"timestamp_ns": pa.int64(), **POSE_TYPES}
_FLOW: Final = "flow_labels.feather"
_CALIBRATION: Final = "calibration/egovehicle_SE3_sensor.feather"
_LASERS_PER_LIDAR: Final = 32
_LIDARS: Final = ("up_lidar", "down_lidar")
_NOMINAL_ORIGIN_M: Final = (1.35, 0.0, 1.64)  # of up_lidar in the fleet; stands in for a missing calibration


def list_segment(uri: str) -> SegmentListing:
    """List the sweeps of a log.

    Raises:
        InvalidInput: Not a log folder, or no sweeps.

    """
    storage = open_folder(uri, DATASET)
    names = _names_by_stamp(storage)
    stamps = np.array(list(names), dtype=np.int64)
    common = tuple((place, digest_of(place)) for place in map(storage.place, (_POSES, _CALIBRATION)))
    return SegmentListing(DATASET, uri, segment_id_of(DATASET, uri), stamps, tuple(names.values()), common)


def read_segment(listing: SegmentListing) -> "Argoverse2Segment":
    """Read poses and calibration of a listed log; no points.

    Without a calibration, beams are taken to start at the nominal place on the roof.

    Raises:
        InvalidInput: Poses are missing or cover none of the sweeps.

    """
    storage = open_storage(listing.uri)
    return Argoverse2Segment(listing, storage, _read_poses(storage, listing.timestamps_ns), _read_lidars(storage))


@dataclass(eq=False)
class Argoverse2Segment(SegmentReader):
    """One log behind the SegmentReader protocol."""

    listing: SegmentListing
    storage: Storage
    world_from_ego: dict[int, Float64Array]  # by time stamp, of the sweeps that have a pose
    ego_from_lidar: Float64Array  # (2, 4, 4)

    def read_sweep(self, index: int) -> Sweep:
        """Read one sweep; raises UnreadableSweep."""
        path, timestamp_ns = self.listing.names[index], int(self.timestamps_ns[index])
        place = self.storage.place(path)
        points, columns = _read_points(self.storage, path)
        if timestamp_ns not in self.world_from_ego:
            raise UnreadableSweep(f"{place}: {self.storage.place(_POSES)} has no finite pose at {timestamp_ns}")
        offset_ns = columns.get("offset_ns", np.zeros(len(points), np.int64))
        is_upper_half = columns.get("laser_number", np.zeros(len(points), np.int64)) >= _LASERS_PER_LIDAR
        return Sweep(
            index=index,
            timestamp_ns=timestamp_ns,
            points_ego=points,
            capture_offset_s=(offset_ns * 1e-9).astype(np.float32),
            world_from_ego=self.world_from_ego[timestamp_ns],
            sensor_origins_ego=self.ego_from_lidar[:, :3, 3].astype(np.float32),
            lidar_of_point=(is_upper_half != self._is_swapped).astype(np.uint8),
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
        poses = _poses_at(read_columns(self.storage, _POSES, _POSE_COLUMNS, InvalidInput), between_ns)
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
        if index != 0 or self.storage.size(_FLOW) is None:
            return None
        names = ("flow_tx_m", "flow_ty_m", "flow_tz_m")
        types = {**dict.fromkeys(names, pa.float64()), "is_ground_0": pa.bool_()}
        columns = read_columns(self.storage, _FLOW, types, InvalidInput)
        sweep = self.read_sweep(0)
        if len(columns["is_ground_0"]) != sweep.num_points:
            raise InvalidInput(
                f"{self.storage.place(_FLOW)}: {len(columns['is_ground_0'])} rows, expected one a point of the "
                f"log's first sweep ({sweep.num_points}, {self.listing.names[0]})"
            )
        flow_m = np.full((sweep.num_points, 3), np.nan)
        world_from_next = self.world_from_ego.get(int(self.timestamps_ns[1])) if len(self.timestamps_ns) > 1 else None
        if world_from_next is not None:
            next_from_ego = invert(world_from_next) @ sweep.world_from_ego
            flow_label_m = np.stack([columns[name] for name in names], axis=1)
            points_next = sweep.points_ego + flow_label_m  # where each point goes, in the next ego frame
            flow_next_m = points_next - transform_points(next_from_ego, sweep.points_ego)
            flow_m = rotate_vectors(invert(next_from_ego), flow_next_m)
        return PointTruth(flow_ref_m=flow_m.astype(np.float32), is_ground=columns["is_ground_0"])

    @cached_property
    def _is_swapped(self) -> bool:
        """Whether the lower laser numbers are those of the second lidar: told by the first sweep that can be read."""
        for name in self.listing.names:
            try:
                points, columns = _read_points(self.storage, name)
            except UnreadableSweep:
                continue
            return "laser_number" in columns and _is_swapped(points, columns["laser_number"], self.ego_from_lidar)
        return False

    @cached_property
    def _cuboids(self) -> Columns | None:
        return read_cuboids(self.storage, "annotations.feather", "timestamp_ns")


def _read_points(storage: Storage, name: str) -> tuple[Float32Array, Columns]:
    """Return (N, 3) points, and of the columns offset_ns and laser_number those that a sweep has."""
    columns = read_columns(
        storage,
        name,
        dict.fromkeys("xyz", pa.float32()),
        UnreadableSweep,
        optional={"offset_ns": pa.int64(), "laser_number": pa.int64()},
    )
    points = np.stack([columns[axis] for axis in "xyz"], axis=1)
    require_finite_points(points, storage.place(name))
    return points, columns


def _is_swapped(points: Float32Array, laser_number: Int64Array, ego_from_lidar: Float64Array) -> bool:
    """Tell whether the lasers up to 31 are the second lidar's: seen from its own lidar a laser has one elevation."""
    spread_rad = np.zeros((2, 2))  # half of the lasers, lidar
    for lidar in range(2):
        x, y, z = transform_points(invert(ego_from_lidar[lidar]), points).T
        elevation = np.arctan2(z, np.hypot(x, y))
        for laser in np.unique(laser_number):
            own = elevation[laser_number == laser]
            spread_rad[int(laser >= _LASERS_PER_LIDAR), lidar] += np.median(np.abs(own - np.median(own)))
    return bool(spread_rad[0, 1] + spread_rad[1, 0] < spread_rad[0, 0] + spread_rad[1, 1])


def _names_by_stamp(storage: Storage) -> dict[int, str]:
    names: dict[int, str] = {}
    for name in storage.list_files(_SWEEPS):
        if not name.endswith(".feather"):
            continue
        stem = name.rpartition("/")[2].removesuffix(".feather")
        if not (stem.isdecimal() and int(stem) < 2**63):
            raise InvalidInput(f"{storage.place(name)}: a sweep's name must be its time stamp in nanoseconds")
        if int(stem) in names:
            raise InvalidInput(f"{storage.place(name)}: same time stamp as {names[int(stem)]}")
        names[int(stem)] = name
    if not names:
        raise InvalidInput(f"{storage.place(_SWEEPS)}: no sweeps, expected files {{timestamp_ns}}.feather")
    return dict(sorted(names.items()))


def _read_poses(storage: Storage, timestamps_ns: Int64Array) -> dict[int, Float64Array]:
    columns = read_columns(storage, _POSES, _POSE_COLUMNS, InvalidInput)
    poses = _poses_at(columns, timestamps_ns)
    if not poses:
        known_ns = columns["timestamp_ns"]
        known = f"lie in {known_ns.min()} to {known_ns.max()}" if len(known_ns) else "are none"
        raise InvalidInput(
            f"{storage.place(_POSES)}: poses do not cover the sweeps: no finite pose at any sweep's time stamp; "
            f"poses {known}, sweeps in {timestamps_ns[0]} to {timestamps_ns[-1]} ns; files of another log?"
        )
    return poses


def _poses_at(columns: Columns, timestamps_ns: Int64Array) -> dict[int, Float64Array]:
    """Return the finite poses at these time stamps."""
    poses = transforms_of(columns)
    is_wanted = np.isin(columns["timestamp_ns"], timestamps_ns) & np.isfinite(poses).all(axis=(1, 2))
    return dict(zip(columns["timestamp_ns"][is_wanted].tolist(), poses[is_wanted], strict=True))


def _read_lidars(storage: Storage) -> Float64Array:
    """Return (2, 4, 4) ego_from_lidar; the same twice where only one is calibrated, or the nominal one."""
    known = []
    if storage.size(_CALIBRATION) is not None:
        columns = read_columns(storage, _CALIBRATION, {"sensor_name": pa.string(), **POSE_TYPES}, InvalidInput)
        transforms = dict(zip(columns["sensor_name"].tolist(), transforms_of(columns), strict=True))
        known = [transforms[name] for name in _LIDARS if name in transforms]
        if not np.isfinite(known).all():
            raise InvalidInput(f"{storage.place(_CALIBRATION)}: a lidar's place is NaN or infinite")
    known = known or [yaw_translation(0.0, np.array(_NOMINAL_ORIGIN_M))]
    return np.stack([known[0], known[-1]])
