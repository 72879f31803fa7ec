import pickle
from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest
from pyarrow import feather

from labeling.geometry.boxes import points_in_box
from labeling.geometry.transforms import invert, rotate_vectors, transform_points, yaw_translation
from labeling.readers.reader import SegmentReader
from labeling.readers.reader import open_segment as open_by_name
from schemas.errors import InvalidInput, UnreadableSweep

START_NS = 315_966_265_259_836_000
STEP_NS = 100_196_000
EGO_STEP_M = 1.5
YAW_STEP = 0.1
POINTS = np.array([[5.0, 0.0, 0.5], [-3.0, 2.0, 1.0], [10.0, -4.0, 2.0], [0.5, 20.0, 0.25]])


def open_segment(uri):
    return open_by_name("av2", uri)


def world_from_ego(index):
    return yaw_translation(YAW_STEP * index, np.array([5000.0 + EGO_STEP_M * index, 2000.0, 60.0]))


def pose_columns(transforms):
    yaw = np.arctan2(transforms[:, 1, 0], transforms[:, 0, 0])
    quaternion = {"qw": np.cos(yaw / 2), "qx": 0 * yaw, "qy": 0 * yaw, "qz": np.sin(yaw / 2)}
    return {**quaternion, **{f"t{axis}_m": transforms[:, k, 3] for k, axis in enumerate("xyz")}}


def write(path, columns):
    path.parent.mkdir(parents=True, exist_ok=True)
    feather.write_feather(pa.table(columns), path)


def write_sweep(path, points, **extra):
    write(path, {**dict(zip("xyz", points.astype(np.float16).T, strict=True)), **extra})


@pytest.fixture
def log(tmp_path):
    """Three sweeps, five poses, two objects: what a real log's folder holds, and no more."""
    folder = tmp_path / "val" / "log-1"
    stamps = START_NS + STEP_NS * np.arange(-1, 4)
    for stamp in stamps[1:4]:
        offset_ns = np.array([0, 25_000_000, 50_000_000, 100_000_000], dtype=np.int32)
        write_sweep(folder / f"sensors/lidar/{stamp}.feather", POINTS, intensity=np.zeros(4, "u1"), offset_ns=offset_ns)
    poses = np.array([world_from_ego(index) for index in range(-1, 4)])
    write(folder / "city_SE3_egovehicle.feather", {"timestamp_ns": stamps, **pose_columns(poses)})
    sensors = np.array([yaw_translation(0.0, np.array([1.35, 0.0, height])) for height in (1.6, 1.5, 1.4)])
    names = ["up_lidar", "ring_front_center", "down_lidar"]
    write(folder / "calibration/egovehicle_SE3_sensor.feather", {"sensor_name": names, **pose_columns(sensors)})
    boxes = np.array([yaw_translation(yaw, np.array([8.0, 1.0, 0.9])) for yaw in (0.25, np.pi)])
    write(
        folder / "annotations.feather",
        {
            "timestamp_ns": stamps[[1, 3]],
            "track_uuid": pa.array(["car", "bus"], pa.large_string()),  # as newer pandas writes
            "category": pa.array(["REGULAR_VEHICLE", "BUS"]),
            **{name: np.array([size, 2 * size]) for name, size in (("length_m", 4), ("width_m", 2), ("height_m", 1.5))},
            **pose_columns(boxes),
        },
    )
    return folder


def first_sweep(log):
    return log / f"sensors/lidar/{START_NS}.feather"


def test_a_log_opens_as_a_segment(log):
    reader = open_segment(str(log))
    assert isinstance(reader, SegmentReader)
    assert reader.dataset == "av2"
    assert reader.uri == str(log)
    assert reader.segment_id.startswith("log-1-")
    np.testing.assert_array_equal(reader.timestamps_ns, START_NS + STEP_NS * np.arange(3))
    assert reader.timestamps_ns.dtype == np.int64


