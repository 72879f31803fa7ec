"""The flow ablation: chosen sweeps observed with parts of the flow stage left out, judged as ``evaluate`` judges flow.

A row is a profile with overrides. All rows see the same sweeps of the same logs, pooled by their points.

Core-seconds a sweep: user and system time of this process from the ground of one more sweep to its proposals, as in a
run over the whole segment. The sweep before is prepared first and not counted, so that the window is filled; sweep 0
has none before it and pays for its whole window. Reading and judging are not counted.

Source: paper, appendix, "Ablation Study on Unsupervised Flow Estimation".
"""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from math import sqrt
from typing import Any, Final

import numpy as np
from pydantic import BaseModel, ConfigDict

from labeling.evaluation.flow import (
    FlowFigures,
    FlowSums,
    StaticFigures,
    StaticSums,
    flow_figures,
    static_figures,
)
from labeling.evaluation.markdown import Row, format_degrees, format_number, format_percent, render_rows
from labeling.evaluation.report import judge_sweep
from labeling.evaluation.truth import MAX_GAP_S, SegmentTruth, SweepPointTruth, read_truth, sweep_point_truth
from labeling.folders.identity import code_version
from labeling.line import observe, prepare_sweeps
from labeling.readers.reader import SegmentReader
from labeling.threads import use_one_thread
from schemas.config import LabelingConfig, resolve_config
from schemas.errors import InvalidInput
from schemas.frames import Annotations, PointTruth, Sweep
from schemas.lidars import Lidar
from schemas.objects import SweepObservation

SWEEPS_A_LOG: Final = 4  # when none are named


@dataclass(frozen=True, slots=True)
class FlowRow:
    """What one row runs. No profile: nothing, and zero flow is predicted everywhere."""

    key: str
    name: str
    profile: str | None
    overrides: dict[str, Any] = field(default_factory=dict)
    without: tuple[str, ...] = ()  # steps that are left out

    def config(self, changes: dict[str, Any]) -> LabelingConfig | None:
        """Return the parameters of the row; ``changes`` win over its own overrides."""
        if self.profile is None:
            return None
        return resolve_config(self.profile, {**self.overrides, **changes}).leave_out(*self.without)


_NSFP: Final = {  # as published: 8 x 128, Adam at 0.008, up to 1000 iterations, the whole scene in one pair of nets
    "static.method": "none",
    "flow.method": "nsfp",
    "flow.learning_rate": 0.008,
    "flow.local_consistency": 0.0,
    "flow.chamfer_cutoff_m": sqrt(2),
}
_NO_CONSISTENCY: Final = {"flow.local_consistency": 0.0}

FLOW_ROWS: Final = (
    FlowRow("zero", "zero flow", None),
    FlowRow("nsfp", "NSFP", "paper", _NSFP),
    FlowRow(
        "no-box-query", "paper without box query", "paper", _NO_CONSISTENCY, without=("flow.expansion", "flow.pruning")
    ),
    FlowRow("expansion", "  + expansion", "paper", _NO_CONSISTENCY, without=("flow.pruning",)),
    FlowRow("pruning", "  + pruning", "paper", _NO_CONSISTENCY),
    FlowRow("paper", "  + local consistency = paper", "paper"),
    FlowRow("rigid", "rigid", "default", {"flow.method": "rigid"}),
    FlowRow("default", "default", "default"),
)


class FlowRowFigures(BaseModel):
    """What one row is worth, all sweeps pooled."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    key: str
    name: str
    config: LabelingConfig | None  # None: nothing was run
    flow: FlowFigures
    static: StaticFigures | None
    num_failed_fits: int
    core_s_per_sweep: float | None


class LogSweeps(BaseModel):
    """Which sweeps of a log were judged."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    segment_id: str
    sweeps: tuple[int, ...]


