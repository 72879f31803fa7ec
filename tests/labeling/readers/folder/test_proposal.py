"""What init-folder proposes reads the folder right, and says how sure it is."""

import numpy as np
import pytest

from labeling.geometry.transforms import yaw_translation
from labeling.readers.folder.description import Description, parse_description
from labeling.readers.folder.proposal import propose, write_proposal
from labeling.readers.reader import open_segment
from labeling.storage.storage import open_storage
from schemas.errors import InvalidInput


def proposed(folder):
    """Write a proposal in place of what is said; return its lines by key, and the folder read so."""
    (folder / "motionlabel.yaml").unlink()
    lines = {line.key: line for line in write_proposal(open_storage(folder))}
    return lines, open_segment("folder", str(folder))


def require_same(reader, world, atol_m=1e-4):
    np.testing.assert_array_equal(reader.timestamps_ns, [sweep.timestamp_ns for sweep in world])
    for index, sweep in enumerate(world):
        ours = reader.read_sweep(index)
        np.testing.assert_allclose(ours.points_ego, sweep.points_ego, rtol=0, atol=atol_m)
        np.testing.assert_allclose(ours.capture_offset_s, sweep.capture_offset_s, rtol=0, atol=1e-7)
        np.testing.assert_allclose(ours.world_from_ego, sweep.world_from_ego, rtol=0, atol=1e-6)


@pytest.mark.parametrize(
    "kind",
    ["bin", "npy", "npy-structured", "npz", "npz-columns", "pcd-ascii", "pcd-compressed", "ply-big", "las", "feather"],
)
def test_a_proposal_reads_the_folder_right(kind, write_folder, world, tmp_path):
    lines, reader = proposed(write_folder(tmp_path / "log", kind))
    require_same(reader, world, 0.0006 if kind == "las" else 1e-4)
    assert lines["sweeps"].sureness == lines["units"].sureness == lines["time"].sureness == "sure"
    assert lines["poses"].sureness == "sure"


def test_the_proposal_for_bare_rows_names_their_columns(write_folder, tmp_path):
    lines, _ = proposed(write_folder(tmp_path / "log", "bin"))
    assert lines["columns"].value == ["x", "y", "z", "intensity", "t"]


@pytest.mark.parametrize("layout", ["kitti", "csv", "npy-4x4"])
def test_poses_are_found_by_their_rows_whatever_the_file_is_called(layout, write_folder, world, tmp_path):
    folder = write_folder(tmp_path / "log", poses=layout)
    path = next(path for path in folder.iterdir() if path.suffix in (".txt", ".csv", ".npy"))
    path.rename(folder / f"where_we_were{path.suffix}")
    lines, reader = proposed(folder)
    assert lines["poses"].value["file"] == f"where_we_were{path.suffix}"
    require_same(reader, world)


def test_inverted_poses_are_found_out(write_folder, world, tmp_path):
    folder = write_folder(tmp_path / "log", poses="npy-4x4")
    np.save(folder / "poses.npy", np.linalg.inv(np.load(folder / "poses.npy")))
    lines, reader = proposed(folder)
    assert lines["poses"].value["inverse"] is True
    assert lines["poses"].sureness == "sure"
    require_same(reader, world)


@pytest.mark.parametrize(
    ("axes", "turn", "sureness"),
    [
        (["right", "forward", "up"], [[0, -1, 0], [1, 0, 0], [0, 0, 1]], "sure"),
        (
            ["back", "right", "up"],
            [[-1, 0, 0], [0, -1, 0], [0, 0, 1]],
            "likely",
        ),  # or inverted poses, on a straight road
        (["left", "back", "up"], [[0, 1, 0], [-1, 0, 0], [0, 0, 1]], "sure"),
    ],
)
def test_a_lidar_that_is_turned_in_the_vehicle_is_found_out(axes, turn, sureness, write_folder, world, tmp_path):
    turn = np.array(turn, dtype=np.float32)
    folder = write_folder(tmp_path / "log", points_of=lambda sweep: sweep.points_ego @ turn.T)
    lines, reader = proposed(folder)
    assert lines["axes"].value == axes
    assert lines["axes"].sureness == sureness
    require_same(reader, world)


