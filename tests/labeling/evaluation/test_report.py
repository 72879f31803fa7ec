import numpy as np
import pytest

from labeling.evaluation.report import PASSES, Report, evaluate_segments
from labeling.evaluation.tables import render_table
from labeling.geometry.transforms import yaw_translation
from schemas.errors import InvalidInput


@pytest.fixture
def things(kit):
    return [
        kit.thing("car", (10, 3), speed_mps=8),
        kit.thing("walker", (12, -6), speed_mps=1.5, yaw=2.0, size=(0.8, 0.7, 1.7)),
        kit.thing("parked", (20, -8)),
    ]


def evaluate(folder, *logs, azimuth_deg=None, min_score=None):
    return evaluate_segments(folder, logs, azimuth_deg=azimuth_deg, min_score=min_score)


def detection(report, overlap="3D", level="L1"):
    return next(one for one in report.pooled.boxes.detection if (one.overlap, one.level) == (overlap, level))


def test_perfect_labels_are_perfect(kit, things):
    log = kit.log(things)
    report = evaluate(kit.folder(log, kit.true_rows(log), kit.point_rows(log)), log)
    for one in report.pooled.boxes.detection:
        assert (one.ap, one.precision, one.recall) == (1, 1, 1)
        assert one.aph == pytest.approx(1)
        assert one.ap_interval == (1, 1)
        assert one.num_truths == 16
    assert report.pooled.tracks.hota == pytest.approx(1)
    assert report.pooled.tracks.purity == report.pooled.tracks.completeness == 1
    assert report.pooled.boxes.errors.center_median_m == pytest.approx(0, abs=1e-6)
    assert report.pooled.flow.epe3d_m == pytest.approx(0, abs=1e-6)
    assert report.pooled.flow.num_sweeps == 7  # the last one has no next
    assert report.pooled.zero_flow.moving_epe_m == pytest.approx((0.8 + 0.15) / 2, rel=1e-5)
    assert report.pooled.static.num_sweeps == 8
    assert report.pooled.static.in_box_precision == report.pooled.static.in_box_recall == 1
    assert report.pooled.static.moving_lost == 0
    assert report.notes == ()


def test_a_labelled_parked_car_is_wrong(kit, things):
    log = kit.log(things)
    report = evaluate(kit.folder(log, kit.true_rows(log, {"car", "walker", "parked"})), log)
    assert detection(report).precision == pytest.approx(2 / 3)
    wrong = report.pooled.boxes.wrong
    assert (wrong.num_wrong, wrong.num_on_mover, wrong.num_on_standing, wrong.num_on_nothing) == (8, 0, 8, 0)


def test_a_pause_is_ignored(kit):
    log = kit.log([kit.thing("bus", (10, 0), moves=lambda t: 5 * min(t, 0.6))], num_sweeps=16)
    rows = kit.true_rows(log, {"bus"})
    paused = [row for row in rows if row["sweep_index"] >= 9]
    moving = [row for row in rows if row["sweep_index"] < 9]
    for labels, recall in ((rows, 1), (moving, 1), (paused, 0)):
        report = evaluate(kit.folder(log, labels), log)
        assert detection(report).recall == recall
        assert report.pooled.boxes.wrong.num_wrong == 0


def test_labels_and_truth_outside_the_region_do_not_count(kit, things):
    far = [kit.thing("far", (10, 25), speed_mps=8), kit.thing("farther", (70, 0), speed_mps=8)]
    log = kit.log([*things, *far])
    with_far = evaluate(kit.folder(log, kit.true_rows(log)), log)
    without_far = evaluate(kit.folder(log, kit.true_rows(log, {"car", "walker"})), log)
    assert detection(with_far) == detection(without_far)
    assert detection(with_far).num_truths == 16


def test_azimuth_hides_what_no_camera_saw(kit, things):
    behind = [kit.thing("behind", (-15, 2), speed_mps=3), kit.thing("beside", (3, -12), speed_mps=3)]
    log = kit.log([*things, *behind])
    folder = kit.folder(log, kit.true_rows(log, {"car", "walker", "beside"}), kit.point_rows(log))
    assert detection(evaluate(folder, log)).recall == pytest.approx(24 / 32)
    seen = evaluate(folder, log, azimuth_deg=40)
    assert (detection(seen).precision, detection(seen).recall, detection(seen).num_truths) == (1, 1, 16)
    assert seen.pooled.flow.num_moving_points == 7 * 80


