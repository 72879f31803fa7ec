import json

import pyarrow as pa
import pytest

from labeling.folders.entries import prepare_folder
from labeling.folders.folder import LabelFolder, publish_manifest
from labeling.folders.identity import LabelSet
from labeling.folders.writer import publish_segment
from labeling.storage.local import LocalStorage
from schemas.config import LabelingConfig, resolve_config
from schemas.errors import InvalidInput
from schemas.manifest import Manifest, SegmentEntry


def make_manifest(*segments, identity="0" * 16, min_score=0.5):
    return Manifest(
        identity=identity,
        dataset="av2",
        config={},
        config_hash="c",
        code_version="1",
        recommended_min_score=min_score,
        segments=segments,
    )


def failed(segment_id="log-1"):
    return SegmentEntry(segment_id=segment_id, uri="x", state="FAILED", reason="bad")


@pytest.fixture
def storage(tmp_path):
    storage = LocalStorage(str(tmp_path / "out"))
    prepare_folder(storage, LabelingConfig(write_points=True))
    return storage


@pytest.fixture
def done(storage, make_observation, make_track):
    """Publish the shards of one segment and return its entry."""
    label_set = LabelSet("av2", "log-1", "00", LabelingConfig())
    shards = publish_segment(storage, label_set, [make_observation(0, [1])], [make_track("a", [0], {0: [1]})])
    return SegmentEntry(segment_id="log-1", uri="x", state="SUCCEEDED", num_tracks=1, shards=shards)


def test_tables_come_back(storage, done, tmp_path):
    publish_manifest(storage, make_manifest(done, failed("log-2")))
    folder = LabelFolder.open(tmp_path / "out")
    assert folder.segment_ids == ("log-1",)
    assert folder.table("labels", "log-1")["track_id"].to_pylist() == ["a"]
    assert folder.table("points", "log-1") is None
    with pytest.raises(InvalidInput, match=r"no labels of segment log-2: it has log-1"):
        folder.table("labels", "log-2")
    with pytest.raises(InvalidInput, match=r"unknown table 'boxes': expected one of labels, sweeps, points"):
        folder.table("boxes", "log-1")


def test_points_come_back_sweep_by_sweep(storage, make_observation, make_track, tmp_path):
    label_set = LabelSet("av2", "log-1", "00", LabelingConfig(write_points=True))
    observations = [make_observation(0, [1, 4]), make_observation(1), make_observation(2, [3])]
    shards = publish_segment(storage, label_set, observations, [make_track("a", [0, 2], {0: [1], 2: [3]})])
    publish_manifest(
        storage, make_manifest(SegmentEntry(segment_id="log-1", uri="x", state="SUCCEEDED", shards=shards))
    )
    folder = LabelFolder.open(tmp_path / "out")
    groups = list(folder.row_groups("points", "log-1"))
    assert [group["sweep_index"].to_pylist() for group in groups] == [[0, 0], [2]]
    assert pa.concat_tables(groups) == folder.table("points", "log-1")


def test_a_table_that_was_not_written_has_no_row_groups(storage, done, tmp_path):
    publish_manifest(storage, make_manifest(done))
    folder = LabelFolder.open(tmp_path / "out")
    assert list(folder.row_groups("points", "log-1")) == []
    assert folder.shard("points", "log-1") is None
    assert folder.shard("labels", "log-1") == done.shards[0]


def test_a_segment_that_failed_in_one_run_and_succeeded_in_another_has_labels(storage, done, tmp_path):
    publish_manifest(storage, make_manifest(done, identity="1" * 16, min_score=0.2))
    publish_manifest(storage, make_manifest(failed(), identity="2" * 16, min_score=0.4))
    folder = LabelFolder.open(tmp_path / "out")
    assert folder.entry("log-1") == done
    assert len(folder.manifests) == 2
    assert folder.recommended_min_score == 0.4


