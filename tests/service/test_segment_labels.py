"""The labels of one segment through the API: the shard's own bytes, or its rows, and nothing else."""

import hashlib
import io
import json
import shutil
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from fastapi.testclient import TestClient

from labeling.folders.writer import describe_shard
from labeling.storage.storage import open_storage
from schemas.api.jobs import SegmentState
from schemas.manifest import SegmentEntry
from schemas.tables import SCHEMAS
from service.app import create_app
from service.routes import segment_labels

STREET = "synthetic:street?sweeps=30"
NUM_ROWS = 3000


def make_shard(num_rows=NUM_ROWS):
    """Return the bytes of a shard of labels in several row groups, with nulls where they may be."""

    def values(field):
        if pa.types.is_string(field.type):
            return [f"{field.name} \u00e9 {i}" for i in range(num_rows)]
        return [None if field.nullable and i % 3 else i / 7 if pa.types.is_floating(field.type) else i
                for i in range(num_rows)]  # fmt: skip

    schema = SCHEMAS["labels"]
    table = pa.table([pa.array(values(field), field.type) for field in schema], schema=schema)
    buffer = io.BytesIO()
    pq.write_table(table, buffer, row_group_size=700)
    return buffer.getvalue()


@pytest.fixture
def publish(queue):
    """Return a function that labels the segment that waits, and returns the shard's bytes."""

    def run(output):
        content, storage = make_shard(), open_storage(output)
        shard = describe_shard("labels", "labels/s-1.parquet", io.BytesIO(content), "s-1")
        storage.prepare(("labels",))
        storage.publish(shard.path, content)
        claim = queue.claim_segment("test", lease_s=60)
        entry = SegmentEntry(segment_id="s", uri=claim.uri, state="SUCCEEDED", shards=(shard,))
        queue.finish(claim, SegmentState.SUCCEEDED, entry=entry)
        return content

    return run


@pytest.fixture
def labelled(submit, publish, settings):
    """The address of a segment's labels, and the bytes of their shard."""
    job = submit()
    return f"/v1/jobs/{job}/segments/0/labels", publish(f"{settings.data_roots[0]}/out")


def test_the_shard_comes_as_it_is(api, labelled):
    address, content = labelled
    answer = api.get(address)
    assert answer.status_code == 200, answer.text
    assert answer.content == content
    assert answer.headers["content-type"] == "application/vnd.apache.parquet"
    assert answer.headers["content-length"] == str(len(content))
    assert answer.headers["etag"] == f'"{hashlib.sha256(content).hexdigest()}"'
    head = api.head(address)
    assert (head.headers["content-length"], head.content) == (str(len(content)), b"")


def test_lines_are_the_rows_of_the_shard(api, labelled):
    address, content = labelled
    answer = api.get(address, params={"format": "jsonl"})
    assert answer.headers["content-type"] == "application/jsonl"
    assert [json.loads(line) for line in answer.text.splitlines()] == pq.read_table(io.BytesIO(content)).to_pylist()
    assert answer.headers["etag"] == f'"{hashlib.sha256(content).hexdigest()}.jsonl"'  # other bytes, another tag


def test_lines_are_made_from_a_batch_at_a_time(tmp_path):
    path = tmp_path / "shard"
    path.write_bytes(make_shard())
    pieces = list(segment_labels._lines_of(path.open("rb")))
    assert sum(piece.count("\n") for piece in pieces) == NUM_ROWS
    assert max(piece.count("\n") for piece in pieces) <= segment_labels._BATCH_ROWS


@pytest.mark.parametrize("format_", ["parquet", "jsonl"])
def test_whoever_has_them_is_sent_nothing_and_nothing_is_read(api, labelled, settings, format_):
    address, _ = labelled
    etag = api.get(address, params={"format": format_}).headers["etag"]
    shutil.rmtree(f"{settings.data_roots[0]}/out")
    for known in (etag, f'"other", {etag}', f"W/{etag}", "*"):
        answer = api.get(address, params={"format": format_}, headers={"If-None-Match": known})
        assert (answer.status_code, answer.content, answer.headers["etag"]) == (304, b"", etag)
    other = {"parquet": "jsonl", "jsonl": "parquet"}[format_]
    assert api.get(address, params={"format": other}, headers={"If-None-Match": etag}).status_code == 404


