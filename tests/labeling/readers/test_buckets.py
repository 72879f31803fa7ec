"""Segments in a bucket and on a disk are the same segments, and so are their labels."""

import dataclasses
import pickle

import numpy as np
import pyarrow as pa
import pytest
from pyarrow import feather

from labeling.folders.entries import prepare_folder
from labeling.folders.folder import LabelFolder
from labeling.in_process import label_in_process
from labeling.readers.reader import open_segment, reopen, segment_id_of
from labeling.run import label_segments
from labeling.storage import places
from labeling.storage.bucket import ObjectStorage
from labeling.storage.storage import open_storage
from schemas.config import resolve_config
from schemas.errors import InvalidInput, StorageTrouble, UnreadableSweep

CONFIG = resolve_config("fast", {"static.vote_gaps_s": [0.1, 0.2], "write_points": True})
NUM_SWEEPS = 6
PACKET = "49.0 8.4 112.0 0 0 0" + " 0" * 24


def captures():
    """A road, a wall and two blocks that drive, in the frame of a vehicle that stands."""
    rng = np.random.default_rng(0)
    road = np.column_stack([rng.uniform(-20, 20, (1500, 2)), rng.normal(0, 0.01, 1500)])
    wall = np.column_stack([rng.uniform(-20, 20, 400), np.full(400, 9.0), rng.uniform(0, 3, 400)])
    block = rng.uniform([-2, -1, 0.3], [2, 1, 1.8], (300, 3))
    places_m = [((0.8 * k - 6, 4, 0), (6 - 0.9 * k, -5, 0)) for k in range(NUM_SWEEPS)]
    return [np.concatenate([road, wall, block + near, block + far]) for near, far in places_m]


def write_kitti(folder, points_of_sweeps):
    for kind in ("velodyne_points/data", "oxts/data"):
        (folder / kind).mkdir(parents=True)
    for number, points in enumerate(points_of_sweeps):
        content = np.column_stack([points, np.zeros(len(points))]).astype("<f4").tobytes()
        (folder / f"velodyne_points/data/{number:010d}.bin").write_bytes(content)
        (folder / f"oxts/data/{number:010d}.txt").write_text(PACKET)
    stamps = [f"2011-09-26 13:04:32.{number}\n" for number in range(len(points_of_sweeps))]
    (folder / "velodyne_points/timestamps.txt").write_text("".join(stamps))
    (folder.parent / "calib_imu_to_velo.txt").write_text("R: 1 0 0 0 1 0 0 0 1\nT: 0 0 0\n")
    return folder


def write_plain(folder, points_of_sweeps):
    (folder / "lidar").mkdir(parents=True)
    stamps_ns = [1_700_000_000_000_000_000 + 100_000_000 * number for number in range(len(points_of_sweeps))]
    for stamp_ns, points in zip(stamps_ns, points_of_sweeps, strict=True):
        content = np.column_stack([points, np.zeros(len(points))]).astype("<f4").tobytes()
        (folder / f"lidar/{stamp_ns}.bin").write_bytes(content)
    (folder / "poses.txt").write_text("".join(f"{stamp_ns} 0 0 0 0 0 0 1\n" for stamp_ns in stamps_ns))
    return folder


@pytest.fixture(params=["av2", "kitti_raw", "folder"])
def dataset(request):
    return request.param


@pytest.fixture
def folder(dataset, tmp_path, write_av2):
    """One segment of each kind, in a folder of its own."""
    if dataset == "av2":
        return write_av2(tmp_path / "val/log 1", np.arange(NUM_SWEEPS) / 10, captures())
    if dataset == "folder":
        return write_plain(tmp_path / "val/drive 1", captures())
    return write_kitti(tmp_path / "2011_09_26/2011_09_26_drive_0001_sync", captures())


@pytest.fixture
def uri(folder, bucket):
    """The same segment in a bucket."""
    storage = open_storage(f"{bucket}/drives")
    for path in folder.parent.rglob("*"):
        if path.is_file():
            storage.publish(str(path.relative_to(folder.parent)), path)
    return f"{bucket}/drives/{folder.name}"


@pytest.fixture
def both(dataset, folder, uri):
    return open_segment(dataset, str(folder)), open_segment(dataset, uri)


def test_the_same_sweeps_are_listed_and_read(dataset, both, uri):
    local, remote = both
    assert (remote.dataset, remote.uri) == (dataset, uri)
    assert remote.segment_id == segment_id_of(dataset, uri + "/") != local.segment_id
    assert remote.listing.names == local.listing.names
    assert remote.listing.digest == local.listing.digest
    np.testing.assert_array_equal(remote.timestamps_ns, local.timestamps_ns)
    for index in range(NUM_SWEEPS):
        for field in dataclasses.fields(ours := remote.read_sweep(index)):
            np.testing.assert_array_equal(getattr(ours, field.name), getattr(local.read_sweep(index), field.name))


def test_labels_are_equal_to_the_last_byte_on_disk_and_in_the_bucket(both, bucket, tmp_path):
    """Chance is seeded from the segment's id, so both get one."""
    outputs = [open_storage(tmp_path / "out"), open_storage(f"{bucket}/out")]
    for reader, output in zip(both, outputs, strict=True):
        prepare_folder(output, CONFIG)
        same = reopen(dataclasses.replace(reader.listing, segment_id="segment"))
        (entry,) = label_in_process([same], output, CONFIG, lambda _: None)
        assert (entry.state, entry.uri) == ("SUCCEEDED", reader.uri)
        assert entry.num_tracks > 1
    paths = [
        {path for table in ("labels", "sweeps", "points") for path in output.list_files(table)} for output in outputs
    ]
    assert paths[0] == paths[1]
    assert len(paths[0]) == 3
    for path in paths[0]:
        assert outputs[0].read(path) == outputs[1].read(path)


