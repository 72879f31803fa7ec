"""The static map: SEGMENT.ply or .pcd, all that stands in a recording, in the world frame, one point a voxel."""

import tempfile
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Final

import numpy as np

from labeling.evidence.vehicle import VehicleBody, find_vehicle, points_when_seen
from labeling.exporters.exporter import ExportOptions
from labeling.exporters.output import ExportFolder
from labeling.exporters.segments import SegmentLabels, SweepLabels
from labeling.exporters.tiles import VoxelTiles
from labeling.geometry.boxes import points_in_box
from labeling.geometry.transforms import transform_points
from labeling.readers.reader import SegmentReader
from labeling.stages.ground import segment_ground
from schemas.arrays import BoolArray, Float64Array
from schemas.config import GroundParams
from schemas.errors import InvalidInput
from schemas.frames import Sweep
from schemas.tables.points import PointRows

VOXEL_M: Final = 0.1
MIN_VOXEL_M: Final = 0.01
CLOUDS: Final = ("ply", "pcd")
# What a box misses of its object: mirrors, swinging arms, exhaust, and mixed returns behind its edges.
MARGIN_M: Final = 0.3


def export(segments: Iterable[SegmentLabels], output: ExportFolder, options: ExportOptions) -> None:
    """Write a file a segment; see ``Exporter``. The recording is read again, a sweep at a time.

    Left out is whatever may move, whatever its score: points that are neither ground nor static, points in boxes, and
    those on the recording vehicle. A point is the mean of those that fell into its voxel.
    """
    cloud, voxel_m = options.cloud or CLOUDS[0], VOXEL_M if options.voxel_m is None else options.voxel_m
    if cloud not in CLOUDS:
        raise InvalidInput(f"--cloud {cloud}: expected one of {', '.join(CLOUDS)}")
    if not MIN_VOXEL_M <= voxel_m < np.inf:
        raise InvalidInput(f"--voxel-m {voxel_m:g}: expected metres, {MIN_VOXEL_M:g} or more")
    for segment in segments:
        with tempfile.TemporaryDirectory(prefix="motionlabel-") as folder:
            tiles = VoxelTiles(Path(folder), voxel_m)
            for points_world in _standing_points(segment):
                tiles.add(points_world)
            header, dtype = (_ply_header, "<f8") if cloud == "ply" else (_pcd_header, "<f4")
            with output.writing(f"{segment.segment_id}.{cloud}") as file:
                file.write(header(tiles.count_voxels()).encode())
                for points_world in tiles.means():
                    file.write(points_world.astype(dtype).tobytes())


def _standing_points(segment: SegmentLabels) -> Iterator[Float64Array]:
    """Yield the (N, 3) points of each sweep that belong to the map, world frame."""
    reader = segment.open_recording()
    vehicle = _find_vehicle(reader, segment)
    beside: Sweep | None = None
    for labels, moving in segment.with_points():
        sweep = segment.read_recorded(reader, labels)
        beside = beside or _read_beside(reader, segment, sweep)
        is_static = ~_may_move(sweep, labels, moving) & ~vehicle.covers(points_when_seen(sweep, beside))
        yield transform_points(sweep.world_from_ego, sweep.points_ego[is_static])
        beside = sweep


def _may_move(sweep: Sweep, labels: SweepLabels, moving: PointRows) -> BoolArray:
    """Return (N,) which points belong, or may belong, to something that moves at some time."""
    may_move = np.zeros(sweep.num_points, dtype=bool)
    may_move[moving.point_index] = True
    for box in labels.boxes_ego:
        may_move |= points_in_box(sweep.points_ego, box, MARGIN_M)
    return may_move


def _find_vehicle(reader: SegmentReader, segment: SegmentLabels) -> VehicleBody:
    """Return what the lidars see of the recording vehicle: it would draw a trail through the map."""
    usable = {sweep.sweep_index for sweep in segment}

    def read(index: int) -> Sweep | None:
        return reader.read_sweep(index) if index in usable else None

    return find_vehicle(
        len(reader.timestamps_ns),
        read,
        lambda sweep: segment_ground(sweep.points_ego, GroundParams(), np.random.default_rng(0)),
        lambda sweep: _read_beside(reader, segment, sweep),
    )


def _read_beside(reader: SegmentReader, segment: SegmentLabels, sweep: Sweep) -> Sweep | None:
    """Return the usable sweep before another, or else after it."""
    usable = [other.sweep_index for other in segment]
    place = usable.index(sweep.index)
    return reader.read_sweep(usable[place - 1 if place else 1]) if len(usable) > 1 else None


def _ply_header(size: int) -> str:
    properties = "".join(f"property double {axis}\n" for axis in "xyz")
    return f"ply\nformat binary_little_endian 1.0\nelement vertex {size}\n{properties}end_header\n"


def _pcd_header(size: int) -> str:
    """Return the header of a binary PCD of float32, which is what PCL's points hold."""
    return (
        "# .PCD v0.7 - Point Cloud Data file format\nVERSION 0.7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\n"
        f"WIDTH {size}\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS {size}\nDATA binary\n"
    )
