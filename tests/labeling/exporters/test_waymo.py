import numpy as np
import pyarrow.parquet as pq
import pytest

BOX = "[LiDARBoxComponent]"
TYPES = {
    "key.segment_context_name": "string",
    "key.frame_timestamp_micros": "int64",
    "key.laser_object_id": "string",
    **{f"{BOX}.box.{part}.{axis}": "double" for part in ("center", "size") for axis in "xyz"},
    f"{BOX}.box.heading": "double",
    f"{BOX}.type": "int8",
    f"{BOX}.num_lidar_points_in_box": "int64",
    f"{BOX}.num_top_lidar_points_in_box": "int64",
    **{f"{BOX}.{part}.{axis}": "double" for part in ("speed", "acceleration") for axis in "xyz"},
    f"{BOX}.difficulty_level.detection": "int8",
    f"{BOX}.difficulty_level.tracking": "int8",
}


@pytest.fixture
def read(export):
    """Return a function that exports a folder of one segment and reads its table back."""

    def run(folder, **options):
        (path,) = (export(folder, "wod", **options) / "lidar_box").iterdir()
        assert path.name == f"{folder.segment_ids[0]}.parquet"
        return pq.ParquetFile(path).read()

    return run


def test_columns_are_those_of_the_data_set(read, labels, make_labels):
    assert len(TYPES) == 21
    for folder, output in [(labels, "some"), (make_labels([], name="empty"), "none")]:
        table = read(folder, output=output)
        assert list(table.schema.names) == list(TYPES)
        assert {field.name: str(field.type) for field in table.schema} == TYPES


def test_the_car_is_where_its_corners_are(read, labels, car):
    rows = [row for row in read(labels).to_pylist() if row["key.laser_object_id"] == car.track_id]
    assert [row["key.frame_timestamp_micros"] for row in rows] == [
        1_700_000_000_000_000 + 100_000 * i for i in range(3)
    ]
    for row in rows:
        length, width, height = (row[f"{BOX}.box.size.{axis}"] for axis in "xyz")
        x, y, z = (row[f"{BOX}.box.center.{axis}"] for axis in "xyz")
        heading = row[f"{BOX}.box.heading"]
        ahead = np.array([np.cos(heading), np.sin(heading)])
        left = np.array([-ahead[1], ahead[0]])
        corners = car.corners_of([x, y], ahead, left, length, width)
        for place, corner in car.corners.items():
            assert corners[place] == pytest.approx(corner, abs=1e-5)
        assert (z - height / 2, z + height / 2) == pytest.approx((car.bottom_z, car.top_z), abs=1e-6)
        # Waymo's speeds are in the axes of the world: there the vehicle looks along y
        ahead_mps, left_mps, _ = car.velocity_ego
        speed = [row[f"{BOX}.speed.{axis}"] for axis in "xyz"]
        assert speed == pytest.approx([-left_mps, ahead_mps, 0], abs=1e-6)
        assert row["key.segment_context_name"] == labels.segment_ids[0]
        assert row[f"{BOX}.num_lidar_points_in_box"] == car.num_points


def test_what_is_not_known_is_null(read, labels):
    row = read(labels).to_pylist()[0]
    unknown = {f"{BOX}.num_top_lidar_points_in_box", *(f"{BOX}.acceleration.{axis}" for axis in "xyz")}
    assert {name for name, value in row.items() if value is None} == unknown
    assert (row[f"{BOX}.difficulty_level.detection"], row[f"{BOX}.difficulty_level.tracking"]) == (0, 0)


def test_a_heading_of_pi_is_minus_pi(read, make_labels, make_driven):
    track = make_driven(sweeps=[0], box_ego=[10, 2, 0.8, 4.5, 1.8, 1.6, np.pi])
    (heading,) = read(make_labels([track]))[f"{BOX}.box.heading"].to_pylist()
    assert -np.pi <= heading < np.pi
    assert np.cos(heading) == pytest.approx(-1)


def test_types_follow_from_sizes_or_are_given(read, labels):
    assert read(labels, min_score=0.0)[f"{BOX}.type"].to_pylist() == [1, 1, 1, 2, 1]
    assert set(read(labels, output="signs", category="SIGN")[f"{BOX}.type"].to_pylist()) == {3}
