from pathlib import Path

import numpy as np
import pytest

from labeling.exporters.kitti import read_calibration
from schemas.errors import InvalidInput

TRACKING = """P0: 1 0 0 0 0 1 0 0 0 0 1 0
P2: 700 0 600 44 0 700 170 0.2 0 0 1 0.003
R_rect 1 0 0 0 1 0 0 0 1
Tr_velo_cam 0 -1 0 0.1 0 0 -1 -0.2 1 0 0 -0.3
"""
OBJECT = TRACKING.replace("R_rect", "R0_rect:").replace("Tr_velo_cam", "Tr_velo_to_cam:")
# the same camera: x right, y down, z ahead, 0.3 m before, 0.2 m above and 0.1 m left of the lidar
RAW = {
    "calib_velo_to_cam.txt": "calib_time: 15-Mar-2012 11:37:16\nR: 0 -1 0 0 0 -1 1 0 0\nT: 0.1 -0.2 -0.3\n",
    "calib_cam_to_cam.txt": "calib_time: 09-Jan-2012\nR_00: 1 0 0 0 1 0 0 0 1\nR_rect_00: 1 0 0 0 1 0 0 0 1\n"
    "P_rect_02: 700 0 600 44 0 700 170 0.2 0 0 1 0.003\n",
}
KITTI_DATE = Path(__file__).resolve().parents[3] / "../shared/data/kitti_raw/2011_09_26"


@pytest.fixture
def calibration(tmp_path):
    path = tmp_path / "0000.txt"
    path.write_text(TRACKING)
    return str(path)


@pytest.fixture
def read(export, calibration):
    """Return a function that exports a folder of one segment and splits its lines."""

    def run(folder, **options):
        (path,) = export(folder, "kitti", **{"calibration": calibration, **options}).rglob("*.txt")
        assert path.relative_to(path.parents[1]).as_posix() == f"label_02/{folder.segment_ids[0]}.txt"
        return [line.split(" ") for line in path.read_text().splitlines()]

    return run


def to_camera(point_ego):
    """Where the calibration above sees a point of the ego frame."""
    x, y, z = point_ego
    return np.array([-y + 0.1, -z - 0.2, x - 0.3])


def test_a_line_has_the_columns_of_a_label(read, labels):
    lines = read(labels)
    assert {len(line) for line in lines} == {17}
    assert [line[:5] for line in lines] == [
        ["0", "0", "Car", "-1", "3"],
        ["1", "0", "Car", "-1", "3"],
        ["1", "1", "Pedestrian", "-1", "3"],
        ["2", "0", "Car", "-1", "3"],
    ]


def test_the_car_is_where_its_corners_are(read, labels, car):
    for line in read(labels):
        if line[2] != "Car":
            continue
        height, width, length, x, y, z_ahead, rotation_y = map(float, line[10:])
        # turned by rotation_y about y, which points down: x of the object ahead, z of the object to its left
        ahead = np.array([np.cos(rotation_y), 0, -np.sin(rotation_y)])
        left = np.array([np.sin(rotation_y), 0, np.cos(rotation_y)])
        for up_m, z in ((0.0, car.bottom_z), (height, car.top_z)):
            corners = car.corners_of([x, y - up_m, z_ahead], ahead, left, length, width)
            for place, corner in car.corners.items():
                assert corners[place] == pytest.approx(to_camera([*corner, z]), abs=3e-6)


def test_the_angle_of_view_is_that_of_the_camera(read, labels):
    line = next(line for line in read(labels) if line[2] == "Car")
    # turned left by 30 degrees of what is straight ahead, seen along a ray that goes left by atan(1.9 / 9.7)
    assert float(line[16]) == pytest.approx(-np.pi / 2 - np.pi / 6, abs=1e-6)
    assert float(line[5]) == pytest.approx(-np.pi / 2 - np.pi / 6 + np.arctan2(1.9, 9.7), abs=1e-6)


def test_the_rectangle_holds_all_corners(read, labels, car):
    line = next(line for line in read(labels) if line[2] == "Car")
    corners = [to_camera([*xy, z]) for xy in car.corners.values() for z in (car.bottom_z, car.top_z)]
    u = [(700 * x + 600 * z + 44) / (z + 0.003) for x, _, z in corners]
    v = [(700 * y + 170 * z + 0.2) / (z + 0.003) for _, y, z in corners]
    assert list(map(float, line[6:10])) == pytest.approx([min(u), min(v), max(u), max(v)], abs=1e-3)


def test_what_is_not_wholly_ahead_has_no_rectangle(read, make_labels, make_driven):
    beside = make_labels([make_driven(sweeps=[0], box_ego=[0.0, 4.0, 0.8, 4.5, 1.8, 1.6, 0.0])])
    (line,) = read(beside)
    assert list(map(float, line[6:10])) == [-1] * 4


def test_every_way_to_give_the_calibration_is_the_same(tmp_path, calibration):
    (tmp_path / "object.txt").write_text(OBJECT)
    (tmp_path / "date").mkdir()
    for name, text in RAW.items():
        (tmp_path / "date" / name).write_text(text)
    expected = read_calibration(calibration)
    for place in ("object.txt", "date"):
        found = read_calibration(str(tmp_path / place))
        np.testing.assert_array_equal(found.camera_from_ego, expected.camera_from_ego)
        np.testing.assert_array_equal(found.image_from_camera, expected.image_from_camera)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", r"expected a line Tr_velo_cam or Tr_velo_to_cam of 12 numbers"),
        (TRACKING.replace("P2", "P9"), r"expected a line P2 of 12 numbers"),
        (TRACKING.replace("R_rect 1 0", "R_rect 1"), r"expected a line R_rect or R0_rect of 9 numbers"),
        (TRACKING.replace("R_rect 1 0", "R_rect nan 0"), r"expected a line R_rect or R0_rect of 9 numbers"),
    ],
)
def test_what_is_no_calibration_is_one_line(tmp_path, text, message):
    (tmp_path / "bad.txt").write_text(text)
    with pytest.raises(InvalidInput, match=message):
        read_calibration(str(tmp_path / "bad.txt"))


def test_half_a_raw_calibration_is_one_line(tmp_path):
    (tmp_path / "calib_velo_to_cam.txt").write_text(RAW["calib_velo_to_cam.txt"])
    with pytest.raises(InvalidInput, match=r"calib_cam_to_cam.txt: no such file"):
        read_calibration(str(tmp_path))


@pytest.mark.data
@pytest.mark.skipif(not KITTI_DATE.exists(), reason="no KITTI drive beside the repository")
def test_the_real_camera_looks_ahead():
    calibration = read_calibration(str(KITTI_DATE))
    ahead = calibration.camera_from_ego @ [20.0, 0.0, 0.0, 1.0]
    assert ahead[:3] == pytest.approx([0.0, 0.0, 20.0], abs=0.6)
    u, v, w = calibration.image_from_camera @ ahead
    assert (u / w, v / w) == pytest.approx((610, 173), abs=20)  # the middle of the image, a little below
