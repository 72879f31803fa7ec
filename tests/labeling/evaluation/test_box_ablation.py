"""On a small street: what each row changes, and that its labels are judged as `label` and `evaluate` would."""

import numpy as np
import pytest

from labeling.evaluation import box_ablation
from labeling.evaluation.box_ablation import (
    BOX_ROW_KEYS,
    ablate_boxes,
    choose_box_rows,
    render_box_ablation,
    true_velocities_mps,
)
from labeling.evaluation.report import evaluate_segments
from labeling.evaluation.truth import read_truth
from labeling.folders.entries import make_manifest, prepare_folder
from labeling.folders.folder import LabelFolder, publish_manifest
from labeling.in_process import label_in_process
from labeling.line import prepare_sweeps
from labeling.readers.reader import SegmentReader
from labeling.storage.storage import open_storage
from labeling.synthetic.rigs import SpinningLidar
from labeling.synthetic.scene import Scene, drive, wall
from labeling.synthetic.shapes import car, walker
from schemas.config import resolve_config
from schemas.errors import InvalidInput, UnreadableSweep


def reader_of(num_sweeps=12):
    """Return a street with a wall, two parked cars, a passing car and a walker."""
    movers = (drive(car(), (6, 4.5), 0.0, 8.0), drive(walker(), (9, -6), np.pi / 2, 1.4))
    parked = tuple(drive(car(), (x, -7.5)) for x in (2.0, 14.0))
    scene = Scene(structures=(wall((-40, 10), (60, 10)),), movers=movers + parked)
    return scene.reader(num_sweeps, 10.0, SpinningLidar(num_beams=32, azimuth_steps=540))


class Broken(SegmentReader):
    """A reader whose sweep 3 cannot be read."""

    def __init__(self, reader):
        self.listing = reader.listing
        self.read_annotations, self.read_point_truth = reader.read_annotations, reader.read_point_truth
        self._reader = reader

    def read_sweep(self, index):
        if index == 3:
            raise UnreadableSweep("sweep_3.bin: truncated")
        return self._reader.read_sweep(index)


def ablate(*readers, keys=None, profile="fast", changes=None, azimuth_deg=None):
    rows = choose_box_rows(keys)
    return ablate_boxes(readers, rows, profile=profile, changes=changes or {}, azimuth_deg=azimuth_deg)


@pytest.fixture(scope="module")
def ablation():
    return ablate(reader_of())


def row_of(ablation, key):
    return next(row for row in ablation.rows if row.key == key)


def ap(ablation, key):
    return row_of(ablation, key).box_figures.detection[0].ap


def flat(config):
    dumped = config.model_dump()
    stages = {name: values for name, values in dumped.items() if isinstance(values, dict)}
    return {f"{stage}.{key}": value for stage, values in stages.items() for key, value in values.items()}


def test_rows_differ_from_the_run_in_the_named_parameters_only():
    run = flat(resolve_config("default", {"flow.iterations": 7}))
    no_flow = {"flow.method": "none"}

    def without(*steps):
        return {"registration.without": steps}

    expected = {
        "no-flow-clustering": no_flow,
        "no-flow-full": no_flow,
        "flow-clustering": {},
        "full": {},
        "oracle-clustering": {},
        "oracle-full": {},
        "position-clustering": {"proposals.without": ("flow_clustering",)},
        "no-start": without("motion_start", "rotation_start", "translation_grid"),
        "rotation-start": without("motion_start", "translation_grid"),
        "grid-start": without("motion_start", "rotation_start"),
        "both-starts": without("motion_start"),
        "unconstrained": without("upright"),
    }
    for row in choose_box_rows(None):
        config = flat(row.config("default", {"flow.iterations": 7}))
        assert {key: value for key, value in config.items() if value != run[key]} == expected[row.key]
    assert tuple(expected) == BOX_ROW_KEYS


def test_rows_without_flow_take_no_external_flow_either():
    (row,) = choose_box_rows(["no-flow-full"])
    config = row.config("default", {"flow.method": "external", "flow.external_folder": "out/flow"})
    assert (config.flow.method, config.flow.external_folder) == ("none", None)


@pytest.mark.parametrize(("key", "changes"), [("full", {}), ("no-flow-full", {"flow.method": "none"})])
def test_rows_are_judged_as_their_labels_would_be(ablation, tmp_path, key, changes):
    reader, config, storage = reader_of(), resolve_config("fast", changes), open_storage(tmp_path)
    prepare_folder(storage, config)
    entries = list(label_in_process([reader], storage, config, lambda _: None))
    publish_manifest(storage, make_manifest("synthetic", entries, config))
    report = evaluate_segments(LabelFolder.open(tmp_path), [reader], azimuth_deg=None, min_score=None)
    row = row_of(ablation, key)
    assert row.box_figures == report.pooled.boxes
    assert row.tracks == report.pooled.tracks
    assert row.box_figures.num_labels > 20


