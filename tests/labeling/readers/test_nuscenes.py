"""nuScenes tables and sweeps written from the made-up world: what is read is the world."""

import json
import pickle
import uuid
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from typer.testing import CliRunner

from labeling.folders.folder import LabelFolder
from labeling.geometry.boxes import iou_3d, transform_boxes
from labeling.geometry.transforms import invert, transform_points
from labeling.readers import json_tables
from labeling.readers.nuscenes import _read_points
from labeling.readers.reader import open_segment, reopen, segment_id_of
from labeling.storage.storage import open_storage
from labeling.synthetic.rigs import SpinningLidar
from labeling.synthetic.scene import Scene, drive, wall
from labeling.synthetic.shapes import car
from schemas.errors import InvalidInput, UnreadableSweep
from service.cli import app

DATA = Path(__file__).resolve().parents[3] / "../shared/data"
HZ, STEPS, RINGS = 20.0, 1085, 32
TURN_NS = 50_000_000
NUM_SWEEPS, SWEEPS_A_KEY_FRAME = 13, 5  # key frames are sweeps 0, 5 and 10
TABLES = ["scene", "sensor", "sample", "calibrated_sensor", "sample_data", "ego_pose"]
ORIGIN_M = (0.94, 0.0, 1.84)
EGO_FROM_LIDAR = np.eye(4)  # x of the lidar is to the right, y ahead
EGO_FROM_LIDAR[:3, :3] = [[0, 1, 0], [-1, 0, 0], [0, 0, 1]]
EGO_FROM_LIDAR[:3, 3] = ORIGIN_M


def token(*parts):
    return uuid.uuid5(uuid.NAMESPACE_OID, "/".join(map(str, parts))).hex


def quaternion(rotation):
    return Rotation.from_matrix(rotation).as_quat(scalar_first=True).tolist()


def placed(pose):
    return {"rotation": quaternion(pose[:3, :3]), "translation": pose[:3, 3].tolist()}


def make_world(num_sweeps=NUM_SWEEPS):
    scene = Scene(
        structures=(wall((50, -20), (50, 20)), wall((-50, 12), (50, 12))),
        movers=(drive(car(), (-10, 5), speed_mps=8.0), drive(car(), (10, -6))),
        ego=drive(car(), speed_mps=4.0).path,
    )
    return scene.reader(num_sweeps=num_sweeps, hz=HZ, lidar=SpinningLidar(RINGS, STEPS, origin_ego_m=ORIGIN_M))


def stamp_ns(world, index):
    """When the turn is over."""
    return int(world.timestamps_ns[index]) + TURN_NS


def pose_at(world, index):
    return world._ego.at(np.array([(stamp_ns(world, index) - world.timestamps_ns[0]) * 1e-9]))[0]


def full_firings(world, index):
    """Return (STEPS, RINGS, 5) rows, (STEPS, RINGS, 3) world points and (STEPS, RINGS) times; the latter NaN for none.

    A beam without a return comes back from the vehicle's roof, as in real sweeps.
    """
    capture, sweep = world._capture(index), world.read_sweep(index)
    points = transform_points(invert(pose_at(world, index) @ EGO_FROM_LIDAR), capture.points_world)
    firing = np.floor(sweep.capture_offset_s / (1 / HZ) * STEPS).astype(int)
    ego = world._ego.at(capture.times_s)
    rays = np.einsum("nji,nj->ni", ego[:, :3, :3], capture.points_world - ego[:, :3, 3]) - ORIGIN_M
    elevation = np.arctan2(rays[:, 2], np.hypot(rays[:, 0], rays[:, 1]))
    ring = np.abs(elevation[:, None] - world._rig[0].inclinations_rad()).argmin(axis=1)
    rows = np.zeros((STEPS, RINGS, 5), dtype=np.float32)
    rows[..., :3] = (0.1, -0.6, -0.3)
    rows[firing, ring, :3] = points
    rows[..., 4] = np.arange(RINGS)
    points_world, after_s = np.full((STEPS, RINGS, 3), np.nan), np.full((STEPS, RINGS), np.nan)
    points_world[firing, ring], after_s[firing, ring] = capture.points_world, sweep.capture_offset_s - TURN_NS * 1e-9
    return rows, points_world.reshape(-1, 3), after_s.ravel()


