"""Waymo segments written from the made-up world: what is read is the world."""

from dataclasses import dataclass, replace

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from typer.testing import CliRunner

from labeling.folders.folder import LabelFolder
from labeling.geometry.boxes import iou_3d, transform_boxes
from labeling.geometry.transforms import invert, transform_points, yaw_translation
from labeling.readers.range_images import RangeImages
from labeling.readers.reader import open_segment, reopen, segment_id_of
from labeling.storage.bucket import ObjectStorage
from labeling.storage.storage import open_storage
from labeling.synthetic.rigs import SpinningLidar
from labeling.synthetic.scene import Scene, drive, wall
from labeling.synthetic.shapes import car
from schemas.errors import InvalidInput, StorageTrouble, UnreadableSweep
from service.cli import app

CONTEXT = "10017090168044687777_6380_000_6400_000"
HALF_TURN_S = 0.05
TOP, FRONT = 1, 2
SIDES = {TOP: (1.35, 0.0, 1.64), FRONT: (3.6, 0.0, 0.5), 3: (1.4, 0.9, 0.7), 4: (1.4, -0.9, 0.7), 5: (-0.9, 0.0, 0.5)}
YAWS = {TOP: 2.6, FRONT: 0.3, 3: 1.6, 4: -1.5, 5: 3.1}  # how each is mounted
SECOND_RETURN_AT = 1.25  # of the first one's range


def rig(steps, beams, side_reach_m=30.0):
    """TOP turns while the vehicle drives; the others see at the frame's instant, for their pixels have no poses."""
    top = SpinningLidar(beams, steps, 0.02, 0.03, origin_ego_m=SIDES[TOP])
    side = SpinningLidar(8, 120, min_range_m=0.5, max_range_m=side_reach_m, has_rolling_shutter=False)
    even = replace(side, beam_shares=(0.0, 1.0), inclinations_deg=(-40.0, 20.0))
    return (top, *(replace(even, origin_ego_m=SIDES[laser]) for laser in range(2, 6)))


def fixed_list(rows, size, kind):
    return pa.array([None if row is None else list(row) for row in rows], pa.list_(kind, size))


def image_columns(field, images):
    return {
        f"{field}.values": pa.array([None if a is None else a.ravel() for a in images], pa.list_(pa.float32())),
        f"{field}.shape": fixed_list([None if a is None else a.shape for a in images], 3, pa.int32()),
    }


def keys(frames, lasers=None):
    columns = {
        "key.segment_context_name": pa.array([CONTEXT] * len(frames)),
        "key.frame_timestamp_micros": pa.array(frames, pa.int64()),
    }
    return columns if lasers is None else columns | {"key.laser_name": pa.array(lasers, pa.int8())}


