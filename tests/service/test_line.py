"""The command line over the real stages, on small logs: the oddities that must be normal results."""

import numpy as np
import pyarrow.compute as pc
import pytest
from matplotlib.image import imread

from labeling.evaluation.plots import WIDTH_PX
from labeling.evaluation.report import Report
from labeling.folders.folder import LabelFolder


@pytest.fixture
def labels_of(label, tmp_path):
    """Return a function that labels one log and returns the exit code and its three tables."""

    def run(log, *arguments):
        code, _, _ = label(log, "--points", "--profile", "fast", *arguments)
        folder = LabelFolder.open(tmp_path / "out")
        (segment_id,) = folder.segment_ids
        return code, *(folder.table(name, segment_id) for name in ("labels", "sweeps", "points"))

    return run


def test_a_driving_block_becomes_one_track_at_its_speed(write_log, labels_of):
    code, labels, sweeps, points = labels_of(write_log(num_sweeps=12, speed_mps=8.0))
    assert code == 0
    assert len(sweeps) == 12
    (track_id,) = labels["track_id"].unique().to_pylist()
    assert np.median(labels["velocity_x_mps"]) == pytest.approx(8.0, abs=0.5)
    assert np.median(labels["length_m"]) == pytest.approx(4.0, abs=0.5)
    assert np.median(labels["width_m"]) == pytest.approx(2.0, abs=0.5)
    owned = points.filter(pc.field("track_id") == track_id)
    assert len(owned) > 1000
    assert set(owned["point_index"].to_pylist()) <= set(range(1900, 2200))  # rows of the block


def test_nothing_moves(write_log, labels_of):
    code, labels, sweeps, _ = labels_of(write_log(num_sweeps=8, speed_mps=0.0))
    assert code == 0
    assert len(labels) == 0
    assert set(sweeps["status"].to_pylist()) == {"ok"}


@pytest.mark.parametrize(
    ("num_sweeps", "times_s"),
    [(1, None), (2, None), (12, [*np.arange(6) / 10, *(np.arange(6) / 10 + 5)])],
    ids=["one sweep only", "two sweeps", "a gap of five seconds"],
)
def test_little_or_broken_time(write_log, labels_of, num_sweeps, times_s):
    code, _, sweeps, points = labels_of(write_log(num_sweeps=num_sweeps, times_s=times_s))
    assert code == 0
    assert len(sweeps) == num_sweeps
    is_last = [num_sweeps - 1] if times_s is None else [5, 11]
    for sweep, flow in zip(points["sweep_index"].to_pylist(), points["flow_x_m"].to_pylist(), strict=True):
        assert (flow is None) == (sweep in is_last)


def test_one_bad_sweep_in_the_middle(write_log, labels_of, damage_sweep):
    log = write_log(num_sweeps=12)
    damage_sweep(log, 6)
    code, labels, sweeps, _ = labels_of(log)
    assert code == 3
    assert sweeps["status"].to_pylist() == ["rejected" if index == 6 else "ok" for index in range(12)]
    assert 6 not in labels["sweep_index"].to_pylist()
    assert len(set(labels["track_id"].to_pylist())) == 1


def test_evaluate_and_render_say_what_they_miss(write_log, label, cli, tmp_path):
    log = write_log(num_sweeps=8)
    label(log, "--profile", "fast")
    code, _, err = cli("evaluate", tmp_path / "out", log, "--dataset", "av2")
    assert code == 2
    assert len(err) == 1
    assert "annotations" in err[0]
    code, out, err = cli("render", tmp_path / "out", log, "--dataset", "av2", "--sweep", 3, "--png", tmp_path / "a.png")
    assert (code, err) == (0, [])
    assert out == f"picture: {tmp_path / 'a.png'}\n"
    assert (tmp_path / "a.png").read_bytes().startswith(b"\x89PNG")
    code, _, err = cli("render", tmp_path / "out", log, "--dataset", "av2", "--sweep", 8, "--png", tmp_path / "a.png")
    assert code == 2
    assert "sweep 8" in err[0]


def test_evaluate_prints_writes_and_draws_its_figures(cli, tmp_path):
    street = "synthetic:street?sweeps=4&beams=16&azimuth_steps=360"
    of_street = (street, "--dataset", "synthetic")
    assert cli("label", *of_street, "--output", tmp_path / "out", "--points", "--profile", "fast")[0] == 0
    code, printed, err = cli("evaluate", tmp_path / "out", *of_street)
    assert (code, err) == (0, [])
    files = tmp_path / "a.json", tmp_path / "a.PNG"
    assert cli("evaluate", tmp_path / "out", *of_street, "--json", files[0], "--png", files[1]) == (0, printed, [])
    assert Report.model_validate_json(files[0].read_text()).pooled.boxes.num_labels > 0
    assert imread(files[1], format="png").shape[1] == WIDTH_PX


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--png", "{tmp}/absent/a.png"], "--png {tmp}/absent/a.png: no folder {tmp}/absent"),
        (["--json", "{tmp}/absent/a.json"], "--json {tmp}/absent/a.json: no folder {tmp}/absent"),
        (["--png", "{tmp}/a.pdf"], "--png {tmp}/a.pdf: expected a name that ends in .png"),
        (["--png", "{tmp}"], "--png {tmp}: expected a name that ends in .png"),
        (["--min-score", "2"], "--min-score 2: expected a score between 0 and 1"),
        (["--azimuth-deg", "0"], "--azimuth-deg 0: expected degrees above 0 and up to 180"),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, list) else "",
)
def test_wrong_options_of_evaluate_are_one_line_before_any_work(cli, tmp_path, arguments, message):
    arguments = [argument.format(tmp=tmp_path) for argument in arguments]
    code, out, err = cli("evaluate", tmp_path / "out", "no segment", "--dataset", "av2", *arguments)
    assert (code, out) == (2, "")
    assert err == [f"motionlabel: {message.format(tmp=tmp_path)}"]