def test_path_relative_path_and_file_uri_are_the_same_segment_and_a_copy_elsewhere_is_not(log, monkeypatch, tmp_path):
    monkeypatch.chdir(log.parent)
    ids = {open_segment(uri).segment_id for uri in (str(log), f"{log}/", "log-1", "./log-1", log.as_uri())}
    assert len(ids) == 1
    log.rename(tmp_path / "log-1")
    assert open_segment(str(tmp_path / "log-1")).segment_id not in ids


def test_a_sweep_is_read_as_it_was_recorded(log):
    reader = open_segment(str(log))
    sweep = reader.read_sweep(1)
    assert (sweep.index, sweep.timestamp_ns) == (1, START_NS + STEP_NS)
    np.testing.assert_array_equal(sweep.points_ego, POINTS)  # chosen to be exact in float16
    np.testing.assert_allclose(sweep.capture_offset_s, [0, 0.025, 0.05, 0.1])
    np.testing.assert_allclose(sweep.world_from_ego, world_from_ego(1), atol=1e-9)
    np.testing.assert_allclose(sweep.sensor_origins_ego, [[1.35, 0, 1.6], [1.35, 0, 1.4]], rtol=1e-6)


@pytest.mark.parametrize("kind", [pa.float16(), pa.float32(), pa.float64()], ids=str)
def test_coordinates_of_any_float_type_are_read(log, kind):
    columns = {axis: pa.array(POINTS[:, k].astype(kind.to_pandas_dtype())) for k, axis in enumerate("xyz")}
    write(first_sweep(log), columns)
    sweep = open_segment(str(log)).read_sweep(0)
    np.testing.assert_array_equal(sweep.points_ego, POINTS)
    np.testing.assert_array_equal(sweep.capture_offset_s, 0)  # no offset_ns: capture times are unknown


def see_walls(heights_m, num_columns=360):
    """Return what lidars of 32 lasers at some heights see of four walls, one by one, and the laser of each point."""
    azimuth, elevation = np.meshgrid(
        np.linspace(-np.pi, np.pi, num_columns, endpoint=False), np.linspace(-0.2, 0.1, 32)
    )
    rays = np.stack([np.cos(azimuth), np.sin(azimuth), np.tan(elevation)], axis=-1).reshape(-1, 3)
    range_m = 6 / np.abs(rays[:, :2]).max(axis=1)
    clouds = [rays * range_m[:, None] + np.array([1.35, 0.0, height_m]) for height_m in heights_m]
    return np.concatenate(clouds), np.repeat(np.arange(32 * len(heights_m)), num_columns).astype("u1")