def test_score_cut_rules_precision_and_recall_not_average_precision(kit, things):
    log = kit.log(things)
    rows = kit.true_rows(log, {"car"}, 0.9) + kit.true_rows(log, {"walker"}, 0.4)
    folder = kit.folder(log, rows)
    recommended, lower = evaluate(folder, log), evaluate(folder, log, min_score=0.3)
    assert (recommended.min_score, detection(recommended).recall) == (0.5, 0.5)
    assert (lower.min_score, detection(lower).recall) == (0.3, 1.0)
    assert detection(recommended).ap == detection(lower).ap == 1
    assert (recommended.pooled.tracks.completeness, lower.pooled.tracks.completeness) == (0.5, 1)


def test_points_left_out_predict_zero_flow(kit, things):
    log = kit.log(things)
    report = evaluate(kit.folder(log, [], []), log)
    assert report.pooled.flow == report.pooled.zero_flow
    assert report.pooled.static.moving_lost == 1


def test_flow_of_a_standing_wall_is_five_metres_wrong(kit):
    wall = np.random.default_rng(0).uniform([5, -9, 1], [6, 9, 2], (200, 3))
    road = np.column_stack([*np.mgrid[4:8, -11:11].reshape(2, -1).astype(float) + 0.5, np.zeros(88)])
    log = kit.log([], extra_points=np.vstack([wall, road]))
    rows = kit.point_rows(kit.log([kit.thing("car", (10, 3), speed_mps=8)]))[:1]
    points = [
        rows[0] | {"sweep_index": t, "point_index": i, "flow_x_m": 3.0, "flow_y_m": 4.0, "flow_z_m": 0.0}
        for t in range(7)
        for i in range(200)
    ]
    report = evaluate(kit.folder(log, [], points), log)
    assert report.pooled.flow.epe3d_m == 5
    assert report.pooled.flow.num_points == 7 * 200
    assert report.pooled.flow.false_motion == 1
    assert report.pooled.zero_flow.epe3d_m == 0


def test_moving_the_world_changes_no_figure(kit, things):
    def judge(world_from_start):
        log = kit.log(things, world_from_start=world_from_start)
        rows = kit.true_rows(log)
        for row in rows:
            row["length_m"] *= 0.8
        return evaluate(kit.folder(log, rows, kit.point_rows(log)), log).pooled

    plain, moved = judge(np.eye(4)), judge(yaw_translation(2.0, np.array([4000.0, -900.0, 35.0])))
    assert moved.tracks.hota == pytest.approx(plain.tracks.hota)
    assert moved.tracks.hota < 0.99
    assert moved.flow.epe3d_m == pytest.approx(plain.flow.epe3d_m, abs=1e-4)
    assert moved.boxes.errors.size_median_m == pytest.approx(plain.boxes.errors.size_median_m, rel=1e-5)
    assert moved.boxes.errors.center_median_m == pytest.approx(plain.boxes.errors.center_median_m, abs=1e-6)
    assert moved.static == plain.static
    for one, other in zip(moved.boxes.detection, plain.boxes.detection, strict=True):
        assert (one.ap, one.recall) == (other.ap, other.recall)


def test_rejected_sweeps_are_missed_and_said(kit, things):
    log = kit.log(things, unreadable=(4,))
    rows = [row for row in kit.true_rows(log) if row["sweep_index"] != 4]
    report = evaluate(kit.folder(log, rows, kit.point_rows(log)), log)
    assert detection(report).num_truths == 16
    assert detection(report).recall == pytest.approx(14 / 16)
    assert report.pooled.num_rejected_sweeps == 1
    assert report.pooled.flow.num_sweeps == 5  # neither the one before, the broken one, nor the last
    assert report.pooled.static.num_sweeps == 7
    assert "1 of 8 sweeps rejected" in report.notes[0]


def test_only_the_sweeps_asked_for_are_judged(kit, things):
    log = kit.log(things)
    rows = [row for row in kit.true_rows(log) if 2 <= row["sweep_index"] < 5]
    report = evaluate(kit.folder(log, rows, labelled=range(2, 5)), log)
    assert (detection(report).recall, detection(report).num_truths) == (1, 6)


