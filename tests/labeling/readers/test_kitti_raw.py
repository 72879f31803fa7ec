import pickle
from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest
from pyarrow import feather
from scipy.spatial import cKDTree

from labeling.geometry.boxes import points_in_box
from labeling.geometry.transforms import invert, transform_points, yaw_of
from labeling.readers.reader import SegmentReader
from labeling.readers.reader import open_segment as open_by_name
from schemas.errors import InvalidInput, UnreadableSweep

FIRST_LINE_NS = 1_317_042_272_348_999_000  # 2011-09-26 13:04:32.348999 UTC
POINTS = np.array([[5.0, 0.1, -0.5, 0.3], [-3.0, 2.0, 1.0, 0.0], [10.0, -4.0, 2.0, 1.0]], dtype=np.float32)
LAT, LON, ALT = 49.0, 8.4, 112.0
EARTH_RADIUS_M = 6378137.0
LEVER_M = np.array([-0.8, 0.3, -0.8])  # T of calib_imu_to_velo.txt: where the IMU is, in the Velodyne frame


def open_segment(uri):
    return open_by_name("kitti_raw", uri)


def oxts(east_m=0.0, north_m=0.0, up_m=0.0, roll=0.0, pitch=0.0, yaw=0.0):
    """A packet that far from the first one, on a sphere and without any projection; close by, they agree."""
    lat = LAT + np.rad2deg(north_m / EARTH_RADIUS_M)
    lon = LON + np.rad2deg(east_m / (EARTH_RADIUS_M * np.cos(np.deg2rad(LAT))))
    return " ".join(map(repr, map(float, [lat, lon, ALT + up_m, roll, pitch, yaw, *[0] * 24])))


def packet_path(drive, number):
    return drive / f"oxts/data/{number:010d}.txt"


def sweep_path(drive, number):
    return drive / f"velodyne_points/data/{number:010d}.bin"


def stamps_path(drive):
    return drive / "velodyne_points/timestamps.txt"


@pytest.fixture
def drive(tmp_path):
    """Four sweeps with packets; the ego drives north, 1 m a sweep, and faces north."""
    folder = tmp_path / "2011_09_26" / "2011_09_26_drive_0001_sync"
    (folder / "velodyne_points/data").mkdir(parents=True)
    (folder / "oxts/data").mkdir(parents=True)
    for number in range(4):
        sweep_path(folder, number).write_bytes(POINTS.tobytes())
        packet_path(folder, number).write_text(oxts(north_m=number, yaw=np.pi / 2))
    lines = [f"2011-09-26 13:04:32.{348999000 + 100000001 * number:09d}\n" for number in range(4)]
    stamps_path(folder).write_text("".join(lines))
    lever = " ".join(map(str, LEVER_M))
    (folder.parent / "calib_imu_to_velo.txt").write_text(
        f"calib_time: now 16:47:16\nR: 1 0 0 0 1 0 0 0 1\nT: {lever}\n"
    )
    return folder


def write_annotations(drive, frames):
    number = len(frames)
    columns = {"track_uuid": [f"t{frame}" for frame in frames], "category": ["CAR"] * number}
    numbers = {"qw": 1, "qx": 0, "qy": 0, "qz": 0, "tx_m": 9, "ty_m": 1, "tz_m": -1}
    numbers |= {"length_m": 4, "width_m": 2, "height_m": 1.5}
    columns |= {name: np.full(number, value, np.float32) for name, value in numbers.items()}
    feather.write_feather(pa.table({"frame": np.array(frames, np.int32), **columns}), drive / "annotations.feather")


def test_a_drive_opens_as_a_segment(drive):
    reader = open_segment(str(drive))
    assert isinstance(reader, SegmentReader)
    assert (reader.dataset, reader.uri) == ("kitti_raw", str(drive))
    assert reader.segment_id.startswith("2011_09_26_drive_0001_sync-")
    assert reader.read_point_truth(0) is None


def test_time_stamps_are_exact_to_the_nanosecond(drive):
    timestamps_ns = open_segment(str(drive)).timestamps_ns
    np.testing.assert_array_equal(timestamps_ns, FIRST_LINE_NS + 100_000_001 * np.arange(4))
    assert timestamps_ns.dtype == np.int64