@pytest.mark.parametrize("heights_m", [(1.6, 1.4), (1.4, 1.6)], ids=["up first", "down first"])
def test_each_point_knows_its_lidar_whatever_the_order_of_laser_numbers(log, heights_m):
    points, laser = see_walls(heights_m)
    write_sweep(first_sweep(log), points, laser_number=laser)
    sweep = open_segment(str(log)).read_sweep(0)
    heights = sweep.sensor_origins_ego[sweep.lidar_of_point, 2]
    np.testing.assert_allclose(heights, np.repeat(heights_m, len(points) // 2), rtol=1e-6)


def test_which_laser_is_of_which_lidar_is_told_by_the_first_sweep_that_can_be_read(log):
    points, laser = see_walls((1.4, 1.6))
    first_sweep(log).write_bytes(b"")
    write_sweep(log / f"sensors/lidar/{START_NS + STEP_NS}.feather", points, laser_number=laser)
    write_sweep(log / f"sensors/lidar/{START_NS + 2 * STEP_NS}.feather", POINTS, laser_number=np.zeros(4, "u1"))
    np.testing.assert_array_equal(open_segment(str(log)).read_sweep(2).lidar_of_point, 1)


def test_without_laser_numbers_all_points_are_of_the_first_lidar(log):
    np.testing.assert_array_equal(open_segment(str(log)).read_sweep(0).lidar_of_point, 0)


def test_annotations_belong_to_the_exact_time_stamp(log):
    reader = open_segment(str(log))
    first = reader.read_annotations(0)
    assert (first.track_ids, first.categories) == (("car",), ("REGULAR_VEHICLE",))
    np.testing.assert_allclose(first.boxes_ego, [[8, 1, 0.9, 4, 2, 1.5, 0.25]], atol=1e-12)
    assert reader.read_annotations(1) is None
    assert reader.read_annotations(2).boxes_ego[0, 6] == pytest.approx(np.pi)  # not -pi


def test_what_a_log_need_not_have(log):
    (log / "annotations.feather").unlink()
    (log / "calibration/egovehicle_SE3_sensor.feather").unlink()
    reader = open_segment(str(log))
    assert reader.read_annotations(0) is None
    assert reader.read_point_truth(0) is None
    np.testing.assert_allclose(reader.read_sweep(0).sensor_origins_ego, [[1.35, 0, 1.64]] * 2, rtol=1e-6)


def write_flow(log, num_rows=4):
    """Flow as the data set has it: object 0 moves 1 m along WORLD x, the rest stands, ego motion is included."""
    next_from_world = invert(world_from_ego(1))
    points_world = transform_points(world_from_ego(0), POINTS)
    points_world[0, 0] += 1.0
    flow = (transform_points(next_from_world, points_world) - POINTS)[:num_rows]
    names = ("flow_tx_m", "flow_ty_m", "flow_tz_m")
    columns = dict(zip(names, flow.astype(np.float32).T, strict=True))
    write(log / "flow_labels.feather", {**columns, "is_ground_0": np.arange(num_rows) == 3})


def test_flow_truth_is_the_objects_own_motion_in_the_axes_of_its_sweep(log):
    write_flow(log)
    reader = open_segment(str(log))
    truth = reader.read_point_truth(0)
    np.testing.assert_allclose(truth.flow_ref_m[1:], 0, atol=1e-5)  # 5 km from the origin, float32 labels
    own_motion = rotate_vectors(invert(world_from_ego(0)), np.array([1.0, 0.0, 0.0]))
    np.testing.assert_allclose(truth.flow_ref_m[0], own_motion, atol=1e-5)
    np.testing.assert_array_equal(truth.is_ground, [False, False, False, True])
    assert reader.read_point_truth(1) is None  # the file is about the first sweep


def test_flow_truth_is_unknown_where_the_next_pose_is(log):
    write_flow(log)
    for path in sorted((log / "sensors/lidar").iterdir())[1:]:
        path.unlink()
    truth = open_segment(str(log)).read_point_truth(0)
    assert np.isnan(truth.flow_ref_m).all()
    assert truth.is_ground.sum() == 1


def test_flow_labels_of_another_length_are_refused(log):
    write_flow(log, num_rows=3)
    with pytest.raises(InvalidInput, match=r"flow_labels\.feather: 3 rows, expected one a point .*\(4, "):
        open_segment(str(log)).read_point_truth(0)


def test_one_sweep_alone_is_a_segment(log):
    for path in sorted((log / "sensors/lidar").iterdir())[1:]:
        path.unlink()
    reader = open_segment(str(log))
    assert len(reader.timestamps_ns) == 1
    assert reader.read_sweep(0).num_points == 4


def test_opening_reads_no_points_and_a_reader_can_be_sent_to_a_worker(log):
    for path in (log / "sensors/lidar").iterdir():
        path.write_bytes(b"")
    reader = pickle.loads(pickle.dumps(open_segment(str(log))))
    assert len(reader.timestamps_ns) == 3
    with pytest.raises(UnreadableSweep):
        reader.read_sweep(0)


def truncate(path):
    path.write_bytes(path.read_bytes()[:-40])


def nan_row(path):
    write_sweep(path, np.vstack([POINTS, [np.nan, 0, 0], [0, np.inf, 0]]))


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        pytest.param(truncate, "not a readable feather file, truncated", id="truncated"),
        pytest.param(lambda path: path.write_text("x,y,z\n1,2,3\n"), "not a readable feather file", id="not-feather"),
        pytest.param(lambda path: path.write_bytes(b""), "not a readable feather file", id="empty-file"),
        pytest.param(lambda path: write_sweep(path, POINTS[:0]), "no points", id="zero-points"),
        pytest.param(nan_row, "2 of 6 points hold NaN or infinity", id="nan"),
        pytest.param(lambda path: write(path, {"x": [1.0], "y": [1.0]}), "no column z; it has x, y", id="no-z"),
        pytest.param(
            lambda path: write(path, {"x": [1.0, None], "y": [1.0, 2.0], "z": [1.0, 2.0]}),
            "column x is empty in 1 of 2 rows",
            id="nulls",
        ),
        pytest.param(
            lambda path: write(path, {axis: ["one"] for axis in "xyz"}), "column x is not float$", id="text-coordinates"
        ),
        pytest.param(lambda path: path.unlink(), "no such file", id="gone-since-opening"),
    ],
)
def test_a_bad_sweep_is_named_and_its_neighbours_are_read(log, spoil, message):
    reader = open_segment(str(log))
    spoil(first_sweep(log))
    with pytest.raises(UnreadableSweep, match=message) as caught:
        reader.read_sweep(0)
    assert str(caught.value).startswith(str(first_sweep(log)))
    assert "\n" not in str(caught.value)
    assert reader.read_sweep(1).num_points == 4


