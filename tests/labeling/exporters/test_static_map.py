import dataclasses

import numpy as np
import pytest

from labeling.exporters.exporter import ExportOptions, export_labels
from labeling.readers.argoverse2 import Argoverse2Segment
from schemas.errors import InvalidInput


def read_ply(path):
    header, _, body = path.read_bytes().partition(b"end_header\n")
    lines = header.decode().splitlines()
    assert lines[:2] == ["ply", "format binary_little_endian 1.0"]
    assert lines[3:] == ["property double x", "property double y", "property double z"]
    points = np.frombuffer(body, dtype="<f8").reshape(-1, 3)
    assert lines[2] == f"element vertex {len(points)}"
    return points


def read_pcd(path):
    header, _, body = path.read_bytes().partition(b"DATA binary\n")
    fields = dict(line.split(" ", 1) for line in header.decode().splitlines() if not line.startswith("#"))
    points = np.frombuffer(body, dtype="<f4").reshape(-1, 3)
    assert (fields["FIELDS"], fields["SIZE"], fields["TYPE"]) == ("x y z", "4 4 4", "F F F")
    assert fields["POINTS"] == fields["WIDTH"] == str(len(points))
    return points


WALL = [[15.0 + step, -4.0, 1.0] for step in range(9)]


@pytest.fixture
def read(export):
    """Return a function that exports a folder of one segment and reads its map."""

    def run(folder, **options):
        (path,) = export(folder, "map", **options).iterdir()
        assert path.stem == folder.segment_ids[0]
        return read_ply(path) if path.suffix == ".ply" else read_pcd(path)

    return run


def test_what_moves_is_not_in_the_map(read, label_recorded):
    np.testing.assert_allclose(read(label_recorded()), WALL, atol=1e-6)


def test_a_car_that_pauses_is_not_in_the_map(read, label_recorded):
    """Its points have no rows then, its box has."""
    np.testing.assert_allclose(read(label_recorded(moving=())), WALL, atol=1e-6)


def test_what_moves_by_itself_is_not_in_the_map(read, label_recorded):
    far_away = [50.0, 50.0, 0.8, 4.5, 1.8, 1.6, 0.0]
    found = read(label_recorded(moving=(4,), box_ego=far_away))
    expected = [*WALL[:4], *WALL[5:], [10.0, 2.2, 0.9], [10.3, 2.0, 0.8], [9.6, 2.1, 1.1]]
    np.testing.assert_allclose(sorted(found.tolist()), sorted(expected), atol=1e-6)


def test_both_file_formats_hold_the_same(read, label_recorded):
    labels = label_recorded()
    np.testing.assert_allclose(read(labels, cloud="pcd", output="pcd"), read(labels), atol=1e-6)


def test_open3d_reads_both(label_recorded, export):
    o3d = pytest.importorskip("open3d")
    labels = label_recorded()
    for cloud in ("ply", "pcd"):
        (path,) = export(labels, "map", cloud, cloud=cloud).iterdir()
        np.testing.assert_allclose(np.asarray(o3d.io.read_point_cloud(str(path)).points), WALL, atol=1e-6)


def test_a_large_voxel_keeps_the_mean(read, label_recorded):
    np.testing.assert_allclose(read(label_recorded(), voxel_m=40.0), [[19.0, -4.0, 1.0]], atol=1e-6)


def test_points_are_in_the_world(read, tmp_path, write_av2, make_labels, make_sweep, monkeypatch):
    write_av2(tmp_path / "log", [0.0], [np.array([[10.0, 2.0, 1.0]])])
    turned = np.array([[0.0, -1, 0, 100], [1, 0, 0, 50], [0, 0, 1, 3], [0, 0, 0, 1]])
    read_sweep = Argoverse2Segment.read_sweep

    def read_turned(self, index):
        return dataclasses.replace(read_sweep(self, index), world_from_ego=turned)

    monkeypatch.setattr(Argoverse2Segment, "read_sweep", read_turned)
    sweeps = [make_sweep(0, num_points=1)]
    labels = make_labels([], sweeps=sweeps, uri=str(tmp_path / "log"), with_points=True)
    np.testing.assert_allclose(read(labels), [[98.0, 60.0, 4.0]], atol=1e-6)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"cloud": "laz"}, r"--cloud laz: expected one of ply, pcd"),
        ({"voxel_m": 0.001}, r"--voxel-m 0.001: expected metres, 0.01 or more"),
        ({"voxel_m": float("nan")}, r"--voxel-m nan: expected metres"),
        ({"min_score": 0.5}, r"--min-score means nothing to format map"),
    ],
)
def test_wrong_options_are_one_line(label_recorded, tmp_path, options, message):
    with pytest.raises(InvalidInput, match=message):
        export_labels(label_recorded(), "map", tmp_path / "export", ExportOptions(**options))


def test_a_recording_that_is_gone_is_one_line(label_recorded, tmp_path, export):
    labels = label_recorded()
    (tmp_path / "log").rename(tmp_path / "moved")
    with pytest.raises(InvalidInput, match=r"this format needs the recording of segment log-.*/log: no such folder"):
        export(labels, "map")


def test_a_recording_that_changed_is_one_line(label_recorded, tmp_path, write_av2, export):
    labels = label_recorded()
    write_av2(tmp_path / "log", [0.0, 0.1, 0.2], [np.ones((5, 3))] * 3)
    with pytest.raises(InvalidInput, match=r"sweep 0 of .* has 5 points, but its labels were made from 12: has the"):
        export(labels, "map")


def test_labels_without_points_are_one_line(make_labels, label_recorded, tmp_path, export):
    label_recorded()
    labels = make_labels([], name="bare", uri=str(tmp_path / "log"))
    with pytest.raises(InvalidInput, match=r"has no table of points, which this format needs"):
        export(labels, "map")
