"""KITTI raw drives (``{date}/{date}_drive_{number}_sync``): Velodyne sweeps with OXTS poses.

The ego frame is the Velodyne's. The world has east, north and up axes and its origin at the first OXTS packet of the
drive, whose latitude sets the scale of the Mercator projection (with scale 1, distances are 1.5 times too long). A
sweep's index is its file number: a number without a file is a sweep that cannot be read.

The poses are those of the packets, and GPS drifts: on drive 2011_09_26/0005, against scan matching, 0.1-0.2 m a second
sideways and 0.15 m a second in height, while headings agree within 0.1 degrees.
"""

import re
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import Final

import numpy as np
from scipy.spatial.transform import Rotation

from labeling.geometry.transforms import invert
from labeling.readers.files import Columns, cuboids_of, open_folder, read_cuboids, read_file, require_finite_points
from labeling.readers.reader import READERS, SegmentReader, digest_of, segment_id_of
from labeling.storage import places
from labeling.storage.storage import Storage, open_storage
from schemas.arrays import Float32Array, Float64Array, Int64Array
from schemas.errors import InvalidInput, LabelingError, UnreadableSweep
from schemas.frames import Annotations, Sweep
from schemas.listing import SegmentListing

DATASET: Final = "kitti_raw"
_SWEEPS: Final = READERS[DATASET].layout
_PACKETS: Final = "oxts/data"
_SWEEP: Final = _SWEEPS + "/{:010d}.bin"
_PACKET: Final = _PACKETS + "/{:010d}.txt"
_TIMESTAMPS: Final = "velodyne_points/timestamps.txt"
_CALIBRATION: Final = "calib_imu_to_velo.txt"
_EARTH_RADIUS_M: Final = 6378137.0  # of KITTI's own projection
_BYTES_PER_POINT: Final = 16  # float32 x, y, z, reflectance
_TIMESTAMP: Final = re.compile(r"\d{4}-\d\d-\d\d \d\d:\d\d:\d\d(\.\d{1,9})?")


def list_segment(uri: str) -> SegmentListing:
    """List the sweeps and the packets of a drive, and read its time stamps.

    Raises:
        InvalidInput: Not a drive folder, no sweeps, time stamps that do not fit or do not ascend, or no poses.

    """
    storage = open_folder(uri, DATASET)
    timestamps_ns = _read_timestamps(storage)
    sweeps, packets = sorted(_numbered(storage, _SWEEP)), sorted(_numbered(storage, _PACKET))
    _check_numbers(storage, sweeps, packets, len(timestamps_ns))
    names = (*map(_SWEEP.format, sweeps), *map(_PACKET.format, packets))
    calibration = places.join(places.split(uri)[0], _CALIBRATION)
    common = ((calibration, digest_of(calibration)),)
    return SegmentListing(DATASET, uri, segment_id_of(DATASET, uri), timestamps_ns, names, common)


def read_segment(listing: SegmentListing) -> "KittiRawSegment":
    """Read the first packet of a listed drive, and the calibration in the folder above; no points.

    Raises:
        InvalidInput: One of them is missing or broken.

    """
    storage = open_storage(listing.uri)
    first = next(name for name in listing.names if name.endswith(".txt"))
    lat, lon, alt, *_ = _read_packet(storage, first, InvalidInput)
    scale = np.cos(np.deg2rad(lat))
    velodyne_from_imu = _read_rigid(open_storage(places.split(listing.uri)[0]))
    return KittiRawSegment(listing, storage, scale, _mercator(lat, lon, alt, scale), invert(velodyne_from_imu))


