"""Segments are found as a disk and as a bucket have them, a page at a time, and shared out without a rest."""

import os
import tracemalloc
from bisect import bisect_right
from datetime import UTC, datetime

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from labeling.readers.discovery import find_segments, shard_of
from labeling.readers.reader import READERS
from labeling.storage.bucket import ObjectStorage
from labeling.storage.storage import open_storage
from schemas.errors import InvalidInput

LAYOUTS = {name: reader.layout for name, reader in READERS.items() if reader.layout and not reader.holds_several}
PARTS = st.sampled_from(["a", "b", "a-b", "a0", "sensors", "lidar", "velodyne_points", "data"])
PATHS = st.lists(PARTS, max_size=3).map(tuple)


def refuse(message):
    raise AssertionError(message)


def found(dataset, place, since=None):
    """All segments, sorted, relative to the place; each is found once."""
    names = list(find_segments(dataset, place, refuse, since))
    assert len(names) == len(set(names))
    return sorted(name.removeprefix(str(place)).lstrip("/") for name in names)


def expected(layout, files):
    """The rule in other words: whatever has a file below its layout, unless it lies in another such folder."""
    parts = tuple(layout.split("/"))
    size = len(parts)
    marked = {file[:i] for file in files for i in range(len(file) - size) if file[i : i + size] == parts}
    return sorted("/".join(path) for path in marked if not any(path[:i] in marked for i in range(len(path))))


def fill(place, files):
    storage = open_storage(place)
    for file in files:
        if "://" not in str(place):
            (place / "/".join(file)).parent.mkdir(parents=True, exist_ok=True)
        storage.publish("/".join(file), b"")


