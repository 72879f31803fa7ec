"""Time stamps from names and from files, and poses at times between those of the sweeps."""

import numpy as np
import pytest

from labeling.readers.folder.stamps import in_order, stamp_in_name
from labeling.readers.folder.text import parse_table, time_ns, unit_of
from labeling.readers.reader import open_segment
from schemas.errors import InvalidInput, UnreadableSweep


def count(index, sweep):
    return f"{index:06d}"


def read_stamps(folder):
    return open_segment("folder", str(folder)).timestamps_ns


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("1700000000123456789.bin", 1_700_000_000_123_456_789),
        ("lidar/1700000000123456.pcd", 1_700_000_000_123_456_000),
        ("1700000000123.npy", 1_700_000_000_123_000_000),
        ("1700000000.5.pcd", 1_700_000_000_500_000_000),
        ("1700000000_000000005.pcd", 1_700_000_000_000_000_005),
        ("n015-2018-07-24-11-22-45+0800__LIDAR_TOP__1532402927647951.pcd.bin", 1_532_402_927_647_951_000),
        ("000012.bin", None),
        ("cloud.ply", None),
    ],
)
def test_a_name_tells_its_time(name, expected):
    assert stamp_in_name(name) == expected


def test_a_table_is_read_in_any_of_the_usual_ways():
    quoted = parse_table(b'\xef\xbb\xbf"time","x"\r\n\r\n"1.5","2"\r\n', "there")
    assert (quoted.names, [row.cells for row in quoted.rows], quoted.rows[0].number) == (
        ("time", "x"),
        [("1.5", "2")],
        3,
    )
    assert parse_table(b"# a comment\n# time x\n1.5; 2\n", "there").rows[0].cells == ("1.5", "2")
    assert parse_table(b"#timestamp tx ty\n1 2 3\n", "there").names == ("timestamp", "tx", "ty")
    assert len(parse_table(b"nan nan nan\n1 2 3\n", "there").rows) == 2
    with pytest.raises(InvalidInput, match=r"^there: no rows$"):
        parse_table(b"time,x\n", "there")
    with pytest.raises(InvalidInput, match=r"^there: line 1: no row of cells"):
        parse_table(b"1," + b"2" * 200_000, "there")


def test_names_are_in_the_order_of_their_numbers():
    assert in_order(["10.bin", "9.bin", "a_2.bin"]) == ["a_2.bin", "9.bin", "10.bin"]


@pytest.mark.parametrize(
    ("cell", "expected"),
    [
        ("1700000000123456789", 1_700_000_000_123_456_789),
        ("1700000000.123456789", 1_700_000_000_123_456_789),
        ("1.036e-01", 103_600_000),
        ("2011-09-26T13:04:32.348999000", 1_317_042_272_348_999_000),
    ],
)
def test_times_are_exact_to_the_nanosecond(cell, expected):
    assert time_ns(cell, unit_of(cell)) == expected


@pytest.mark.parametrize("cell", ["", "nan", "inf", "1e30", "soon"])
def test_what_is_no_time_is_refused(cell):
    with pytest.raises(ValueError, match="expected a time, got"):
        time_ns(cell, "s")


@pytest.mark.parametrize(
    "text_of",
    [
        pytest.param(lambda k, ns: f"{ns}\n", id="nanoseconds"),
        pytest.param(lambda k, ns: f"{ns // 10**9}.{ns % 10**9:09d}\n\n", id="seconds-and-blank-lines"),
        pytest.param(lambda k, ns: f"{np.datetime64(ns, 'ns')}\n".replace("T", " "), id="dates"),
        pytest.param(lambda k, ns: f"{k:06d}.pcd, {ns}\n", id="named"),
        pytest.param(lambda k, ns: f"{k} {ns}\n", id="numbered"),
    ],
)
def test_a_file_tells_the_times(text_of, write_folder, world, tmp_path):
    folder = write_folder(tmp_path / "log", stem=count)
    expected = [sweep.timestamp_ns for sweep in world]
    (folder / "timestamps.txt").write_text("".join(text_of(k, ns) for k, ns in enumerate(expected)))
    np.testing.assert_array_equal(read_stamps(folder), expected)


