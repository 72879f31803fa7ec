import os
import pickle
import pickletools
import subprocess
import sys

import numpy as np
import pytest

from labeling.exporters.segments import read_segment
from labeling.trajectories.scenarionet import make_scenario
from labeling.trajectories.trajectories import SegmentTracks, make_horizon, write_trajectories
from labeling.trajectories.windows import Horizon
from schemas.errors import InvalidInput

TIMES_S = np.arange(31) / 10


@pytest.fixture
def folder(make_folder, driving, circling):
    """Two cars: one from the first sweep to the last but for a gap, one that comes after a second."""
    with_gap = [time_s for time_s in TIMES_S if not 1.05 < time_s < 1.95]
    return make_folder([driving(with_gap), circling(TIMES_S[10:], track_id="late")])


def scenario_of(folder, hz=10.0):
    labels = read_segment(folder, folder.segment_ids[0], 0.0)
    return make_scenario(SegmentTracks(labels, tuple(labels.tracks(0.0)), 0.55), hz)


def test_a_scenario_has_what_scenarionet_asks_for(folder):
    scenario = scenario_of(folder)
    assert set(scenario) >= {"id", "version", "length", "metadata", "tracks", "dynamic_map_states", "map_features"}
    assert set(scenario["metadata"]) >= {"ts", "metadrive_processed", "coordinate", "sdc_id"}
    assert scenario["metadata"]["ts"].shape == (scenario["length"],) == (31,)
    assert scenario["metadata"]["sdc_id"] in scenario["tracks"]
    for object_id, track in scenario["tracks"].items():
        assert track["type"] in {"VEHICLE", "PEDESTRIAN", "CYCLIST"}
        assert (track["metadata"]["object_id"], track["metadata"]["type"]) == (object_id, track["type"])
        state = track["state"]
        assert set(state) >= {"position", "heading", "velocity", "length", "width", "height", "valid"}
        assert state["position"].shape == (31, 3)
        assert state["velocity"].shape == (31, 2)
        assert state["valid"].any()
        for values in state.values():
            assert len(values) == 31
            assert not values[~state["valid"]].any()


def test_cars_are_where_their_labels_are(folder, circling):
    scenario = scenario_of(folder)
    origin = scenario["metadata"]["world_origin_m"]
    assert origin == [100.0, 50.0, 3.0]  # where the vehicle starts
    late = scenario["tracks"]["late"]["state"]
    assert late["valid"].tolist() == [False] * 10 + [True] * 21
    rows = circling(TIMES_S[10:])
    np.testing.assert_allclose(late["position"][10:] + origin, rows.boxes[:, :3], atol=1e-3)
    np.testing.assert_allclose(late["heading"][10:], rows.boxes[:, 6], atol=1e-6)
    gap = scenario["tracks"]["car"]["state"]["valid"]
    assert np.flatnonzero(~gap).tolist() == list(range(11, 20))


def test_the_vehicle_itself_is_a_track(folder):
    """It drives along y of the world, a metre a sweep."""
    ego = scenario_of(folder)["tracks"]["ego"]["state"]
    assert ego["valid"].all()
    np.testing.assert_allclose(ego["position"], np.outer(np.arange(31), [0, 1, 0]), atol=1e-6)
    np.testing.assert_allclose(ego["velocity"], np.tile([0, 10], (31, 1)), atol=1e-4)
    np.testing.assert_allclose(ego["heading"], np.pi / 2, atol=1e-6)


def test_summaries_count_what_is_there(folder):
    metadata = scenario_of(folder)["metadata"]
    assert metadata["object_summary"]["car"] == {
        "type": "VEHICLE",
        "object_id": "car",
        "track_length": 31,
        "moving_distance": pytest.approx(30.0, abs=1e-4),
        "valid_length": 22,
        "continuous_valid_length": 11,
    }
    assert metadata["object_summary"]["late"]["continuous_valid_length"] == 21
    numbers = metadata["number_summary"]
    assert (numbers["num_objects"], numbers["num_objects_each_type"]) == (3, {"VEHICLE": 3})
    assert (numbers["num_moving_objects"], numbers["num_moving_objects_each_type"]) == (3, {"VEHICLE": 3})
    assert {name for name, number in numbers.items() if not number} == {
        "num_traffic_lights",
        "num_traffic_light_types",
        "num_traffic_light_each_step",
        "num_map_features",
        "map_height_diff",
    }


def test_a_pickle_holds_plain_values_and_arrays(folder, tmp_path):
    """Nothing of ours, nothing to be run: it is read where motionlabel is not installed."""
    summary = write_trajectories(folder, tmp_path / "out", format_name="scenarionet")
    assert (summary.num_units, summary.num_tracks, summary.num_gaps, summary.num_written) == (1, 2, 1, 3)
    names = sorted(path.name for path in (tmp_path / "out").iterdir())
    assert names == ["dataset_mapping.pkl", "dataset_summary.pkl", f"sd_av2_1_{folder.segment_ids[0]}.pkl"]
    for path in (tmp_path / "out").iterdir():
        strings = {argument for _, argument, _ in pickletools.genops(path.read_bytes()) if isinstance(argument, str)}
        assert {name for name in strings if name in sys.modules} <= {"numpy", "numpy._core.multiarray"}
    content = (tmp_path / "out" / names[2]).read_bytes()
    assert content == pickle.dumps(scenario_of(folder), 4)


def test_bytes_do_not_hang_on_the_order_of_hashes(folder, tmp_path, contents):
    code = (
        "import sys; from labeling.folders.folder import LabelFolder; "
        "from labeling.trajectories.trajectories import write_trajectories; "
        "write_trajectories(LabelFolder.open(sys.argv[1]), sys.argv[2], format_name='scenarionet')"
    )
    for seed in "12":
        arguments = [sys.executable, "-c", code, folder.storage.root, tmp_path / seed]
        subprocess.run(arguments, check=True, env={**os.environ, "PYTHONHASHSEED": seed})
    assert contents(tmp_path / "1") == contents(tmp_path / "2")


def test_another_rate_is_asked_for(folder):
    scenario = scenario_of(folder, hz=4.0)
    np.testing.assert_allclose(scenario["metadata"]["ts"], np.arange(13) / 4)


def test_windows_mean_nothing_to_it(folder, tmp_path):
    with pytest.raises(InvalidInput, match="--step-s means nothing to format scenarionet"):
        make_horizon("scenarionet", {"step_s": 1.0})
    assert make_horizon("scenarionet", {"hz": 5.0}) == Horizon(hz=5.0)