def test_points_of_one_run_and_labels_of_another_are_one_segment(storage, done, make_observation, make_track, tmp_path):
    label_set = LabelSet("av2", "log-1", "00", LabelingConfig(write_points=True))
    shards = publish_segment(storage, label_set, [make_observation(0, [1])], [make_track("a", [0], {0: [1]})])
    assert shards[:2] == done.shards
    with_points = done.model_copy(update={"shards": shards})
    for identity, entry in [("1", with_points), ("2", done)]:
        publish_manifest(storage, make_manifest(entry, identity=identity * 16))
    assert LabelFolder.open(tmp_path / "out").entry("log-1") == with_points


@pytest.mark.parametrize("newer_comes", ["first", "last"])
def test_of_labels_that_were_deleted_and_made_anew_the_new_ones_count(
    storage, done, make_observation, tmp_path, newer_comes
):
    for path in (tmp_path / "out").glob("*/log-1-*"):
        path.unlink()
    label_set = LabelSet("av2", "log-1", "00", resolve_config(overrides={"seed": 1}))
    shards = publish_segment(storage, label_set, [make_observation(0, [1])], [])
    newer = SegmentEntry(segment_id="log-1", uri="x", state="SUCCEEDED", shards=shards)
    for identity, entry in [("1", done), ("0" if newer_comes == "first" else "2", newer)]:
        publish_manifest(storage, make_manifest(entry, identity=identity * 16))
    assert LabelFolder.open(tmp_path / "out").entry("log-1") == newer


def test_an_incomplete_manifest_never_replaces_a_complete_one(storage, done, tmp_path):
    for published, expected in [
        (make_manifest(failed()), "FAILED"),
        (make_manifest(done), "SUCCEEDED"),
        (make_manifest(failed()), "SUCCEEDED"),
        (make_manifest(done.model_copy(update={"state": "PARTIAL"})), "PARTIAL"),  # labels deleted and made anew
    ]:
        publish_manifest(storage, published)
        assert LabelFolder.open(tmp_path / "out").manifests[0].segments[0].state == expected


def test_no_folder_and_no_manifest_are_said_in_one_line(storage, tmp_path):
    for place in (tmp_path / "nowhere", tmp_path / "out"):
        with pytest.raises(InvalidInput, match=rf"no labels at {place}: expected manifests"):
            LabelFolder.open(place)


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda content: content[:-10], "bytes, its manifest says"),
        (lambda content: content[:50] + b"X" + content[51:], "was changed after it was written"),
        (None, "is missing, but its manifest lists it"),
    ],
    ids=["truncated", "changed", "deleted"],
)
def test_a_damaged_shard_is_named(storage, done, tmp_path, damage, message):
    publish_manifest(storage, make_manifest(done))
    path = tmp_path / "out" / done.shards[0].path
    content = path.read_bytes()
    path.unlink()
    if damage:
        path.write_bytes(damage(content))
    with pytest.raises(InvalidInput, match=message) as caught:
        LabelFolder.open(tmp_path / "out").table("labels", "log-1")
    assert str(path) in str(caught.value)


def test_unknown_schema_versions_are_refused_by_name(storage, done, tmp_path, monkeypatch):
    publish_manifest(storage, make_manifest(done))
    folder = LabelFolder.open(tmp_path / "out")
    monkeypatch.setattr("labeling.folders.folder.READABLE_VERSIONS", (2, 3))
    with pytest.raises(InvalidInput, match=r"labels/.* has schema version 1: this motionlabel reads 2, 3"):
        folder.table("labels", "log-1")
    with pytest.raises(InvalidInput, match=r"manifests/.* has schema version 1: this motionlabel reads 2, 3"):
        LabelFolder.open(tmp_path / "out")


@pytest.mark.parametrize(
    "content", ["", "{", "[]", "{}", json.dumps({"schema_version": 1})], ids=["empty", "half", "list", "no", "fields"]
)
def test_what_is_no_manifest_is_named_and_can_be_replaced(storage, done, tmp_path, content):
    path = tmp_path / "out/manifests" / f"{'0' * 16}.json"
    path.write_text(content)
    with pytest.raises(InvalidInput, match=f"{path} is not a manifest"):
        LabelFolder.open(tmp_path / "out")
    publish_manifest(storage, make_manifest(done))
    assert LabelFolder.open(tmp_path / "out").segment_ids == ("log-1",)