class FlowAblation(BaseModel):
    """All that `motionlabel ablate flow` says."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    logs: tuple[LogSweeps, ...]
    azimuth_deg: float | None
    changes: dict[str, Any]  # what all rows were given beside their own overrides
    code_version: str
    rows: tuple[FlowRowFigures, ...]


@dataclass(slots=True)
class _RowSums:
    """What the figures of a row are made of."""

    flow: FlowSums = field(default_factory=FlowSums)
    static: StaticSums = field(default_factory=StaticSums)
    num_failed_fits: int = 0
    core_s: float = 0.0


class TimedReader(SegmentReader):
    """A reader that adds up the core-seconds its sweeps take to read."""

    def __init__(self, reader: SegmentReader) -> None:
        self.listing = reader.listing
        self.core_s = 0.0
        self._reader = reader

    @property
    def lidars(self) -> tuple[Lidar, ...] | None:
        """Return what its lidars are, see ``SegmentReader``."""
        return self._reader.lidars

    def read_sweep(self, index: int) -> Sweep:
        """Read a sweep, see ``SegmentReader``."""
        start_s = time.process_time()
        try:
            return self._reader.read_sweep(index)
        finally:
            self.core_s += time.process_time() - start_s

    def read_annotations(self, index: int) -> Annotations | None:
        """Return cuboids, see ``SegmentReader``."""
        return self._reader.read_annotations(index)

    def read_point_truth(self, index: int) -> PointTruth | None:
        """Return point-wise truth, see ``SegmentReader``."""
        return self._reader.read_point_truth(index)


def choose_flow_rows(keys: Sequence[str] | None) -> tuple[FlowRow, ...]:
    """Return the rows of these keys in the order of the table; None: all.

    Raises:
        InvalidInput: An unknown key.

    """
    known = [row.key for row in FLOW_ROWS]
    for key in keys or ():
        if key not in known:
            raise InvalidInput(f"unknown row {key!r}: expected some of {', '.join(known)}")
    return tuple(row for row in FLOW_ROWS if keys is None or row.key in keys)


def ablate_flow(
    readers: Sequence[SegmentReader],
    rows: Sequence[FlowRow],
    *,
    changes: dict[str, Any],
    sweeps: Sequence[int] | None,
    azimuth_deg: float | None,
    progress: Callable[[int, int], None] | None = None,
) -> FlowAblation:
    """Observe some sweeps of each log once a row and judge their flow, all logs pooled.

    Args:
        readers: The recordings with their truth.
        rows: See ``choose_flow_rows``.
        changes: Overrides that hold for every row.
        sweeps: Indices, the same in each log; None: SWEEPS_A_LOG spread over those with truth flow.
        azimuth_deg: Points farther from straight ahead are left out; None: all around.
        progress: Called with how many observations are done and how many there will be.

    Raises:
        InvalidInput: A sweep without truth flow, or a parameter out of bounds.

    """
    use_one_thread()
    configs = {row.key: row.config(changes) for row in rows}
    truths = [read_truth(reader) for reader in readers]
    chosen = [choose_sweeps(reader, truth, sweeps) for reader, truth in zip(readers, truths, strict=True)]
    sums = {row.key: _RowSums() for row in rows}
    num_done, num_steps = 0, len(rows) * sum(map(len, chosen))
    for reader, truth, indices in zip(readers, truths, chosen, strict=True):
        for index in indices:
            sweep = reader.read_sweep(index)
            point_truth = sweep_point_truth(truth, sweep, reader.read_point_truth(index), azimuth_deg)
            if point_truth is None or point_truth.flow_ego_m is None:
                raise InvalidInput(f"sweep {index} of {reader.uri} has no truth flow: expected annotations or labels")
            for row in rows:
                _add(sums[row.key], reader, configs[row.key], sweep, point_truth, truth.gap_s(index))
                num_done += 1
                if progress is not None:
                    progress(num_done, num_steps)
    return FlowAblation(
        logs=tuple(
            LogSweeps(segment_id=reader.segment_id, sweeps=tuple(indices))
            for reader, indices in zip(readers, chosen, strict=True)
        ),
        azimuth_deg=azimuth_deg,
        changes=changes,
        code_version=code_version(),
        rows=tuple(_figures(row, configs[row.key], sums[row.key]) for row in rows),
    )


def choose_sweeps(reader: SegmentReader, truth: SegmentTruth, sweeps: Sequence[int] | None) -> list[int]:
    """Return the sweeps to judge, ascending: those named, else SWEEPS_A_LOG spread over those that can be judged.

    Raises:
        InvalidInput: A named sweep has no next one, cannot be read or has no truth flow; or no sweep can be judged.

    """
    num_sweeps = len(reader.timestamps_ns)
    if sweeps is not None:
        for index in sweeps:
            if not 0 <= index < num_sweeps:
                raise InvalidInput(f"sweep {index} lies outside {reader.uri}, which has sweeps 0:{num_sweeps}")
            if not _has_flow(reader, truth, index):
                raise InvalidInput(
                    f"sweep {index} of {reader.uri} has no truth flow: expected annotations or flow labels, and a "
                    f"next sweep within {MAX_GAP_S} s"
                )
        return sorted(set(sweeps))
    usable = [index for index in range(num_sweeps) if _has_flow(reader, truth, index)]
    if not usable:
        raise InvalidInput(f"{reader.uri} has no sweep with truth flow: expected annotations or flow labels")
    middles = (2 * np.arange(SWEEPS_A_LOG) + 1) * len(usable) // (2 * SWEEPS_A_LOG)
    return [usable[place] for place in np.unique(middles)]


def _has_flow(reader: SegmentReader, truth: SegmentTruth, index: int) -> bool:
    if truth.gap_s(index) > MAX_GAP_S or not np.isfinite(truth.world_from_ego[index : index + 2]).all():
        return False
    is_annotated = bool(truth.is_annotated[index : index + 2].all())
    return is_annotated or reader.read_point_truth(index) is not None


def _add(
    sums: _RowSums,
    reader: SegmentReader,
    config: LabelingConfig | None,
    sweep: Sweep,
    point_truth: SweepPointTruth,
    gap_s: float,
) -> None:
    """Observe one sweep with one row's parameters, judge it, and add it to the row."""
    point_index, flow_world_m = np.empty(0, dtype=np.int32), np.empty((0, 3), dtype=np.float32)
    if config is not None:
        observation, core_s = observe_timed(reader, config, sweep.index)
        points = observation.points.only_dynamic() if observation.points else None
        if points is None or points.flow_world_m is None:
            raise InvalidInput(f"sweep {sweep.index} of {reader.uri} has no flow: {observation.reason or 'none found'}")
        point_index, flow_world_m = points.point_index, points.flow_world_m
        sums.num_failed_fits += observation.num_failed_fits
        sums.core_s += core_s
    flow, _, static = judge_sweep(sweep, point_truth, point_index, flow_world_m, gap_s)
    sums.flow += flow
    sums.static += static