def test_late_capture_moves_neither_truth_nor_labels(kit, things):
    log = kit.log(things, capture_offset_s=0.07)
    assert detection(evaluate(kit.folder(log, kit.true_rows(log)), log)).ap == 1


def test_logs_are_pooled_by_truth_not_by_figure(kit, things):
    long_log, short_log = kit.log(things, num_sweeps=12), kit.log(things[:1], num_sweeps=4, segment_id="short")
    folder = kit.folder(long_log, kit.true_rows(long_log), kit.point_rows(long_log))
    folder.tables |= kit.folder(short_log, [], kit.point_rows(short_log)).tables
    report = evaluate(folder, long_log, short_log)
    assert [log.name for log in report.logs] == ["log", "short"]
    assert [log.boxes.detection[0].recall for log in report.logs] == [1, 0]
    assert detection(report).recall == pytest.approx(24 / 28)
    assert report.pooled.tracks.num_truth_tracks == 3
    assert report.pooled.flow.num_points == sum(log.flow.num_points for log in report.logs)
    low, high = detection(report).recall_interval
    assert low < 24 / 28 <= high == 1


def test_without_a_points_table_the_report_says_what_to_do(kit, things):
    log = kit.log(things)
    report = evaluate(kit.folder(log, kit.true_rows(log)), log)
    assert report.pooled.flow is report.pooled.zero_flow is report.pooled.static is None
    assert report.notes == ("log: no points table, so no flow and static figures: label with --points to have them",)


def test_report_survives_json_and_renders_every_part(kit, things):
    log = kit.log(things)
    report = evaluate(kit.folder(log, kit.true_rows(log), kit.point_rows(log)), log, azimuth_deg=60)
    assert Report.model_validate_json(report.model_dump_json()) == report
    text = render_table(report)
    for title in ("Scene flow", "Speed classes", "Static", "Boxes", "Wrong", "band", "Tracks", "Errors", "Parts of"):
        assert title in text
    assert "zero flow" in text
    assert "within 60 deg" in text
    tables = [block.splitlines() for block in text.split("\n\n") if block.startswith("|")]
    assert len(tables) == 9
    for table in tables:
        assert len({len(line) for line in table}) == 1  # aligned


def test_progress_counts_every_pass(kit, things):
    log = kit.log(things)
    for points in (None, kit.point_rows(log)):
        steps = []
        folder = kit.folder(log, kit.true_rows(log), points)
        evaluate_segments(folder, [log], azimuth_deg=None, min_score=None, progress=steps.append)
        assert steps == sorted(steps)
        assert steps[-1] == PASSES * log.num_sweeps


def test_a_segment_that_was_never_labelled_is_named(kit, things):
    log = kit.log(things)
    stranger = kit.log(things, segment_id="stranger")
    with pytest.raises(InvalidInput, match=r"no labels of segment stranger .* the folder has log"):
        evaluate(kit.folder(log, []), stranger)


def test_a_segment_without_truth_is_refused(kit, things):
    log = kit.log(things, unannotated=tuple(range(8)))
    with pytest.raises(InvalidInput, match="neither annotations nor point-wise truth"):
        evaluate(kit.folder(log, []), log)


@pytest.mark.parametrize("change", ["shorter", "other stamps", "fewer points"])
def test_a_recording_that_changed_since_is_refused(kit, things, change):
    log = kit.log(things)
    folder = kit.folder(log, kit.true_rows(log), kit.point_rows(log))
    if change == "shorter":
        log.num_sweeps = 5
    elif change == "fewer points":
        log.things = [kit.replace(thing, num_points=3) for thing in things]
    else:
        other = kit.log(things)
        other.__class__ = type("Late", (type(log),), {"timestamps_ns": property(lambda self: log.timestamps_ns + 7)})
        with pytest.raises(InvalidInput, match="changed since it was labelled"):
            evaluate(folder, other)
        return
    with pytest.raises(InvalidInput, match="changed since it was labelled"):
        evaluate(folder, log)


def test_no_segment_is_wrong_usage(kit, things):
    with pytest.raises(InvalidInput, match="name at least one"):
        evaluate(kit.folder(kit.log(things), []))
