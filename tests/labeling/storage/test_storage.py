import os
import pickle
import sys
import threading
import tracemalloc
from datetime import UTC, datetime, timedelta
from itertools import chain
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import labeling.storage.bucket
from labeling.storage.bucket import ObjectStorage
from labeling.storage.local import LocalStorage
from labeling.storage.storage import open_storage
from schemas.errors import InvalidInput, StorageTrouble


@pytest.fixture(params=["local", "s3"])
def place(request, tmp_path):
    return str(tmp_path / "out") if request.param == "local" else request.getfixturevalue("bucket") + "/out"


@pytest.fixture
def storage(place):
    storage = open_storage(place)
    storage.prepare(("labels", "manifests"))
    return storage


@pytest.fixture
def write(tmp_path):
    def write_file(content):
        path = tmp_path / f"source-{len(list(tmp_path.iterdir()))}"
        path.write_bytes(content)
        return path

    return write_file


def test_the_first_writer_wins_and_the_second_is_a_no_op(storage, write):
    assert storage.publish("labels/a.parquet", write(b"first"))
    assert not storage.publish("labels/a.parquet", write(b"second"))
    assert not storage.publish("labels/a.parquet", b"third")
    assert storage.read("labels/a.parquet") == b"first"
    assert storage.publish("labels/b.parquet", b"bytes")
    assert storage.read("labels/b.parquet") == b"bytes"


def test_of_many_writers_at_once_exactly_one_publishes(storage, write):
    sources = [write(bytes([i]) * 100_000) for i in range(8)]
    barrier = threading.Barrier(len(sources))
    won = []

    def publish(source):
        barrier.wait()
        if storage.publish("labels/a.parquet", source):
            won.append(source)

    threads = [threading.Thread(target=publish, args=(source,)) for source in sources]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(won) == 1
    assert storage.read("labels/a.parquet") == won[0].read_bytes()
    assert list(storage.list_files("labels")) == ["labels/a.parquet"]


def test_replace_overwrites(storage):
    storage.replace("manifests/b.json", b"old")
    storage.replace("manifests/b.json", b"new")
    assert storage.read("manifests/b.json") == b"new"


@pytest.fixture
def tree(storage):
    """Files at three depths, whose names sort otherwise than their folders, and a hidden one."""
    storage.prepare(("", "a", "a/b", "a-b", "a/.c", ".d"))
    for path in ("z", "a/x 1", "a/x+2", "a/b/y", "a-b/y", "a/.c/y", ".d/y", "a/.hidden", "a0"):
        storage.publish(path, path.encode())
    return storage


def test_files_and_folders_are_listed_one_level_at_a_time(tree):
    assert sorted(tree.list_files()) == ["a0", "z"]
    assert sorted(tree.list_files("a")) == ["a/x 1", "a/x+2"]
    assert sorted(tree.list_folders()) in (["a", "a-b"], ["a", "a-b", "labels", "manifests"])  # a disk keeps empty ones
    assert list(tree.list_folders("a")) == ["a/b"]
    assert [tree.has_folder(folder) for folder in ("", "a", "a/b", "a/b/y", "b")] == [True, True, True, False, False]
    assert [tree.read(path) for path in tree.list_files("a/b")] == [b"a/b/y"]


def test_a_folder_was_modified_when_the_newest_of_its_own_files_was(tree, place):
    assert tree.last_modified("b") is None
    assert datetime.now(UTC) - timedelta(hours=1) < tree.last_modified("a") < datetime.now(UTC) + timedelta(hours=1)
    if not place.startswith("s3://"):
        for path, stamp_s in {"a/x 1": 100, "a/x+2": 300, "a/b/y": 900, "a/.hidden": 900}.items():
            os.utime(Path(place) / path, (stamp_s, stamp_s))
        assert tree.last_modified("a") == datetime.fromtimestamp(300, UTC)
        (Path(place) / "a/dangling").symlink_to("nowhere")
        assert tree.last_modified("a") == datetime.fromtimestamp(300, UTC)


def test_what_is_absent_is_absent(storage):
    assert list(storage.list_files("points")) == list(storage.list_folders("points")) == []
    assert storage.size("labels/none.parquet") is None
    assert storage.size("labels") is None
    for read in (storage.read, lambda path: storage.read_range(path, 0, 1)):
        with pytest.raises(FileNotFoundError, match=f"^{storage.root}/labels/none.parquet: no such [^\\n]+$"):
            read("labels/none.parquet")


