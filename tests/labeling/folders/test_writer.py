import json
import weakref

import numpy as np
import pyarrow.parquet as pq
import pytest

from labeling.folders.entries import prepare_folder
from labeling.folders.identity import LABEL_VERSION, LabelSet, code_version
from labeling.folders.writer import publish_segment as publish_shards
from labeling.storage.local import LocalStorage
from schemas.config import AttributionParams, LabelingConfig
from schemas.tables import SCHEMAS, TABLES


@pytest.fixture
def publish(tmp_path):
    def publish_segment(observations, tracks=(), *, folder="out", **config):
        storage = LocalStorage(str(tmp_path / folder))
        prepare_folder(storage, LabelingConfig(write_points=True))
        config = LabelingConfig(**{"write_points": True, "attribution": AttributionParams(without="tracks")} | config)
        shards = publish_shards(storage, LabelSet("av2", "log-1", "00", config), iter(observations), tracks)
        return {shard.table: tmp_path / folder / shard.path for shard in shards}, shards

    return publish_segment


def test_tables_have_the_promised_schema_and_rows(publish, make_observation, make_track):
    observations = [make_observation(0, [7, 3, 9]), make_observation(1, [1, 2]), make_observation(2, reason="bad file")]
    tracks = [make_track("b", [0, 1], {0: [3, 9], 1: [2]}), make_track("a", [0, 1, 2], {1: [1]})]
    paths, shards = publish(observations, tracks)
    tables = {name: pq.read_table(path) for name, path in paths.items()}
    for name, table in tables.items():
        assert table.schema.equals(SCHEMAS[name])  # names, types and nullability
    assert [shard.rows for shard in shards] == [5, 3, 5]

    labels = tables["labels"]
    assert list(zip(labels["sweep_index"].to_pylist(), labels["track_id"].to_pylist(), strict=True)) == [
        (0, "a"), (0, "b"), (1, "a"), (1, "b"), (2, "a"),
    ]  # fmt: skip
    first, second = labels.slice(0, 2).to_pylist()
    assert first["box_source"] == "interpolated"
    assert first["visible_center_x_m"] is None
    assert first["visible_yaw_rad"] is None
    assert first["registration_error_m"] is None
    assert second["box_source"] == "observed"
    assert (second["length_m"], second["width_m"], second["height_m"], second["yaw_rad"]) == (4.0, 2.0, 1.5, np.pi)
    assert second["visible_length_m"] == 4.0
    assert second["velocity_x_mps"] == 10.0
    assert second["num_points"] == 2

    sweeps = tables["sweeps"].to_pylist()
    assert [sweep["status"] for sweep in sweeps] == ["ok", "ok", "rejected"]
    assert [sweep["reason"] for sweep in sweeps] == ["", "", "bad file"]
    assert sweeps[1]["world_from_ego"] == [1, 0, 0, 1, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]  # row-major

    points = tables["points"]
    assert points["point_index"].to_pylist() == [7, 3, 9, 1, 2]
    assert points["track_id"].to_pylist() == [None, "b", "b", "a", "b"]
    assert points["flow_x_m"].to_pylist() == [7, 3, 9, 1, 2]
    assert pq.ParquetFile(paths["points"]).num_row_groups == 2  # one a sweep that has points


def test_flow_is_null_where_there_is_no_next_sweep(publish, make_observation):
    paths, _ = publish([make_observation(0, [1]), make_observation(1, [1], has_flow=False)])
    assert pq.read_table(paths["points"])["flow_z_m"].to_pylist() == [1.0, None]


def test_nothing_moves(publish, make_observation):
    paths, shards = publish([make_observation(0)])
    assert [shard.rows for shard in shards] == [0, 1, 0]
    assert pq.read_table(paths["labels"]).schema.equals(SCHEMAS["labels"])


def test_metadata_says_what_made_the_shard(publish, make_observation):
    paths, shards = publish([make_observation(0)], seed=5)
    assert {(shard.label_version, shard.code_version) for shard in shards} == {(LABEL_VERSION, code_version())}
    for path in paths.values():
        metadata = pq.read_schema(path).metadata
        assert metadata[b"motionlabel.schema_version"] == b"1"
        assert metadata[b"motionlabel.label_version"].decode() == str(LABEL_VERSION)
        assert metadata[b"motionlabel.code_version"].decode() == code_version()
        assert metadata[b"motionlabel.frame"] == b"world"
        assert LabelingConfig.model_validate(json.loads(metadata[b"motionlabel.config"])).seed == 5


def test_labels_are_the_same_bytes_with_points_and_without(publish, make_observation, make_track):
    def once(folder, **config):
        return publish([make_observation(0, [1])], [make_track("a", [0], {0: [1]})], folder=folder, **config)[1][:2]

    assert once("with") == once("without", write_points=False, attribution=AttributionParams())


def test_the_same_rows_give_the_same_bytes(publish, make_observation, make_track):
    def once(folder):
        tracks = [make_track("a", [0, 1], {0: [1], 1: [2]})]
        return publish([make_observation(0, [1, 5]), make_observation(1, [2])], tracks, folder=folder)[1]

    assert once("one") == once("two")


def test_what_was_published_first_is_what_is_described(publish, make_observation):
    _, first = publish([make_observation(0, [1])])
    paths, second = publish([make_observation(0, [1, 2])])  # as if another kind of CPU had run it
    assert second == first
    assert len(pq.read_table(paths["points"])) == 1


def test_nothing_is_visible_before_all_sweeps_are_in(tmp_path, make_observation):
    storage = LocalStorage(str(tmp_path))
    prepare_folder(storage, LabelingConfig())

    def observe():
        yield make_observation(0, [1])
        published = [path for folder in (*TABLES, "reservations") for path in storage.list_files(folder)]
        assert published == ["reservations/complete.json"]

    shards = publish_shards(storage, LabelSet("av2", "log-1", "00", LabelingConfig()), observe(), [])
    assert [shard.table for shard in shards] == ["labels", "sweeps"]  # points were not asked for


def test_few_observations_are_held_at_a_time(publish, make_observation):
    points = []

    def observe():
        for index in range(20):
            observation = make_observation(index, range(50))
            points.append(weakref.ref(observation.points.points_ego))
            yield observation
            del observation
            assert sum(point() is not None for point in points) <= 2

    publish(observe())
    assert len(points) == 20


def test_points_follow_their_objects(publish, make_observation, make_track):
    inside = {4: (0.0, 0.0, 1.0)}
    observations = [make_observation(0, [4, 5], at=inside), make_observation(1, [4], at=inside)]
    paths, _ = publish(observations, [make_track("a", [0, 1], {0: [4], 1: [4]})], attribution=AttributionParams())
    points = pq.read_table(paths["points"])
    assert points["point_index"].to_pylist() == [4, 5, 4]
    assert points["track_id"].to_pylist() == ["a", None, "a"]
    assert points["flow_x_m"].to_pylist() == pytest.approx([1.0, 0.0, 0.0])  # the box moves 1 m
