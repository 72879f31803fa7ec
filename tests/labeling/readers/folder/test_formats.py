"""Whatever format a folder is in, its sweeps are those of the world that it was written from."""

import pickle

import numpy as np
import pytest

from labeling.readers.reader import SegmentReader, open_segment, reopen

FORMATS = (
    "bin", "npy", "npy-structured", "npz", "npz-columns", "pcd-ascii", "pcd-binary", "pcd-compressed", "ply-ascii",
    "ply-little", "ply-big", "las", "laz", "feather",
)  # fmt: skip


def require_same(reader, world, *, atol_m=0.0):
    np.testing.assert_array_equal(reader.timestamps_ns, [sweep.timestamp_ns for sweep in world])
    for index, sweep in enumerate(world):
        ours = reader.read_sweep(index)
        np.testing.assert_allclose(ours.points_ego, sweep.points_ego, rtol=0, atol=atol_m)
        np.testing.assert_array_equal(ours.capture_offset_s, sweep.capture_offset_s)
        np.testing.assert_allclose(ours.world_from_ego, sweep.world_from_ego, rtol=0, atol=1e-6)
        np.testing.assert_array_equal(ours.sensor_origins_ego, sweep.sensor_origins_ego)
        np.testing.assert_array_equal(ours.lidar_of_point, 0)


@pytest.mark.parametrize("kind", FORMATS)
def test_sweeps_are_those_of_the_world(kind, write_folder, world, tmp_path):
    reader = open_segment("folder", str(write_folder(tmp_path / "log", kind)))
    assert isinstance(reader, SegmentReader)
    require_same(reader, world, atol_m=0.0006 if kind in ("las", "laz") else 0.0)


@pytest.mark.parametrize("layout", ["kitti", "4x4.txt", "tum", "csv", "csv-angles", "npy-4x4", "npy-12"])
def test_poses_are_those_of_the_world(layout, write_folder, world, tmp_path):
    reader = open_segment("folder", str(write_folder(tmp_path / "log", poses=layout)))
    for index, sweep in enumerate(world):
        np.testing.assert_allclose(reader.read_sweep(index).world_from_ego, sweep.world_from_ego, rtol=0, atol=1e-6)


def test_a_listing_travels_and_files_that_come_later_are_not_seen(write_folder, world, tmp_path):
    folder = write_folder(tmp_path / "log")
    listing = pickle.loads(pickle.dumps(open_segment("folder", str(folder)).listing))
    (folder / "lidar/1.pcd").write_bytes(b"")
    (folder / "poses.csv").write_text("no")
    require_same(reopen(listing), world)
