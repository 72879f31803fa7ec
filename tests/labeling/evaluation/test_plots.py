import itertools

import numpy as np
import pytest
from matplotlib.image import imread
from matplotlib.text import Text

from labeling.evaluation.plots import BLUE, MAX_NOTES, SKY, WIDTH_PX, draw_report, render_report
from labeling.evaluation.report import evaluate_segments
from schemas.errors import InvalidInput

PANELS = [
    "Boxes found",
    "Parts of each box from truth",
    "Tracks",
    "Boxes by speed, m/s",
    "By range, m",
    "By length, m",
    "Centre error",
    "Size error, |dl| + |dw| + |dh|",
    "Heading error",
    "Flow: end-point error, m",
    "Flow: shares",
    "Flow: IoU by speed, m/s",
    "Static points removed",
]


NUM_FOUND = 5  # of the car's 8 sweeps


@pytest.fixture(scope="module")
def report(kit):
    """A car found too short, shifted and not to the end; a walker missed; a parked car labelled; flow too short."""
    things = [
        kit.thing("car", (10, 3), speed_mps=8),
        kit.thing("walker", (12, -6), speed_mps=1.5, yaw=2.0, size=(0.8, 0.7, 1.7)),
        kit.thing("parked", (20, -8)),
    ]
    log = kit.log(things)
    rows = [*kit.true_rows(log, {"parked"}), *kit.true_rows(log, {"car"})[:NUM_FOUND]]
    for row in rows:
        row["length_m"] *= 0.9
        row["center_x_m"] += 0.25
        row["yaw_rad"] += 0.1

    def too_short(thing):
        return np.array([np.cos(thing.yaw), np.sin(thing.yaw), 0]) * thing.speed_mps * 0.09

    folder = kit.folder(log, rows, kit.point_rows(log, too_short))
    return evaluate_segments(folder, [log], azimuth_deg=None, min_score=None)


def change(record, **parts):
    """Return a copy of a report with parts of its pooled figures replaced."""
    return record.model_copy(update={"pooled": record.pooled.model_copy(update=parts)})


def change_errors(report, **parts):
    errors = report.pooled.boxes.errors.model_copy(update=parts)
    return change(report, boxes=report.pooled.boxes.model_copy(update={"errors": errors}))


def panels(report):
    """Return the panels of the picture by their titles."""
    return {axes.get_title(loc="left"): axes for axes in draw_report(report).axes}


def said(report):
    """Return all that is written in panels and below them."""
    figure = draw_report(report)
    return [text.get_text() for text in (*figure.texts, *(text for axes in figure.axes for text in axes.texts))]


def heights(axes):
    """Return the heights of the bars, a row for each series."""
    return np.array([[bar.get_height() for bar in bars] for bars in bars_of(axes)])


def bars_of(axes):
    return [container for container in axes.containers if hasattr(container, "patches")]


def percent(values):
    return [100 * (value or 0) for value in values]


def test_every_panel_is_there(report):
    assert list(panels(report)) == PANELS


def test_bars_of_the_boxes_are_the_figures_in_percent(report):
    boxes = report.pooled.boxes
    drawn = panels(report)
    found = [[getattr(one, name) for one in boxes.detection] for name in ("ap", "aph", "precision", "recall")]
    assert heights(drawn["Boxes found"]) == pytest.approx(np.array([percent(row) for row in found]))
    assert heights(drawn["Parts of each box from truth"])[0] == pytest.approx(percent(row.aph for row in boxes.oracle))
    for title, quantity in zip(PANELS[3:6], ("speed_mps", "range_m", "length_m"), strict=True):
        bands = [band for band in boxes.bands if band.quantity == quantity]
        rows = [percent(getattr(band, name) for band in bands) for name in ("ap", "precision", "recall")]
        assert heights(drawn[title]) == pytest.approx(np.array(rows))
        assert any(value not in (0, 100) for row in rows for value in row)  # else the test would see little
        names = [label.get_text() for label in drawn[title].get_xticklabels()]
        assert [name.partition("\n")[2] for name in names] == [f"{band.num_truths} to find" for band in bands]


def test_whiskers_are_the_intervals(report):
    axes = panels(report)["Boxes found"]
    whiskers = bars_of(axes)[0].errorbar.lines[2][0].get_segments()
    intervals = [one.ap_interval for one in report.pooled.boxes.detection]
    assert [segment[:, 1] for segment in whiskers] == [pytest.approx(percent(bounds)) for bounds in intervals]