@dataclass(eq=False)
class KittiRawSegment(SegmentReader):
    """One drive behind the SegmentReader protocol."""

    listing: SegmentListing
    storage: Storage
    mercator_scale: float
    origin_m: Float64Array  # (3,) of the first packet, Mercator
    imu_from_velodyne: Float64Array  # (4, 4)

    def read_sweep(self, index: int) -> Sweep:
        """Read one sweep; raises UnreadableSweep. Capture times are unknown: offsets are zero."""
        sweep, packet = _SWEEP.format(index), _PACKET.format(index)
        self._require_listed(sweep, "a gap in the drive")
        points = _read_points(self.storage, sweep)
        self._require_listed(packet, "so the sweep has no pose")
        return Sweep(
            index=index,
            timestamp_ns=int(self.timestamps_ns[index]),
            points_ego=points,
            capture_offset_s=np.zeros(len(points), dtype=np.float32),
            world_from_ego=self._read_pose(packet),
            sensor_origins_ego=np.zeros((1, 3), dtype=np.float32),
            lidar_of_point=np.zeros(len(points), dtype=np.uint8),
        )

    def read_annotations(self, index: int) -> Annotations | None:
        """Return the cuboids of ``annotations.feather`` (Velodyne frame) whose ``frame`` is this index.

        The file speaks for all sweeps from its first frame to its last: one without rows holds no objects.
        """
        if self._cuboids is None:
            return None
        frame = self._cuboids["frame"]
        if not len(frame) or not frame.min() <= index <= frame.max():
            return None
        return cuboids_of(self._cuboids, frame == index)

    def _read_pose(self, path: str) -> Float64Array:
        lat, lon, alt, roll, pitch, yaw = _read_packet(self.storage, path, UnreadableSweep)
        world_from_imu = np.eye(4)
        world_from_imu[:3, :3] = _rotation_zyx(roll, pitch, yaw)
        world_from_imu[:3, 3] = _mercator(lat, lon, alt, self.mercator_scale) - self.origin_m
        return world_from_imu @ self.imu_from_velodyne

    def _require_listed(self, path: str, consequence: str) -> None:
        if path not in self._names:
            raise UnreadableSweep(f"{self.storage.place(path)}: not there when the drive was listed, {consequence}")

    @cached_property
    def _names(self) -> frozenset[str]:
        return frozenset(self.listing.names)

    @cached_property
    def _cuboids(self) -> Columns | None:
        return read_cuboids(self.storage, "annotations.feather", "frame")


def _read_timestamps(storage: Storage) -> Int64Array:
    """Return (T,) int64 ns, UTC. Parsed as integers: float64 seconds would be off by 100 ns."""
    place = storage.place(_TIMESTAMPS)
    text = read_file(storage, _TIMESTAMPS, InvalidInput, ", expected one line a sweep").decode(errors="replace")
    timestamps_ns: list[int] = []
    for number, line in enumerate(text.rstrip().splitlines(), start=1):
        try:
            if not _TIMESTAMP.fullmatch(line.strip()):
                raise ValueError
            timestamp_ns = int(np.datetime64(line.strip(), "ns").astype(np.int64))
        except ValueError:
            raise InvalidInput(f"{place}: line {number}: expected a time as 2011-09-26 13:04:32.348999000") from None
        if timestamps_ns and timestamp_ns <= timestamps_ns[-1]:
            raise InvalidInput(f"{place}: line {number}: time stamps must ascend, this one is not after the last")
        timestamps_ns.append(timestamp_ns)
    if not timestamps_ns:
        raise InvalidInput(f"{place}: no time stamps, expected one line a sweep")
    return np.array(timestamps_ns, dtype=np.int64)


def _numbered(storage: Storage, pattern: str) -> Iterator[int]:
    """Yield the numbers of the files that a pattern names."""
    for name in storage.list_files(pattern.rpartition("/")[0]):
        stem = name.rpartition("/")[2].partition(".")[0]
        if re.fullmatch(r"\d{10}", stem) and name == pattern.format(int(stem)):
            yield int(stem)