def test_a_csv_tells_the_times_by_the_names_of_its_columns(write_folder, world, tmp_path):
    folder = write_folder(tmp_path / "log", stem=count)
    rows = [f"{sweep.timestamp_ns / 1e3:.0f},0,{k:06d}.pcd" for k, sweep in enumerate(world)]
    (folder / "when.csv").write_text("\n".join(["stamp,frame_id,file", *rows]))
    with (folder / "motionlabel.yaml").open("a") as file:
        file.write("stamps: {file: when.csv}\n")
    np.testing.assert_allclose(read_stamps(folder), [sweep.timestamp_ns for sweep in world], rtol=0, atol=500)


def test_a_rate_tells_the_times_of_numbered_sweeps(write_folder, tmp_path):
    folder = write_folder(tmp_path / "log", poses="kitti", stem=count, said={"rate_hz": 10.0})
    np.testing.assert_array_equal(read_stamps(folder), np.arange(8) * 100_000_000)


def test_rows_are_counted_by_number_where_sweeps_are_missing(write_folder, world, tmp_path):
    folder = write_folder(tmp_path / "log", poses="kitti", stem=count, said={"rate_hz": 10.0})
    (folder / "lidar/000003.pcd").unlink()
    reader = open_segment("folder", str(folder))
    assert reader.timestamps_ns[3] == 400_000_000
    np.testing.assert_allclose(reader.read_sweep(3).world_from_ego, world[4].world_from_ego, atol=1e-9)


@pytest.mark.parametrize(
    ("change", "index", "message"),
    [
        pytest.param(lambda ns: ns[3], 4, "line 5: not after", id="repeated"),
        pytest.param(lambda ns: ns[0] - 10**9, 4, "line 5: not after", id="past"),
        pytest.param(lambda ns: ns[7] + 10**12, 4, "line 5: not after", id="future"),
        pytest.param(lambda ns: "soon", 4, "line 5: expected a time", id="text"),
    ],
)
def test_one_wrong_time_costs_one_sweep(change, index, message, write_folder, world, tmp_path):
    folder = write_folder(tmp_path / "log", poses="kitti", stem=count)
    stamps = [sweep.timestamp_ns for sweep in world]
    lines = list(map(str, stamps))
    lines[index] = str(change(stamps))
    (folder / "timestamps.txt").write_text("\n".join(lines))
    reader = open_segment("folder", str(folder))
    good = [k for k in range(8) if k != index]
    np.testing.assert_array_equal(reader.timestamps_ns[good], np.array(stamps)[good])
    for k in good:
        assert reader.read_sweep(k).num_points == world[k].num_points
    with pytest.raises(UnreadableSweep, match=message):
        reader.read_sweep(index)


def test_a_sweep_without_a_line_of_its_own_has_no_time(write_folder, world, tmp_path):
    folder = write_folder(tmp_path / "log", poses="kitti", stem=count)
    lines = [f"{k:06d},{sweep.timestamp_ns}" for k, sweep in enumerate(world) if k != 2]
    (folder / "timestamps.csv").write_text("name,time\n" + "\n".join(lines))
    reader = open_segment("folder", str(folder))
    with pytest.raises(UnreadableSweep, match=r"000002\.pcd: .*timestamps\.csv: no line of lidar/000002\.pcd"):
        reader.read_sweep(2)
    assert [k for k in range(8) if k not in reader.sweeps.faults] == [0, 1, 3, 4, 5, 6, 7]


def trajectory(folder):
    lines = (folder / "trajectory.txt").read_text().splitlines()[1:]
    return np.array([[float(cell) for cell in line.split()] for line in lines])


def test_poses_between_sweeps_are_interpolated_over_short_gaps_only(write_folder, world, tmp_path):
    folder = write_folder(tmp_path / "log")
    lines = (folder / "trajectory.txt").read_text().splitlines()
    del lines[3]  # of sweep 2
    (folder / "trajectory.txt").write_text("\n".join(lines))
    reader = open_segment("folder", str(folder))
    np.testing.assert_allclose(reader.read_sweep(2).world_from_ego, world[2].world_from_ego, atol=0.02)
    del lines[2:5]
    (folder / "trajectory.txt").write_text("\n".join(lines))
    reader = open_segment("folder", str(folder))
    with pytest.raises(UnreadableSweep, match=r"no pose at \d+ ns, the nearest is 0\.2 s away; .* or a gap\?"):
        reader.read_sweep(2)
    assert reader.read_sweep(0).num_points
    assert reader.read_sweep(6).num_points
