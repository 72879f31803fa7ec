"""The box ablation: labels made with parts of the line left out, each row judged as ``evaluate`` judges labels.

Ground, static points and flow are found once a log; what follows them runs once a row. Flow is the run's own, none
(``flow.method=none``), or the truth of ``labeling.evaluation.truth`` at the run's dynamic points, of an oracle. Boxes
are those of the full pipeline, or of clustering alone: each proposal as it is, a track of its own.

Of one log at a time all dynamic points are held, with two velocities about 60 bytes each.

Source: paper, "Unsupervised 3D Object Detection" (the labels themselves, not a detector trained on them) and appendix,
"Ablation Study on Auto Meta Labeling".
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict

from labeling.evaluation.boxes import Level, Overlap, match, sweep_overlaps
from labeling.evaluation.detection import BoxFigures, DetectionFigures, box_figures
from labeling.evaluation.evidence import BoxEvidence, gather_evidence, pool
from labeling.evaluation.markdown import (
    Row,
    format_degrees,
    format_interval,
    format_number,
    format_percent,
    render_rows,
)
from labeling.evaluation.tracks import TrackFigures, hota_sums, track_figures
from labeling.evaluation.truth import SegmentTruth, read_truth, sweep_point_truth
from labeling.folders.identity import code_version
from labeling.line import fit_plan, label_tracks, prepare_sweeps, vote_and_plan
from labeling.readers.reader import SegmentReader, sweep_range
from labeling.stages.flow import finish_flow
from labeling.stages.proposals import propose_boxes
from labeling.stages.refinement import SweepClock
from labeling.stages.tracking import make_track_id
from labeling.threads import use_one_thread
from schemas.arrays import Float32Array, Float64Array
from schemas.config import LabelingConfig, ProposalParams, resolve_config
from schemas.errors import InvalidInput
from schemas.manifest import RECOMMENDED_MIN_SCORE
from schemas.objects import DynamicPoints, LabeledTrack, Proposal, SweepObservation
from schemas.tables import labels
from schemas.tables.labels import LabelRows

POINTS_OF_HALF_SCORE: Final = 10  # a proposal of so many points has score 0.5

FlowSource = Literal["own", "none", "truth"]
BoxSource = Literal["clustering", "full"]


@dataclass(frozen=True, slots=True)
class BoxRow:
    """What one row does: its flow, its boxes, and the parameters it changes."""

    key: str
    name: str
    flow: FlowSource
    boxes: BoxSource
    without: tuple[str, ...] = ()  # steps that are left out

    def config(self, profile: str, changes: dict[str, Any]) -> LabelingConfig:
        """Return the parameters of the row; without the steps that it leaves out."""
        no_flow = {"flow.method": "none", "flow.external_folder": None} if self.flow == "none" else {}
        return resolve_config(profile, {**changes, **no_flow}).leave_out(*self.without)


def _starts(key: str, name: str, *left_out: str) -> BoxRow:
    return BoxRow(key, name, "own", "full", without=tuple(f"registration.{step}" for step in left_out))


_FLOW_CLUSTERING: Final = BoxRow("flow-clustering", "flow + clustering", "own", "clustering")
_FULL: Final = BoxRow("full", "flow + full pipeline", "own", "full")

BOX_TABLES: Final[dict[str, tuple[BoxRow, ...]]] = {
    "Flow and pipeline": (
        BoxRow("no-flow-clustering", "no flow + clustering", "none", "clustering"),
        BoxRow("no-flow-full", "no flow + full pipeline", "none", "full"),
        _FLOW_CLUSTERING,
        _FULL,
        BoxRow("oracle-clustering", "oracle flow + clustering", "truth", "clustering"),
        BoxRow("oracle-full", "oracle flow + full pipeline", "truth", "full"),
    ),
    "Clustering": (
        BoxRow(
            "position-clustering",
            "filtered by flow, clustered by position",
            "own",
            "clustering",
            without=("proposals.flow_clustering",),
        ),
        replace(_FLOW_CLUSTERING, name="clustered by position and flow"),
    ),
    "Registration, full pipeline": (
        _starts("no-start", "no start", "rotation_start", "translation_grid", "motion_start"),
        _starts("rotation-start", "rotation start (R)", "translation_grid", "motion_start"),
        _starts("grid-start", "translation grid (T)", "rotation_start", "motion_start"),
        _starts("both-starts", "R and T", "motion_start"),
        BoxRow("unconstrained", "unconstrained ICP", "own", "full", without=("registration.upright",)),
        replace(_FULL, name="full"),
    ),
}
BOX_ROW_KEYS: Final = tuple(dict.fromkeys(row.key for rows in BOX_TABLES.values() for row in rows))


class RowFigures(BaseModel):
    """What one row's labels are worth, all logs pooled."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    key: str
    name: str
    flow: FlowSource
    boxes: BoxSource
    without: tuple[str, ...]
    box_figures: BoxFigures
    tracks: TrackFigures | None  # None: of clustering, whose labels are no tracks


