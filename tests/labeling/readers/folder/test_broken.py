"""What is broken is said in one line that names the file and the likely cause; a sweep alone costs no other."""

import numpy as np
import pytest

from labeling.readers.reader import open_segment, reopen
from schemas.errors import InvalidInput, UnreadableSweep


def sweep_files(folder):
    return sorted((folder / "lidar").iterdir())


def keep_lines(path, count):
    path.write_text("".join(path.read_text().splitlines(keepends=True)[:count]))


def rewrite_lines(path, change):
    path.write_text("".join(change(line) + "\n" for line in path.read_text().splitlines()))


def rewrite_floats(path, change):
    path.write_bytes(change(np.fromfile(path, "<f4").reshape(-1, 5)).astype("<f4").tobytes())


BROKEN_SWEEPS = {
    "cut": (
        "pcd-binary",
        lambda path: path.write_bytes(path.read_bytes()[:-7]),
        r"bytes, expected \d+ points of 23: tru",
    ),
    "cut-lzf": ("pcd-compressed", lambda path: path.write_bytes(path.read_bytes()[:-7]), "compressed bytes, expected"),
    "no-header": ("pcd-ascii", lambda path: path.write_bytes(b"1 2 3\n4 5 6\n"), r"no \.pcd header"),
    "empty": ("ply-little", lambda path: path.write_bytes(b""), r"no \.ply header"),
    "cut-ply": ("ply-ascii", lambda path: path.write_bytes(path.read_bytes()[:-500]), "numbers, expected .* truncated"),
    "cut-npy": ("npy", lambda path: path.write_bytes(path.read_bytes()[:-7]), "log/lidar/.*npy: "),
    "cut-npz": ("npz", lambda path: path.write_bytes(path.read_bytes()[:-7]), r"no readable array of NumPy, truncated"),
    "npy-as-npz": ("npz", lambda path: path.write_bytes(b"\x93NUMPY"), r"no readable array of NumPy, trunc"),
    "pickled": (
        "npy",
        lambda path: np.save(path, np.array([{}], dtype=object), allow_pickle=True),
        "pickled Python obj",
    ),
    "four-of-five": (
        "bin",
        lambda path: rewrite_floats(path, lambda rows: rows[:8, :4]),
        r"128 bytes are no rows of 5 .*"
        r"rows of 4 or 8 would fit: say `columns`",
    ),
    "no-points": ("bin", lambda path: path.write_bytes(b""), "no points in the sweep"),
    "only-zeros": ("bin", lambda path: rewrite_floats(path, np.zeros_like), r"no points in the sweep, of \d+ rows"),
    "millimetres": (
        "bin",
        lambda path: rewrite_floats(path, lambda rows: rows * np.array([1e3, 1e3, 1e3, 1, 1])),
        "other `units`",
    ),
    "point-times": (
        "bin",
        lambda path: rewrite_floats(path, lambda rows: rows + np.array([0, 0, 0, 0, 1.7e9])),
        r"column t puts a point 1\.7e\+09 s from its sweep's stamp: .*`since: epoch`",
    ),
    "gone": ("feather", lambda path: path.unlink(), "no such file"),
}


@pytest.mark.parametrize(("kind", "spoil", "message"), BROKEN_SWEEPS.values(), ids=BROKEN_SWEEPS)
def test_a_broken_sweep_is_rejected_alone(kind, spoil, message, write_folder, world, tmp_path):
    folder = write_folder(tmp_path / "log", kind)
    listing = open_segment("folder", str(folder)).listing
    path = sweep_files(folder)[2]
    spoil(path)
    reader = reopen(listing)
    with pytest.raises(UnreadableSweep, match=message) as caught:
        reader.read_sweep(2)
    assert str(caught.value).startswith(f"{path}: ")
    assert "\n" not in str(caught.value)
    for index in (1, 3):
        assert reader.read_sweep(index).num_points == world[index].num_points


def test_rows_that_are_no_points_stay_where_their_rays_began(write_folder, world, tmp_path):
    folder = write_folder(tmp_path / "log", "bin")
    rows_at_fault = {3: [np.nan] * 5, 9: [1, np.inf, 2, 0, 0], 11: [0] * 5}

    def spoil(rows):
        for row, numbers in rows_at_fault.items():
            rows[row] = numbers
        return rows

    rewrite_floats(sweep_files(folder)[2], spoil)
    ours, theirs = open_segment("folder", str(folder)).read_sweep(2), world[2]
    others = np.setdiff1d(np.arange(theirs.num_points), list(rows_at_fault))
    np.testing.assert_array_equal(ours.points_ego[others], theirs.points_ego[others])
    np.testing.assert_array_equal(ours.points_ego[list(rows_at_fault)], np.tile(theirs.sensor_origins_ego, (3, 1)))
    assert np.isfinite(ours.capture_offset_s).all()