def observe_timed(reader: SegmentReader, config: LabelingConfig, index: int) -> tuple[SweepObservation, float]:
    """Observe one sweep as in a run over its segment and return its core-seconds without reading."""
    timed = TimedReader(reader)
    works = prepare_sweeps(timed, config, range(max(index - 1, 0), index + 1))
    if index > 0:
        next(works)  # fills the window
    start_s = time.process_time() - timed.core_s
    observation = observe(next(works), config)
    return observation, time.process_time() - timed.core_s - start_s


def _figures(row: FlowRow, config: LabelingConfig | None, sums: _RowSums) -> FlowRowFigures:
    is_run = config is not None
    return FlowRowFigures(
        key=row.key,
        name=row.name.strip(),
        config=config,
        flow=flow_figures(sums.flow),
        static=static_figures(sums.static) if is_run else None,
        num_failed_fits=sums.num_failed_fits,
        core_s_per_sweep=sums.core_s / sums.flow.num_sweeps if is_run else None,
    )


def render_flow_ablation(ablation: FlowAblation) -> str:
    """Return the two tables, flow and static removal, as Markdown."""
    names = {row.key: row.name for row in FLOW_ROWS}
    header = "row | EPE3D m | Acc5 % | Acc10 % | theta deg | mIoU % | moving EPE m | standing EPE m | false motion %"
    header += " | core-s a sweep"
    flow = render_rows("Scene flow", header, [(names[row.key], *_flow_cells(row)) for row in ablation.rows])
    sections = [_scope(ablation), flow, _static(ablation.rows)]
    sections += [f"Note: {row.name}: {row.num_failed_fits} fits failed" for row in ablation.rows if row.num_failed_fits]
    return "\n\n".join(section for section in sections if section) + "\n"


def _scope(ablation: FlowAblation) -> str:
    flow = ablation.rows[0].flow
    view = "" if ablation.azimuth_deg is None else f", within {ablation.azimuth_deg:g} deg of straight ahead"
    changes = "".join(f", {key}={value}" for key, value in ablation.changes.items())
    logs = "; ".join(f"{log.segment_id} sweeps {', '.join(map(str, log.sweeps))}" for log in ablation.logs)
    return f"{flow.num_points} points, {flow.num_moving_points} moving{view}{changes}. {logs}."


def _flow_cells(row: FlowRowFigures) -> Row:
    flow = row.flow
    return (
        format_number(flow.epe3d_m),
        format_percent(flow.acc5),
        format_percent(flow.acc10),
        format_degrees(flow.theta_rad),
        format_percent(flow.mean_speed_iou),
        format_number(flow.moving_epe_m),
        format_number(flow.standing_epe_m),
        format_percent(flow.false_motion),
        "-" if row.core_s_per_sweep is None else f"{row.core_s_per_sweep:.2f}",
    )


def _static(rows: Sequence[FlowRowFigures]) -> str:
    """Return one line for each way of static removal among the rows."""
    lines: dict[str, Row] = {}
    for row in rows:
        if row.config is not None and row.static is not None and row.config.static.method != "none":
            static, method = row.static, row.config.static.method
            in_box = (static.in_box_precision, static.in_box_recall)
            shares = (*in_box, static.moving_lost, static.scene_precision, static.scene_recall)
            lines[method] = (f"{method} ({row.config.profile})", *map(format_percent, shares))
    header = "static removal | in-box P % | in-box R % | moving lost % | scene P % | scene R %"
    return render_rows("Static points removed", header, list(lines.values()))
