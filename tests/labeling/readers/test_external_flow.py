"""Flow read from files beside the sweeps, alone and through the line."""

import numpy as np
import pyarrow as pa
import pytest
from pyarrow import feather

from labeling.line import observe_sweeps
from labeling.readers.external_flow import read_external_flow
from labeling.readers.reader import open_segment
from schemas.config import resolve_config
from schemas.errors import InvalidInput, UnreadableSweep

STREET = "synthetic:street?sweeps=3&seed=1&beams=16&azimuth_steps=360"


def write_flow(folder, segment_id, timestamp_ns, flow):
    path = folder / segment_id / f"{timestamp_ns}.feather"
    path.parent.mkdir(exist_ok=True)
    names = ("flow_x_m", "flow_y_m", "flow_z_m")
    feather.write_feather(pa.table(dict(zip(names, flow.T, strict=True))), str(path))
    return path


def test_flow_comes_back_as_written(tmp_path):
    flow = np.arange(12, dtype=np.float32).reshape(4, 3)
    write_flow(tmp_path, "log", 7, flow)
    np.testing.assert_array_equal(read_external_flow(str(tmp_path), "log", 7, 4), flow)


@pytest.mark.parametrize(
    ("flow", "says"),
    [(np.zeros((3, 3)), "3 rows, its sweep 4 points"), (np.full((4, 3), np.nan), "4 rows that are not finite")],
)
def test_a_file_that_does_not_fit_is_refused(tmp_path, flow, says):
    write_flow(tmp_path, "log", 7, flow)
    with pytest.raises(UnreadableSweep, match=says):
        read_external_flow(str(tmp_path), "log", 7, 4)


def test_a_missing_or_broken_file_is_refused(tmp_path):
    with pytest.raises(UnreadableSweep, match="no external flow at"):
        read_external_flow(str(tmp_path), "log", 7, 4)
    write_flow(tmp_path, "log", 7, np.zeros((4, 3))).write_bytes(b"not feather")
    with pytest.raises(UnreadableSweep, match="not a Feather file"):
        read_external_flow(str(tmp_path), "log", 7, 4)


def test_the_line_uses_the_flow_it_is_given(tmp_path):
    reader = open_segment("synthetic", STREET)
    for index in (0, 1):
        sweep = reader.read_sweep(index)
        flow = np.tile(np.float32([0.5, 0.0, 0.1]), (sweep.num_points, 1))
        flow[::2] = 0, 0, 0.2  # straight up, steeper than any road: it is not ours to judge
        write_flow(tmp_path, reader.segment_id, sweep.timestamp_ns, flow)
    config = resolve_config("default", {"flow.method": "external", "flow.external_folder": str(tmp_path)})
    first, second, last = observe_sweeps(reader, config)
    for observation in (first, second):
        points = observation.points
        found = np.linalg.norm(points.flow_world_m, axis=1)[points.is_dynamic]
        is_even = points.point_index[points.is_dynamic] % 2 == 0
        np.testing.assert_allclose(found, np.where(is_even, 0.2, np.hypot(0.5, 0.1)), atol=1e-5)
        assert observation.num_failed_fits == 0
    assert last.points.flow_world_m is None


def test_method_and_folder_go_together(tmp_path):
    for overrides in ({"flow.method": "external"}, {"flow.external_folder": str(tmp_path)}):
        with pytest.raises(InvalidInput, match="give both or neither"):
            resolve_config("default", overrides)


def test_whole_scene_flow_refuses_static_removal():
    with pytest.raises(InvalidInput, match=r"static\.method=none"):
        resolve_config("default", {"flow.method": "nsfp"})
    assert resolve_config("default", {"flow.method": "nsfp", "static.method": "none"}).flow.method == "nsfp"