@pytest.mark.parametrize("dataset", LAYOUTS)
@settings(max_examples=25, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(plain=st.sets(PATHS, min_size=1, max_size=4), segments=st.sets(PATHS, max_size=4))
def test_a_disk_and_a_bucket_have_the_same_segments(tmp_path_factory, bucket, dataset, plain, segments):
    layout = tuple(LAYOUTS[dataset].split("/"))
    files = sorted({(*path, "file") for path in plain} | {(*path, *layout, "sweep") for path in segments})
    folder = tmp_path_factory.mktemp("drives")
    for place in (folder, f"{bucket}/{folder.name}"):
        fill(place, files)
        assert found(dataset, place) == expected(LAYOUTS[dataset], files)


def test_segments_of_another_data_set_are_none(tmp_path, bucket):
    for place in (tmp_path, f"{bucket}/drives"):
        fill(place, [("drive", *layout.split("/"), "sweep") for layout in LAYOUTS.values()])
        fill(place, [(dataset, *layout.split("/"), "sweep") for dataset, layout in LAYOUTS.items()])
        for dataset in LAYOUTS:
            assert found(dataset, place) == sorted(["drive", dataset])


SCENES = b'[{"token": "a", "name": "scene-0001"}, {"token": "b", "name": "scene-0002"}]'


@pytest.mark.parametrize("kind", ["local", "s3"])
def test_the_segments_of_a_folder_that_holds_several_are_found(tmp_path, bucket, kind):
    place = tmp_path if kind == "local" else f"{bucket}/several"
    fill(place, [("waymo", split, "lidar_calibration", "a.parquet") for split in ("training", "validation")])
    fill(place, [("waymo", "training", "lidar", name) for name in ("a.parquet", "b.parquet", "readme.txt")])
    fill(place, [("nuscenes", "samples", "LIDAR_TOP", "1.pcd.bin"), ("nuscenes", "maps", "1.png")])
    open_storage(place).prepare(("nuscenes/v1.0-mini",))
    open_storage(place).publish("nuscenes/v1.0-mini/scene.json", SCENES)
    assert found("wod", place) == ["waymo/training/lidar/a.parquet", "waymo/training/lidar/b.parquet"]
    assert found("nuscenes", place) == ["nuscenes/v1.0-mini/scene-0001", "nuscenes/v1.0-mini/scene-0002"]
    with pytest.raises(InvalidInput, match="when each was written is not known"):
        find_segments("wod", str(place), refuse, datetime(2026, 1, 1, tzinfo=UTC))


@pytest.mark.parametrize("kind", ["local", "s3"])
def test_a_segment_itself_is_found_and_hidden_folders_are_not(tmp_path, bucket, kind):
    place = tmp_path if kind == "local" else f"{bucket}/x"
    fill(place, [("log", "sensors", "lidar", "1.feather"), (".trash", "log", "sensors", "lidar", "1.feather")])
    assert found("av2", place) == ["log"]
    for itself in (f"{place}/log", f"{place}/log/"):
        assert list(find_segments("av2", itself, refuse)) == [f"{place}/log"]


@pytest.mark.parametrize("kind", ["local", "s3"])
def test_since_looks_at_the_sweeps(tmp_path, bucket, kind):
    place = tmp_path if kind == "local" else f"{bucket}/x"
    fill(place, [("log", "sensors", "lidar", f"{k}.feather") for k in range(3)])
    assert found("av2", place, datetime(2020, 1, 1, tzinfo=UTC)) == ["log"]
    assert found("av2", place, datetime(2999, 1, 1, tzinfo=UTC)) == []
    if kind == "local":
        os.utime(place / "log/sensors/lidar/1.feather", (4e9, 4e9))
        assert found("av2", place, datetime.fromtimestamp(4e9, UTC)) == ["log"]
        assert found("av2", place, datetime.fromtimestamp(4e9 + 1, UTC)) == []


def test_links_are_followed_and_loops_end(tmp_path):
    fill(tmp_path, [("disk", "log", "sensors", "lidar", "1.feather")])
    (tmp_path / "drives").mkdir()
    (tmp_path / "drives/link").symlink_to(tmp_path / "disk/log")
    (tmp_path / "drives/back").symlink_to(tmp_path / "drives")
    (tmp_path / "drives/up").symlink_to(tmp_path)
    assert set(find_segments("av2", str(tmp_path / "drives"), refuse)) == {str(tmp_path / "disk/log")}


@pytest.mark.parametrize("name", ["lo\ng", os.fsdecode(b"lo\xff")])
def test_a_name_that_no_place_has_is_told_and_left_out(tmp_path, name):
    fill(tmp_path, [(name, "log", "sensors", "lidar", "1.feather"), ("log", "sensors", "lidar", "1.feather")])
    told = []
    assert list(find_segments("av2", str(tmp_path), told.append)) == [str(tmp_path / "log")]
    (line,) = told
    assert line.startswith(f"{str(tmp_path / name)!r} is left out with all that it holds: ")


def test_a_key_that_no_place_has_is_told_and_left_out(bucket):
    fill(f"{bucket}/x", [("50%", "sensors", "lidar", "1.feather"), ("log", "sensors", "lidar", "1.feather")])
    told = []
    assert list(find_segments("av2", f"{bucket}/x", told.append)) == [f"{bucket}/x/log"]
    assert len(told) == 1


class Keys:
    """A bucket of sorted keys, in pages of 1,000, that counts its requests."""

    def __init__(self, keys):
        self.keys, self.num_asked = keys, 0

    def list(self, prefix, offset, chunk_size):
        start = bisect_right(self.keys, max(prefix, offset or ""))
        while True:
            self.num_asked += 1
            page = [key for key in self.keys[start : start + chunk_size] if key.startswith(prefix)]
            yield [{"path": key} for key in page]
            if len(page) < chunk_size:
                return
            start += chunk_size


class Logs:
    """The sorted keys of logs with 2,000 pictures and 150 sweeps each, none of which is held."""

    files = 2150

    def __init__(self, num_logs):
        self.num_logs = num_logs

    def __len__(self):
        return self.num_logs * self.files

    def __getitem__(self, item):
        if isinstance(item, slice):
            return [self[i] for i in range(*item.indices(len(self)))]
        log, file = divmod(item, self.files)
        kind = f"cameras/{file:06d}.jpg" if file < 2000 else f"lidar/{file:06d}.feather"
        return f"logs/{log:08d}/sensors/{kind}"


@pytest.fixture
def open_keys(monkeypatch):
    def use(keys):
        store = Keys(keys)
        monkeypatch.setattr("labeling.readers.discovery.open_storage", lambda place: ObjectStorage(place, store))
        return store

    return use


def test_two_requests_a_segment_however_many_pictures_it_has(open_keys):
    store = open_keys(Logs(50))
    names = list(find_segments("av2", "s3://b", refuse))
    assert names == [f"s3://b/logs/{log:08d}" for log in range(50)]
    assert store.num_asked < 2 * 50 + 10


def test_segments_come_while_a_bucket_of_100000_keys_is_listed(open_keys):
    store = open_keys([f"logs/{log:05d}/sensors/lidar/{k}.feather" for log in range(10_000) for k in range(10)])
    names = find_segments("av2", "s3://b", refuse)
    assert next(names) == "s3://b/logs/00000"
    assert store.num_asked < 10  # not the hundred pages of all keys
    assert sum(1 for _ in names) == 9_999
    assert store.num_asked < 10_000 + 100 + 10


def test_memory_does_not_grow_with_the_segments_of_a_bucket(open_keys):
    peaks = []
    for num_logs in (10, 60):
        open_keys(Logs(num_logs))
        tracemalloc.start()
        assert sum(1 for _ in find_segments("av2", "s3://b", refuse)) == num_logs
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    assert peaks[1] < 1.2 * peaks[0]


@given(st.integers(1, 9), st.sets(st.integers(0, 10**6), max_size=30))
def test_every_segment_belongs_to_exactly_one_share(num_shards, logs):
    names = [f"s3://b/logs/{log}" for log in logs]
    shares = [{name for name in names if shard_of("av2", name, num_shards) == shard} for shard in range(num_shards)]
    assert sorted(name for share in shares for name in share) == sorted(names)
    assert [shard_of("av2", name, num_shards) for name in names] == [
        shard_of("av2", name, num_shards) for name in names
    ]


def test_shares_are_fair_and_stay_as_they_are():
    shares = [shard_of("av2", f"s3://b/logs/{log}", 4) for log in range(4000)]
    assert all(900 < shares.count(shard) < 1100 for shard in range(4))
    assert shares[:8] == [1, 0, 0, 2, 1, 3, 3, 3]  # other numbers would submit the segments of a running backfill twice


@pytest.mark.parametrize(
    ("dataset", "place", "message"),
    [
        ("waymo?", "x", r"unknown dataset 'waymo\?'"),
        ("synthetic", "x", "segments of dataset synthetic lie in no folder"),
        ("av2", "missing", r"missing: no such folder, or nothing in it; a segment of dataset av2 is "),
        ("av2", "gs://b/x", "expected an absolute path, file:///path or s3://bucket/prefix"),
    ],
)
def test_what_cannot_be_looked_through_is_told_at_once(tmp_path, monkeypatch, dataset, place, message):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(InvalidInput, match=message):
        find_segments(dataset, place, refuse)


def test_a_whole_bucket_is_a_place(bucket):
    fill(bucket, [("log", "sensors", "lidar", "1.feather"), ("file",)])
    assert found("av2", bucket) == found("av2", f"{bucket}/") == ["log"]


def test_a_bucket_that_is_missing_is_told_at_once(bucket):
    with pytest.raises(InvalidInput, match=r"^s3://not-a-bucket/x: no such bucket$"):
        find_segments("av2", "s3://not-a-bucket/x", refuse)