def test_a_sweep_is_read_as_it_was_recorded(drive):
    sweep = open_segment(str(drive)).read_sweep(2)
    assert (sweep.index, sweep.timestamp_ns) == (2, FIRST_LINE_NS + 200_000_002)
    np.testing.assert_array_equal(sweep.points_ego, POINTS[:, :3])
    np.testing.assert_array_equal(sweep.capture_offset_s, 0)
    np.testing.assert_array_equal(sweep.sensor_origins_ego, [[0, 0, 0]])
    np.testing.assert_array_equal(sweep.lidar_of_point, 0)


def test_the_pose_is_the_velodynes_in_east_north_up_from_the_first_packet(drive):
    reader = open_segment(str(drive))
    poses = [reader.read_sweep(index).world_from_ego for index in range(4)]
    # The Velodyne stands 0.8 m ahead of the IMU, 0.3 m to its right, 0.8 m above; ahead is north, right is east.
    np.testing.assert_allclose(poses[0][:3, 3], [0.3, 0.8, 0.8], atol=1e-6)
    assert yaw_of(poses[0]) == pytest.approx(np.pi / 2)
    np.testing.assert_allclose(poses[3][:3, 3] - poses[0][:3, 3], [0, 3, 0], atol=1e-4)  # with scale 1: 4.6 m


def test_the_scale_is_the_first_packets_however_far_the_drive_goes(drive):
    packet_path(drive, 3).write_text(oxts(east_m=100.0, north_m=50_000.0))
    reader = open_segment(str(drive))
    first, last = (reader.read_sweep(index).world_from_ego for index in (1, 3))
    scale = np.cos(np.deg2rad(LAT))
    north = [np.log(np.tan(np.pi / 4 + np.deg2rad(LAT) / 2 + m / EARTH_RADIUS_M / 2)) for m in (1.0, 50_000.0)]
    expected = scale * EARTH_RADIUS_M * (north[1] - north[0]) - 0.3 - 0.8  # lever arms: facing east now, was north
    assert last[1, 3] - first[1, 3] == pytest.approx(expected, abs=1e-6)
    assert last[0, 3] - first[0, 3] == pytest.approx(100.0 + 0.8 - 0.3, abs=1e-6)


@pytest.mark.parametrize(
    ("angles", "axis", "expected"),
    [
        pytest.param({"yaw": 0.1}, 0, [np.cos(0.1), np.sin(0.1), 0], id="yaw-turns-left"),
        pytest.param({"pitch": 0.1}, 0, [np.cos(0.1), 0, -np.sin(0.1)], id="pitch-dips-the-nose"),
        pytest.param({"roll": 0.1}, 1, [0, np.cos(0.1), np.sin(0.1)], id="roll-lifts-the-left"),
        pytest.param({"yaw": np.pi / 2, "roll": 0.1}, 1, [-np.cos(0.1), 0, np.sin(0.1)], id="roll-before-yaw"),
    ],
)
def test_attitude_follows_the_devkits_convention(drive, angles, axis, expected):
    packet_path(drive, 1).write_text(oxts(**angles))
    pose = open_segment(str(drive)).read_sweep(1).world_from_ego
    np.testing.assert_allclose(pose[:3, axis], expected, atol=1e-12)


def test_annotations_speak_for_their_range_of_frames(drive):
    write_annotations(drive, [1, 3, 3])
    reader = open_segment(str(drive))
    assert reader.read_annotations(0) is None
    assert reader.read_annotations(1).track_ids == ("t1",)
    assert len(reader.read_annotations(2).boxes_ego) == 0  # looked at, and nothing there
    boxes = reader.read_annotations(3).boxes_ego
    np.testing.assert_allclose(boxes, [[9, 1, -1, 4, 2, 1.5, 0]] * 2, atol=1e-12)


def test_no_annotations_and_an_empty_file_of_them(drive):
    assert open_segment(str(drive)).read_annotations(0) is None
    write_annotations(drive, [])
    assert open_segment(str(drive)).read_annotations(0) is None


def test_annotations_without_frame_are_refused_when_asked_for(drive):
    feather.write_feather(pa.table({"track_uuid": ["a"]}), drive / "annotations.feather")
    reader = open_segment(str(drive))
    with pytest.raises(InvalidInput, match=r"annotations\.feather: no column frame"):
        reader.read_annotations(0)


def test_one_sweep_alone_is_a_segment(drive):
    stamps_path(drive).write_text("2011-09-26 13:04:32.348999000\n")
    for number in (1, 2, 3):
        sweep_path(drive, number).unlink()
    reader = open_segment(str(drive))
    assert len(reader.timestamps_ns) == 1
    assert reader.read_sweep(0).num_points == 3


