import json

import pyarrow as pa
import pytest

from labeling.exporters.exporter import EXPORTERS


def test_labels_are_exported_by_command(cli, write_log, tmp_path):
    log, out, export = write_log(), tmp_path / "out", tmp_path / "export"
    assert cli("label", log, "--dataset", "av2", "--output", out, "--profile", "fast")[0] == 0
    arguments = ["export", out, "--format", "av2", "--output", export]
    code, said, err = cli(*arguments)
    assert (code, err) == (0, [])
    (path,) = export.rglob("annotations.feather")
    boxes = pa.ipc.open_file(path.read_bytes()).read_all()
    assert (
        said
        == f"{export}: boxes: {len(boxes)}, sweeps: 6 (0 rejected), segments: 1; files: 1 written, 0 already there\n"
    )
    assert len(boxes) > 0
    assert cli(*arguments)[1] == said.replace("1 written, 0 already", "0 written, 1 already")
    code, said, err = cli(*arguments, "--category", "ANIMAL")
    assert (code, said) == (2, "")
    assert err == [
        f"motionlabel: {path} is there with other content, of other labels, options or versions: delete it, or choose "
        "another --output"
    ]


def test_exported_annotations_are_the_labels_that_were_exported(cli, write_log, tmp_path):
    """Read as a log's own annotations they leave nothing to say of the labels: no box is off, missing or too many."""
    log, out, figures = write_log(num_sweeps=8), tmp_path / "out", tmp_path / "figures.json"
    assert cli("label", log, "--dataset", "av2", "--output", out, "--profile", "fast")[0] == 0
    assert cli("export", out, "--format", "av2", "--output", tmp_path / "export")[0] == 0
    (path,) = (tmp_path / "export").rglob("annotations.feather")
    path.rename(log / "annotations.feather")
    assert cli("evaluate", out, log, "--dataset", "av2", "--json", figures)[0] == 0
    boxes = json.loads(figures.read_text())["pooled"]["boxes"]
    assert (boxes["num_objects"], boxes["wrong"]["num_wrong"]) == (1, 0)
    assert {(found["ap"], found["precision"], found["recall"]) for found in boxes["detection"]} == {(1.0, 1.0, 1.0)}
    assert [
        boxes["errors"][f"{name}_median_{unit}"] for name, unit in (("center", "m"), ("size", "m"), ("yaw", "rad"))
    ] == (pytest.approx([0.0, 0.0, 0.0], abs=1e-9))


def test_rejected_sweeps_are_counted(cli, write_log, damage_sweep, tmp_path):
    log, out = write_log(), tmp_path / "out"
    damage_sweep(log, 3)
    assert cli("label", log, "--dataset", "av2", "--output", out, "--profile", "fast")[0] == 3
    code, said, err = cli("export", out, "--format", "openlabel", "--output", tmp_path / "export")
    assert (code, err) == (0, [])
    assert "sweeps: 5 (1 rejected), segments: 1" in said


def test_a_segment_that_failed_is_named(cli, write_log, tmp_path):
    out = tmp_path / "out"
    assert (
        cli("label", write_log(), tmp_path / "lost", "--dataset", "av2", "--output", out, "--profile", "fast")[0] == 3
    )
    code, said, (line,) = cli("export", out, "--format", "av2", "--output", tmp_path / "export")
    assert code == 3
    assert "segments: 1; files: 1 written" in said
    assert line.startswith("motionlabel: lost-")
    assert line.endswith(" has no labels: it failed, and label says why")


def test_bad_input_is_one_line(cli, tmp_path):
    for arguments, message in [
        (
            [tmp_path, "--format", "csv", "--output", "x"],
            f"unknown format 'csv': expected one of {', '.join(EXPORTERS)}",
        ),
        ([tmp_path, "--format", "av2", "--output", "x"], f"no labels at {tmp_path}: expected manifests/*.json"),
        ([tmp_path, "--format", "av2", "--output", ""], "--output is empty"),
    ]:
        code, said, (line,) = cli("export", *arguments)
        assert (code, said) == (2, "")
        assert message in line
