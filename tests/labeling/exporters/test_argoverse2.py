import numpy as np
import pyarrow as pa
import pytest

TYPES = {
    "timestamp_ns": "int64",
    "track_uuid": "string",
    "category": "string",
    **dict.fromkeys(("length_m", "width_m", "height_m", "qw", "qx", "qy", "qz", "tx_m", "ty_m", "tz_m"), "double"),
    "num_interior_pts": "int64",
}


@pytest.fixture
def read(export):
    """Return a function that exports a folder of one segment and reads its table back."""

    def run(folder, **options):
        (path,) = export(folder, "av2", **options).rglob("annotations.feather")
        content = path.read_bytes()
        assert content.startswith(b"ARROW1")  # Feather v2
        assert path.parent.name == folder.segment_ids[0]
        return pa.ipc.open_file(content).read_all()

    return run


def test_columns_are_those_of_the_data_set(read, labels):
    assert {field.name: str(field.type) for field in read(labels).schema} == TYPES


def test_the_car_is_where_its_corners_are(read, labels, car):
    table = read(labels)
    rows = [row for row in table.to_pylist() if row["track_uuid"] == car.track_id]
    assert [row["timestamp_ns"] % 10**9 // 10**8 for row in rows] == [0, 1, 2]
    for row in rows:
        w, x, y, z = (row[f"q{axis}"] for axis in "wxyz")
        assert (x, y) == (0, 0)
        ahead = np.array([w * w - z * z, 2 * w * z])  # the quaternion applied to x
        left = np.array([-ahead[1], ahead[0]])
        corners = car.corners_of([row["tx_m"], row["ty_m"]], ahead, left, row["length_m"], row["width_m"])
        for place, corner in car.corners.items():
            assert corners[place] == pytest.approx(corner, abs=1e-5)
        assert row["tz_m"] - row["height_m"] / 2 == pytest.approx(car.bottom_z, abs=1e-6)
        assert row["tz_m"] + row["height_m"] / 2 == pytest.approx(car.top_z, abs=1e-6)
        assert row["num_interior_pts"] == car.num_points


def test_time_stamps_are_those_of_the_sweeps(read, labels):
    assert set(read(labels)["timestamp_ns"].to_pylist()) == {
        1_700_000_000_000_000_000 + index * 100_000_000 for index in range(3)
    }


def test_categories_follow_from_sizes_or_are_given(read, labels):
    table = read(labels, min_score=0.0)
    assert set(zip(table["height_m"].to_numpy().round(1), table["category"].to_pylist(), strict=True)) == {
        (1.6, "REGULAR_VEHICLE"),
        (1.8, "PEDESTRIAN"),
        (3.2, "LARGE_VEHICLE"),
    }
    assert set(read(labels, output="animals", category="ANIMAL")["category"].to_pylist()) == {"ANIMAL"}


def test_no_boxes_are_an_empty_table(read, make_labels):
    table = read(make_labels([]))
    assert len(table) == 0
    assert {field.name: str(field.type) for field in table.schema} == TYPES


def test_our_own_reader_reads_it(read, labels, car, tmp_path):
    from labeling.readers.files import cuboids_of, read_cuboids
    from labeling.storage.storage import open_storage

    read(labels)
    columns = read_cuboids(
        open_storage(tmp_path / "export" / labels.segment_ids[0]), "annotations.feather", "timestamp_ns"
    )
    is_car = columns["track_uuid"] == car.track_id
    for box in cuboids_of(columns, is_car).boxes_ego:
        np.testing.assert_allclose(box, car.box_ego, atol=1e-6)
