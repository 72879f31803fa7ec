from types import SimpleNamespace

import pytest
from pydantic import BaseModel

from labeling import line
from labeling.evaluation import flow_ablation
from labeling.evaluation.flow_ablation import (
    FLOW_ROWS,
    FlowAblation,
    ablate_flow,
    choose_flow_rows,
    choose_sweeps,
    observe_timed,
    render_flow_ablation,
)
from labeling.evaluation.truth import read_truth
from labeling.line import observe_sweeps
from labeling.synthetic.rigs import SpinningLidar
from labeling.synthetic.scene import Scene, drive, wall
from labeling.synthetic.shapes import car
from schemas.config import resolve_config
from schemas.errors import InvalidInput

QUICK = {"static.vote_gaps_s": [0.2], "flow.iterations": 2, "flow.hidden_layers": 1, "flow.hidden_units": 8}
CONFIGS = {row.key: row.config({}) for row in FLOW_ROWS}


@pytest.fixture(scope="module")
def street():
    movers = (drive(car(), (6, 4.5), 0.0, 8.0), drive(car(), (14, -7.5)))
    scene = Scene(structures=(wall((-40, 10), (60, 10)),), movers=movers)
    return scene.reader(6, 10.0, SpinningLidar(num_beams=32, azimuth_steps=540))


@pytest.fixture(scope="module")
def ablation(street):
    return ablate_flow([street], FLOW_ROWS, changes=QUICK, sweeps=[2], azimuth_deg=None)


def leaves(model, prefix=""):
    values = {}
    for name in type(model).model_fields:
        value = getattr(model, name)
        values |= leaves(value, f"{prefix}{name}.") if isinstance(value, BaseModel) else {f"{prefix}{name}": value}
    return values


def difference(one, other):
    ours, theirs = leaves(CONFIGS[one]), leaves(CONFIGS[other])
    return {name: value for name, value in theirs.items() if ours[name] != value}


def test_rows_differ_in_the_named_parameters_and_no_others():
    paper = resolve_config("paper").flow
    assert CONFIGS["zero"] is None
    assert CONFIGS["paper"] == resolve_config("paper")
    assert CONFIGS["default"] == resolve_config()
    assert difference("no-box-query", "expansion") == {"flow.without": paper.leave_out("pruning").without}
    assert difference("expansion", "pruning") == {"flow.without": paper.without}
    assert difference("pruning", "paper") == {"flow.local_consistency": 0.1}
    assert difference("default", "rigid") == {"flow.method": "rigid"}
    no_box_query = CONFIGS["no-box-query"].flow
    assert (no_box_query.has("expansion"), no_box_query.has("pruning")) == (False, False)
    assert no_box_query.local_consistency == 0


def test_nsfp_is_as_published():
    nsfp = CONFIGS["nsfp"]
    flow = nsfp.flow
    assert (flow.method, nsfp.static.method) == ("nsfp", "none")
    assert (flow.hidden_layers, flow.hidden_units, flow.learning_rate) == (8, 128, 0.008)
    assert (flow.iterations, flow.patience) == (1000, 100)
    assert flow.chamfer_cutoff_m**2 == pytest.approx(2)
    assert (flow.has("backward_net"), flow.local_consistency, flow.has("voted_start")) == (True, 0, False)


def test_changes_hold_for_every_row_and_win():
    for row in FLOW_ROWS[1:]:
        assert row.config({"flow.iterations": 3}).flow.iterations == 3
    assert FLOW_ROWS[4].config({"flow.local_consistency": 0.7}).flow.local_consistency == 0.7


def test_rows_come_in_the_order_of_the_table():
    assert choose_flow_rows(None) == FLOW_ROWS
    assert [row.key for row in choose_flow_rows(["default", "zero"])] == ["zero", "default"]
    with pytest.raises(InvalidInput, match="unknown row 'magic': expected some of zero, nsfp, "):
        choose_flow_rows(["zero", "magic"])


def test_every_row_is_judged_on_the_same_points(ablation):
    assert [row.key for row in ablation.rows] == [row.key for row in FLOW_ROWS]
    assert len({(row.flow.num_points, row.flow.num_moving_points, row.flow.num_sweeps) for row in ablation.rows}) == 1
    assert ablation.rows[0].flow.num_moving_points > 100


def test_zero_flow_is_wrong_by_the_truth_and_rigid_motion_finds_the_car(ablation):
    figures = {row.key: row.flow for row in ablation.rows}
    assert figures["zero"].normalised_moving_epe == pytest.approx(1)
    assert figures["zero"].moving_epe_m == pytest.approx(0.8, abs=0.01)  # 8 m/s at 10 Hz
    assert figures["zero"].standing_epe_m == 0
    assert figures["rigid"].moving_epe_m < 0.2


def test_whole_scene_flow_reaches_every_point_above_the_ground(street):
    observation, _ = observe_timed(street, choose_flow_rows(["nsfp"])[0].config(QUICK), 2)
    points = observation.points.only_dynamic()
    assert len(points.point_index) == observation.num_points - observation.num_ground
    assert (points.flow_world_m != 0).any(axis=1).all()


def test_static_removal_is_shown_once_a_method(ablation):
    text = render_flow_ablation(ablation)
    lines = text.partition("Static points removed")[2].splitlines()
    assert [line.split("|")[1].strip() for line in lines[4:]] == ["chamfer (paper)", "visibility (default)"]
    static = {row.key: row.static for row in ablation.rows}
    assert static["no-box-query"] == static["paper"] != static["default"] == static["rigid"]
    assert static["zero"] is None