@dataclass
class Segment:
    """A segment as it is on disk, before it is written: each part may be damaged first."""

    frames: list  # us
    poses: list  # (4, 4) world from vehicle
    images: dict  # (frame, laser) -> [first, second] (H, W, 4)
    pixel_poses: dict  # frame -> (H, W, 6)
    beams: dict  # laser -> (low, high, values or None)
    boxes: list  # (frame, object id, type, (7,) box)
    points_world: list  # per frame (N, 3), in the order that a reader gives them
    times_s: list  # per frame (N,) after the frame's pose, 0 where the format does not tell
    lasers: list  # per frame (N,)
    extrinsics: dict

    def write(self, root, rows_a_group=5):
        order = list(self.images)
        frames, lasers = [frame for frame, _ in order], [laser for _, laser in order]
        lidar = keys(frames, lasers)
        for k in (1, 2):
            images = [self.images[row][k - 1] for row in order]
            lidar |= image_columns(f"[LiDARComponent].range_image_return{k}", images)
        pose_frames = list(self.pixel_poses)
        lidar_pose = keys(pose_frames, [TOP] * len(pose_frames)) | image_columns(
            "[LiDARPoseComponent].range_image_return1", list(self.pixel_poses.values())
        )
        vehicle_pose = keys(self.frames) | {
            "[VehiclePoseComponent].world_from_vehicle.transform": fixed_list(
                [pose.ravel() for pose in self.poses], 16, pa.float64()
            )
        }
        numbers = sorted(self.beams)
        calibration = {
            "key.segment_context_name": pa.array([CONTEXT] * len(numbers)),
            "key.laser_name": pa.array(numbers, pa.int8()),
            "[LiDARCalibrationComponent].extrinsic.transform": fixed_list(
                [self.extrinsics[laser].ravel() for laser in numbers], 16, pa.float64()
            ),
        }
        for k, (name, kind) in enumerate(
            [("min", pa.float64()), ("max", pa.float64()), ("values", pa.list_(pa.float64()))]
        ):
            column = pa.array([self.beams[laser][k] for laser in numbers], kind)
            calibration[f"[LiDARCalibrationComponent].beam_inclination.{name}"] = column
        box = np.array([row[3] for row in self.boxes]).reshape(-1, 7)
        names = [f"box.{part}.{a}" for part in ("center", "size") for a in "xyz"] + ["box.heading"]
        lidar_box = {
            **keys([row[0] for row in self.boxes]),
            "key.laser_object_id": pa.array([row[1] for row in self.boxes], pa.string()),
            **{f"[LiDARBoxComponent].{name}": pa.array(box[:, k]) for k, name in enumerate(names)},
            "[LiDARBoxComponent].type": pa.array([row[2] for row in self.boxes], pa.int8()),
            "[LiDARBoxComponent].speed.x": pa.nulls(len(box), pa.float64()),
        }
        for component, columns, group in (
            ("lidar", lidar, rows_a_group),
            ("lidar_pose", lidar_pose, max(rows_a_group // 5, 1)),
            ("vehicle_pose", vehicle_pose, 100),
            ("lidar_calibration", calibration, 100),
            ("lidar_box", lidar_box, 1000),
        ):
            (root / component).mkdir(parents=True, exist_ok=True)
            pq.write_table(pa.table(columns), root / component / f"{CONTEXT}.parquet", row_group_size=group)
        return root / "lidar" / f"{CONTEXT}.parquet"


def pixels(points_lidar, ascending_rad, width, mounted_yaw):
    """Return range, row and column of (N, 3) points, and how far off their pixel's middle they lie, rad."""
    x, y, z = points_lidar.T
    elevation = np.arctan2(z, np.hypot(x, y))
    top_down = ascending_rad[::-1]
    row = np.abs(elevation[:, None] - top_down).argmin(axis=1)
    from_the_back = (np.pi - (np.arctan2(y, x) + mounted_yaw)) % (2 * np.pi)  # clockwise, from straight behind
    column = from_the_back / (2 * np.pi) * width - 0.5
    off = np.abs(column - np.round(column)) * 2 * np.pi / width + np.abs(elevation - top_down[row])
    return np.linalg.norm(points_lidar, axis=1), row, np.round(column).astype(int) % width, off


def make_segment(world, has_second_returns=True):
    """Project what the lidars of a made-up world see to the pixels of Waymo's images."""
    segment = Segment([], [], {}, {}, {}, [], [], [], [], {})
    start_s = {index: (ns - world.timestamps_ns[0]) * 1e-9 for index, ns in enumerate(world.timestamps_ns)}
    pose_at = world._ego.at
    segment.extrinsics = {laser: yaw_translation(YAWS[laser], np.array(place)) for laser, place in SIDES.items()}
    for index in range(len(world.timestamps_ns)):
        frame = int(world.timestamps_ns[index]) // 1000
        sweep = world.read_sweep(index)
        seen_world = world._capture(index).points_world
        times_s = world._capture(index).times_s
        frame_pose = pose_at(np.array([start_s[index] + HALF_TURN_S]))[0]
        segment.frames.append(frame)
        segment.poses.append(frame_pose)
        rows_world, rows_time, rows_laser = [], [], []
        for number, laser in enumerate(SIDES):
            lidar = world._rig[number]
            mine = np.flatnonzero(sweep.lidar_of_point == number)
            beams, width = lidar.inclinations_rad(), lidar.azimuth_steps
            segment.beams[laser] = (None, None, beams) if laser == TOP else (np.deg2rad(-40), np.deg2rad(20), None)
            poses = pose_at(times_s[mine])
            offset = seen_world[mine] - poses[:, :3, 3]
            points_ego = np.einsum("nji,nj->ni", poses[:, :3, :3], offset)  # of the vehicle when the point was seen
            points_lidar = transform_points(invert(segment.extrinsics[laser]), points_ego)
            distance, row, column, off = pixels(points_lidar, beams, width, YAWS[laser])
            assert off.max() < 1e-5
            first, second = np.zeros((2, len(beams), width, 4), dtype=np.float32)
            first[..., 0] = second[..., 0] = -1  # as Waymo marks pixels without a return
            first[row, column, 0] = distance
            order = np.lexsort((column, row))
            twice = order[::7] if has_second_returns else order[:0]
            second[row[twice], column[twice], 0] = distance[twice] * SECOND_RETURN_AT
            segment.images[frame, laser] = [first, second]
            if laser == TOP:
                column_s = start_s[index] + (width - np.arange(width) - 0.5) / width * 0.1  # it turns anticlockwise
                column_poses = pose_at(column_s)
                roll_pitch_yaw = euler_of(column_poses[:, :3, :3])
                pixel_poses = np.concatenate([roll_pitch_yaw, column_poses[:, :3, 3]], axis=1).astype(np.float32)
                segment.pixel_poses[frame] = np.tile(pixel_poses, (len(beams), 1, 1))
            origin_world = poses[:, :3, :3] @ np.array(SIDES[laser]) + poses[:, :3, 3]
            beyond = origin_world + SECOND_RETURN_AT * (seen_world[mine] - origin_world)
            if laser != TOP:  # at the frame's pose there is what was seen at the stamp's
                frame_from_stamp = frame_pose @ invert(sweep.world_from_ego)
                seen = transform_points(frame_from_stamp, seen_world[mine])
                beyond = transform_points(frame_from_stamp, beyond)
            else:
                seen = seen_world[mine]
            after_s = times_s[mine] - start_s[index] - HALF_TURN_S if laser == TOP else np.zeros(len(mine))
            rows_world += [seen[order], beyond[twice]]
            rows_time += [after_s[order], after_s[twice]]
            rows_laser += [np.full(len(order) + len(twice), number)]
        segment.points_world.append(np.concatenate(rows_world))
        segment.times_s.append(np.concatenate(rows_time))
        segment.lasers.append(np.concatenate(rows_laser))
        truth = world.read_annotations(index)
        frame_from_stamp = invert(frame_pose) @ sweep.world_from_ego
        turn = np.arctan2(frame_from_stamp[1, 0], frame_from_stamp[0, 0])
        for name, box in zip(truth.track_ids, truth.boxes_ego, strict=True):
            center = transform_points(frame_from_stamp, box[None, :3])[0]
            segment.boxes.append((frame, name, 1, np.array([*center, *box[3:6], box[6] + turn])))
    return segment


def euler_of(rotation):
    """Roll, pitch, yaw of (N, 3, 3) rotations Rz Ry Rx, read from their elements."""
    roll = np.arctan2(rotation[:, 2, 1], rotation[:, 2, 2])
    pitch = -np.arcsin(rotation[:, 2, 0])
    return np.column_stack([roll, pitch, np.arctan2(rotation[:, 1, 0], rotation[:, 0, 0])])


@pytest.fixture(scope="module")
def world():
    """The vehicle drives 12 m/s in a bend up a slope, between a car that drives and walls."""
    scene = Scene(
        structures=(wall((30, -20), (30, 20)), wall((-20, 9), (28, 9))),
        movers=(drive(car(), (12, 4), speed_mps=8.0), drive(car(), (9, -6))),
        ego=drive(car(), speed_mps=12.0, yaw_rate_radps=0.3).path,
        ground=replace(Scene().ground, slope_x=0.04),
    )
    return scene.reader(num_sweeps=6, lidar=rig(360, 16))


@pytest.fixture(scope="module")
def made(world):
    return make_segment(world)


@pytest.fixture
def segment(made):
    return replace(made, **{name: type(old)(old) for name, old in vars(made).items()})


@pytest.mark.parametrize("rows_a_group", [5, 3, 100])
def test_what_is_read_is_the_world(segment, tmp_path, rows_a_group):
    reader = open_segment("wod", str(segment.write(tmp_path / "training", rows_a_group)))
    assert (reader.timestamps_ns // 1000).tolist() == segment.frames
    for index, pose in enumerate(segment.poses):
        sweep = reader.read_sweep(index)
        assert sweep.timestamp_ns == segment.frames[index] * 1000
        np.testing.assert_array_equal(sweep.world_from_ego, pose)
        np.testing.assert_array_equal(sweep.lidar_of_point, segment.lasers[index])
        np.testing.assert_allclose(sweep.sensor_origins_ego, list(SIDES.values()), atol=1e-6)
        points_world = transform_points(pose, sweep.points_ego)
        np.testing.assert_allclose(points_world, segment.points_world[index], atol=1e-4)
        np.testing.assert_allclose(sweep.capture_offset_s, segment.times_s[index], atol=2e-3)
    assert np.ptp(segment.times_s[0]) > 0.09  # the vehicle drove 1.2 m meanwhile


def test_points_that_stay_at_their_pixel_are_off_by_the_way_of_the_vehicle(segment, tmp_path):
    """With the frame's pose at each pixel they would be: this drive tells the difference."""
    for frame, pose in zip(segment.frames, segment.poses, strict=True):
        flat = np.concatenate([euler_of(pose[None, :3, :3])[0], pose[:3, 3]]).astype(np.float32)
        segment.pixel_poses[frame] = np.broadcast_to(flat, segment.pixel_poses[frame].shape)
    reader = open_segment("wod", str(segment.write(tmp_path)))
    sweep = reader.read_sweep(1)
    off_m = np.linalg.norm(transform_points(segment.poses[1], sweep.points_ego) - segment.points_world[1], axis=1)
    assert off_m[sweep.lidar_of_point == 0].max() > 0.5
    assert off_m[sweep.lidar_of_point > 0].max() < 1e-4
    np.testing.assert_allclose(sweep.capture_offset_s, 0, atol=1e-6)


def turned(roll, pitch, yaw, place):
    """Rz(yaw) Ry(pitch) Rx(roll), then a move, from cosines and sines."""
    (a, b, c), (d, e, f) = np.cos([roll, pitch, yaw]), np.sin([roll, pitch, yaw])
    about_x = np.array([[1, 0, 0], [0, a, -d], [0, d, a]])
    about_y = np.array([[b, 0, e], [0, 1, 0], [-e, 0, b]])
    about_z = np.array([[c, -f, 0], [f, c, 0], [0, 0, 1]])
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = about_z @ about_y @ about_x, place
    return pose


def test_lidars_that_lean_and_poses_that_roll_bring_a_point_back_to_its_pixel(segment, tmp_path):
    """From a point to the nearest pixel and back is half a pixel, however all is turned."""
    rng = np.random.default_rng(5)
    frame, height, width = segment.frames[0], 64, 2650
    low, high = np.deg2rad([-18, 3])
    for laser in SIDES:
        segment.extrinsics[laser] = turned(0.03 * laser, -0.02 * laser, YAWS[laser], SIDES[laser])
        segment.beams[laser] = (low, high, None)
    lean = turned(0.05, -0.04, 2.0, (3000.0, -5000.0, 12.0))
    points_ego = rng.uniform([-40, -40, -2], [40, 40, 3], (4000, 3))
    poses = rng.uniform([-0.1, -0.1, -3, 2990, -5010, 10], [0.1, 0.1, 3, 3010, -4990, 14], (height, width, 6))
    segment.poses[0] = lean
    segment.pixel_poses[frame] = poses.astype(np.float32)
    sent, ranges_m = {}, {}
    for laser in SIDES:
        image = np.zeros((height, width, 4), dtype=np.float32)
        polar = transform_points(invert(segment.extrinsics[laser]), points_ego)
        middles = low + (np.arange(height) + 0.5) / height * (high - low)
        distance, row, column, _ = pixels(polar, middles, width, np.arctan2(*segment.extrinsics[laser][[1, 0], 0]))
        elevation = np.arcsin(polar[:, 2] / distance)
        keep = (elevation > low) & (elevation < high)
        _, first = np.unique(row * width + column, return_index=True)
        chosen = first[keep[first]]
        image[row[chosen], column[chosen], 0] = distance[chosen]
        segment.images[frame, laser] = [image, None]
        sent[laser], ranges_m[laser] = points_ego[chosen], distance[chosen]
        if laser == TOP:
            pixel_poses = segment.pixel_poses[frame][row[chosen], column[chosen]].astype(np.float64)
            world = [
                (turned(*pose[:3], pose[3:]) @ [*p, 1])[:3] for pose, p in zip(pixel_poses, sent[TOP], strict=True)
            ]
            sent[TOP] = transform_points(invert(lean), np.array(world))
    sweep = open_segment("wod", str(segment.write(tmp_path))).read_sweep(0)
    assert len(sent[TOP]) > 1000
    off_rad = np.hypot(np.pi / width, (high - low) / height / 2)
    for number, laser in enumerate(SIDES):
        off_m = np.linalg.norm(sweep.points_ego[sweep.lidar_of_point == number] - sent[laser], axis=1)
        assert (off_m <= off_rad * ranges_m[laser] + 2e-3).all()  # float32 places 5 km from the origin


def test_a_jump_of_poses_is_not_taken_for_speed(segment, tmp_path):
    """All that follows is three metres ahead, of the vehicle and of its pixels: 30 m/s more in two frames."""
    for k in range(3, 6):
        segment.poses[k] = yaw_translation(0.0, np.array([3.0, 0, 0])) @ segment.poses[k]
        segment.pixel_poses[segment.frames[k]] = segment.pixel_poses[segment.frames[k]] + np.float32([0, 0, 0, 3, 0, 0])
    reader = open_segment("wod", str(segment.write(tmp_path)))
    for index in range(6):
        np.testing.assert_allclose(reader.read_sweep(index).capture_offset_s, segment.times_s[index], atol=2e-3)


def test_a_vehicle_that_stands_tells_no_capture_times(segment, tmp_path):
    for k, frame in enumerate(segment.frames):
        segment.poses[k] = yaw_translation(0.0, np.array([0.001 * k, 0, 0]))
        segment.pixel_poses[frame] = segment.pixel_poses[segment.frames[0]]
    assert not open_segment("wod", str(segment.write(tmp_path))).read_sweep(1).capture_offset_s.any()


def test_boxes_are_those_of_the_world(segment, tmp_path):
    reader = open_segment("wod", str(segment.write(tmp_path)))
    for index, frame in enumerate(segment.frames):
        rows = [row for row in segment.boxes if row[0] == frame]
        truth = reader.read_annotations(index)
        assert truth.track_ids == tuple(row[1] for row in rows)
        assert set(truth.categories) == {"VEHICLE"}
        np.testing.assert_allclose(truth.boxes_ego, [row[3] for row in rows], atol=1e-12)
    (tmp_path / "lidar_box" / f"{CONTEXT}.parquet").unlink()
    assert open_segment("wod", reader.uri).read_annotations(0) is None


def test_a_frame_that_is_bad_is_rejected_alone(segment, tmp_path):
    first, second, third = segment.frames[:3]
    del segment.images[first, 3]
    segment.images[second, FRONT] = [segment.images[second, FRONT][0][:, :, :3], None]
    segment.pixel_poses[third] = np.zeros_like(segment.pixel_poses[third])
    reader = open_segment("wod", str(segment.write(tmp_path)))
    for index, reason in enumerate(
        [
            f"lidar/{CONTEXT}.parquet: no row of frame {first}, laser 3$",
            rf"frame {second}, laser 2: \[LiDARComponent\].range_image_return1 has 2880 values and shape \[8, 120, 3\]",
            f"frame {third}, laser 1: [0-9]+ of [0-9]+ returns have no finite pose in lidar_pose$",
        ]
    ):
        with pytest.raises(UnreadableSweep, match=reason) as refusal:
            reader.read_sweep(index)
        assert "\n" not in str(refusal.value)
    np.testing.assert_allclose(
        transform_points(segment.poses[3], reader.read_sweep(3).points_ego), segment.points_world[3], atol=1e-4
    )


@pytest.mark.parametrize(
    ("damage", "reason"),
    [
        (lambda s, f: s.images[f, 4][0].__setitem__((0, 0, 0), np.nan), "laser 4: 1 of 960 ranges are NaN"),
        (lambda s, f: s.images[f, TOP][1].__setitem__((0, 0, 0), np.inf), "laser 1: 1 of 5760 ranges are NaN or inf"),
        (lambda s, f: [s.images[f, laser][k].fill(0) for laser in SIDES for k in (0, 1)], "no points in the sweep"),
        (lambda s, f: s.pixel_poses[f].__setitem__((0, 0, 3), np.inf), "laser 1: 1 of .* returns have no finite pose"),
        (lambda s, f: s.pixel_poses.pop(f), "lidar_pose.*no row of frame .*, laser 1$"),
        (lambda s, f: s.pixel_poses.__setitem__(f, np.ones((16, 90, 6), np.float32)), "16, 90. have a pose"),
        (lambda s, f: s.images.__setitem__((f, TOP), [s.images[f, TOP][0][:8]] * 2), "8 rows, but 16 beams"),
        (lambda s, f: s.images.__setitem__((f, 5), [None, None]), "range_image_return1 is empty"),
        (lambda s, f: s.poses.__setitem__(0, np.full((4, 4), np.nan)), "no finite pose of frame"),
        (lambda s, f: [s.images.pop((f, laser)) for laser in SIDES], "no row of frame .*, laser 1, 2, 3, 4, 5$"),
    ],
    ids=[
        "NaN",
        "infinite",
        "no returns",
        "infinite pose",
        "no pixel poses",
        "other pixel poses",
        "other beams",
        "no image",
        "no pose",
        "no rows",
    ],
)
def test_the_reason_is_one_line(segment, tmp_path, damage, reason):
    frame = segment.frames[0]
    segment.images |= {row: [a.copy() for a in images] for row, images in segment.images.items() if row[0] == frame}
    segment.images[frame, TOP][0][0, 0, 0] = 5.0
    segment.pixel_poses[frame] = segment.pixel_poses[frame].copy()
    damage(segment, frame)
    reader = open_segment("wod", str(segment.write(tmp_path)))
    assert len(reader.timestamps_ns) == 6
    with pytest.raises(UnreadableSweep, match=reason) as refusal:
        reader.read_sweep(0)
    assert "\n" not in str(refusal.value)
    assert reader.read_sweep(1).num_points


def test_a_damaged_row_group_is_one_sweep(segment, tmp_path):
    path = segment.write(tmp_path)
    column = pq.ParquetFile(path).metadata.row_group(1).column(3)
    content = bytearray(path.read_bytes())
    start = column.dictionary_page_offset or column.data_page_offset
    content[start : start + 60] = b"\xff" * 60
    path.write_bytes(content)
    reader = open_segment("wod", str(path))
    with pytest.raises(UnreadableSweep, match=r"row group 1 of frame .*: not readable as Parquet, damaged") as refusal:
        reader.read_sweep(1)
    assert "\n" not in str(refusal.value)
    for index in (0, 2, 3, 4, 5):
        assert reader.read_sweep(index).num_points == len(segment.points_world[index])


@pytest.mark.parametrize("component", ["lidar", "lidar_pose", "lidar_calibration", "vehicle_pose"])
def test_a_component_that_is_missing_or_broken_is_named(segment, tmp_path, component):
    uri = str(segment.write(tmp_path))
    file = tmp_path / component / f"{CONTEXT}.parquet"
    content = file.read_bytes()
    file.unlink()
    with pytest.raises(InvalidInput, match=f"^{file}: no such file; a segment has one in each of lidar, lidar_pose"):
        open_segment("wod", uri)
    file.write_bytes(content[: len(content) // 2])
    with pytest.raises(InvalidInput, match=f"^{file}: not readable as Parquet, damaged") as refusal:
        open_segment("wod", uri)
    assert "\n" not in str(refusal.value)
    pq.write_table(pa.table({"key.segment_context_name": [CONTEXT]}), file)
    with pytest.raises(InvalidInput, match=f"^{file}: no column key"):
        open_segment("wod", uri)


@pytest.mark.parametrize("component", ["lidar", "lidar_pose", "lidar_calibration", "vehicle_pose", "lidar_box"])
def test_whatever_is_damaged_is_said_in_one_line(segment, tmp_path, component):
    uri, file = str(segment.write(tmp_path)), tmp_path / component / f"{CONTEXT}.parquet"
    content, rng = file.read_bytes(), np.random.default_rng(3)
    reasons = []
    for _ in range(25):  # names, offsets and sizes stand at the end
        damaged = bytearray(content)
        for place in rng.integers(1, min(len(content), 3000), 3):
            damaged[-place] = rng.integers(256)
        file.write_bytes(damaged)
        try:
            reader = open_segment("wod", uri)
            reader.read_annotations(0)
            reader.read_sweep(0)
        except (InvalidInput, UnreadableSweep) as refusal:
            reasons.append(str(refusal))
    assert reasons
    assert not [reason for reason in reasons if "\n" in reason]


def test_what_is_no_segment_is_said_with_one_that_is(segment, tmp_path):
    uri = str(segment.write(tmp_path))
    for place in (tmp_path, tmp_path / "lidar"):
        with pytest.raises(InvalidInput, match=rf"expected a segment of dataset wod.*: pass one of them, as {uri}$"):
            open_segment("wod", str(place))
    with pytest.raises(InvalidInput, match=r"other\.parquet: no such file"):
        open_segment("wod", str(tmp_path / "lidar/other.parquet"))
    with pytest.raises(InvalidInput, match="looks like dataset wod"):
        open_segment("av2", str(tmp_path))
    segment.frames[:] = [frame + 10**9 for frame in segment.frames]
    with pytest.raises(InvalidInput, match=r"poses do not cover the sweeps: .*; a file of another segment"):
        open_segment("wod", str(segment.write(tmp_path)))


def test_other_poses_are_another_input(segment, tmp_path):
    uri = str(segment.write(tmp_path))
    listing = open_segment("wod", uri).listing
    assert reopen(listing).listing.digest == listing.digest
    assert listing.segment_id == segment_id_of("wod", uri)
    segment.poses[2] = yaw_translation(0.0, np.ones(3)) @ segment.poses[2]
    segment.write(tmp_path)
    assert open_segment("wod", uri).listing.digest != listing.digest
    with pytest.raises(InvalidInput, match=r"vehicle_pose.* has changed since"):
        reopen(listing)


def test_the_types_on_disk_vary(segment, tmp_path):
    """Waymo's own files have float poses where the class says double."""
    uri = str(segment.write(tmp_path))
    file = tmp_path / "vehicle_pose" / f"{CONTEXT}.parquet"
    table = pq.read_table(file)
    floats = table.column(2).combine_chunks().flatten().cast(pa.float32())
    pq.write_table(table.set_column(2, table.column_names[2], pa.FixedSizeListArray.from_arrays(floats, 16)), file)
    np.testing.assert_allclose(open_segment("wod", uri).read_sweep(2).world_from_ego, segment.poses[2], atol=1e-5)


def test_a_sweep_reads_its_own_row_groups_from_a_bucket(segment, tmp_path, bucket, monkeypatch):
    uri = segment.write(tmp_path)
    storage = open_storage(f"{bucket}/wod")
    for path in tmp_path.rglob("*.parquet"):
        storage.publish(str(path.relative_to(tmp_path)), path)
    local, remote = (open_segment("wod", place) for place in (str(uri), f"{bucket}/wod/lidar/{uri.name}"))
    assert remote.listing.digest == local.listing.digest
    remote.read_sweep(0)  # tells the turn of TOP, once
    asked = []
    read_range = ObjectStorage.read_range

    def count(self, path, start, stop):
        asked.append((path.partition("/")[0], stop - start))
        return read_range(self, path, start, stop)

    monkeypatch.setattr(ObjectStorage, "read_range", count)
    ours, theirs = remote.read_sweep(2), local.read_sweep(2)
    np.testing.assert_array_equal(ours.points_ego, theirs.points_ego)
    np.testing.assert_array_equal(ours.capture_offset_s, theirs.capture_offset_s)
    group = pq.ParquetFile(uri).metadata.row_group(2)
    own = sum(group.column(k).total_compressed_size for k in range(group.num_columns))
    assert sum(size for component, size in asked if component == "lidar") <= own
    assert len(asked) < 20

    def refuse(*_):
        raise StorageTrouble("the network is away")

    monkeypatch.setattr(ObjectStorage, "read_range", refuse)
    with pytest.raises(StorageTrouble, match="the network is away"):
        remote.read_sweep(1)


def test_a_row_group_of_many_frames_is_read_a_row_at_a_time(segment, tmp_path):
    images = RangeImages(open_storage(segment.write(tmp_path, 100).parent.parent), f"lidar/{CONTEXT}.parquet", [], "")
    batches = []
    iterate = images._file.iter_batches
    images._file.iter_batches = lambda *args, **options: (batches.append(b) or b for b in iterate(*args, **options))
    fields = ["[LiDARComponent].range_image_return1"]
    found = images.read(segment.frames[1], [1, 2, 3, 4, 5], fields, 4)
    assert sorted(found) == [1, 2, 3, 4, 5]
    assert [batch.num_rows for batch in batches] == [1] * 10  # it stops at the frame's last row


def test_a_drive_is_labelled_from_start_to_finish(tmp_path):
    """One car drives past; its labels are where the boxes of the world are."""
    scene = Scene(
        structures=(wall((60, -20), (60, 20)), wall((-60, 12), (60, 12))),
        movers=(drive(car(), (-12, 5), speed_mps=9.0),),
        ego=drive(car(), speed_mps=3.0).path,
    )
    world = scene.reader(num_sweeps=12, lidar=rig(720, 32, side_reach_m=4.0))
    segment = make_segment(world, has_second_returns=False)
    uri = str(segment.write(tmp_path / "validation"))
    output = tmp_path / "labels"
    options = ["--dataset", "wod", "--output", str(output), "--profile", "fast"]
    result = CliRunner().invoke(app, ["label", uri, *options])
    assert result.exit_code == 0, result.output
    rows = LabelFolder.open(str(output)).table("labels", segment_id_of("wod", uri)).to_pylist()
    assert [row["sweep_index"] for row in rows] == list(range(12))
    for row in rows:
        (truth,) = transform_boxes(segment.poses[row["sweep_index"]], segment.boxes[row["sweep_index"]][3][None])
        center, size = [row[f"center_{a}_m"] for a in "xyz"], [row[f"{a}_m"] for a in ("length", "width", "height")]
        assert iou_3d(truth[None], np.array([[*center, *size, row["yaw_rad"]]]))[0, 0] > 0.7
        assert np.hypot(row["velocity_x_mps"], row["velocity_y_mps"]) == pytest.approx(9.0, abs=0.3)