def _check_numbers(storage: Storage, sweeps: list[int], packets: list[int], num_timestamps: int) -> None:
    if not sweeps:
        raise InvalidInput(f"{storage.place(_SWEEPS)}: no sweeps, expected files as 0000000000.bin")
    if sweeps[-1] >= num_timestamps:
        raise InvalidInput(
            f"{storage.place(_SWEEP.format(sweeps[-1]))}: no time stamp: {_TIMESTAMPS} has {num_timestamps} lines, "
            "expected one for each number from 0 on, gaps included"
        )
    if not packets:
        raise InvalidInput(f"{storage.place(_PACKETS)}: no poses, expected OXTS packets as 0000000000.txt")
    if not set(packets) & set(sweeps):
        raise InvalidInput(
            f"{storage.place(_PACKETS)}: poses do not cover the sweeps: packets are numbered {packets[0]} to "
            f"{packets[-1]}, sweeps {sweeps[0]} to {sweeps[-1]}"
        )


def _read_points(storage: Storage, path: str) -> Float32Array:
    content, place = read_file(storage, path, UnreadableSweep), storage.place(path)
    if len(content) % _BYTES_PER_POINT:
        raise UnreadableSweep(
            f"{place}: {len(content)} bytes are not whole points of {_BYTES_PER_POINT} bytes, truncated?"
        )
    points = np.frombuffer(content, dtype="<f4").reshape(-1, 4)[:, :3].astype(np.float32)
    require_finite_points(points, place)
    return points


def _read_packet(storage: Storage, path: str, error: type[LabelingError]) -> list[float]:
    """Return lat, lon, alt (degrees, degrees, m), roll, pitch, yaw (rad) of an OXTS packet."""
    values = read_file(storage, path, error, ", so the sweep has no pose").split()[:6]
    try:
        packet = [float(value) for value in values]
    except ValueError:
        packet = []
    if len(packet) < 6 or not np.isfinite(packet).all() or abs(packet[0]) > 85:
        raise error(f"{storage.place(path)}: expected finite numbers lat lon alt roll pitch yaw ...")
    return packet


def _mercator(lat: float, lon: float, alt: float, scale: float) -> Float64Array:
    """Return (3,) east, north, up in metres of a position in degrees. Source: KITTI raw devkit, latlonToMercator."""
    east = scale * _EARTH_RADIUS_M * np.deg2rad(lon)
    north = scale * _EARTH_RADIUS_M * np.log(np.tan(np.deg2rad(90 + lat) / 2))
    return np.array([east, north, alt])


def _rotation_zyx(roll: float, pitch: float, yaw: float) -> Float64Array:
    """Return (3, 3) Rz(yaw) Ry(pitch) Rx(roll), yaw 0 facing east. Source: KITTI raw devkit, convertOxtsToPose."""
    rotation: Float64Array = Rotation.from_euler("ZYX", [yaw, pitch, roll]).as_matrix()
    return rotation


def _read_rigid(storage: Storage) -> Float64Array:
    """Return the (4, 4) of a KITTI calibration file with lines ``R: 9 numbers`` and ``T: 3 numbers``."""
    hint = "; KITTI keeps the calibration in the folder of the date"
    text = read_file(storage, _CALIBRATION, InvalidInput, hint).decode(errors="replace")
    lines = dict(line.split(":", 1) for line in text.splitlines() if ":" in line)
    transform = np.eye(4)
    try:
        transform[:3, :3] = np.array(lines["R"].split(), dtype=np.float64).reshape(3, 3)
        transform[:3, 3] = np.array(lines["T"].split(), dtype=np.float64).reshape(3)
    except (KeyError, ValueError):
        raise InvalidInput(f"{storage.place(_CALIBRATION)}: expected lines R: with 9 numbers and T: with 3") from None
    if not np.allclose(transform[:3, :3] @ transform[:3, :3].T, np.eye(3), atol=1e-3):
        raise InvalidInput(f"{storage.place(_CALIBRATION)}: R is not a rotation")
    return transform
