"""Sweeps in a plain folder: .bin, .npy, .npz, .pcd, .ply, .las, .laz or .feather files, with poses beside them.

What the files do not say, ``motionlabel.yaml`` says: see description.py. Sweeps are taken to be compensated for ego
motion to their time stamps.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

from labeling.readers.files import open_folder, read_file
from labeling.readers.folder.columns import read_columns
from labeling.readers.folder.description import Description, read_description
from labeling.readers.folder.places import CommonFiles, common_names, find_common, find_sweeps
from labeling.readers.folder.points import (
    capture_offsets_of,
    coordinates_of,
    lidars_of,
    origins_ego_of,
    points_ego_of,
    returns_of,
)
from labeling.readers.folder.poses import (
    PoseRows,
    SweepPoses,
    parse_camera_from_sensor,
    parse_poses,
    poses_of_sweeps,
    require_upright,
)
from labeling.readers.folder.stamps import TimedSweeps, stamps_of_names, stamps_of_table
from labeling.readers.folder.text import parse_table
from labeling.readers.reader import SegmentReader, digest_of, segment_id_of
from labeling.storage.storage import Storage, open_storage
from schemas.arrays import Float64Array
from schemas.errors import InvalidInput, UnreadableSweep
from schemas.frames import Sweep
from schemas.listing import SegmentListing

DATASET: Final = "folder"


def list_segment(uri: str) -> SegmentListing:
    """List the sweeps of a folder, and read its YAML and its time stamps.

    Raises:
        InvalidInput: No folder, no sweeps, no poses, or no time stamps.

    """
    storage = open_folder(uri, DATASET)
    description = read_description(storage)
    names = find_sweeps(storage, description)
    files = find_common(description, common_names(storage, description), uri)
    sweeps = time_sweeps(storage, description, files, names)
    common = tuple((place, digest_of(place)) for place in map(storage.place, files.names))
    return SegmentListing(DATASET, uri, segment_id_of(DATASET, uri), sweeps.timestamps_ns, sweeps.names, common)


def read_segment(listing: SegmentListing) -> "FolderSegment":
    """Read the YAML and the poses of a listed folder; no points.

    Raises:
        InvalidInput: Poses are missing, of another layout or of other sweeps.

    """
    storage = open_storage(listing.uri)
    there = [place.removeprefix(listing.uri).lstrip("/") for place, digest in listing.common if digest]
    description = read_description(storage)
    files = find_common(description, there, listing.uri)
    sweeps = time_sweeps(storage, description, files, listing.names)
    rows, camera_from_sensor = read_pose_files(storage, description, files)
    place = storage.place(files.poses or "")
    poses = poses_of_sweeps(rows, sweeps, description, camera_from_sensor, place)
    require_upright(poses, place)
    return FolderSegment(listing, storage, description, sweeps, files, poses)


@dataclass(eq=False)
class FolderSegment(SegmentReader):
    """One folder behind the SegmentReader protocol."""

    listing: SegmentListing
    storage: Storage
    description: Description
    sweeps: TimedSweeps
    files: CommonFiles
    poses: SweepPoses

    def read_sweep(self, index: int) -> Sweep:
        """Read one sweep; raises UnreadableSweep."""
        name, timestamp_ns = self.listing.names[index], int(self.timestamps_ns[index])
        place, description = self.storage.place(name), self.description
        if index in self.sweeps.faults:
            raise UnreadableSweep(f"{place}: {self.sweeps.faults[index]}")
        if index in self.poses.reasons:
            raise UnreadableSweep(f"{place}: {self.storage.place(self.files.poses or '')}: {self.poses.reasons[index]}")
        columns = read_columns(read_file(self.storage, name, UnreadableSweep), name, place, description)
        coordinates = coordinates_of(columns, description)
        is_return = returns_of(coordinates, place)
        lidar_of_point = lidars_of(columns, is_return, description, place)
        return Sweep(
            index=index,
            timestamp_ns=timestamp_ns,
            points_ego=points_ego_of(coordinates, is_return, lidar_of_point, description, place),
            capture_offset_s=capture_offsets_of(columns, is_return, description, timestamp_ns, place),
            world_from_ego=self.poses.world_from_ego[index],
            sensor_origins_ego=origins_ego_of(description),
            lidar_of_point=lidar_of_point,
        )


def time_sweeps(
    storage: Storage, description: Description, files: CommonFiles | None, names: Sequence[str]
) -> TimedSweeps:
    """Return the sweeps with their time stamps; raise InvalidInput."""
    if files is None or files.stamps is None:
        return stamps_of_names(names, description.rate_hz, storage.root)
    if description.rate_hz is not None:
        raise InvalidInput(f"{storage.place(files.stamps)}: there, and `rate_hz` in motionlabel.yaml: keep one")
    table = parse_table(read_file(storage, files.stamps, InvalidInput), storage.place(files.stamps))
    return stamps_of_table(names, table, description.stamps)


def read_pose_files(
    storage: Storage, description: Description, files: CommonFiles
) -> tuple[PoseRows, Float64Array | None]:
    """Return the rows of poses, and camera_from_sensor where there is a calibration; raise InvalidInput."""
    assert files.poses is not None
    content = read_file(storage, files.poses, InvalidInput)
    rows = parse_poses(content, files.poses, storage.place(files.poses), description)
    if files.calibration is None:
        return rows, None
    calibration = read_file(storage, files.calibration, InvalidInput)
    return rows, parse_camera_from_sensor(calibration, storage.place(files.calibration))