@settings(max_examples=30, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.integers(0, 12), st.integers(0, 12))
def test_a_range_is_a_slice_of_the_content(storage, start, stop):
    content = bytes(range(9))
    storage.publish("labels/nine", content)
    assert storage.size("labels/nine") == 9
    assert storage.read_range("labels/nine", start, stop) == content[start:stop]


def test_a_storage_travels_to_other_processes_without_its_secrets(storage):
    storage.publish("labels/a", b"a")
    text = pickle.dumps(storage)
    assert b"secret" not in text
    assert pickle.loads(text).read("labels/a") == b"a"


class Keys:
    """A store that makes up the keys it is asked for, a page at a time."""

    def __init__(self, num_pages):
        self.num_pages, self.num_asked = num_pages, 0

    def list(self, prefix, offset, chunk_size):
        for page in range(int(offset[-6:-1]) + 1 if offset else 0, self.num_pages):
            self.num_asked += 1
            yield [{"path": f"{prefix}log-{page:05d}/sweep-{k:05d}"} for k in range(chunk_size)]


def peak_bytes(listing):
    tracemalloc.start()
    count = sum(1 for _ in listing)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    return count, peak


def test_memory_does_not_grow_with_the_keys_of_a_bucket():
    few, many = (ObjectStorage("s3://b", Keys(num_pages)) for num_pages in (10, 200))
    assert peak_bytes(many.list_folders("logs"))[0] == 200
    pages = [chain.from_iterable(store._pages("logs")) for store in (few, many)]
    (few_count, few_peak), (many_count, many_peak) = map(peak_bytes, pages)
    assert (few_count, many_count) == (10_000, 200_000)
    assert many_peak < 1.5 * few_peak


def test_a_listing_asks_for_no_more_than_is_taken():
    keys = Keys(1000)
    assert next(ObjectStorage("s3://b", keys).list_folders("logs")) == "logs/log-00000"
    assert keys.num_asked == 1
    assert ObjectStorage("s3://b", keys).has_folder("logs")
    assert keys.num_asked == 2


def test_memory_does_not_grow_with_the_files_of_a_folder(tmp_path):
    for k in range(3000):
        (tmp_path / f"sweep-{k:050d}").touch()
    count, peak = peak_bytes(LocalStorage(str(tmp_path)).list_files())
    assert count == 3000
    assert peak < 3000 * 50  # less than the names alone