def test_axes_and_poses_of_another_convention_are_found_out_together(write_folder, world, tmp_path):
    """Camera axes: z ahead, x to the right, y down, for points and poses alike."""
    turn = np.array([[0, -1, 0], [0, 0, -1], [1, 0, 0]])
    folder = write_folder(
        tmp_path / "log", poses="npy-4x4", points_of=lambda sweep: (sweep.points_ego @ turn.T).astype(np.float32)
    )
    change = np.eye(4)
    change[:3, :3] = turn
    np.save(folder / "poses.npy", change @ np.load(folder / "poses.npy") @ change.T)
    lines, reader = proposed(folder)
    assert lines["axes"].value == ["right", "down", "forward"]
    require_same(reader, world)


def test_poses_of_a_camera_are_found_out_without_a_calibration(write_folder, world, tmp_path):
    folder = write_folder(tmp_path / "log", poses="npy-4x4")
    camera_from_lidar = np.array([[0, -1, 0, 0.1], [0, 0, -1, -0.3], [1, 0, 0, -0.5], [0, 0, 0, 1.0]])
    np.save(folder / "poses.npy", camera_from_lidar @ np.load(folder / "poses.npy") @ np.linalg.inv(camera_from_lidar))
    lines, reader = proposed(folder)
    assert lines["poses"].value == {"file": "poses.npy", "of": "sensor", "axes": ["right", "down", "forward"]}
    np.testing.assert_allclose(reader.read_sweep(7).world_from_ego[:3, :3], world[7].world_from_ego[:3, :3], atol=1e-6)


def test_poses_of_another_drive_fit_in_no_way_and_that_is_said(write_folder, world, tmp_path):
    folder = write_folder(tmp_path / "log", poses="npy-4x4")
    bend = [yaw_translation(0.15 * k, 2.0 * k * np.array([np.cos(0.07 * k), np.sin(0.07 * k), 0])) for k in range(8)]
    np.save(folder / "poses.npy", bend)
    (folder / "motionlabel.yaml").unlink()
    lines = {line.key: line for line in propose(open_storage(folder))}
    assert lines["poses"].sureness == "a guess"
    assert "NO READING FITS" in lines["poses"].text


def test_millimetres_are_found_out(write_folder, world, tmp_path):
    folder = write_folder(tmp_path / "log", points_of=lambda sweep: sweep.points_ego * np.float32(1000))
    lines, reader = proposed(folder)
    assert (lines["units"].value, lines["units"].sureness) == ("mm", "likely")
    require_same(reader, world)


def test_what_files_do_not_tell_is_called_a_guess(write_folder, tmp_path):
    folder = write_folder(tmp_path / "log", poses="kitti", stem=lambda index, sweep: f"{index:04d}")
    lines, reader = proposed(folder)
    assert (lines["rate_hz"].value, lines["rate_hz"].sureness) == (10.0, "a guess")
    assert reader.timestamps_ns[1] == 100_000_000
    (folder / "poses.txt").unlink()
    lines = {line.key: line for line in propose(open_storage(folder))}
    assert lines["poses"].sureness == "a guess"
    assert "NO POSES" in lines["poses"].text


def test_a_vehicle_that_stands_tells_no_axes(write_folder, world, tmp_path):
    folder = write_folder(tmp_path / "log", poses="npy-4x4")
    np.save(folder / "poses.npy", np.tile(np.eye(4), (len(world), 1, 1)))
    lines, _ = proposed(folder)
    assert lines["axes"].sureness == lines["poses"].sureness == "a guess"


def test_a_description_that_is_there_stays_unless_forced(write_folder, tmp_path):
    folder = write_folder(tmp_path / "log")
    before = (folder / "motionlabel.yaml").read_text()
    with pytest.raises(InvalidInput, match=r"motionlabel\.yaml is there already: --force"):
        write_proposal(open_storage(folder))
    assert (folder / "motionlabel.yaml").read_text() == before
    write_proposal(open_storage(folder), is_forced=True)
    text = (folder / "motionlabel.yaml").read_text()
    assert all("  # " in line for line in text.splitlines() if not line.startswith("#"))
    assert isinstance(parse_description(text, "there"), Description)
