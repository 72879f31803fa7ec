import os
import sys
import threading

import pytest
from obstore.store import MemoryStore

from labeling.storage.storage import LocalStorage, ObjectStorage, open_storage
from schemas.errors import InvalidInput


@pytest.fixture(params=["local", "object"])
def storage(request, tmp_path):
    storage = (
        LocalStorage(str(tmp_path / "out")) if request.param == "local" else ObjectStorage("s3://b", MemoryStore())
    )
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
    assert storage.read("labels/a.parquet") == b"first"


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
    assert storage.list_files("labels") == ("labels/a.parquet",)


def test_replace_overwrites_and_list_is_sorted(storage, write):
    storage.replace("manifests/b.json", b"old")
    storage.replace("manifests/b.json", b"new")
    storage.replace("manifests/a.json", b"")
    assert storage.read("manifests/b.json") == b"new"
    assert storage.list_files("manifests") == ("manifests/a.json", "manifests/b.json")


def test_what_is_absent_is_absent(storage):
    assert storage.list_files("points") == ()
    with pytest.raises(FileNotFoundError) as caught:
        storage.read("labels/none.parquet")
    assert "\n" not in str(caught.value)


def test_an_interrupted_publish_leaves_nothing_to_read(tmp_path, write, monkeypatch):
    storage = LocalStorage(str(tmp_path / "out"))
    storage.prepare(("labels",))

    def killed(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(os, "link", killed)
    with pytest.raises(KeyboardInterrupt):
        storage.publish("labels/a.parquet", write(b"half"))
    assert storage.list_files("labels") == ()
    assert list((tmp_path / "out/labels").iterdir()) == []


def test_files_left_by_a_killed_process_are_not_listed(tmp_path):
    (tmp_path / "labels").mkdir()
    (tmp_path / "labels/.0123.tmp").write_bytes(b"half")
    assert LocalStorage(str(tmp_path)).list_files("labels") == ()


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


def test_a_disk_without_hard_links_is_found_before_any_work(tmp_path, monkeypatch):
    def refuse(*_):
        raise PermissionError(1, "Operation not permitted")

    monkeypatch.setattr(os, "link", refuse)
    with pytest.raises(InvalidInput, match="Operation not permitted"):
        LocalStorage(str(tmp_path)).prepare(("labels",))


def test_s3_without_its_extra_says_how_to_get_it(monkeypatch):
    monkeypatch.setitem(sys.modules, "obstore.store", None)
    with pytest.raises(InvalidInput, match=r"pip install motionlabel\[s3\]"):
        open_storage("s3://bucket/prefix")


@pytest.mark.parametrize("uri", ["gs://bucket/x", "s3://", "http://host/x"])
def test_other_places_are_refused_by_name(uri):
    with pytest.raises(InvalidInput, match=uri.split(":")[0]):
        open_storage(uri)


def test_a_store_that_cannot_be_reached_gives_one_line(monkeypatch):
    for name, value in {"ENDPOINT_URL": "http://127.0.0.1:9", "ACCESS_KEY_ID": "a", "SECRET_ACCESS_KEY": "b"}.items():
        monkeypatch.setenv(f"AWS_{name}", value)
    with pytest.raises(InvalidInput, match="s3://bucket/prefix") as caught:
        open_storage("s3://bucket/prefix").prepare(("labels",))
    assert "\n" not in str(caught.value)