def test_a_label_folder_in_a_bucket_is_written_once_and_read_back(dataset, uri, bucket):
    steps = []
    for _ in range(2):
        manifest = label_segments(dataset, [uri], f"{bucket}/out", CONFIG, label_in_process, on_progress=steps.append)
    assert [step.stage for step in steps].count("already there") == 1
    folder = LabelFolder.open(f"{bucket}/out")
    assert folder.manifests == (manifest,)
    (segment_id,) = folder.segment_ids
    assert len(folder.table("sweeps", segment_id)) == NUM_SWEEPS
    assert folder.table("labels", segment_id)["score"].to_numpy().min() > 0


def test_a_sweep_is_one_request(both, monkeypatch):
    asked = []
    read = ObjectStorage.read
    monkeypatch.setattr(ObjectStorage, "read", lambda self, path: (asked.append(path), read(self, path))[1])
    _, remote = both
    remote.read_sweep(3)
    assert sum(path == remote.listing.names[3] for path in asked) == 1
    assert len(asked) <= 2  # KITTI keeps a packet beside


def test_what_is_gone_is_unreadable_and_a_network_that_fails_is_not(both, monkeypatch):
    _, remote = both

    def absent(_, path):
        raise FileNotFoundError(path)

    with monkeypatch.context() as patch:
        patch.setattr(ObjectStorage, "read", absent)
        with pytest.raises(UnreadableSweep, match=f"^{remote.uri}/{remote.listing.names[2]}: no such file"):
            remote.read_sweep(2)
    monkeypatch.setenv("AWS_ENDPOINT_URL", "http://127.0.0.1:9")
    monkeypatch.setattr("labeling.storage.bucket.RETRY", {"max_retries": 0})
    cut_off = dataclasses.replace(remote, storage=open_storage(remote.uri))
    with pytest.raises(StorageTrouble):
        cut_off.read_sweep(2)


@pytest.mark.parametrize("dataset", ["av2", "kitti_raw"], indirect=True)
def test_what_is_no_segment_is_said_in_the_words_of_folders(dataset, uri):
    above, name = places.split(uri)
    with pytest.raises(
        InvalidInput, match=f"^{above}: .* holds segments of dataset {dataset}: pass one of them, as {name}$"
    ):
        open_segment(dataset, above)
    with pytest.raises(InvalidInput, match=f"^{above}/other: no such folder$"):
        open_segment(dataset, f"{above}/other")
    (sweep, *_) = open_segment(dataset, uri).listing.names
    with pytest.raises(InvalidInput, match=f"^{uri}/{sweep}: is a file, expected the folder of one {dataset} segment$"):
        open_segment(dataset, f"{uri}/{sweep}")
    other = {"av2": "kitti_raw", "kitti_raw": "av2"}[dataset]
    with pytest.raises(InvalidInput, match=f"looks like dataset {dataset}$"):
        open_segment(other, uri)


def test_sweeps_that_come_or_go_after_listing_change_no_other(dataset, folder):
    """A log that is still being copied: one of six comes after all have agreed what there is, another goes."""
    names = open_segment(dataset, str(folder)).listing.names
    late, gone = folder / names[2], folder / names[4]
    content = late.read_bytes()
    late.unlink()
    listing = open_segment(dataset, str(folder)).listing
    digest = listing.digest
    late.write_bytes(content)
    gone.unlink()
    reader = reopen(listing)
    assert reader.listing.digest == digest != open_segment(dataset, str(folder)).listing.digest
    reasons = {}
    for index, timestamp_ns in enumerate(reader.timestamps_ns):
        try:
            assert reader.read_sweep(index).timestamp_ns == timestamp_ns
        except UnreadableSweep as error:
            reasons[index] = str(error)
    rejected = {"av2": {3: gone}, "folder": {3: gone}, "kitti_raw": {2: late, 4: gone}}[
        dataset
    ]  # KITTI's time stamps tell of the late one
    assert reasons.keys() == rejected.keys()
    assert all(reasons[index].startswith(str(path)) for index, path in rejected.items())


def test_other_poses_or_another_calibration_are_another_input(dataset, folder):
    """Poses computed anew are labelled anew, and no process goes on with others than were listed."""
    file = {
        "av2": folder / "city_SE3_egovehicle.feather",
        "kitti_raw": folder.parent / "calib_imu_to_velo.txt",
        "folder": folder / "poses.txt",
    }[dataset]
    listing = open_segment(dataset, str(folder)).listing
    content = file.read_bytes()
    if dataset == "av2":
        table = feather.read_table(file)
        moved = table.set_column(table.column_names.index("tx_m"), "tx_m", pa.array(np.full(NUM_SWEEPS, 1.0)))
        feather.write_feather(moved, file)
    elif dataset == "folder":
        file.write_text(content.decode().replace(" 0 0 0 0 0 0 1", " 1 0 0 0 0 0 1"))
    else:
        file.write_text("R: 1 0 0 0 1 0 0 0 1\nT: .5 0 0\n")
    assert open_segment(dataset, str(folder)).listing.digest != listing.digest
    with pytest.raises(InvalidInput, match=f"^{file} has changed since"):
        reopen(listing)
    file.write_bytes(content)
    assert reopen(listing).listing.digest == open_segment(dataset, str(folder)).listing.digest == listing.digest


def test_a_listing_is_small(both):
    for reader in both:
        assert len(pickle.dumps(reader.listing)) < 200 * NUM_SWEEPS + 500
        assert pickle.loads(pickle.dumps(reader.listing)).digest == reader.listing.digest