@pytest.mark.parametrize("is_missing", [True, False], ids=["missing", "zero-quaternion"])
def test_a_sweep_without_a_pose_is_rejected_alone(log, is_missing):
    path = log / "city_SE3_egovehicle.feather"
    columns = {name: column.to_numpy().copy() for name, column in zip(*table_parts(path), strict=True)}
    row = int(np.flatnonzero(columns["timestamp_ns"] == START_NS)[0])
    if is_missing:
        columns = {name: np.delete(column, row) for name, column in columns.items()}
    else:
        for name in ("qw", "qx", "qy", "qz"):
            columns[name][row] = 0.0
    write(path, columns)
    reader = open_segment(str(log))
    with pytest.raises(UnreadableSweep, match=f"no finite pose at {START_NS}"):
        reader.read_sweep(0)
    assert reader.read_sweep(1).num_points == 4


def table_parts(path):
    table = feather.read_table(path)
    return table.column_names, table.columns


def test_poses_of_another_log_name_both_ranges(log):
    stamps = np.array([10, 20])
    write(log / "city_SE3_egovehicle.feather", {"timestamp_ns": stamps, **pose_columns(np.tile(np.eye(4), (2, 1, 1)))})
    with pytest.raises(InvalidInput, match=f"poses do not cover the sweeps.* 10 to 20, sweeps in {START_NS} to"):
        open_segment(str(log))


def test_an_empty_pose_file_is_said_to_be_empty(log):
    poses = pose_columns(np.zeros((0, 4, 4)))
    write(log / "city_SE3_egovehicle.feather", {"timestamp_ns": np.zeros(0, np.int64), **poses})
    with pytest.raises(InvalidInput, match="poses are none"):
        open_segment(str(log))


def drop_poses(log):
    (log / "city_SE3_egovehicle.feather").unlink()