def test_windows_line_ends_are_read(drive):
    stamps_path(drive).write_bytes(stamps_path(drive).read_bytes().replace(b"\n", b"\r\n"))
    assert len(open_segment(str(drive)).timestamps_ns) == 4


def test_opening_reads_no_points_and_a_reader_can_be_sent_to_a_worker(drive):
    for number in range(4):
        sweep_path(drive, number).write_bytes(b"abc")
    reader = pickle.loads(pickle.dumps(open_segment(str(drive))))
    assert len(reader.timestamps_ns) == 4
    with pytest.raises(UnreadableSweep):
        reader.read_sweep(0)


def with_bad_points():
    points = np.tile(POINTS, (2, 1))
    points[0, 1], points[4, 2] = np.nan, -np.inf
    return points.tobytes()


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        pytest.param(lambda path: path.unlink(), "not there when the drive was listed, a gap in the drive", id="gap"),
        pytest.param(lambda path: path.write_bytes(POINTS.tobytes()[:-5]), "43 bytes are not whole points", id="cut"),
        pytest.param(lambda path: path.write_bytes(b""), "no points in the sweep", id="zero-points"),
        pytest.param(lambda path: path.write_bytes(with_bad_points()), "2 of 6 points hold NaN or infinity", id="nan"),
    ],
)
def test_a_bad_sweep_is_named_and_its_neighbours_are_read(drive, spoil, message):
    spoil(sweep_path(drive, 1))
    reader = open_segment(str(drive))
    assert len(reader.timestamps_ns) == 4
    with pytest.raises(UnreadableSweep, match=message) as caught:
        reader.read_sweep(1)
    assert str(caught.value).startswith(str(sweep_path(drive, 1)))
    assert [reader.read_sweep(index).num_points for index in (0, 2, 3)] == [3, 3, 3]


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        pytest.param(
            lambda path: path.unlink(), "not there when the drive was listed, so the sweep has no pose", id="missing"
        ),
        pytest.param(lambda path: path.write_text("49.0 8.4 112"), "expected finite numbers lat lon alt", id="cut"),
        pytest.param(lambda path: path.write_text(""), "expected finite numbers lat lon alt", id="empty"),
        pytest.param(lambda path: path.write_text("49 8.4 nan 0 0 0"), "expected finite numbers", id="nan"),
        pytest.param(lambda path: path.write_text("lat lon alt r p y"), "expected finite numbers", id="text"),
        pytest.param(lambda path: path.write_text("90 8.4 112 0 0 0"), "expected finite numbers", id="pole"),
    ],
)
def test_a_sweep_with_a_bad_pose_is_rejected_alone(drive, spoil, message):
    spoil(packet_path(drive, 2))
    reader = open_segment(str(drive))
    with pytest.raises(UnreadableSweep, match=message):
        reader.read_sweep(2)
    assert reader.read_sweep(3).num_points == 3


def edit_line(drive, number, text):
    lines = stamps_path(drive).read_text().splitlines()
    lines[number - 1] = text
    stamps_path(drive).write_text("\n".join(lines))


def drop_sweeps(drive):
    for number in range(4):
        sweep_path(drive, number).unlink()


def drop_poses(drive):
    for number in range(4):
        packet_path(drive, number).unlink()


def shift_poses(drive):
    for number in range(4):
        packet_path(drive, number).rename(packet_path(drive, number + 10))


