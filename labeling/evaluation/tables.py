"""The report as text: aligned Markdown tables. Lengths in metres, angles in degrees, shares in percent."""

from collections.abc import Callable, Sequence

import numpy as np

from labeling.evaluation.detection import BandFigures, DetectionFigures, Histogram
from labeling.evaluation.flow import MIN_BIN_POINTS, SPEED_BINS, FlowFigures
from labeling.evaluation.markdown import (
    Row,
    format_degrees,
    format_interval,
    format_number,
    format_percent,
    render_rows,
)
from labeling.evaluation.report import LogFigures, Report

_QUANTITIES = {"speed_mps": "speed m/s", "range_m": "range m", "length_m": "length m"}
_BARS = "·▁▂▃▄▅▆▇█"


def render_table(report: Report) -> str:
    """Return all figures of a report; parts without truth or labels are left out."""
    one_log = report.pooled.model_copy(update={"name": report.logs[0].name})
    logs = (*report.logs, report.pooled) if len(report.logs) > 1 else (one_log,)
    sections = [
        describe_scope(report),
        _flow(logs),
        _speeds(logs),
        _static(logs),
        _boxes(logs),
        _bands(report.pooled),
        _tracks(logs),
        _errors(report.pooled),
        _oracle(report.pooled),
        "\n".join(f"Note: {note}" for note in report.notes),
    ]
    return "\n\n".join(section for section in sections if section) + "\n"


def describe_scope(report: Report) -> str:
    """Say in a line what a report covers."""
    view = "" if report.azimuth_deg is None else f", within {report.azimuth_deg:g} deg of straight ahead"
    logs = f"{len(report.logs)} log{'s' * (len(report.logs) > 1)}"
    sweeps = f"{report.pooled.num_sweeps} sweeps ({report.pooled.num_rejected_sweeps} rejected)"
    return f"{logs}, {sweeps}{view}. Score cut of P, R, errors and tracks: {report.min_score:g}."


def _flow(logs: Sequence[LogFigures]) -> str:
    header = (
        "flow | points | moving | EPE3D m | Acc5 % | Acc10 % | theta deg | moving EPE m | normalised | standing EPE m"
    )
    header += " | false motion % | mIoU %"
    return render_rows("Scene flow", header, _flow_rows(logs, _flow_cells))


def _flow_cells(flow: FlowFigures) -> Row:
    return (
        f"{flow.num_points}",
        f"{flow.num_moving_points}",
        format_number(flow.epe3d_m),
        format_percent(flow.acc5),
        format_percent(flow.acc10),
        format_degrees(flow.theta_rad),
        format_number(flow.moving_epe_m),
        format_number(flow.normalised_moving_epe),
        format_number(flow.standing_epe_m),
        format_percent(flow.false_motion),
        format_percent(flow.mean_speed_iou),
    )


def _speeds(logs: Sequence[LogFigures]) -> str:
    header = " | ".join(["IoU %", *(f"{name} m/s" for name in SPEED_BINS)])
    title = f"Speed classes (* fewer than {MIN_BIN_POINTS} truth points: not in the mean)"
    return render_rows(title, header, _flow_rows(logs, _speed_cells))


def _speed_cells(flow: FlowFigures) -> Row:
    return [
        format_percent(iou) + "*" * (points < MIN_BIN_POINTS)
        for iou, points in zip(flow.speed_iou, flow.speed_num_points, strict=True)
    ]


def _flow_rows(logs: Sequence[LogFigures], cells: Callable[[FlowFigures], Row]) -> list[Row]:
    rows: list[Row] = []
    for log in logs:
        rows += [(name, *cells(flow)) for name, flow in ((log.name, log.flow), ("  zero flow", log.zero_flow)) if flow]
    return rows


def _static(logs: Sequence[LogFigures]) -> str:
    header = "static removal | points | in-box P % | in-box R % | scene P % | scene R % | moving lost %"
    rows = []
    for log in logs:
        if static := log.static:
            shares = (static.in_box_precision, static.in_box_recall, static.scene_precision, static.scene_recall)
            rows.append(
                (log.name, f"{static.num_points}", *map(format_percent, shares), format_percent(static.moving_lost))
            )
    return render_rows("Static points removed", header, rows)