def test_ablation_survives_json_and_renders_every_row(ablation):
    assert FlowAblation.model_validate_json(ablation.model_dump_json()) == ablation
    text = render_flow_ablation(ablation)
    assert all(f"\n| {row.name}" in text for row in FLOW_ROWS)
    assert "flow.iterations=2" in text
    assert f"{street_id(ablation)} sweeps 2." in text
    assert "failed" not in text


def street_id(ablation):
    return ablation.logs[0].segment_id


def test_failed_fits_are_said(ablation):
    row = ablation.rows[-1].model_copy(update={"num_failed_fits": 3})
    assert "Note: default: 3 fits failed" in render_flow_ablation(ablation.model_copy(update={"rows": (row,)}))


def test_logs_and_sweeps_are_pooled_by_points(street):
    def judge(readers, sweeps):
        rows = choose_flow_rows(["zero", "rigid"])
        return ablate_flow(readers, rows, changes=QUICK, sweeps=sweeps, azimuth_deg=None).rows[1].flow

    one, two, both, twice = (
        judge([street], [1]),
        judge([street], [2]),
        judge([street], [1, 2]),
        judge([street] * 2, [2]),
    )
    assert both.num_points == one.num_points + two.num_points
    assert both.epe3d_m * both.num_points == pytest.approx(one.epe3d_m * one.num_points + two.epe3d_m * two.num_points)
    assert twice.num_points == 2 * two.num_points
    assert twice.epe3d_m == pytest.approx(two.epe3d_m)


def test_progress_counts_every_observation(street):
    steps = []
    rows = choose_flow_rows(["zero", "rigid"])
    ablate_flow(
        [street], rows, changes=QUICK, sweeps=[1, 2], azimuth_deg=None, progress=lambda *step: steps.append(step)
    )
    assert steps == [(1, 4), (2, 4), (3, 4), (4, 4)]


@pytest.mark.parametrize("index", [0, 3])
def test_a_sweep_observed_alone_is_as_in_the_whole_run(street, index):
    config = choose_flow_rows(["rigid"])[0].config(QUICK)
    alone, _ = observe_timed(street, config, index)
    whole = list(observe_sweeps(street, config))[index]
    assert alone.sweep_index == whole.sweep_index == index
    assert alone.points.flow_world_m.tobytes() == whole.points.flow_world_m.tobytes()
    assert alone.points.point_index.tobytes() == whole.points.point_index.tobytes()


def test_reading_and_filling_the_window_are_not_counted(street, monkeypatch):
    """On a clock that only reading moves nothing is left; on one that fits move as well, those of one sweep are."""
    clock_s = 0.0

    def read_sweep(index):
        nonlocal clock_s
        clock_s += 1000.0
        return street.read_sweep(index)

    def fit_nets(problems, params):
        nonlocal clock_s
        clock_s += 1.0
        return stage(problems, params)

    stage = line.fit_nets
    names = ("listing", "lidars", "read_annotations", "read_point_truth")
    reader = SimpleNamespace(read_sweep=read_sweep, **{name: getattr(street, name) for name in names})
    monkeypatch.setattr(flow_ablation.time, "process_time", lambda: clock_s)
    monkeypatch.setattr(line, "fit_nets", fit_nets)
    row = choose_flow_rows(["nsfp"])[0]
    assert observe_timed(reader, row.config(QUICK), 2)[1] == 1.0  # one batch
    assert observe_timed(reader, choose_flow_rows(["rigid"])[0].config(QUICK), 2)[1] == 0.0
    assert clock_s > 2000


def choose(log, sweeps=None):
    return choose_sweeps(log, read_truth(log), sweeps)


def test_four_sweeps_are_spread_over_those_with_truth(kit):
    things = [kit.thing("car", (10, 3), speed_mps=8)]
    assert choose(kit.log(things, num_sweeps=41)) == [5, 15, 25, 35]
    assert choose(kit.log(things, num_sweeps=3)) == [0, 1]
    broken = kit.log(things, num_sweeps=6, unreadable=(3,), unannotated=(1,))
    assert choose(broken) == [4]  # neither the one before, the broken or unannotated one, nor the last


@pytest.mark.parametrize(
    ("sweeps", "message"),
    [
        ([1, 8], "sweep 8 lies outside fake:log, which has sweeps 0:8"),
        ([7], "sweep 7 of fake:log has no truth flow"),
        ([2], "sweep 2 of fake:log has no truth flow"),
    ],
    ids=["outside", "last", "before a broken one"],
)
def test_a_sweep_that_cannot_be_judged_is_named(kit, sweeps, message):
    log = kit.log([kit.thing("car", (10, 3), speed_mps=8)], unreadable=(3,))
    with pytest.raises(InvalidInput, match=message):
        choose(log, sweeps)


def test_named_sweeps_come_once_and_in_order(kit):
    assert choose(kit.log([kit.thing("car", (10, 3), speed_mps=8)]), [4, 1, 4]) == [1, 4]


def test_a_log_without_truth_is_refused(kit):
    log = kit.log([kit.thing("car", (10, 3))], unannotated=tuple(range(8)))
    with pytest.raises(InvalidInput, match="no sweep with truth flow"):
        choose(log)


def test_points_out_of_view_do_not_count(street):
    rows = choose_flow_rows(["zero"])
    seen, all_around = (
        ablate_flow([street], rows, changes={}, sweeps=[2], azimuth_deg=azimuth).rows[0].flow.num_points
        for azimuth in (40.0, None)
    )
    assert 0 < seen < all_around