def write_table(folder, name, rows):
    folder.mkdir(parents=True, exist_ok=True)
    (folder / f"{name}.json").write_text(json.dumps(rows, indent=0))


def write_scene(root, world, version="v1.0-mini"):
    """Write a scene beside another one, and cameras beside the lidar."""
    tables = root / version
    scenes = ["scene-0061", "scene-0103"]
    write_table(
        tables,
        "scene",
        [{"token": token(s), "name": s, "description": "Parked {trucks}", "nbr_samples": 3} for s in scenes],
    )
    channels = ["LIDAR_TOP", "CAM_FRONT"]
    write_table(tables, "sensor", [{"token": token(c), "channel": c, "modality": c[:3].lower()} for c in channels])
    calibrated, samples, data, poses = [], [], [], []
    for scene in scenes:
        for channel in channels:
            row = {"token": token(scene, channel), "sensor_token": token(channel), **placed(EGO_FROM_LIDAR)}
            calibrated.append(row | {"camera_intrinsic": []})
        for index in range(len(world.timestamps_ns)):
            stamp_us = stamp_ns(world, index) // 1000
            key_frame = index - index % SWEEPS_A_KEY_FRAME
            is_key_frame = key_frame == index
            if is_key_frame:
                samples.append(
                    {"token": token(scene, index), "timestamp": stamp_us, "prev": "", "scene_token": token(scene)}
                )
            for channel in channels:
                own = token(scene, channel, index)
                folder = "samples" if is_key_frame else "sweeps"
                data.append(
                    {
                        "token": own,
                        "sample_token": token(scene, key_frame),
                        "ego_pose_token": own,
                        "calibrated_sensor_token": token(scene, channel),
                        "timestamp": stamp_us,
                        "fileformat": "pcd",
                        "is_key_frame": is_key_frame,
                        "height": 0,
                        "filename": f"{folder}/{channel}/{scene}__{channel}__{stamp_us}.pcd.bin",
                        "prev": "",
                    }
                )
                poses.append({"token": own, "timestamp": stamp_us, **placed(pose_at(world, index))})
            path = root / data[-2]["filename"]
            path.parent.mkdir(parents=True, exist_ok=True)
            if scene == scenes[0]:
                full_firings(world, index)[0].tofile(path)
    rng = np.random.default_rng(0)
    for name, rows in (
        ("sample_data", data),
        ("ego_pose", poses),
        ("sample", samples),
        ("calibrated_sensor", calibrated),
    ):
        write_table(tables, name, [rows[k] for k in rng.permutation(len(rows))])
    write_annotations(tables, world, scenes[0])
    return f"{tables}/{scenes[0]}"


def write_annotations(tables, world, scene):
    annotations = []
    for index in range(0, len(world.timestamps_ns), SWEEPS_A_KEY_FRAME):
        for i in range(2):
            if (index, i) != (0, 1):  # the parked car is annotated from the second key frame on
                x, y, z, length, width, height, yaw = truth_at(world, index, i)
                annotations.append(
                    {
                        "token": token("annotation", index, i),
                        "sample_token": token(scene, index),
                        "instance_token": token("instance", i),
                        "translation": [x, y, z],
                        "size": [width, length, height],
                        "rotation": [float(np.cos(yaw / 2)), 0.0, 0.0, float(np.sin(yaw / 2))],
                        "num_lidar_pts": 5,
                    }
                )
    write_table(tables, "sample_annotation", annotations)
    write_table(tables, "instance", [{"token": token("instance", i), "category_token": token("car")} for i in range(2)])
    write_table(tables, "category", [{"token": token("car"), "name": "vehicle.car"}])


def truth_at(world, index, mover):
    """The world box of a road user at the stamp of a sweep."""
    return world.box_at(mover, (stamp_ns(world, index) - world.timestamps_ns[0]) * 1e-9)


@pytest.fixture(scope="module")
def world():
    return make_world()


@pytest.fixture
def uri(world, tmp_path):
    return write_scene(tmp_path / "nuscenes", world)