def _boxes(logs: Sequence[LogFigures]) -> str:
    header = "boxes | overlap | level | truths | AP % | 90 % of AP | APH % | P % | 90 % of P | R % | 90 % of R"
    rows = [(log.name, *_detection_cells(one)) for log in logs if log.boxes for one in log.boxes.detection]
    wrong = []
    for log in logs:
        if log.boxes:
            counts = log.boxes.wrong
            numbers = (counts.num_wrong, counts.num_on_mover, counts.num_on_standing, counts.num_on_nothing)
            wrong.append((log.name, f"{log.boxes.num_objects}", f"{log.boxes.num_labels}", *map(str, numbers)))
    where = "where | movers | labels | wrong | on a mover | on a standing object | on nothing annotated"
    return "\n\n".join(
        filter(None, [render_rows("Boxes", header, rows), render_rows("Wrong boxes (3D L1)", where, wrong)])
    )


def _detection_cells(one: DetectionFigures) -> Row:
    return (
        one.overlap,
        one.level,
        f"{one.num_truths}",
        format_percent(one.ap),
        format_interval(one.ap_interval),
        format_percent(one.aph),
        format_percent(one.precision),
        format_interval(one.precision_interval),
        format_percent(one.recall),
        format_interval(one.recall_interval),
    )


def name_band(band: BandFigures) -> str:
    """Write the ends of a band, as 3-6 or 15+."""
    return f"{band.low:g}+" if band.high is None else f"{band.low:g}-{band.high:g}"


def _bands(pooled: LogFigures) -> str:
    rows = []
    for band in pooled.boxes.bands if pooled.boxes else ():
        shares = (band.ap, band.precision, band.recall)
        rows.append((_QUANTITIES[band.quantity], name_band(band), f"{band.num_truths}", *map(format_percent, shares)))
    return render_rows("Boxes by band (3D L1)", "of | band | truths | AP % | P % | R %", rows)


def _tracks(logs: Sequence[LogFigures]) -> str:
    header = "tracks | truth | labelled | purity % | completeness % | id switches | HOTA % | DetA % | AssA %"
    rows = []
    for log in logs:
        if tracks := log.tracks:
            counts = (f"{tracks.num_truth_tracks}", f"{tracks.num_label_tracks}")
            shares = (tracks.hota, tracks.detection_accuracy, tracks.association_accuracy)
            quality = (format_percent(tracks.purity), format_percent(tracks.completeness), f"{tracks.num_id_switches}")
            rows.append((log.name, *counts, *quality, *map(format_percent, shares)))
    return render_rows("Tracks", header, rows)


def _errors(pooled: LogFigures) -> str:
    if pooled.boxes is None or not pooled.boxes.errors.num_matches:
        return ""
    errors = pooled.boxes.errors
    rows = [
        ("centre m", format_number(errors.center_median_m), "0 to 3", _bars(errors.center)),
        ("size m", format_number(errors.size_median_m), "0 to 6", _bars(errors.size)),
        ("heading deg", format_degrees(errors.yaw_median_rad), "-180 to 180", _bars(errors.yaw)),
    ]
    header = "error | median | range | histogram"
    return render_rows(f"Errors of {errors.num_matches} right boxes (3D L1)", header, rows)


def _bars(histogram: Histogram) -> str:
    """Draw the counts as one bar a bin, the fullest at full height; a bin with a single match still shows."""
    heights = np.ceil(np.array(histogram.counts) * (len(_BARS) - 1) / max(histogram.counts)).astype(int)
    return "".join(_BARS[height] for height in heights)


def _oracle(pooled: LogFigures) -> str:
    rows = [(row.name, format_percent(row.aph)) for row in pooled.boxes.oracle] if pooled.boxes else []
    return render_rows("Parts of each box from truth (3D L1)", "box | APH %", rows)