def test_an_interrupted_publish_leaves_nothing_to_read(tmp_path, write, monkeypatch):
    storage = LocalStorage(str(tmp_path / "out"))
    storage.prepare(("labels",))

    def killed(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(os, "link", killed)
    with pytest.raises(KeyboardInterrupt):
        storage.publish("labels/a.parquet", write(b"half"))
    assert list(storage.list_files("labels")) == []
    assert list((tmp_path / "out/labels").iterdir()) == []


def test_what_is_published_locally_is_on_the_disk_before_it_is_seen(tmp_path, monkeypatch):
    storage = LocalStorage(str(tmp_path))
    steps = []
    fsync, link = os.fsync, os.link
    monkeypatch.setattr(
        os, "fsync", lambda number: (steps.append(Path(f"/proc/self/fd/{number}").readlink()), fsync(number))
    )
    monkeypatch.setattr(os, "link", lambda source, target: (steps.append("link"), link(source, target)))
    storage.publish("a", b"a")
    (file, linked, folder) = steps
    assert file.name.startswith(".")
    assert (linked, folder) == ("link", tmp_path)


def test_files_left_by_a_killed_process_are_not_listed(tmp_path):
    (tmp_path / "labels").mkdir()
    (tmp_path / "labels/.0123.tmp").write_bytes(b"half")
    assert list(LocalStorage(str(tmp_path)).list_files("labels")) == []


def test_a_link_that_leads_nowhere_is_listed_and_absent(tmp_path):
    (tmp_path / "sweep").symlink_to("nowhere")
    storage = LocalStorage(str(tmp_path))
    assert list(storage.list_files()) == ["sweep"]
    assert storage.size("sweep") is None


def test_published_files_have_the_mode_that_the_umask_gives(tmp_path, write):
    storage = LocalStorage(str(tmp_path / "out"))
    storage.prepare(("labels",))
    storage.publish("labels/a.parquet", write(b"x"))
    plain = write(b"x")
    assert (tmp_path / "out/labels/a.parquet").stat().st_mode == plain.stat().st_mode


@pytest.mark.parametrize("in_the_way", ["out", "out/labels"])
def test_a_file_in_the_way_is_found_before_any_work(tmp_path, in_the_way):
    (tmp_path / in_the_way).parent.mkdir(exist_ok=True)
    (tmp_path / in_the_way).write_text("")
    with pytest.raises(InvalidInput, match=r"cannot write labels to .*out/labels: .*choose another --output"):
        LocalStorage(str(tmp_path / "out")).prepare(("labels",))


def refuse(error):
    def call(*_, **__):
        raise error

    return call


def test_a_disk_without_hard_links_is_found_before_any_work(tmp_path, monkeypatch):
    monkeypatch.setattr(os, "link", refuse(PermissionError(1, "Operation not permitted")))
    with pytest.raises(InvalidInput, match="Operation not permitted"):
        LocalStorage(str(tmp_path)).prepare(("labels",))


@pytest.mark.parametrize(
    "use",
    [
        lambda storage: storage.prepare(("labels",)),
        lambda storage: storage.publish("a", b"a"),
        lambda storage: storage.replace("a", b"a"),
        lambda storage: storage.read("here"),
        lambda storage: storage.read_range("here", 0, 1),
        lambda storage: storage.size("here"),
        lambda storage: list(storage.list_files()),
    ],
    ids=["prepare", "publish", "replace", "read", "range", "size", "list"],
)
def test_trouble_with_the_disk_is_no_wrong_input_and_names_the_place(tmp_path, monkeypatch, use):
    (tmp_path / "here").write_bytes(b"here")
    broken = refuse(OSError(5, "Input/output error"))
    with monkeypatch.context() as patch:
        for module, name in ((os, "scandir"), (os, "fsync"), (Path, "touch"), (Path, "open"), (Path, "read_bytes")):
            patch.setattr(module, name, broken)
        with pytest.raises(StorageTrouble, match=rf"^{tmp_path}[^\n]*: Input/output error$"):
            use(LocalStorage(str(tmp_path)))


def test_s3_without_its_extra_says_how_to_get_it(monkeypatch):
    monkeypatch.setitem(sys.modules, "obstore.store", None)
    with pytest.raises(InvalidInput, match=r"pip install motionlabel\[s3\]"):
        open_storage("s3://bucket/prefix")


@pytest.mark.parametrize("uri", ["gs://bucket/x", "s3://", "http://host/x", "synthetic:street"])
def test_other_places_are_refused_by_name(uri):
    with pytest.raises(InvalidInput, match=uri.split(":")[0]):
        open_storage(uri)


def test_a_path_may_be_relative_and_a_file_uri_is_a_path(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "link").symlink_to("out")
    for place in ("out", "link", f"file://{tmp_path}/out"):
        assert open_storage(place).root == str(tmp_path / "out")


def test_a_missing_bucket_is_wrong_input(bucket):
    storage = open_storage("s3://another-bucket/prefix")
    for use in (
        lambda: storage.prepare(("labels",)),
        lambda: storage.read("a"),
        lambda: storage.publish("a", b"a"),
        lambda: list(storage.list_files()),
    ):
        with pytest.raises(InvalidInput, match=r"^s3://another-bucket/prefix\S*: no such bucket$"):
            use()


def test_a_store_that_cannot_be_reached_is_trouble_in_one_line(bucket, monkeypatch):
    monkeypatch.setenv("AWS_ENDPOINT_URL", "http://127.0.0.1:9")
    monkeypatch.setattr(labeling.storage.bucket, "RETRY", {"max_retries": 0, "retry_timeout": timedelta(seconds=1)})
    storage = open_storage("s3://bucket/prefix")
    for use in (
        lambda: storage.prepare(("labels",)),
        lambda: storage.read("a"),
        lambda: storage.publish("a", b"a"),
        lambda: storage.size("a"),
    ):
        with pytest.raises(StorageTrouble, match=r"^s3://bucket/prefix\S*: [^\n]+$"):
            use()
