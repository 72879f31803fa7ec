import dataclasses

import pytest

from labeling.folders.identity import LABEL_VERSION, LabelSet, code_version, manifest_identity
from labeling.readers.reader import open_segment
from schemas.config import LabelingConfig, resolve_config
from schemas.tables import TABLES

STREET = "synthetic:street?beams=8&azimuth_steps=90"
WITH_POINTS = LabelSet("av2", "log-1", "00", resolve_config(overrides={"write_points": True}))


def changed(**overrides):
    config = resolve_config(overrides={"write_points": True} | overrides)
    return dataclasses.replace(WITH_POINTS, config=config)


def renamed(other):
    """The tables whose shards are called otherwise than those of WITH_POINTS."""
    return {table for table in TABLES if other.paths.get(table) != WITH_POINTS.paths[table]}


@pytest.mark.parametrize(
    "other",
    [
        dataclasses.replace(WITH_POINTS, segment_id="log-2"),
        dataclasses.replace(WITH_POINTS, dataset="folder"),
        dataclasses.replace(WITH_POINTS, content="01"),
        dataclasses.replace(WITH_POINTS, label_version=LABEL_VERSION + 1),
        changed(**{"flow.iterations": 61}),
        changed(seed=1),
        changed(sweeps=[0, 4]),
    ],
    ids=["segment", "dataset", "content", "label version", "parameter", "seed", "sweeps"],
)
def test_what_decides_labels_renames_all(other):
    assert renamed(other) == set(TABLES)


STAGES = ["ground", "static", "decomposition", "flow", "proposals", "tracking", "joining", "registration", "refinement"]


@pytest.mark.parametrize("stage", STAGES)
def test_every_stage_up_to_the_tracks_decides_labels(stage):
    name, value = next((name, value) for name, value in getattr(LabelingConfig(), stage) if isinstance(value, float))
    assert renamed(changed(**{f"{stage}.{name}": value * 0.9})) == set(TABLES)


def test_what_decides_points_alone_renames_points_alone():
    assert renamed(changed(**{"attribution.without": "tracks"})) == {"points"}


def test_which_tables_are_wanted_and_how_values_were_named_renames_nothing():
    assert renamed(dataclasses.replace(WITH_POINTS, config=LabelingConfig())) == {"points"}  # that is not there at all
    named = LabelSet("av2", "log-1", "00", resolve_config("fast"))
    spelled = LabelSet("av2", "log-1", "00", resolve_config(overrides={"flow.method": "rigid"}))
    assert named.paths == spelled.paths


def test_points_have_a_shard_only_when_asked():
    assert list(WITH_POINTS.paths) == ["labels", "sweeps", "points"]  # in the order of publishing
    assert list(dataclasses.replace(WITH_POINTS, config=LabelingConfig()).paths) == ["labels", "sweeps"]
    for table, path in WITH_POINTS.paths.items():
        identity = path.removeprefix(f"{table}/log-1-").removesuffix(".parquet")
        assert len(identity) == 16
        assert int(identity, 16) >= 0


def test_other_sweeps_are_other_content():
    config = LabelingConfig()
    one, again, longer = (
        LabelSet.of(open_segment("synthetic", f"{STREET}&sweeps={n}"), config) for n in (4, 4, 5)
    )  # fmt: skip
    assert one == again
    assert one.content != longer.content


def test_a_manifest_is_named_by_what_was_asked(monkeypatch):
    config = LabelingConfig()
    identity = manifest_identity(["a", "b"], config)
    assert identity == manifest_identity(["b", "a"], config)  # a set, in whatever order it was given
    assert identity != manifest_identity(["a"], config)
    assert identity != manifest_identity(["ab"], config)
    assert identity != manifest_identity(["a", "b"], LabelingConfig(write_points=True))
    monkeypatch.setattr("labeling.folders.identity.LABEL_VERSION", LABEL_VERSION + 1)
    assert identity != manifest_identity(["a", "b"], config)


def test_code_version_names_the_package_and_its_source():
    package, digest = code_version().split("+")
    assert package.count(".") == 2
    assert len(digest) == 12