def drop_sweeps(log):
    for path in (log / "sensors/lidar").iterdir():
        path.unlink()


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        pytest.param(drop_poses, r"city_SE3_egovehicle\.feather: no such file", id="no-poses"),
        pytest.param(lambda log: truncate(log / "city_SE3_egovehicle.feather"), "truncated", id="truncated-poses"),
        pytest.param(
            lambda log: write(log / "city_SE3_egovehicle.feather", {"timestamp_ns": [1]}), "no column qw", id="no-qw"
        ),
        pytest.param(drop_sweeps, r"no sweeps, expected files \{timestamp_ns\}\.feather", id="no-sweeps"),
        pytest.param(lambda log: write_sweep(log / "sensors/lidar/a.feather", POINTS), "time stamp", id="bad-name"),
        pytest.param(
            lambda log: write_sweep(log / f"sensors/lidar/0{START_NS}.feather", POINTS), "same time stamp", id="twice"
        ),
        pytest.param(
            lambda log: truncate(log / "calibration/egovehicle_SE3_sensor.feather"), "truncated", id="calibration"
        ),
    ],
)
def test_a_log_that_cannot_be_read_at_all(log, spoil, message):
    spoil(log)
    with pytest.raises(InvalidInput, match=message):
        open_segment(str(log))


def test_bad_annotations_break_their_reader_but_not_the_labelling(log):
    path = log / "annotations.feather"
    write(path, {"timestamp_ns": [START_NS]})
    reader = open_segment(str(log))
    assert reader.read_sweep(0).num_points == 4
    with pytest.raises(InvalidInput, match=r"annotations\.feather: no column track_uuid"):
        reader.read_annotations(0)


def test_an_annotation_without_extent_is_refused(log):
    path = log / "annotations.feather"
    columns = {name: column.to_pylist() for name, column in zip(*table_parts(path), strict=True)}
    write(path, {**columns, "width_m": [2.0, 0.0]})
    with pytest.raises(InvalidInput, match=r"annotations\.feather: row 1: .* sizes above zero"):
        open_segment(str(log)).read_annotations(0)


def test_missing_folder(tmp_path):
    with pytest.raises(InvalidInput, match="nowhere: no such folder"):
        open_segment(str(tmp_path / "nowhere"))


def test_a_file_instead_of_a_folder(log):
    with pytest.raises(InvalidInput, match="is a file, expected the folder of one av2 segment"):
        open_segment(str(log / "annotations.feather"))


def test_a_drive_of_another_data_set_is_recognised(tmp_path):
    (tmp_path / "velodyne_points/data").mkdir(parents=True)
    with pytest.raises(InvalidInput, match=r"no folder sensors/lidar/ .* looks like dataset kitti_raw"):
        open_segment(str(tmp_path))


def test_the_folder_above_is_recognised(log):
    with pytest.raises(InvalidInput, match="holds segments of dataset av2: pass one of them, as log-1"):
        open_segment(str(log.parent))


def test_any_other_folder(tmp_path):
    with pytest.raises(InvalidInput, match="pass the folder of one segment"):
        open_segment(str(tmp_path))


DATA = Path(__file__).resolve().parents[3] / "../shared/data"


def open_real(pattern):
    folder = next(iter(sorted(DATA.glob(pattern))), None)
    if folder is None:
        pytest.skip(f"no log {pattern} in {DATA.name} beside the repository")
    return open_segment(str(folder))


@pytest.fixture(scope="module")
def real_log():
    return open_real("av2/val/*")


@pytest.mark.data
def test_real_points_that_do_not_move_have_no_flow(real_log):
    truth = real_log.read_point_truth(0)
    columns = feather.read_table(Path(real_log.uri) / "flow_labels.feather", columns=["dynamic"])
    is_dynamic = columns["dynamic"].to_numpy()
    speed_m = np.linalg.norm(truth.flow_ref_m, axis=1)
    assert np.median(speed_m[~is_dynamic]) < 0.001  # the data set's ego motion is rounded to float16
    assert np.percentile(speed_m[~is_dynamic], 99) < 0.02
    assert np.median(speed_m[is_dynamic]) > 0.5
    assert 0.1 < truth.is_ground.mean() < 0.6