def test_histograms_are_the_counts_between_their_edges(report):
    errors = report.pooled.boxes.errors
    assert errors.num_matches == NUM_FOUND
    drawn = panels(report)
    for title, histogram, unit in zip(
        PANELS[6:9], (errors.center, errors.size, errors.yaw), (1, 1, np.degrees(1)), strict=True
    ):
        (bars,) = bars_of(drawn[title])
        assert [bar.get_height() for bar in bars] == list(histogram.counts)
        assert sum(bar.get_height() for bar in bars) == NUM_FOUND
        lefts = [bar.get_x() for bar in bars]
        assert [*lefts, bars[-1].get_x() + bars[-1].get_width()] == pytest.approx(np.array(histogram.edges) * unit)


def test_medians_are_marked_and_written(report):
    errors, drawn = report.pooled.boxes.errors, panels(report)
    expected = {
        "Centre error": ([errors.center_median_m], f"median {errors.center_median_m:.2f} m"),
        "Size error, |dl| + |dw| + |dh|": ([0.4], "median 0.40 m"),
        "Heading error": ([-np.degrees(0.1), np.degrees(0.1)], "median |error| 5.7 deg"),
    }
    for title, (places, text) in expected.items():
        assert [line.get_xdata()[0] for line in drawn[title].lines] == pytest.approx(places, abs=1e-4)
        assert drawn[title].get_title(loc="right") == text


def test_what_lies_beyond_and_what_points_backwards_stands_out(report):
    errors = report.pooled.boxes.errors
    far = errors.center.model_copy(update={"counts": (*errors.center.counts[:-1], 3)})
    turned = errors.yaw.model_copy(update={"counts": (2, *errors.yaw.counts[1:-1], 5)})
    drawn = panels(change_errors(report, center=far, yaw=turned))
    assert drawn["Centre error"].get_xlabel() == "m; 3 at 2.9 m or more"
    assert drawn["Heading error"].get_xlabel() == "deg; 7 at more than 90 deg"
    for title, is_pale in (
        ("Centre error", [False] * 29 + [True]),
        ("Heading error", [True] * 9 + [False] * 18 + [True] * 9),
    ):
        (bars,) = bars_of(drawn[title])
        colors = [SKY if pale else BLUE for pale in is_pale]
        assert [bar.get_facecolor() for bar in bars] == [pytest.approx(rgba(color)) for color in colors]


def rgba(color):
    return (*(int(color[place : place + 2], 16) / 255 for place in (1, 3, 5)), 1.0)


def test_bars_of_the_points_stand_beside_zero_flow(report):
    flow, zero, static = report.pooled.flow, report.pooled.zero_flow, report.pooled.static
    drawn = panels(report)
    errors = [[one.epe3d_m, one.moving_epe_m, one.standing_epe_m] for one in (flow, zero)]
    assert heights(drawn["Flow: end-point error, m"]) == pytest.approx(np.array(errors))
    assert 0 < errors[0][1] < errors[1][1]
    shares = [percent((one.acc5, one.acc10, one.false_motion, one.mean_speed_iou)) for one in (flow, zero)]
    assert heights(drawn["Flow: shares"]) == pytest.approx(np.array(shares))
    speeds = [percent(one.speed_iou) for one in (flow, zero)]
    assert heights(drawn["Flow: IoU by speed, m/s"]) == pytest.approx(np.array(speeds))
    removed = (static.in_box_precision, static.in_box_recall, static.scene_precision, static.scene_recall, 0)
    assert heights(drawn["Static points removed"])[0] == pytest.approx(percent(removed))


def test_few_truth_points_are_starred(report):
    points = (5000, 999, 1000, 0, 0, 0)
    flow = report.pooled.flow.model_copy(update={"speed_num_points": points})
    axes = panels(change(report, flow=flow))["Flow: IoU by speed, m/s"]
    names = [label.get_text() for label in axes.get_xticklabels()]
    assert names[:3] == ["0-3\n5,000", "3-6*\n999", "6-9\n1,000"]


