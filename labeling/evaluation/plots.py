"""The figures of a report as one picture, pooled over its logs. What the report lacks is said where it would stand."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from math import degrees
from pathlib import Path
from typing import Final

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.container import BarContainer
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from labeling.evaluation.detection import BandFigures, BoxFigures, ErrorFigures, Histogram, Interval
from labeling.evaluation.flow import MIN_BIN_POINTS, SPEED_BINS, FlowFigures, StaticFigures
from labeling.evaluation.markdown import format_degrees, format_number
from labeling.evaluation.report import LogFigures, Report
from labeling.evaluation.tables import describe_scope, name_band
from labeling.evaluation.tracks import TrackFigures
from schemas.arrays import Float64Array
from schemas.errors import InvalidInput

WIDTH_PX: Final = 1800
DPI: Final = 100
MARGIN_PX: Final = 64  # left of the first panel, where its numbers stand; half as much right of the last
GAP_PX: Final = 64  # between panels, numbers of the right one included
HEAD_PX: Final = 78  # title and scope
NOTE_PX: Final = 22
MAX_NOTES: Final = 4

BACKGROUND: Final = "#ffffff"
PANEL: Final = "#f7f8fa"
TEXT: Final = "#1d2530"
FAINT_TEXT: Final = "#6a7484"
LINE: Final = "#dde1e7"
BLUE: Final = "#2b5c9e"
SKY: Final = "#8fb8de"
GREEN: Final = "#35967f"
ORANGE: Final = "#e0912f"
GREY: Final = "#b9c0ca"

Values = Sequence[float | None]
Draw = Callable[[Axes], None]


@dataclass(frozen=True, slots=True)
class _Series:
    """Bars of one colour, one for each group."""

    name: str
    color: str
    values: Values
    intervals: Sequence[Interval] = ()

    def in_percent(self) -> "_Series":
        values = [None if value is None else 100 * value for value in self.values]
        intervals = [None if bounds is None else (100 * bounds[0], 100 * bounds[1]) for bounds in self.intervals]
        return replace(self, values=values, intervals=intervals)


@dataclass(frozen=True, slots=True)
class _Row:
    """Panels side by side: the relative width of each, and what draws it."""

    panels: Sequence[tuple[float, Draw]]
    above_px: int = 46  # the titles
    axes_px: int = 230
    below_px: int = 72  # names of the bars, and what is said of them

    @property
    def height_px(self) -> int:
        return self.above_px + self.axes_px + self.below_px


def render_report(report: Report, path: Path) -> None:
    """Draw a report as a PNG, 1800 pixels wide.

    Raises:
        InvalidInput: ``path`` cannot be written.

    """
    figure = draw_report(report)
    try:
        figure.savefig(path, facecolor=BACKGROUND, format="png")
    except OSError as error:
        raise InvalidInput(f"cannot write the picture {path}: {error.strerror or error}") from None


def draw_report(report: Report) -> Figure:
    """Return the picture: boxes, their bands, errors and tracks above, flow and static removal below."""
    rows = [*_box_rows(report.pooled, report.min_score), _point_row(report.pooled)]
    notes = _shorten(report.notes)
    height_px = HEAD_PX + sum(row.height_px for row in rows) + NOTE_PX * (len(notes) + 1)
    figure = Figure(figsize=(WIDTH_PX / DPI, height_px / DPI), dpi=DPI, facecolor=BACKGROUND)
    FigureCanvasAgg(figure)
    left = MARGIN_PX / WIDTH_PX
    name = report.logs[0].name if len(report.logs) == 1 else f"{len(report.logs)} logs, pooled"
    figure.text(left, 1 - 40 / height_px, f"Labels against annotations: {name}", color=TEXT, fontsize=16, weight="bold")
    figure.text(left, 1 - 66 / height_px, describe_scope(report), color=FAINT_TEXT, fontsize=11)
    top_px = height_px - HEAD_PX
    for row in rows:
        _draw_row(figure, row, top_px, height_px)
        top_px -= row.height_px
    for place, note in enumerate(notes):
        figure.text(left, (top_px - NOTE_PX * (place + 0.5)) / height_px, note, color=FAINT_TEXT, fontsize=10)
    return figure


def _shorten(notes: Sequence[str]) -> list[str]:
    num_left = len(notes) - MAX_NOTES
    more = [f"and {num_left} more notes: see the table"] if num_left > 0 else []
    return [*(f"Note: {note}" for note in notes[:MAX_NOTES]), *more]


def _draw_row(figure: Figure, row: _Row, top_px: int, height_px: int) -> None:
    bottom_px = top_px - row.above_px - row.axes_px
    free_px = WIDTH_PX - 1.5 * MARGIN_PX - GAP_PX * (len(row.panels) - 1)
    left_px: float = MARGIN_PX
    for weight, draw in row.panels:
        width_px = free_px * weight / sum(weight for weight, _ in row.panels)
        place = (left_px / WIDTH_PX, bottom_px / height_px, width_px / WIDTH_PX, row.axes_px / height_px)
        draw(figure.add_axes(place, facecolor=PANEL))
        left_px += width_px + GAP_PX


# ------------------------------------------------------------------------------------------------- what stands where


def _box_rows(pooled: LogFigures, min_score: float) -> list[_Row]:
    boxes, tracks = pooled.boxes, pooled.tracks
    if boxes is None or tracks is None:
        return [_missing("No figures of boxes and tracks: no log has annotations")]
    found = [
        (5, partial(_draw_detection, boxes=boxes)),
        (3, partial(_draw_oracle, boxes=boxes)),
        (3, partial(_draw_tracks, tracks=tracks)),
    ]
    by_quantity = [[band for band in boxes.bands if band.quantity == quantity] for quantity in _BAND_TITLES]
    return [
        _Row(found),
        _Row([(len(bands), partial(_draw_bands, bands=bands)) for bands in by_quantity]),
        _error_row(boxes.errors, min_score),
    ]


def _error_row(errors: ErrorFigures, min_score: float) -> _Row:
    if not errors.num_matches:
        return _missing(f"No errors of centre, size and heading: no right box with a score of {min_score:g} or more")
    center = partial(_draw_lengths, title="Centre error", histogram=errors.center, median_m=errors.center_median_m)
    size = partial(
        _draw_lengths, title="Size error, |dl| + |dw| + |dh|", histogram=errors.size, median_m=errors.size_median_m
    )
    return _Row([(1, center), (1, size), (1, partial(_draw_yaw, errors=errors))], below_px=54)


def _point_row(pooled: LogFigures) -> _Row:
    flow, zero, static = pooled.flow, pooled.zero_flow, pooled.static
    panels: list[tuple[float, Draw]] = []
    if flow is not None and zero is not None:
        panels += [
            (4, partial(_draw_flow_errors, flow=flow, zero=zero)),
            (4, partial(_draw_flow_shares, flow=flow, zero=zero)),
            (6, partial(_draw_speeds, flow=flow, zero=zero)),
        ]
    if static is not None:
        missing = [] if panels else [(14, partial(_say, text="No figures of flow: see the notes below"))]
        return _Row([*panels, *missing, (4, partial(_draw_static, static=static))])
    return _Row(panels) if panels else _missing("No figures of flow and of static points: see the notes below")


def _missing(text: str) -> _Row:
    return _Row([(1, partial(_say, text=text))], above_px=16, axes_px=56, below_px=16)


# ------------------------------------------------------------------------------------------------ boxes and tracks


def _draw_detection(axes: Axes, boxes: BoxFigures) -> None:
    found, wrong = boxes.detection, boxes.wrong
    groups = [f"{one.overlap} {one.level}\n{one.num_truths} to find" for one in found]
    series = [
        _Series("AP", BLUE, [one.ap for one in found], [one.ap_interval for one in found]),
        _Series("APH", SKY, [one.aph for one in found], [one.aph_interval for one in found]),
        _Series("precision", GREEN, [one.precision for one in found], [one.precision_interval for one in found]),
        _Series("recall", ORANGE, [one.recall for one in found], [one.recall_interval for one in found]),
    ]
    _draw_shares(axes, "Boxes found", groups, series)
    _draw_legend(axes)
    axes.set_xlabel(
        f"whiskers: 90 % interval; {wrong.num_wrong} wrong: {wrong.num_on_mover} on a mover, "
        f"{wrong.num_on_standing} on a standing object, {wrong.num_on_nothing} on nothing annotated"
    )


def _draw_oracle(axes: Axes, boxes: BoxFigures) -> None:
    groups = [row.name.replace(" ", "\n", 1) for row in boxes.oracle]
    _draw_shares(axes, "Parts of each box from truth", groups, [_Series("APH", SKY, [row.aph for row in boxes.oracle])])
    axes.set_xlabel("APH (3D L1), the rest of each box from truth")


def _draw_tracks(axes: Axes, tracks: TrackFigures) -> None:
    shares = {
        "HOTA": tracks.hota,
        "DetA": tracks.detection_accuracy,
        "AssA": tracks.association_accuracy,
        "purity": tracks.purity,
        "complete-\nness": tracks.completeness,
    }
    _draw_shares(axes, "Tracks", list(shares), [_Series("share", BLUE, list(shares.values()))])
    counts = (tracks.num_truth_tracks, tracks.num_label_tracks, tracks.num_id_switches)
    axes.set_xlabel("{} movers, {} label tracks, {} id switches".format(*counts))


_BAND_TITLES: Final = {"speed_mps": "Boxes by speed, m/s", "range_m": "By range, m", "length_m": "By length, m"}


def _draw_bands(axes: Axes, bands: Sequence[BandFigures]) -> None:
    groups = [f"{name_band(band)}\n{band.num_truths} to find" for band in bands]
    series = [
        _Series("AP", BLUE, [band.ap for band in bands]),
        _Series("precision", GREEN, [band.precision for band in bands]),
        _Series("recall", ORANGE, [band.recall for band in bands]),
    ]
    _draw_shares(axes, _BAND_TITLES[bands[0].quantity], groups, series)
    _draw_legend(axes)
    axes.set_xlabel("3D L1")


def _draw_lengths(axes: Axes, title: str, histogram: Histogram, median_m: float | None) -> None:
    """Draw errors in metres; the last bin, which holds what lies beyond too, is paler and counted."""
    edges_m = np.array(histogram.edges)
    bars = _draw_histogram(axes, title, edges_m, histogram.counts)
    bars[-1].set_facecolor(SKY)
    if median_m is not None:
        _mark(axes, [median_m], f"median {median_m:.2f} m")
    axes.set_xlabel(f"m; {histogram.counts[-1]} at {edges_m[-2]:.1f} m or more")


def _draw_yaw(axes: Axes, errors: ErrorFigures) -> None:
    """Draw the signed errors of heading; what points backwards is paler and counted."""
    edges_deg = np.degrees(errors.yaw.edges)
    is_turned = np.abs(edges_deg[:-1] + edges_deg[1:]) / 2 > 90
    bars = _draw_histogram(axes, "Heading error", edges_deg, errors.yaw.counts)
    for bar in np.array(bars)[is_turned]:
        bar.set_facecolor(SKY)
    if errors.yaw_median_rad is not None:
        median_deg = degrees(errors.yaw_median_rad)
        _mark(axes, [-median_deg, median_deg], f"median |error| {median_deg:.1f} deg")
    axes.set_xticks(range(-180, 181, 60))
    axes.set_xlabel(f"deg; {np.array(errors.yaw.counts)[is_turned].sum()} at more than 90 deg")


# -------------------------------------------------------------------------------------------------- flow and static


def _draw_flow_errors(axes: Axes, flow: FlowFigures, zero: FlowFigures) -> None:
    series = _against_zero(flow, zero, lambda one: (one.epe3d_m, one.moving_epe_m, one.standing_epe_m))
    _draw_bars(axes, "Flow: end-point error, m", ["all", "moving", "standing"], series, format_number)
    axes.set_xlabel(f"{flow.num_moving_points:,} moving of {flow.num_points:,} points")


def _draw_flow_shares(axes: Axes, flow: FlowFigures, zero: FlowFigures) -> None:
    groups = ["Acc5", "Acc10", "false\nmotion", "mean IoU of\nspeed classes"]
    series = _against_zero(flow, zero, lambda one: (one.acc5, one.acc10, one.false_motion, one.mean_speed_iou))
    _draw_shares(axes, "Flow: shares", groups, series)
    _draw_legend(axes)
    angles = [format_degrees(one.theta_rad) for one in (flow, zero)]
    axes.set_xlabel(f"mean angle of moving points: {angles[0]} deg, of zero flow {angles[1]} deg")


def _draw_speeds(axes: Axes, flow: FlowFigures, zero: FlowFigures) -> None:
    classes = zip(SPEED_BINS, flow.speed_num_points, strict=True)
    groups = [f"{name}{'*' * (points < MIN_BIN_POINTS)}\n{points:,}" for name, points in classes]
    _draw_shares(axes, "Flow: IoU by speed, m/s", groups, _against_zero(flow, zero, lambda one: one.speed_iou))
    _draw_legend(axes)
    axes.set_xlabel(f"with truth points; * fewer than {MIN_BIN_POINTS}: not in the mean")


def _against_zero(flow: FlowFigures, zero: FlowFigures, values: Callable[[FlowFigures], Values]) -> list[_Series]:
    return [_Series("labels", BLUE, values(flow)), _Series("zero flow", GREY, values(zero))]


def _draw_static(axes: Axes, static: StaticFigures) -> None:
    shares = {
        "precision\nin boxes": static.in_box_precision,
        "recall\nin boxes": static.in_box_recall,
        "precision\nscene": static.scene_precision,
        "recall\nscene": static.scene_recall,
        "moving\nlost": static.moving_lost,
    }
    _draw_shares(axes, "Static points removed", list(shares), [_Series("share", GREEN, list(shares.values()))])
    axes.set_xlabel(f"{static.num_points:,} points, {static.num_sweeps} sweeps")


# ------------------------------------------------------------------------------------------------------ small parts


def _draw_shares(axes: Axes, title: str, groups: Sequence[str], series: Sequence[_Series]) -> None:
    """Draw bars of shares, in percent."""
    if _draw_bars(axes, title, groups, [one.in_percent() for one in series], _format_share):
        axes.set_ylim(0, 114)
        axes.set_yticks(range(0, 101, 25), [f"{percent} %" for percent in range(0, 101, 25)])


def _format_share(percent: float | None) -> str:
    return "-" if percent is None else f"{percent:.{int(0 < percent < 9.95)}f}"


def _draw_bars(
    axes: Axes,
    title: str,
    groups: Sequence[str],
    series: Sequence[_Series],
    form: Callable[[float | None], str],
) -> bool:
    """Draw a bar of each series for each group, a dash for None. False: there is nothing but None, which it says."""
    _dress(axes, title)
    if all(value is None for one in series for value in one.values):
        _say(axes, "nothing there to judge")
        return False
    width = 0.84 / len(series)
    for place, one in enumerate(series):
        x = np.arange(len(groups)) + (place - (len(series) - 1) / 2) * width
        bars = axes.bar(
            x, [value or 0.0 for value in one.values], 0.92 * width, yerr=_whiskers(one), label=one.name,
            color=one.color, zorder=2, error_kw={"ecolor": TEXT, "elinewidth": 0.9, "capsize": 2.5},
        )  # fmt: skip
        axes.bar_label(bars, [form(value) for value in one.values], padding=2, fontsize=9, color=TEXT)
    two_lines = [name if "\n" in name else f"{name}\n" for name in groups]  # so that all captions stand level
    axes.set_xticks(range(len(groups)), two_lines)
    axes.set_xlim(-0.55, len(groups) - 0.45)
    axes.margins(y=0.14)
    return True


def _draw_legend(axes: Axes) -> None:
    """Name the series at the right of the title; without any, nothing."""
    if not axes.containers:
        return
    axes.legend(
        loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=4, frameon=False, fontsize=10, labelcolor=TEXT,
        borderaxespad=0.2, handlelength=0.9, handleheight=0.9, handletextpad=0.4, columnspacing=1.2,
    )  # fmt: skip


def _whiskers(series: _Series) -> Float64Array | None:
    """Return (2, groups) lengths of the whiskers below and above, zero where there is no interval."""
    if not any(series.intervals):
        return None
    lengths = np.zeros((2, len(series.values)))
    for group, (value, bounds) in enumerate(zip(series.values, series.intervals, strict=True)):
        if value is not None and bounds is not None:
            lengths[:, group] = np.maximum((value - bounds[0], bounds[1] - value), 0)
    return lengths


def _draw_histogram(axes: Axes, title: str, edges: Float64Array, counts: Sequence[int]) -> BarContainer:
    _dress(axes, title)
    axes.set_xlim(edges[0], edges[-1])
    axes.margins(y=0.14)
    axes.yaxis.set_major_locator(MaxNLocator(5, integer=True))
    axes.set_ylabel("boxes")
    return axes.bar(edges[:-1], counts, np.diff(edges), align="edge", color=BLUE, ec=PANEL, lw=0.8, zorder=2)


def _mark(axes: Axes, places: Sequence[float], text: str) -> None:
    """Mark medians by lines from ground to top."""
    for place in places:
        axes.axvline(place, color=ORANGE, lw=1.6, zorder=3)
    axes.set_title(text, loc="right", fontsize=10.5, color=ORANGE)


def _dress(axes: Axes, title: str) -> None:
    axes.set_title(title, loc="left", fontsize=12, weight="bold", color=TEXT, pad=7)
    axes.grid(axis="y", color=LINE, lw=0.8, zorder=0)
    axes.tick_params(length=0, labelsize=9.5, labelcolor=TEXT)
    axes.tick_params(axis="x", pad=7)  # below the zero of the other axis
    axes.spines[["left", "top", "right"]].set_visible(False)
    axes.spines["bottom"].set_color(FAINT_TEXT)
    axes.xaxis.label.set(color=FAINT_TEXT, fontsize=9.5)
    axes.yaxis.label.set(color=FAINT_TEXT, fontsize=9.5)


def _say(axes: Axes, text: str) -> None:
    """Write what is missing into a panel without axes."""
    axes.set_xticks([])
    axes.set_yticks([])
    axes.spines[:].set_visible(False)
    axes.text(0.5, 0.5, text, transform=axes.transAxes, ha="center", va="center", fontsize=11, color=FAINT_TEXT)