def spoil_calibration(drive, text=None):
    path = drive.parent / "calib_imu_to_velo.txt"
    path.unlink() if text is None else path.write_text(text)


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        pytest.param(lambda drive: stamps_path(drive).unlink(), r"timestamps\.txt: no such file", id="no-stamps"),
        pytest.param(lambda drive: stamps_path(drive).write_text("\n"), "no time stamps", id="empty-stamps"),
        pytest.param(
            lambda drive: edit_line(drive, 3, "2011-09-26 13:04:32.0"), "line 3: time stamps must ascend", id="back"
        ),
        pytest.param(
            lambda drive: edit_line(drive, 2, "2011-09-26 13:04:32.348999000"), "line 2: time stamps", id="equal"
        ),
        pytest.param(lambda drive: edit_line(drive, 2, ""), "line 2: expected a time as 2011", id="blank-line"),
        pytest.param(
            lambda drive: edit_line(drive, 4, "1317042272.3"), "line 4: expected a time as 2011", id="seconds"
        ),
        pytest.param(lambda drive: edit_line(drive, 4, "2011-13-26 13:04:32.9"), "line 4: expected", id="month-13"),
        pytest.param(drop_sweeps, r"data: no sweeps, expected files as 0000000000\.bin", id="no-sweeps"),
        pytest.param(
            lambda drive: sweep_path(drive, 4).write_bytes(POINTS.tobytes()),
            r"0000000004\.bin: no time stamp: .* has 4 lines",
            id="more-sweeps-than-stamps",
        ),
        pytest.param(drop_poses, "no poses, expected OXTS packets", id="no-poses"),
        pytest.param(
            shift_poses,
            "poses do not cover the sweeps: packets are numbered 10 to 13, sweeps 0 to 3",
            id="others-poses",
        ),
        pytest.param(
            lambda drive: packet_path(drive, 0).write_text("x"), "0000000000.txt: expected", id="first-packet"
        ),
        pytest.param(spoil_calibration, r"calib_imu_to_velo\.txt: no such file; .* folder of the date", id="no-calib"),
        pytest.param(lambda drive: spoil_calibration(drive, "R: 1 0 0\nT: 0 0 0"), "with 9 numbers", id="short-calib"),
        pytest.param(
            lambda drive: spoil_calibration(drive, "R: 1 0 0 0 1 0 0 0 2\nT: 0 0 0"), "not a rotation", id="no-rotation"
        ),
    ],
)
def test_a_drive_that_cannot_be_read_at_all(drive, spoil, message):
    spoil(drive)
    with pytest.raises(InvalidInput, match=message) as caught:
        open_segment(str(drive))
    assert "\n" not in str(caught.value)


def test_a_log_of_another_data_set_and_the_folder_of_the_date_are_recognised(drive, tmp_path):
    (tmp_path / "log/sensors/lidar").mkdir(parents=True)
    with pytest.raises(InvalidInput, match="looks like dataset av2"):
        open_segment(str(tmp_path / "log"))
    with pytest.raises(InvalidInput, match="pass one of them, as 2011_09_26_drive_0001_sync"):
        open_segment(str(drive.parent))


DATA = Path(__file__).resolve().parents[3] / "../shared/data"


@pytest.fixture(scope="module")
def real_drive():
    folder = next(iter(sorted(DATA.glob("kitti_raw/*/*_sync"))), None)
    if folder is None:
        pytest.skip(f"no KITTI drive in {DATA.name} beside the repository")
    return open_segment(str(folder))


def upright_points_world(reader, index, change=None):
    sweep = reader.read_sweep(index)
    distance_m = np.linalg.norm(sweep.points_ego[:, :2], axis=1)
    upright = sweep.points_ego[(sweep.points_ego[:, 2] > -1.2) & (distance_m < 30)][::3]
    world_from_ego = sweep.world_from_ego if change is None else change(sweep.world_from_ego)
    return transform_points(world_from_ego, upright)


def median_distance_m(reader, change=None):
    first, last = (upright_points_world(reader, index, change) for index in (20, 49))
    return np.median(cKDTree(last).query(first)[0])


@pytest.mark.data
def test_the_real_world_stays_put_over_three_seconds_and_eleven_metres(real_drive):
    # GPS drift remains: 0.1 to 0.2 m a second on this drive, in the packets themselves.
    assert median_distance_m(real_drive) < 0.35


@pytest.mark.data
def test_with_another_scale_or_calibration_the_real_world_would_move(real_drive):
    ours = median_distance_m(real_drive)

    def with_mercator_scale_one(world_from_ego):
        stretched = world_from_ego.copy()
        stretched[:2, 3] /= real_drive.mercator_scale
        return stretched

    def without_calibration(world_from_ego):
        return world_from_ego @ invert(real_drive.imu_from_velodyne)

    def with_inverse_calibration(world_from_ego):
        return without_calibration(without_calibration(world_from_ego))

    assert median_distance_m(real_drive, with_mercator_scale_one) > 5 * ours
    assert median_distance_m(real_drive, without_calibration) > 1.3 * ours
    assert median_distance_m(real_drive, with_inverse_calibration) > 2 * ours


@pytest.mark.data
def test_real_boxes_hold_points(real_drive):
    for index in (0, 25, 49):
        sweep, annotations = real_drive.read_sweep(index), real_drive.read_annotations(index)
        assert 100_000 < sweep.num_points < 140_000
        assert annotations.track_ids
        for box in annotations.boxes_ego:
            assert points_in_box(sweep.points_ego, box, 0.05).sum() >= 5