def test_a_single_missing_figure_is_a_dash(report):
    bands = tuple(
        band.model_copy(update={"ap": None, "precision": 0.0, "recall": None}) if band.high is None else band
        for band in report.pooled.boxes.bands
    )
    axes = panels(change(report, boxes=report.pooled.boxes.model_copy(update={"bands": bands})))["By range, m"]
    assert [text.get_text() for text in axes.texts][2::3] == ["-", "0", "-"]


@pytest.mark.parametrize(
    ("parts", "absent", "text"),
    [
        ({"boxes": None, "tracks": None}, PANELS[:9], "No figures of boxes and tracks: no log has annotations"),
        ({"flow": None, "zero_flow": None}, PANELS[9:12], "No figures of flow: see the notes below"),
        (
            {"flow": None, "zero_flow": None, "static": None},
            PANELS[9:],
            "No figures of flow and of static points: see the notes below",
        ),
    ],
    ids=["no annotations", "no flow", "no points table"],
)
def test_absent_parts_are_said(report, parts, absent, text):
    without = change(report, **parts)
    drawn = panels(without)
    assert [title for title in drawn if title] == [title for title in PANELS if title not in absent]
    assert not bars_of(drawn[""])
    assert text in said(without)
    assert text not in said(report)


def test_no_right_box_is_said(report):
    none = change_errors(report, num_matches=0, center_median_m=None, size_median_m=None, yaw_median_rad=None)
    assert set(PANELS) - set(panels(none)) == set(PANELS[6:9])
    assert any("no right box with a score of 0.5 or more" in text for text in said(none))


def test_a_panel_of_nothing_but_none_says_so(report):
    oracle = tuple(row.model_copy(update={"aph": None}) for row in report.pooled.boxes.oracle)
    axes = panels(change(report, boxes=report.pooled.boxes.model_copy(update={"oracle": oracle})))[PANELS[1]]
    assert [text.get_text() for text in axes.texts] == ["nothing there to judge"]
    assert (list(axes.get_xticks()), list(axes.get_yticks()), bars_of(axes)) == ([], [], [])


def test_nothing_moves_and_nothing_is_labelled(kit):
    log = kit.log([kit.thing("parked", (20, -8))])
    texts = said(evaluate_segments(kit.folder(log, [], []), [log], azimuth_deg=None, min_score=None))
    assert texts.count("nothing there to judge") >= 5  # boxes, parts, three bands
    assert any(text.startswith("No errors") for text in texts)


def test_head_and_notes_say_what_is_shown(report):
    notes = tuple(f"log {number}: broken" for number in range(MAX_NOTES + 2))
    texts = said(report.model_copy(update={"notes": notes, "logs": report.logs * 2}))
    assert "Labels against annotations: 2 logs, pooled" in texts
    assert "2 logs, 8 sweeps (0 rejected). Score cut of P, R, errors and tracks: 0.5." in texts
    assert [text for text in texts if "note" in text.lower()] == [
        *(f"Note: {note}" for note in notes[:MAX_NOTES]),
        "and 2 more notes: see the table",
    ]
    assert f"Labels against annotations: {report.logs[0].name}" in said(report)


def test_no_title_legend_name_or_caption_touches_another(report):
    notes = ("log: no points table, so no flow and static figures: label with --points to have them",)
    figure = draw_report(report.model_copy(update={"notes": notes}))
    figure.canvas.draw()
    above_bars = [text for axes in figure.axes for text in axes.texts]
    texts = [text for text in figure.findobj(Text) if text.get_text().strip() and text.get_visible()]
    extents = [(text.get_text(), text.get_window_extent()) for text in texts if text not in above_bars]
    assert len(extents) > 60
    for (one, extent), (other, other_extent) in itertools.combinations(extents, 2):
        assert not extent.overlaps(other_extent), f"{one!r} and {other!r}"
    for text, extent in extents:
        assert 0 <= extent.x0 < extent.x1 <= WIDTH_PX, text
        assert extent.y0 >= 0, text


def test_the_picture_is_written_as_wide_as_promised(report, tmp_path):
    path = tmp_path / "figures.png"
    render_report(report, path)
    height_px, width_px = imread(path).shape[:2]
    assert width_px == WIDTH_PX
    assert 1200 < height_px < 1800


def test_unwritable_place_is_named(report, tmp_path):
    with pytest.raises(InvalidInput, match=r"cannot write the picture .*absent.*: No such file"):
        render_report(report, tmp_path / "absent" / "a.png")
