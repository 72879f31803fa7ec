"""Flow read from files beside the sweeps, alone and through the line."""

import dataclasses
import shutil

import numpy as np
import pyarrow as pa
import pytest
from pyarrow import feather

from labeling.folders.identity import LabelSet
from labeling.line import observe_sweeps
from labeling.readers.external_flow import read_external_flow
from labeling.readers.reader import open_segment, reopen
from labeling.storage.storage import open_storage
from schemas.config import resolve_config
from schemas.errors import InvalidInput, UnreadableSweep

STREET = "synthetic:street?sweeps=3&seed=1&beams=16&azimuth_steps=360"


def write_flow(folder, segment_id, timestamp_ns, flow):
    path = folder / segment_id / f"{timestamp_ns}.feather"
    path.parent.mkdir(parents=True, exist_ok=True)
    names = ("flow_x_m", "flow_y_m", "flow_z_m")
    feather.write_feather(pa.table(dict(zip(names, flow.T, strict=True))), str(path))
    return path


@pytest.fixture(scope="module")
def listing():
    """Of a street without external flow."""
    return open_segment("synthetic", STREET).listing


@pytest.fixture
def write(listing, tmp_path):
    """Return a function that writes the flow of a sweep."""

    def run(flow, index=0):
        return write_flow(tmp_path / "flow", listing.segment_id, listing.timestamps_ns[index], np.asarray(flow))

    return run


@pytest.fixture
def read(listing, tmp_path):
    """Return a function that opens the street with external flow, does something, and reads the first sweep's flow."""

    def run(then=lambda: None):
        opened = open_segment("synthetic", STREET, str(tmp_path / "flow")).listing
        then()
        return read_external_flow(opened, int(listing.timestamps_ns[0]), 4)

    return run


def test_flow_comes_back_as_written(write, read):
    flow = np.arange(12, dtype=np.float32).reshape(4, 3)
    write(flow)
    np.testing.assert_array_equal(read(), flow)


def test_flow_is_read_from_a_bucket_too(write, listing, bucket):
    path = write(np.ones((4, 3)))
    open_storage(f"{bucket}/flow").publish(f"{listing.segment_id}/{path.name}", path)
    opened = open_segment("synthetic", STREET, f"{bucket}/flow/").listing
    assert opened.flow.folder == f"{bucket}/flow/{listing.segment_id}"
    np.testing.assert_array_equal(read_external_flow(opened, int(listing.timestamps_ns[0]), 4), 1)


@pytest.mark.parametrize(
    ("flow", "says"),
    [(np.zeros((3, 3)), "3 rows, its sweep 4 points"), (np.full((4, 3), np.nan), "4 rows that are not finite")],
)
def test_a_file_that_does_not_fit_is_refused(write, read, flow, says):
    write(flow)
    with pytest.raises(UnreadableSweep, match=says):
        read()


def test_a_broken_file_is_refused_and_not_quoted(write, read):
    write(np.zeros((4, 3))).write_bytes(b"root:secret:0:0")
    with pytest.raises(UnreadableSweep, match="not a readable feather file") as caught:
        read()
    assert "secret" not in str(caught.value)


def test_only_what_was_there_at_opening_is_read(write, read):
    write(np.zeros((4, 3)), index=1)
    for then in (lambda: None, lambda: write(np.zeros((4, 3)))):
        with pytest.raises(UnreadableSweep, match=r"no external flow at .*: expected one file a sweep"):
            read(then)
    path = write(np.zeros((4, 3)))
    with pytest.raises(UnreadableSweep, match=r"\.feather has changed since labelling began"):
        read(lambda: write(np.ones((4, 3))))
    with pytest.raises(UnreadableSweep, match="no external flow at"):
        read(path.unlink)


def test_a_folder_without_flow_of_the_segment_is_refused_at_opening(tmp_path, listing):
    with pytest.raises(
        InvalidInput, match=f"no external flow of any sweep: expected files {tmp_path}/{listing.segment_id}/"
    ):
        open_segment("synthetic", STREET, str(tmp_path))
    with pytest.raises(InvalidInput, match="opened without external flow"):
        read_external_flow(listing, int(listing.timestamps_ns[0]), 4)


def test_what_is_in_the_files_is_part_of_the_identity_and_where_they_lie_is_not(write, listing, tmp_path):
    def identity(folder):
        config = resolve_config("default", {"flow.method": "external", "flow.external_folder": folder})
        return LabelSet.of(open_segment("synthetic", STREET, folder), config).identity("labels")

    write(np.zeros((4, 3)))
    first = identity(str(tmp_path / "flow"))
    assert identity(f"file://{tmp_path}/flow/") == first
    shutil.copytree(tmp_path / "flow", tmp_path / "copy")
    assert identity(str(tmp_path / "copy")) == first
    write(np.ones((4, 3)))  # of the same size
    assert identity(str(tmp_path / "flow")) != first
    write(np.zeros((4, 3)))
    write(np.zeros((4, 3)), index=1)
    assert identity(str(tmp_path / "flow")) != first
    assert listing.digest != open_segment("synthetic", STREET, str(tmp_path / "copy")).listing.digest


def test_the_line_uses_the_flow_it_is_given(tmp_path):
    reader = open_segment("synthetic", STREET)
    for index in (0, 1):
        sweep = reader.read_sweep(index)
        flow = np.tile(np.float32([0.5, 0.0, 0.1]), (sweep.num_points, 1))
        flow[::2] = 0, 0, 0.2  # straight up, steeper than any road: it is not ours to judge
        write_flow(tmp_path, reader.segment_id, sweep.timestamp_ns, flow)
    config = resolve_config("default", {"flow.method": "external", "flow.external_folder": str(tmp_path)})
    listing = open_segment("synthetic", STREET, config.flow.external_folder).listing
    first, second, last = observe_sweeps(reopen(listing), config)
    for observation in (first, second):
        points = observation.points
        found = np.linalg.norm(points.flow_world_m, axis=1)[points.is_dynamic]
        is_even = points.point_index[points.is_dynamic] % 2 == 0
        np.testing.assert_allclose(found, np.where(is_even, 0.2, np.hypot(0.5, 0.1)), atol=1e-5)
        assert observation.num_failed_fits == 0
    assert last.points.flow_world_m is None
    with pytest.raises(InvalidInput, match="opened without external flow"):
        list(observe_sweeps(reopen(dataclasses.replace(listing, flow=None)), config))


def test_method_and_folder_go_together(tmp_path):
    for overrides in ({"flow.method": "external"}, {"flow.external_folder": str(tmp_path)}):
        with pytest.raises(InvalidInput, match="give both or neither"):
            resolve_config("default", overrides)


def test_whole_scene_flow_refuses_static_removal():
    with pytest.raises(InvalidInput, match=r"static\.method=none"):
        resolve_config("default", {"flow.method": "nsfp"})
    assert resolve_config("default", {"flow.method": "nsfp", "static.method": "none"}).flow.method == "nsfp"
