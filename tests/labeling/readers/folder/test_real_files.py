"""Files of users' kinds beside the repository, and a KITTI drive as a plain folder."""

from pathlib import Path

import numpy as np
import pytest
import yaml
from pyarrow import csv, feather

from labeling.readers.folder.columns import read_columns
from labeling.readers.folder.description import Description
from labeling.readers.folder.points import coordinates_of, lidars_of, points_ego_of, returns_of
from labeling.readers.reader import open_segment

DATA = Path(__file__).resolve().parents[4] / "../shared/data"


def read_points(name, **said):
    path = DATA / "files" / name
    if not path.exists():
        pytest.skip(f"no {name} beside the repository")
    description = Description(**said)
    columns = read_columns(path.read_bytes(), name, name, description)
    coordinates = coordinates_of(columns, description)
    is_return = returns_of(coordinates, name)
    lidar_of_point = lidars_of(columns, is_return, description, name)
    return points_ego_of(coordinates, is_return, lidar_of_point, description, name)[is_return], len(is_return)


@pytest.mark.data
@pytest.mark.parametrize(
    ("name", "said", "num_points"),
    [
        ("sustech_count0.pcd", {"time": {"column": "timestamp", "since": "epoch"}}, 68242),
        ("hesai_compressed.pcd", {"time": {"column": "timestamp", "since": "epoch"}}, 80787),
        ("robosense_nebula_ascii.pcd", {}, 52225),
        ("nuscenes.pcd.bin", {"columns": ["x", "y", "z", "intensity", "ring"]}, 34688),
        ("livox_zeros.bin", {}, 24010),
        ("argoverse1.ply", {"lidar": {"column": "laser_number", "lasers": 32}, "origins": [[0, 0, 0]] * 2}, 91083),
    ],
)
def test_files_of_users_kinds_are_read(name, said, num_points):
    points, num_rows = read_points(name, **said)
    assert num_rows == num_points
    assert 0.5 < np.median(np.linalg.norm(points, axis=1)) < 40
    assert np.quantile(points[:, 2], 0.01) > -15  # the ground is below, not a mile


@pytest.mark.data
def test_a_kitti_drive_as_a_folder_is_the_drive(tmp_path):
    drive = next(iter(sorted(DATA.glob("kitti_raw/*/*_sync"))), None)
    if drive is None:
        pytest.skip(f"no KITTI drive in {DATA.name} beside the repository")
    expected = open_segment("kitti_raw", str(drive))
    (tmp_path / "velodyne").symlink_to(drive / "velodyne_points/data")
    (tmp_path / "timestamps.txt").write_text((drive / "velodyne_points/timestamps.txt").read_text())
    poses = [expected.read_sweep(index).world_from_ego[:3].ravel() for index in range(len(expected.timestamps_ns))]
    np.savetxt(tmp_path / "poses.txt", poses, fmt="%.17g")
    reader = open_segment("folder", str(tmp_path))
    np.testing.assert_array_equal(reader.timestamps_ns, expected.timestamps_ns)
    for index in range(0, len(expected.timestamps_ns), 20):
        ours, theirs = reader.read_sweep(index), expected.read_sweep(index)
        np.testing.assert_array_equal(ours.points_ego, theirs.points_ego)
        np.testing.assert_array_equal(ours.sensor_origins_ego, theirs.sensor_origins_ego)
        np.testing.assert_array_equal(ours.world_from_ego, theirs.world_from_ego)


@pytest.mark.data
def test_an_argoverse_log_as_a_folder_is_the_log(tmp_path):
    """With two lidars told apart by laser, capture times, and poses in a CSV."""
    log = next(iter(sorted(DATA.glob("av2/val/*"))), None)
    if log is None:
        pytest.skip(f"no Argoverse log in {DATA.name} beside the repository")
    expected = open_segment("av2", str(log))
    first = expected.read_sweep(0)
    (tmp_path / "lidar").symlink_to(log / "sensors/lidar")
    csv.write_csv(feather.read_table(log / "city_SE3_egovehicle.feather"), tmp_path / "poses.csv")
    said = {
        "sweeps": "lidar/*.feather",
        "time": {"column": "offset_ns", "unit": "ns"},
        "lidar": {"column": "laser_number", "lasers": 32},
        "origins": first.sensor_origins_ego.tolist(),
    }
    (tmp_path / "motionlabel.yaml").write_text(yaml.safe_dump(said))
    reader = open_segment("folder", str(tmp_path))
    np.testing.assert_array_equal(reader.timestamps_ns, expected.timestamps_ns)
    for index in (0, len(reader.timestamps_ns) // 2):
        ours, theirs = reader.read_sweep(index), expected.read_sweep(index)
        for name in ("points_ego", "capture_offset_s", "sensor_origins_ego"):
            np.testing.assert_allclose(getattr(ours, name), getattr(theirs, name), rtol=0, atol=1e-6)
        np.testing.assert_allclose(ours.world_from_ego, theirs.world_from_ego, rtol=0, atol=1e-6)
        assert len({(a, b) for a, b in zip(ours.lidar_of_point, theirs.lidar_of_point, strict=True)}) == 2