def test_labels_in_a_bucket_come_too(bucket, settings, request_body, publish):
    settings = settings.model_copy(update={"data_roots": (*settings.data_roots, bucket)})
    with TestClient(create_app(settings), base_url="http://127.0.0.1:8000") as client:
        job = client.post("/v1/jobs", json=request_body(output_uri=f"{bucket}/out")).json()["id"]
        content = publish(f"{bucket}/out")
        assert client.get(f"/v1/jobs/{job}/segments/0/labels").content == content


def test_a_segment_without_labels_says_whether_to_wait(api, submit, finish, assert_problem):
    job = submit(segments=[STREET, f"{STREET}0"])
    assert_problem(api.get(f"/v1/jobs/{job}/segments/0/labels"), 409, f"{STREET} is QUEUED: it has no labels yet")
    finish("FAILED")
    assert_problem(api.get(f"/v1/jobs/{job}/segments/0/labels"), 404, "has ended FAILED without labels")
    assert_problem(api.get(f"/v1/jobs/{job}/segments/2/labels"), 404, "has no segment 2: its last is 1")
    for position in ("-1", "x", str(2**31)):
        assert_problem(api.get(f"/v1/jobs/{job}/segments/{position}/labels"), 422, "")
    assert_problem(api.get(f"/v1/jobs/{'0' * 16}/segments/0/labels"), 404, "no job")


def test_what_there_is_no_format_for_is_refused(api, labelled, assert_problem):
    assert_problem(api.get(f"{labelled[0]}?format=csv"), 422, "'parquet' or 'jsonl'")
    assert_problem(api.get(f"{labelled[0]}?form=jsonl"), 422, "form: ")


@pytest.mark.parametrize("format_", ["parquet", "jsonl"])
@pytest.mark.parametrize(
    ("damage", "detail"),
    [
        (lambda path: path.unlink(), "is missing, but its manifest lists it"),
        (lambda path: path.write_bytes(path.read_bytes()[:-9]), "bytes, its manifest says"),
        (lambda path: path.write_bytes(path.read_bytes() + b"9"), "bytes, its manifest says"),
        (lambda path: path.write_bytes(path.read_bytes()[:-1] + b"9"), "was changed after it was written"),
    ],
)
def test_nothing_is_sent_of_a_shard_that_is_another(api, labelled, settings, damage, detail, format_, assert_problem):
    address, _ = labelled
    damage(Path(settings.data_roots[0]) / "out/labels/s-1.parquet")
    assert_problem(api.get(address, params={"format": format_}), 404, detail)


def test_no_link_leads_out_of_the_roots(api, labelled, settings, tmp_path, assert_problem):
    address, _ = labelled
    folder = Path(settings.data_roots[0]) / "out/labels"
    folder.rename(tmp_path / "elsewhere")
    folder.symlink_to(tmp_path / "elsewhere")
    assert_problem(api.get(address), 404, "lies under no data root")


def test_the_store_is_free_while_labels_are_fetched_and_sent(api, labelled, monkeypatch):
    address, _ = labelled
    door, free = api.app.state.door, []
    fetch, send = segment_labels.copy_shard, segment_labels._bytes_of

    def fetch_and_look(*arguments):
        free.append(door._places._value)
        fetch(*arguments)

    def send_and_look(file):
        free.append(door._places._value)
        yield from send(file)

    monkeypatch.setattr(segment_labels, "copy_shard", fetch_and_look)
    monkeypatch.setattr(segment_labels, "_bytes_of", send_and_look)
    before = door._places._value
    assert api.get(address).status_code == 200
    assert free == [before, before]


def test_a_disk_without_room_is_trouble_of_now(api, labelled, monkeypatch, assert_problem):
    def fail(*_):
        raise OSError(28, "No space left on device")

    address, _ = labelled
    monkeypatch.setattr(segment_labels, "copy_shard", fail)
    answer = api.get(address)
    assert_problem(answer, 503, "No space left on device")
    assert answer.headers["retry-after"]