@pytest.mark.data
def test_real_flow_of_movers_is_the_motion_of_their_boxes_in_the_axes_of_the_first_sweep(real_log):
    here, there = real_log.read_sweep(0), real_log.read_sweep(1)
    annotations, later = real_log.read_annotations(0), real_log.read_annotations(1)
    truth = real_log.read_point_truth(0)
    ego_from_next = invert(here.world_from_ego) @ there.world_from_ego
    next_box = dict(zip(later.track_ids, later.boxes_ego, strict=True))
    num_movers = 0
    for track_id, box in zip(annotations.track_ids, annotations.boxes_ego, strict=True):
        rows = np.flatnonzero(points_in_box(here.points_ego, box))
        rows = rows[~truth.is_ground[rows]]
        if len(rows) < 10 or track_id not in next_box:
            continue
        moved = next_box[track_id]
        motion = ego_from_next @ yaw_translation(moved[6], moved[:3]) @ invert(yaw_translation(box[6], box[:3]))
        expected = transform_points(motion, here.points_ego[rows]) - here.points_ego[rows]
        if np.linalg.norm(expected, axis=1).mean() < 0.4:  # 4 m/s
            continue
        num_movers += 1
        error_m = np.linalg.norm(truth.flow_ref_m[rows] - expected, axis=1)
        assert np.median(error_m) < 0.001  # in the axes of the next sweep it would be 3 to 7 mm
    assert num_movers >= 4


@pytest.mark.data
def test_real_time_stamp_is_the_start_of_the_sweep(real_log):
    sweep = real_log.read_sweep(0)
    gap_s = np.diff(real_log.timestamps_ns)[0] * 1e-9
    assert 0 <= sweep.capture_offset_s.min() < 0.01
    assert abs(sweep.capture_offset_s.max() - gap_s) < 0.01


@pytest.mark.data
@pytest.mark.parametrize("pattern", ["av2/val/*", "sim_av2/val/*-s30-*", "sim_av2/val/*-s100-*"])
def test_real_logs_have_sweeps_poses_and_boxes_that_fit(pattern):
    reader = open_real(pattern)
    sweep = reader.read_sweep(len(reader.timestamps_ns) - 1)
    assert 50_000 < sweep.num_points < 200_000
    assert len(sweep.sensor_origins_ego) == 2
    assert np.bincount(sweep.lidar_of_point).min() > 0.3 * sweep.num_points
    np.testing.assert_allclose(sweep.world_from_ego[:3, :3] @ sweep.world_from_ego[:3, :3].T, np.eye(3), atol=1e-9)
    boxes = reader.read_annotations(sweep.index).boxes_ego
    near = boxes[np.hypot(boxes[:, 0], boxes[:, 1]) < 30]  # what is farther may be hidden
    num_filled = sum(points_in_box(sweep.points_ego, box, 0.05).sum() >= 5 for box in near)
    assert num_filled >= 0.75 * len(near) > 0  # mirrored, two thirds at most


def test_annotations_between_the_sweeps_come_with_their_pose(log):
    assert list(open_segment(str(log)).read_annotations_between()) == []
    first_sweep(log).unlink()
    (between,) = open_segment(str(log)).read_annotations_between()
    timestamp_ns, pose, annotations = between
    assert (timestamp_ns, annotations.track_ids) == (START_NS, ("car",))
    np.testing.assert_allclose(pose, world_from_ego(0), atol=1e-6)


@pytest.mark.parametrize("stem", ["1" * 25, str(2**63), "1" * 200])
def test_a_sweep_named_by_more_digits_than_a_time_stamp_has_is_one_line(tmp_path, write_av2, stem):
    log = write_av2(tmp_path / "log", [0.0, 0.1], [np.zeros((1, 3))] * 2)
    sweep = log / f"sensors/lidar/{stem}.feather"
    sweep.touch()
    with pytest.raises(InvalidInput) as caught:
        open_segment(str(log))
    assert str(caught.value) == f"{sweep}: a sweep's name must be its time stamp in nanoseconds"
