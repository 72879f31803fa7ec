"""Whatever format a folder is in, its sweeps are those of the world that it was written from."""

import pickle

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from labeling.readers.folder.columns import columns_there
from labeling.readers.folder.pcd import decompress_lzf
from labeling.readers.folder.widths import best_width
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


@pytest.mark.parametrize("kind", FORMATS)
def test_a_file_cut_or_changed_anywhere_is_read_or_refused_in_words(kind, content_of):
    rng = np.random.default_rng(0)
    suffix, content = content_of(kind, rng.normal(0, 10, (50, 3)).astype(np.float32))
    names, reasons = ("x", "y", "z", "intensity", "t"), []
    for trial in range(120):
        broken = bytearray(content[: rng.integers(len(content))] if trial % 2 else content)
        if not trial % 2:
            broken[rng.integers(len(broken) if trial % 4 else min(len(broken), 400))] = rng.integers(256)
        try:
            columns_there(bytes(broken), f"sweep.{suffix}", names, names)
        except ValueError as error:  # anything else fails the test
            reasons.append(str(error))
    assert reasons
    assert all(10 < len(reason) < 400 and "\n" not in reason for reason in reasons)


@given(st.lists(st.sampled_from([b"a", b"lidar", b"\0" * 40, b"abcabcabc", bytes(range(50))]), max_size=60))
def test_lzf_unpacks_what_was_packed(packed, parts):
    data = b"".join(parts)
    assert decompress_lzf(packed(data), len(data)) == data


@pytest.mark.parametrize("content", [b"\x05ab", b"\x20", b"\x20\x05", b"\xe0\x01"])
def test_lzf_that_is_broken_is_refused(content):
    with pytest.raises(ValueError, match="compressed points"):
        decompress_lzf(content, 6)


@pytest.mark.parametrize("width", [3, 4, 5, 6, 7])
@pytest.mark.parametrize("is_shuffled", [False, True])
def test_the_width_of_rows_is_told_by_their_columns(width, is_shuffled, world):
    points = np.array(world[0].points_ego[:2000])
    if is_shuffled:
        points = np.random.default_rng(0).permutation(points)
    rows = np.arange(len(points))
    extras = (rows % 7 / 7, rows % 32, rows * 1e-5, np.zeros(len(points)))
    table = np.column_stack([points, *extras[: width - 3]]).astype(np.float32)
    whole = len(table) // 840 * 840  # so that each width divides it
    assert best_width(table[:whole].ravel()) == width
