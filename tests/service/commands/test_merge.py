import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from pyarrow import feather

from labeling.readers.reader import open_segment
from schemas.tables.columns import BOX
from service.cli import main

STREET = "synthetic:street?sweeps=8&seed=1&beams=16&azimuth_steps=450"
VULNERABLE = {"PEDESTRIAN", "BICYCLIST"}


@pytest.fixture(scope="module")
def labelled(tmp_path_factory):
    """A street that is labelled once for all tests."""
    output = tmp_path_factory.mktemp("street") / "out"
    assert main(["label", STREET, "--dataset", "synthetic", "--output", str(output), "--profile", "fast"]) == 0
    return output


@pytest.mark.parametrize(("hold_out", "is_vulnerable"), [("vehicle", True), ("vru", False)])
def test_a_street_with_one_kind_held_out(cli, labelled, tmp_path, hold_out, is_vulnerable):
    output = tmp_path / "merged"
    arguments = ["merge", labelled, STREET, "--dataset", "synthetic", "--output", output, "--min-score", 0.0]
    code, said, err = cli(*arguments, "--hold-out", hold_out)
    assert (code, err) == (0, [])
    assert said.endswith("files: 1 written, 0 already there\n")
    (path,) = output.iterdir()
    rows = pq.read_table(path).to_pylist()
    people, auto = ([row for row in rows if row["provenance"] == name] for name in ("human", "auto"))

    reader = open_segment("synthetic", STREET)
    drawn = [reader.read_annotations(index) for index in range(8)]
    wanted = {
        (index, track_id)
        for index, found in enumerate(drawn)
        for track_id, category in zip(found.track_ids, found.categories, strict=True)
        if (category in VULNERABLE) == is_vulnerable
    }
    assert {(row["sweep_index"], row["track_id"]) for row in people} == wanted
    assert wanted

    (shard,) = (labelled / "labels").iterdir()
    labels = pq.read_table(shard).to_pylist()
    tracks = {row["track_id"] for row in auto}
    assert [[row[name] for name in ("sweep_index", "track_id", *BOX)] for row in auto] == [
        [row[name] for name in ("sweep_index", "track_id", *BOX)] for row in labels if row["track_id"] in tracks
    ]
    assert 0 < len(tracks) < len({row["track_id"] for row in labels})  # some stay, some go

    assert cli(*arguments, "--hold-out", hold_out)[1] == said.replace("1 written, 0 already", "0 written, 1 already")


def test_categories_are_named(cli, labelled, tmp_path):
    arguments = ["merge", labelled, STREET, "--dataset", "synthetic", "--output", tmp_path / "merged"]
    code, said, err = cli(*arguments, "--human", "PEDESTRIAN, BICYCLIST")
    assert (code, err) == (0, [])
    assert "human boxes: BICYCLIST " in said
    code, said, (line,) = cli(*arguments, "--human", "PEDESTRIANS")
    assert (code, said) == (2, "")
    assert line.startswith("motionlabel: --human PEDESTRIANS: no such category: these segments have ")


def test_human_boxes_that_cannot_be_placed_are_named(cli, label, write_log, damage_sweep, tmp_path):
    log = write_log()
    damage_sweep(log, 2)
    stamps = sorted(int(path.stem) for path in (log / "sensors/lidar").iterdir())
    write_annotations(log, stamps)
    assert label(log, "--profile", "fast")[0] == 3
    code, said, (line,) = cli(
        "merge", tmp_path / "out", log, "--dataset", "av2", "--human", "REGULAR_VEHICLE", "--output", tmp_path / "m"
    )
    assert code == 3
    assert f"human boxes: REGULAR_VEHICLE {len(stamps) - 1};" in said
    assert "1 human boxes stand in sweeps that were rejected" in line


def write_annotations(log, stamps):
    zeros, ones = [0.0] * len(stamps), [1.0] * len(stamps)
    columns = {"timestamp_ns": stamps, "track_uuid": ["A"] * len(stamps), "category": ["REGULAR_VEHICLE"] * len(stamps)}
    columns |= {"length_m": ones, "width_m": ones, "height_m": ones, "qw": ones, "qx": zeros, "qy": zeros, "qz": zeros}
    columns |= {"tx_m": [40.0] * len(stamps), "ty_m": zeros, "tz_m": zeros}
    feather.write_feather(pa.table(columns), str(log / "annotations.feather"))


def test_bad_input_is_one_line(cli, tmp_path):
    for arguments, message in [
        ([], "expected either --human CATEGORY[,CATEGORY] or --hold-out vehicle|vru"),
        (["--human", "BUS", "--hold-out", "vru"], "expected either --human"),
        (["--human", ""], "--human: expected one or more categories"),
        (["--hold-out", "cars"], "--hold-out cars: expected one of vehicle, vru"),
        (["--human", "BUS", "--min-overlap", "2"], "--min-overlap 2: expected a share"),
        (["--human", "BUS"], f"no labels at {tmp_path}: expected manifests/*.json"),
    ]:
        code, said, (line,) = cli("merge", tmp_path, STREET, "--dataset", "synthetic", "--output", "x", *arguments)
        assert (code, said) == (2, "")
        assert message in line