def test_five_numbers_a_row_are_not_read_as_four_however_sizes_divide(write_folder, tmp_path):
    folder = write_folder(tmp_path / "log", "bin", said={"columns": list("xyzit")})
    rewrite_floats(sweep_files(folder)[0], lambda rows: rows[: len(rows) // 4 * 4])
    (folder / "motionlabel.yaml").unlink()
    with pytest.raises(UnreadableSweep, match=r"looks like rows of 5 float32, not of 4: .*`columns:"):
        open_segment("folder", str(folder)).read_sweep(0)


BROKEN_FOLDERS = {
    "no-poses": (lambda log: (log / "poses.txt").unlink(), r"log: no poses: .* poses\.txt, poses\.csv, .*trajectory"),
    "two-poses": (lambda log: (log / "odom.csv").write_text("x"), r"poses\.txt and odom\.csv: say which"),
    "no-sweeps": (lambda log: [path.unlink() for path in sweep_files(log)], r"no sweeps: expected files \.bin, \.npy"),
    "two-formats": (
        lambda log: (log / "lidar/1.ply").write_text("x"),
        r"sweeps may be lidar/\*\.pcd and lidar/\*\.ply",
    ),
    "fewer-poses": (
        lambda log: keep_lines(log / "poses.txt", 5),
        r"poses\.txt: 5 poses for 8 sweeps, lidar/.*cut off\?",
    ),
    "odd-columns": (
        lambda log: rewrite_lines(log / "poses.txt", lambda line: line + " 0 0"),
        r"poses\.txt: rows of 14 columns, exp",
    ),
    "empty-poses": (lambda log: (log / "poses.txt").write_text("\n# nothing\n"), r"poses\.txt: no rows"),
    "unknown-key": (
        lambda log: (log / "motionlabel.yaml").write_text("unit: m"),
        r"yaml: unit: .*known are sweeps, col",
    ),
    "bad-yaml": (lambda log: (log / "motionlabel.yaml").write_text("a: [1"), r"motionlabel\.yaml: line 1: not YAML: "),
    "deep-yaml": (lambda log: (log / "motionlabel.yaml").write_text("[" * 9999), "not YAML"),
    "odd-date": (lambda log: (log / "motionlabel.yaml").write_text("units: 2001-99-99"), "not YAML: month must be"),
    "bad-axes": (
        lambda log: (log / "motionlabel.yaml").write_text("axes: [up, down, left]"),
        r"axes up, down, left: exp",
    ),
    "named-file-missing": (
        lambda log: (log / "motionlabel.yaml").write_text("poses: {file: p/a.txt}"),
        "a.txt: no such f",
    ),
    "outside": (lambda log: (log / "motionlabel.yaml").write_text("poses: {file: ../a.txt}"), r"poses\.file"),
    "no-time-in-names": (
        lambda log: sweep_files(log)[0].rename(log / "lidar/first.pcd"),
        r"first\.pcd: no time in its",
    ),
}


@pytest.mark.parametrize(("spoil", "message"), BROKEN_FOLDERS.values(), ids=BROKEN_FOLDERS)
def test_a_folder_that_cannot_be_read_at_all(spoil, message, write_folder, tmp_path):
    folder = write_folder(tmp_path / "log", poses="kitti")
    spoil(folder)
    with pytest.raises(InvalidInput, match=message) as caught:
        open_segment("folder", str(folder))
    assert "\n" not in str(caught.value)
    assert str(caught.value).startswith(str(folder))


def test_a_log_of_another_data_set_is_recognised(tmp_path, write_av2):
    folder = write_av2(tmp_path / "log", [0.0, 0.1], [np.ones((5, 3))] * 2)
    with pytest.raises(InvalidInput, match=r"log: no sweeps: expected .*; it looks like dataset av2$"):
        open_segment("folder", str(folder))


def test_poses_of_another_clock_or_another_log(write_folder, tmp_path):
    folder = write_folder(tmp_path / "log")
    text = (folder / "trajectory.txt").read_text()
    (folder / "trajectory.txt").write_text(text.replace("\n17", "\n16"))
    with pytest.raises(InvalidInput, match=r"trajectory\.txt: poses do not cover the sweeps: .* another clock"):
        open_segment("folder", str(folder))


def test_a_pose_that_is_missing_or_broken_costs_its_sweep_alone(write_folder, tmp_path):
    folder = write_folder(tmp_path / "log", poses="kitti")
    lines = (folder / "poses.txt").read_text().splitlines()
    lines[3] = "nan " + lines[3].partition(" ")[2]
    lines[5] = " ".join(["0"] * 12)
    (folder / "poses.txt").write_text("\n\n".join(lines))
    reader = open_segment("folder", str(folder))
    for index in (3, 5):
        with pytest.raises(UnreadableSweep, match=rf"poses\.txt: pose {index} is not finite, or no rotation"):
            reader.read_sweep(index)
    assert reader.read_sweep(4).num_points


def test_blank_lines_say_nothing(write_folder, tmp_path, world):
    folder = write_folder(tmp_path / "log", poses="kitti")
    path = folder / "poses.txt"
    path.write_text("\n" + path.read_text().replace("\n", "\r\n \r\n"))
    reader = open_segment("folder", str(folder))
    np.testing.assert_allclose(reader.read_sweep(7).world_from_ego, world[7].world_from_ego, atol=1e-9)