def test_flow_tells_movers_from_what_stands():
    keys = ["no-flow-clustering", "oracle-clustering", "no-flow-full", "oracle-full"]
    ablation = ablate(reader_of(4), keys=keys, changes={"static.method": "none", "refinement.min_top_speed_mps": 0.0})
    for boxes in ("clustering", "full"):
        without, oracle = (row_of(ablation, f"{flow}-{boxes}").box_figures for flow in ("no-flow", "oracle"))
        assert without.num_labels > oracle.num_labels
        assert without.detection[0].ap <= oracle.detection[0].ap
    assert ap(ablation, "no-flow-clustering") < ap(ablation, "oracle-clustering")


def test_an_oracle_is_not_beaten(ablation):
    for key in ("no-flow-clustering", "no-flow-full", "flow-clustering", "full"):
        assert ap(ablation, key) <= ap(ablation, "oracle-full") + 0.02
    assert ap(ablation, "oracle-full") > 0.5


def test_clusters_are_no_tracks(ablation):
    for row in ablation.rows:
        assert (row.tracks is None) == (row.boxes == "clustering")
    rows = [line for line in render_box_ablation(ablation).splitlines() if line.startswith("| no flow + clustering")]
    assert rows[0].split()[-4:] == ["-", "|", "-", "|"]


def test_the_tables_hold_each_row_that_was_run(ablation):
    text = render_box_ablation(ablation)
    assert "1 log, 12 sweeps (0 rejected), 2 movers" in text
    assert sum(line.startswith("| ") for line in text.splitlines()) == 6 + 2 + 6 + 3 * 2  # rows, headers and rules
    few = render_box_ablation(ablation.model_copy(update={"rows": ablation.rows[:2]}))
    assert "Registration" not in few


def test_an_oracle_knows_the_velocity_in_the_last_sweep_too():
    reader = reader_of(4)
    truth = read_truth(reader)
    for work in prepare_sweeps(reader, resolve_config("fast", {"flow.method": "none"}), range(4)):
        dynamic = work.dynamic
        owner = reader.object_index(dynamic.sweep_index)[dynamic.clusters.point_rows]
        velocity = true_velocities_mps(truth, reader, dynamic)
        assert np.sum(owner == 0) > 20
        np.testing.assert_allclose(velocity[owner == 0], np.tile([8.0, 0, 0], (np.sum(owner == 0), 1)), atol=0.3)
        assert not velocity[(owner != 0) & (owner != 1)].any()


def test_a_log_is_observed_once_whatever_the_rows(monkeypatch):
    methods = []

    def prepare(reader, config, indices):
        methods.append(config.flow.method)
        return prepare_sweeps(reader, config, indices)

    monkeypatch.setattr(box_ablation, "prepare_sweeps", prepare)
    ablate(reader_of(3), keys=["full", "no-start", "oracle-full", "no-flow-full"])
    ablate(reader_of(3), keys=["oracle-full", "no-flow-full"])  # no flow of our own is needed
    assert methods == ["rigid", "none"]


def test_logs_are_pooled():
    one = ablate(reader_of(5), keys=["oracle-full"], changes={"sweeps": (0, 3)})
    two = ablate(reader_of(5), reader_of(5), keys=["oracle-full"], changes={"sweeps": (0, 3)})
    assert (one.num_sweeps, two.num_sweeps) == (3, 6)
    once, twice = (row_of(result, "oracle-full").box_figures for result in (one, two))
    assert twice.num_labels == 2 * once.num_labels
    assert twice.detection[0].num_truths == 2 * once.detection[0].num_truths
    assert twice.detection[0].ap == once.detection[0].ap


def test_progress_counts_sweeps_and_rows():
    steps = []
    rows = choose_box_rows(["oracle-clustering", "no-flow-clustering"])
    ablate_boxes(
        [reader_of(3)],
        rows,
        profile="fast",
        changes={"sweeps": (0, 2)},
        azimuth_deg=None,
        progress=lambda *step: steps.append(step),
    )
    assert steps == [(done, 4) for done in (1, 2, 3, 4)]


def test_a_rejected_sweep_counts_as_missed(ablation):
    broken = ablate(Broken(reader_of()), keys=["oracle-clustering"])
    assert (broken.num_sweeps, broken.num_rejected_sweeps) == (12, 1)
    here, whole = (row_of(result, "oracle-clustering").box_figures for result in (broken, ablation))
    assert here.detection[0].num_truths == whole.detection[0].num_truths
    assert here.detection[0].recall < whole.detection[0].recall


def test_what_cannot_be_judged_is_refused(kit):
    with pytest.raises(InvalidInput, match=r"unknown row 'best': expected some of no-flow-clustering, .*unconstrained"):
        choose_box_rows(["full", "best"])
    with pytest.raises(InvalidInput, match=r"flow\.method=none is what some rows change"):
        ablate(reader_of(3), changes={"flow.method": "none"})
    with pytest.raises(InvalidInput, match="sweeps 0:9 lie outside"):
        ablate(reader_of(3), changes={"sweeps": (0, 9)})
    with pytest.raises(InvalidInput, match="has no annotations there"):
        ablate(kit.log([kit.thing("car", (10, 3), speed_mps=8)], unannotated=tuple(range(8))))


def test_figures_survive_json(ablation):
    again = type(ablation).model_validate_json(ablation.model_dump_json())
    assert again == ablation
