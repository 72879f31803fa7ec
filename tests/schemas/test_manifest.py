import pytest
from pydantic import ValidationError

from schemas.manifest import Manifest, SegmentEntry, Shard
from schemas.tables import SCHEMA_VERSION


def make(*states):
    shard = Shard(table="labels", path="labels/s.parquet", rows=1, bytes=2, sha256="0" * 64)
    segments = tuple(SegmentEntry(segment_id=f"s{i}", uri="u", state=s, shards=(shard,)) for i, s in enumerate(states))
    return Manifest(
        identity="i", dataset="av2", config={}, config_hash="c", code_version="v", recommended_min_score=0.5,
        segments=segments,
    )  # fmt: skip


@pytest.mark.parametrize(
    ("states", "is_complete"),
    [(("SUCCEEDED", "PARTIAL"), True), (("SUCCEEDED", "FAILED"), False), (("FAILED",), False)],
)
def test_complete_means_that_no_segment_failed(states, is_complete):
    assert make(*states).is_complete == is_complete


def test_json_round_trip_keeps_all_and_the_current_version():
    manifest = make("SUCCEEDED", "PARTIAL")
    assert manifest.schema_version == SCHEMA_VERSION
    assert Manifest.model_validate_json(manifest.model_dump_json()) == manifest


@pytest.mark.parametrize("change", [{"extra": 1}, {"segments": [{"segment_id": "s", "uri": "u", "state": "DONE"}]}])
def test_unknown_fields_and_states_are_refused(change):
    with pytest.raises(ValidationError):
        Manifest.model_validate({**make("SUCCEEDED").model_dump(), **change})