class BoxAblation(BaseModel):
    """All that `motionlabel ablate boxes` says."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    logs: tuple[str, ...]
    num_sweeps: int  # labelled or rejected
    num_rejected_sweeps: int
    azimuth_deg: float | None
    min_score: float  # cut of precision, recall, errors and tracks
    code_version: str
    config: dict[str, Any]  # what the rows override
    rows: tuple[RowFigures, ...]


@dataclass(frozen=True, slots=True, eq=False)
class _ObservedSweep:
    """What is known of a sweep before its boxes. A flow that is not there says nothing moves."""

    dynamic: DynamicPoints
    velocities_mps: dict[FlowSource, Float32Array]  # (M, 3) ego axes


@dataclass(frozen=True, slots=True, eq=False)
class _ObservedLog:
    segment_id: str
    truth: SegmentTruth
    sweeps: tuple[_ObservedSweep | SweepObservation, ...]  # an observation is a rejected sweep

    @property
    def used(self) -> list[_ObservedSweep]:
        return [sweep for sweep in self.sweeps if isinstance(sweep, _ObservedSweep)]


@dataclass(frozen=True, slots=True, eq=False)
class _LogEvidence:
    """What one log adds to a row."""

    boxes: BoxEvidence
    hota: Float64Array | None  # (4, 19); None: proposals, which are no tracks


def choose_box_rows(keys: Sequence[str] | None) -> tuple[BoxRow, ...]:
    """Return the rows of these keys in the order of the tables, each once; None: all.

    Raises:
        InvalidInput: An unknown key.

    """
    for key in keys or ():
        if key not in BOX_ROW_KEYS:
            raise InvalidInput(f"unknown row {key!r}: expected some of {', '.join(BOX_ROW_KEYS)}")
    first_of_key = {row.key: row for rows in reversed(BOX_TABLES.values()) for row in rows}
    return tuple(first_of_key[key] for key in BOX_ROW_KEYS if keys is None or key in keys)


def ablate_boxes(
    readers: Sequence[SegmentReader],
    rows: Sequence[BoxRow],
    *,
    profile: str,
    changes: dict[str, Any],
    azimuth_deg: float | None,
    progress: Callable[[int, int], None] | None = None,
) -> BoxAblation:
    """Label the segments once a row and judge each row's labels, all segments pooled.

    Args:
        readers: The recordings with their truth.
        rows: See ``choose_box_rows``.
        profile: What the rows override.
        changes: Parameters that hold for all rows, ``sweeps`` among them.
        azimuth_deg: Truth and labels farther from straight ahead are left out; None: all around.
        progress: Called with how many steps are done and how many there will be: sweeps observed and rows labelled.

    Raises:
        InvalidInput: A range outside a segment, one without annotations, or a parameter out of bounds.

    """
    use_one_thread()
    config = resolve_config(profile, changes)
    if config.flow.method == "none":
        raise InvalidInput("flow.method=none is what some rows change: choose the flow of the others")
    configs = {row.key: row.config(profile, changes) for row in rows}
    num_done, num_steps = 0, sum(len(sweep_range(reader, config)) + len(rows) for reader in readers)

    def advance() -> None:
        nonlocal num_done
        num_done += 1
        if progress is not None:
            progress(num_done, num_steps)

    evidence: dict[str, list[_LogEvidence]] = {row.key: [] for row in rows}
    num_sweeps = num_rejected = 0
    for reader in readers:
        log = _observe(reader, config, {row.flow for row in rows}, advance)
        num_sweeps, num_rejected = num_sweeps + len(log.sweeps), num_rejected + len(log.sweeps) - len(log.used)
        for row in rows:
            found = rounded_rows(_label(log, row, configs[row.key]))
            evidence[row.key].append(_judge(log, found, azimuth_deg, has_tracks=row.boxes == "full"))
            advance()
    return BoxAblation(
        logs=tuple(reader.segment_id for reader in readers),
        num_sweeps=num_sweeps,
        num_rejected_sweeps=num_rejected,
        azimuth_deg=azimuth_deg,
        min_score=RECOMMENDED_MIN_SCORE,
        code_version=code_version(),
        config=config.model_dump(mode="json"),
        rows=tuple(_row_figures(row, evidence[row.key]) for row in rows),
    )


def _observe(
    reader: SegmentReader, config: LabelingConfig, sources: set[FlowSource], advance: Callable[[], None]
) -> _ObservedLog:
    """Run the line up to its flows on one log."""
    indices = sweep_range(reader, config)
    truth = read_truth(reader)
    if not truth.is_annotated[indices.start : indices.stop].any():
        raise InvalidInput(f"segment {reader.segment_id}: nothing to judge by: {reader.uri} has no annotations there")
    if "own" not in sources:
        none = {"method": "none", "external_folder": None}
        config = config.model_copy(update={"flow": config.flow.model_copy(update=none)})
    sweeps: list[_ObservedSweep | SweepObservation] = []
    for work in prepare_sweeps(reader, config, indices):
        if isinstance(work, SweepObservation):
            sweeps.append(work)
        else:
            velocities: dict[FlowSource, Float32Array] = {}
            if (plan := vote_and_plan(work, config)) is not None:
                flow = finish_flow(plan, fit_plan(plan, config))
                velocities["own"] = (flow.flow_ref_m / flow.gap_s).astype(np.float32)
            if "truth" in sources:
                velocities["truth"] = true_velocities_mps(truth, reader, work.dynamic)
            sweeps.append(_ObservedSweep(work.dynamic, velocities))
        advance()
    return _ObservedLog(reader.segment_id, truth, tuple(sweeps))


def true_velocities_mps(truth: SegmentTruth, reader: SegmentReader, dynamic: DynamicPoints) -> Float32Array:
    """Return the (M, 3) true velocities of the dynamic points, ego axes: what an oracle's flow would say.

    They are the evaluation's flow to the next sweep over its time. Where that is unknown (the last sweep, one before a
    gap, an object that is gone) they are the flow to the sweep before, as our flow's are; zero where that is too.
    """
    sweep = reader.read_sweep(dynamic.sweep_index)
    back, back_index = _reversed(truth), len(truth.timestamps_ns) - 1 - sweep.index
    velocity = np.full((len(dynamic.points_ego), 3), np.nan)
    for known, gap_s in (
        (sweep_point_truth(truth, sweep, reader.read_point_truth(sweep.index), None), truth.gap_s(sweep.index)),
        (sweep_point_truth(back, replace(sweep, index=back_index), None, None), -back.gap_s(back_index)),
    ):
        if known is not None and known.flow_ego_m is not None:
            told = known.flow_ego_m[dynamic.clusters.point_rows] / gap_s
            velocity = np.where(np.isnan(velocity), told, velocity)
    return np.nan_to_num(velocity).astype(np.float32)


def _reversed(truth: SegmentTruth) -> SegmentTruth:
    """Return the truth of the segment played backwards: its next sweep is the one before."""
    return replace(
        truth,
        timestamps_ns=-truth.timestamps_ns[::-1],
        world_from_ego=truth.world_from_ego[::-1],
        is_annotated=truth.is_annotated[::-1],
        row_offsets=(truth.row_offsets[-1] - truth.row_offsets)[::-1],
        object_index=truth.object_index[::-1],
        boxes_ego=truth.boxes_ego[::-1],
        speed_mps=truth.speed_mps[::-1],
        num_points=truth.num_points[::-1],
        is_moving=truth.is_moving[::-1],
    )


def _label(log: _ObservedLog, row: BoxRow, config: LabelingConfig) -> list[LabeledTrack]:
    """Run the line of one row after its flow."""
    proposals = [_propose(sweep, row.flow, config.proposals) for sweep in log.sweeps]
    if row.boxes == "clustering":
        return [_as_track(proposal, log.segment_id) for of_sweep in proposals for proposal in of_sweep]
    stamps = [(sweep.dynamic.sweep_index, sweep.dynamic.timestamp_ns) for sweep in log.used]
    clock = SweepClock(*np.array(stamps, dtype=np.int64).reshape(-1, 2).T)
    return label_tracks(proposals, clock, config, log.segment_id)


def _propose(
    sweep: _ObservedSweep | SweepObservation, flow: FlowSource, params: ProposalParams
) -> tuple[Proposal, ...]:
    if isinstance(sweep, SweepObservation):
        return ()
    if flow == "none":
        return propose_boxes(sweep.dynamic, None, params)
    velocity_mps = sweep.velocities_mps.get(flow)
    return () if velocity_mps is None else propose_boxes(sweep.dynamic, velocity_mps, params)


def _as_track(proposal: Proposal, segment_id: str) -> LabeledTrack:
    """Return the label of a proposal as it is: the box of what is seen, the surer the more points it has."""
    num_points = len(proposal.points_world)
    return LabeledTrack(
        track_id=make_track_id(segment_id, proposal),
        sweep_index=np.array([proposal.sweep_index]),
        timestamp_ns=np.array([proposal.timestamp_ns]),
        boxes=proposal.box_visible[None],
        velocity_mps=proposal.velocity_mps[None].astype(np.float64),
        score=np.array([num_points / (num_points + POINTS_OF_HALF_SCORE)]),
        num_points=np.array([num_points]),
        is_observed=np.array([True]),
        boxes_visible=proposal.box_visible[None],
        registration_error_m=np.array([np.nan]),
        point_rows=(np.sort(proposal.point_rows),),
        range_noise_m=proposal.range_noise_m,
    )


def rounded_rows(tracks: Sequence[LabeledTrack]) -> LabelRows:
    """Return the rows of a labels table, in its order, rounded as a label folder does."""
    return labels.from_table(labels.to_table("", "", LabelRows.of_tracks(tracks)))


def _judge(log: _ObservedLog, found: LabelRows, azimuth_deg: float | None, *, has_tracks: bool) -> _LogEvidence:
    truth = log.truth
    poses = {}
    for sweep in log.sweeps:
        index = sweep.sweep_index if isinstance(sweep, SweepObservation) else sweep.dynamic.sweep_index
        if truth.is_annotated[index]:
            poses[index] = truth.world_from_ego[index] if isinstance(sweep, _ObservedSweep) else sweep.world_from_ego
    evidence = gather_evidence(truth, found, poses, azimuth_deg)
    if not has_tracks:
        return _LogEvidence(evidence, None)
    overlaps = sweep_overlaps(evidence, evidence.label_boxes)
    is_kept = evidence.label_score >= RECOMMENDED_MIN_SCORE
    return _LogEvidence(evidence, hota_sums(evidence, match(evidence, overlaps, "L1"), overlaps, is_kept))


def _row_figures(row: BoxRow, logs: Sequence[_LogEvidence]) -> RowFigures:
    evidence = pool([log.boxes for log in logs])
    hota = [log.hota for log in logs if log.hota is not None]
    overlaps = sweep_overlaps(evidence, evidence.label_boxes)
    matching = match(evidence, overlaps, "L1")
    is_kept = evidence.label_score >= RECOMMENDED_MIN_SCORE
    return RowFigures(
        key=row.key,
        name=row.name,
        flow=row.flow,
        boxes=row.boxes,
        without=row.without,
        box_figures=box_figures(evidence, overlaps, matching, RECOMMENDED_MIN_SCORE, has_interval=True),
        tracks=track_figures(evidence, matching, is_kept, np.sum(hota, axis=0)) if hota else None,
    )


def render_box_ablation(ablation: BoxAblation) -> str:
    """Return the tables of the rows that were run, as Markdown."""
    figures = {row.key: row for row in ablation.rows}
    view = "" if ablation.azimuth_deg is None else f", within {ablation.azimuth_deg:g} deg of straight ahead"
    first = ablation.rows[0].box_figures
    scope = (
        f"{len(ablation.logs)} log{'s' * (len(ablation.logs) > 1)}, {ablation.num_sweeps} sweeps "
        f"({ablation.num_rejected_sweeps} rejected){view}, {first.num_objects} movers, "
        f"{_detection(first, '3D', 'L1').num_truths} boxes to find (L1). Profile {ablation.config['profile']}. "
        f"Score cut of P, R, errors and tracks: {ablation.min_score:g}."
    )
    header = "3D AP % | 90 % | 3D AP L2 % | BEV AP % | P % | R % | centre m | size m | yaw deg | purity % | complete %"
    tables = [
        render_rows(
            title, f"boxes | {header}", [(row.name, *_cells(figures[row.key])) for row in rows if row.key in figures]
        )
        for title, rows in BOX_TABLES.items()
    ]
    return "\n\n".join(filter(None, [scope, *tables])) + "\n"


def _cells(row: RowFigures) -> Row:
    boxes, tracks = row.box_figures, row.tracks
    level_1, level_2, bev = (_detection(boxes, *kind) for kind in (("3D", "L1"), ("3D", "L2"), ("BEV", "L1")))
    return (
        format_percent(level_1.ap),
        format_interval(level_1.ap_interval),
        *map(format_percent, (level_2.ap, bev.ap, level_1.precision, level_1.recall)),
        format_number(boxes.errors.center_median_m),
        format_number(boxes.errors.size_median_m),
        format_degrees(boxes.errors.yaw_median_rad),
        format_percent(tracks.purity if tracks else None),
        format_percent(tracks.completeness if tracks else None),
    )


def _detection(boxes: BoxFigures, overlap: Overlap, level: Level) -> DetectionFigures:
    return next(one for one in boxes.detection if (one.overlap, one.level) == (overlap, level))