def edit(uri, table, change):
    """Change the rows of a table."""
    path = f"{uri.rpartition('/')[0]}/{table}.json"
    with open(path) as file:  # noqa: PTH123 - a string
        rows = json.load(file)
    changed = change(rows)
    with open(path, "w") as file:  # noqa: PTH123
        json.dump(rows if changed is None else changed, file, indent=0)
    return path


def test_what_is_read_is_the_world(world, uri):
    reader = open_segment("nuscenes", uri)
    assert reader.timestamps_ns.tolist() == [stamp_ns(world, index) // 1000 * 1000 for index in range(NUM_SWEEPS)]
    for index in range(NUM_SWEEPS):
        sweep = reader.read_sweep(index)
        np.testing.assert_allclose(sweep.world_from_ego, pose_at(world, index), atol=1e-9)
        np.testing.assert_allclose(sweep.sensor_origins_ego, [ORIGIN_M], atol=1e-6)
        assert not sweep.lidar_of_point.any()
        _, points_world, after_s = full_firings(world, index)
        is_seen = np.isfinite(after_s)
        assert is_seen.mean() > 0.5
        read_world = transform_points(sweep.world_from_ego, sweep.points_ego)
        np.testing.assert_allclose(read_world[is_seen], points_world[is_seen], atol=2e-5)
        np.testing.assert_allclose(sweep.capture_offset_s[is_seen], after_s[is_seen], atol=1e-4)


def test_boxes_are_those_of_key_frames_and_lie_on_the_way_between_them(world, uri):
    reader = open_segment("nuscenes", uri)
    for index in range(NUM_SWEEPS):
        truth = reader.read_annotations(index)
        if index > 10:
            assert truth is None  # after the last key frame nobody knows
            continue
        movers = [0, 1] if index >= 5 else [0]  # before, one key frame alone has the parked car
        by_name = {token("instance", i): i for i in movers}
        assert set(truth.track_ids) == set(by_name)
        assert set(truth.categories) == {"vehicle.car"}
        boxes = transform_boxes(pose_at(world, index), truth.boxes_ego)
        expected = [truth_at(world, index, by_name[name]) for name in truth.track_ids]
        np.testing.assert_allclose(boxes, expected, atol=1e-6)
    edit(uri, "sample_annotation", lambda rows: [row for row in rows if row["sample_token"] == "none"])
    assert open_segment("nuscenes", uri).read_annotations(0) is None


def test_a_box_turns_the_short_way(world, uri):
    def turn(rows):
        for row in rows:
            yaw = np.deg2rad(170 if row["sample_token"] == token("scene-0061", 5) else -170)
            row["rotation"] = [np.cos(yaw / 2), 0, 0, np.sin(yaw / 2)]

    edit(uri, "sample_annotation", turn)
    reader = open_segment("nuscenes", uri)
    yaws = [np.rad2deg(reader.read_annotations(index).boxes_ego[0, 6]) for index in range(5, 11)]
    np.testing.assert_allclose(np.mod(yaws, 360), [170, 174, 178, 182, 186, 190], atol=1e-6)


def test_a_sweep_that_is_bad_is_rejected_alone(uri):
    root = uri.rpartition("/v1.0")[0]
    names = open_segment("nuscenes", uri).listing.names

    def rewrite(index, change):
        rows = np.fromfile(f"{root}/{names[index]}", "<f4").reshape(-1, 5)
        change(rows).tofile(f"{root}/{names[index]}")

    rewrite(1, lambda rows: rows.ravel()[:-2])
    rewrite(2, lambda rows: np.where(np.arange(len(rows))[:, None] == 7, np.float32(np.nan), rows))
    rewrite(3, lambda rows: rows[:0])
    (open_storage(root)._folder / names[4]).unlink()
    own = token("scene-0061", "LIDAR_TOP", 6)
    edit(uri, "ego_pose", lambda rows: [row for row in rows if row["token"] != own])
    reader = open_segment("nuscenes", uri)
    reasons = {
        1: "bytes are not whole points of 20 bytes, truncated",
        2: "1 of 34720 points hold NaN",
        3: "no points in the sweep",
        4: "no such file",
        6: rf"ego_pose.json: no pose of {names[6]}$",
    }
    for index in range(NUM_SWEEPS):
        if index not in reasons:
            assert reader.read_sweep(index).num_points == STEPS * RINGS
            continue
        with pytest.raises(UnreadableSweep, match=reasons[index]) as refusal:
            reader.read_sweep(index)
        assert "\n" not in str(refusal.value)
    assert reader.read_annotations(6) is None


def test_rows_that_are_no_whole_firings_have_no_capture_times(tmp_path):
    rows = np.ones((64, 5), dtype=np.float32)
    rows[:, 4] = np.tile(np.arange(32), 2)
    rows.tofile(tmp_path / "whole.bin")
    rows[3:].tofile(tmp_path / "part.bin")
    rows[::-1].copy().tofile(tmp_path / "other.bin")
    storage = open_storage(tmp_path)
    np.testing.assert_allclose(_read_points(storage, "whole.bin")[1], np.repeat([-46.08e-6, 0], 32), atol=1e-9)
    assert not _read_points(storage, "part.bin")[1].any()
    assert not _read_points(storage, "other.bin")[1].any()


@pytest.mark.data
def test_the_firings_of_a_real_sweep_turn_clockwise_once_until_the_stamp():
    if not (DATA / "files/nuscenes.pcd.bin").is_file():
        pytest.skip(f"{DATA / 'files'} is not here: real sweeps stay outside the repository")
    points, offset_s = _read_points(open_storage(DATA / "files"), "nuscenes.pcd.bin")
    assert points.shape == (34_688, 3)
    assert (offset_s[0], offset_s[-1]) == (pytest.approx(-0.05, abs=2e-4), 0)
    far = np.hypot(*points[:, :2].T) > 3
    azimuth = np.unwrap(np.arctan2(points[far, 1], points[far, 0]))
    per_s, at_stamp = np.polyfit(offset_s[far], azimuth, 1)
    assert per_s / (2 * np.pi) == pytest.approx(-20, abs=0.5)
    assert np.abs(per_s * offset_s[far] + at_stamp - azimuth).max() < 0.2


@pytest.mark.parametrize("table", TABLES)
def test_a_table_that_is_missing_or_broken_is_named(uri, table):
    path = open_storage(uri.rpartition("/")[0])._folder / f"{table}.json"
    content = path.read_bytes()
    path.write_bytes(content[: len(content) // 2])
    with pytest.raises(InvalidInput, match=f"^{path}: ") as refusal:
        open_segment("nuscenes", uri)
    assert "\n" not in str(refusal.value)
    field = {"sample_data": b"timestamp", "ego_pose": b"rotation"}.get(table, b"token")
    path.write_bytes(content.replace(b'"%s"' % field, b'"other"'))
    with pytest.raises(InvalidInput, match=rf"^{path}: .*{field.decode()}: Field required$") as refusal:
        open_segment("nuscenes", uri)
    assert "\n" not in str(refusal.value)
    path.unlink()
    with pytest.raises(InvalidInput, match=f"{path}: no such file|expected a scene of dataset nuscenes"):
        open_segment("nuscenes", uri)


def test_what_is_no_scene_is_said_with_what_is_there(uri):
    folder, root = uri.rpartition("/")[0], uri.rpartition("/v1.0")[0]
    with pytest.raises(InvalidInput, match=r"scene.json: no scene 'scene-9'; it has 2, from scene-0061 to scene-0103$"):
        open_segment("nuscenes", f"{folder}/scene-9")
    for place in (folder, root):
        with pytest.raises(InvalidInput, match=f"its scenes are called as {folder}/scene-0061$"):
            open_segment("nuscenes", place)
    with pytest.raises(InvalidInput, match="looks like dataset nuscenes"):
        open_segment("av2", root)


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (lambda row: row.update(filename="../secret.bin"), "expected a path below the folder"),
        (lambda row: row.update(timestamp=row["timestamp"] + 50_000), "same time stamp as"),
        (lambda row: row.update(timestamp="then"), "timestamp: Input should be a valid integer"),
        (lambda row: row.update(calibrated_sensor_token=token("scene-0103", "LIDAR_TOP")), "several calibrations"),
    ],
    ids=range(4),
)
def test_a_record_that_cannot_be_is_said_in_one_line(uri, change, reason):
    own = token("scene-0061", "LIDAR_TOP", 3)
    path = edit(uri, "sample_data", lambda rows: [change(row) for row in rows if row["token"] == own] and rows)
    with pytest.raises(InvalidInput, match=f"^{path}: .*{reason}") as refusal:
        open_segment("nuscenes", uri)
    assert "\n" not in str(refusal.value)


def test_other_poses_or_another_calibration_are_another_input(uri):
    listing = open_segment("nuscenes", uri).listing
    assert listing.segment_id == segment_id_of("nuscenes", uri)
    assert len(pickle.dumps(listing)) < 300 * NUM_SWEEPS + 500
    assert reopen(listing).listing.digest == listing.digest

    def move(rows):
        for row in rows:
            row["translation"][0] += 1.0

    edit(uri, "ego_pose", move)
    assert open_segment("nuscenes", uri).listing.digest != listing.digest
    with pytest.raises(UnreadableSweep, match="the record has changed since the scene was listed"):
        reopen(listing).read_sweep(2)
    edit(uri, "calibrated_sensor", move)
    with pytest.raises(InvalidInput, match="the record has changed since the scene was listed"):
        reopen(listing)


def test_tables_are_searched_once_and_in_chunks(uri, monkeypatch):
    expected = open_segment("nuscenes", uri).listing
    read = []
    folder = type(open_storage(uri))
    read_range = folder.read_range
    monkeypatch.setattr(
        folder, "read_range", lambda self, path, a, b: (read.append((path, b - a)), read_range(self, path, a, b))[1]
    )
    monkeypatch.setattr(json_tables, "_CHUNK_BYTES", 1000)  # records lie across them
    reader = open_segment("nuscenes", uri)
    assert reader.listing.digest == expected.digest
    assert max(size for _, size in read) <= 1000
    read.clear()
    np.testing.assert_array_equal(reopen(expected).read_sweep(3).world_from_ego, reader.read_sweep(3).world_from_ego)
    assert {path for path, _ in read} == {"v1.0-mini/ego_pose.json", "v1.0-mini/calibrated_sensor.json"}
    assert len(read) == 3  # the pose twice, the calibration once


def test_a_scene_in_a_bucket_is_the_scene_on_the_disk(uri, bucket):
    root = open_storage(uri.rpartition("/v1.0")[0])._folder
    storage = open_storage(f"{bucket}/nuscenes")
    for path in root.rglob("*"):
        if path.is_file():
            storage.publish(str(path.relative_to(root)), path)
    local, remote = open_segment("nuscenes", uri), open_segment("nuscenes", f"{bucket}/nuscenes/v1.0-mini/scene-0061")
    assert remote.listing.digest == local.listing.digest
    np.testing.assert_array_equal(remote.read_sweep(4).points_ego, local.read_sweep(4).points_ego)
    np.testing.assert_array_equal(remote.read_annotations(7).boxes_ego, local.read_annotations(7).boxes_ego)


def test_a_scene_is_labelled_from_start_to_finish(tmp_path):
    world = make_world(24)
    uri, output = write_scene(tmp_path / "nuscenes", world), str(tmp_path / "labels")
    options = ["--dataset", "nuscenes", "--output", output, "--profile", "fast"]
    result = CliRunner().invoke(app, ["label", uri, *options])
    assert result.exit_code == 0, result.output
    rows = LabelFolder.open(output).table("labels", segment_id_of("nuscenes", uri)).to_pylist()
    assert len({row["track_id"] for row in rows}) == 1
    assert len(rows) >= 20
    for row in rows:
        box = np.array(
            [*(row[f"center_{a}_m"] for a in "xyz"), row["length_m"], row["width_m"], row["height_m"], row["yaw_rad"]]
        )
        truth = world.box_at(0, (row["timestamp_ns"] - world.timestamps_ns[0]) * 1e-9)
        assert iou_3d(truth[None], box[None])[0, 0] > 0.7
