"""What motionlabel.yaml says of columns, units, axes, the lidar's place and poses is what is read."""

import numpy as np
import pytest
import yaml

from labeling.geometry.transforms import invert
from labeling.readers.folder.description import Placement, axes_matrix
from labeling.readers.reader import open_segment
from schemas.errors import InvalidInput, UnreadableSweep

TILTED = Placement(x=1.0, y=-0.5, z=1.8, roll_deg=3, pitch_deg=-10, yaw_deg=30)


def say(folder, **said):
    path = folder / "motionlabel.yaml"
    path.write_text(yaml.safe_dump({**yaml.safe_load(path.read_text()), **said}))
    return open_segment("folder", str(folder))


def in_frame(transform, points):
    return (points @ transform[:3, :3].T + transform[:3, 3]).astype(np.float32)


def require_same(reader, world):
    for index in (0, 3, 7):
        ours, theirs = reader.read_sweep(index), world[index]
        np.testing.assert_allclose(ours.points_ego, theirs.points_ego, rtol=0, atol=2e-5)
        np.testing.assert_allclose(ours.world_from_ego, theirs.world_from_ego, rtol=0, atol=1e-6)


def test_the_lidars_place_in_the_vehicle(write_folder, world, tmp_path):
    sensor_from_ego = invert(TILTED.ego_from_sensor)
    folder = write_folder(tmp_path / "log", points_of=lambda sweep: in_frame(sensor_from_ego, sweep.points_ego))
    reader = say(folder, sensor=TILTED.model_dump(), origins=[[0, 0, 0]])
    require_same(reader, world)
    np.testing.assert_allclose(reader.read_sweep(0).sensor_origins_ego, [[1.0, -0.5, 1.8]], atol=1e-6)


def test_poses_of_the_lidar(write_folder, world, tmp_path):
    sensor_from_ego = invert(TILTED.ego_from_sensor)
    folder = write_folder(
        tmp_path / "log", poses="npy-4x4", points_of=lambda sweep: in_frame(sensor_from_ego, sweep.points_ego)
    )
    np.save(folder / "poses.npy", np.load(folder / "poses.npy") @ TILTED.ego_from_sensor)
    require_same(say(folder, sensor=TILTED.model_dump(), poses={"of": "sensor"}), world)


def test_poses_that_are_inverse_and_in_feet(write_folder, world, tmp_path):
    folder = write_folder(tmp_path / "log", poses="npy-4x4")
    poses = np.load(folder / "poses.npy")
    poses[:, :3, 3] /= 0.3048
    np.save(folder / "poses.npy", np.linalg.inv(poses))
    require_same(say(folder, poses={"inverse": True, "units": "ft"}), world)


def test_a_left_handed_world(write_folder, world, tmp_path):
    """As a simulator writes it: x ahead, y to the right, z up, in points and poses."""
    mirror = axes_matrix(("forward", "right", "up"))
    folder = write_folder(tmp_path / "log", poses="npy-4x4", points_of=lambda s: in_frame(mirror, s.points_ego))
    np.save(folder / "poses.npy", mirror @ np.load(folder / "poses.npy") @ mirror)
    require_same(say(folder, axes=["forward", "right", "up"], poses={"of": "sensor"}), world)


def test_kittis_poses_of_its_camera(write_folder, world, tmp_path):
    """World and camera have z ahead and y down; Tr of calib.txt is where the lidar is in the camera's frame."""
    camera_from_lidar = np.array([[0, -1, 0, 0.1], [0, 0, -1, -0.3], [1, 0, 0, -0.5], [0, 0, 0, 1.0]])
    folder = write_folder(tmp_path / "log", poses="npy-12")
    (folder / "poses.npy").unlink()
    poses = [camera_from_lidar @ sweep.world_from_ego @ invert(camera_from_lidar) for sweep in world]
    np.savetxt(folder / "poses.txt", [pose[:3].ravel() for pose in poses])
    with pytest.raises(InvalidInput, match=r"poses\.txt: the vehicle would climb .* poses of a camera \(say"):
        open_segment("folder", str(folder))
    numbers = " ".join(map(str, camera_from_lidar[:3].ravel()))
    (folder / "calib.txt").write_text(f"P0: 1 0 0 0 0 1 0 0 0 0 1 0\nTr: {numbers}\n")
    require_same(open_segment("folder", str(folder)), world)


@pytest.mark.parametrize(
    ("unit", "since", "column"),
    [
        ("s", "epoch", lambda stamp_ns, t: t + stamp_ns * 1e-9),
        ("ns", "epoch", lambda stamp_ns, t: (t * 1e9).astype(np.int64) + stamp_ns),
        ("us", "stamp", lambda stamp_ns, t: (t * 1e6).astype(np.uint32)),
    ],
)
def test_times_of_points_in_any_unit(unit, since, column, write_folder, world, tmp_path):
    folder = write_folder(tmp_path / "log", "npz-columns")
    for path, sweep in zip(sorted((folder / "lidar").iterdir()), world, strict=True):
        arrays = dict(np.load(path))
        np.savez(path, **{**arrays, "t": column(sweep.timestamp_ns, arrays["t"].astype(np.float64))})
    reader = say(folder, time={"column": "t", "unit": unit, "since": since})
    np.testing.assert_allclose(reader.read_sweep(4).capture_offset_s, world[4].capture_offset_s, rtol=0, atol=2e-6)


def test_a_column_tells_which_lidar_saw_a_point(write_folder, world, tmp_path):
    folder = write_folder(tmp_path / "log")
    reader = say(folder, lidar={"column": "intensity", "lasers": 50}, origins=[[1, 0, 2], [-1, 0, 2]])
    sweep = reader.read_sweep(0)
    np.testing.assert_array_equal(sweep.lidar_of_point, np.arange(sweep.num_points) % 100 // 50)
    np.testing.assert_array_equal(sweep.sensor_origins_ego, [[1, 0, 2], [-1, 0, 2]])
    with pytest.raises(UnreadableSweep, match=r"column intensity holds 60: motionlabel\.yaml has 2 `origins`, with 30"):
        say(folder, lidar={"column": "intensity", "lasers": 30}, origins=[[1, 0, 2], [-1, 0, 2]]).read_sweep(0)


@pytest.mark.parametrize(
    ("said", "message"),
    [
        ({"columns": ["x", "y", "intensity"]}, "columns: no t, z among x, y, intensity"),
        ({"units": "miles"}, "units: Input should be 'm', 'cm', 'mm' or 'ft'"),
        ({"time": {"column": "t", "unit": "h"}}, r"time\.unit: Input should be"),
        ({"origins": [[0, 0]]}, r"origins\.0\.2: Field required"),
        ({"rate_hz": 0}, "rate_hz: Input should be greater than 0"),
    ],
)
def test_what_cannot_be_said(said, message, write_folder, tmp_path):
    with pytest.raises(InvalidInput, match=rf"motionlabel\.yaml: {message}"):
        say(write_folder(tmp_path / "log"), **said)
