"""The whole line in one process, without Ray: the documentation of the method and the oracle of the distributed run.

reader -> ground -> static -> decomposition -> flow -> proposals | tracking -> registration -> refinement (-> joining)
            (per sweep, within a sliding window: observe_sweeps)      (over the segment: label_tracks)
"""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from labeling.geometry.transforms import rotate_vectors
from labeling.readers.external_flow import read_external_flow
from labeling.readers.reader import SegmentReader, sweep_range
from labeling.seeds import rng_for
from labeling.stages.adoption import adopt_strays
from labeling.stages.decomposition import decompose
from labeling.stages.flow import FlowPlan, FlowScene, Vote, cut_votes, finish_flow, plan_flow, vote_flow
from labeling.stages.joining import join_tracks
from labeling.stages.nsfp import FitProblem, FitResult, fit_nets
from labeling.stages.proposals import propose_boxes
from labeling.stages.refinement import Scorer, SweepClock, is_mover, refine_track
from labeling.stages.registration import register_track
from labeling.stages.scoring import score_rows
from labeling.stages.tracking import link_proposals
from labeling.window import SweepWindow
from schemas.arrays import Float32Array, Int64Array
from schemas.config import LabelingConfig
from schemas.config.joining import Regrouping
from schemas.errors import UnreadableSweep
from schemas.frames import Sweep
from schemas.objects import DynamicPoints, LabeledTrack, Proposal, SweepFlow, SweepObservation, SweepPoints, Track


@dataclass(frozen=True, slots=True, eq=False)
class SweepWork:
    """One sweep, prepared: what may move in it, and what its flow is estimated from."""

    segment_id: str
    dynamic: DynamicPoints
    flow: FlowScene | FlowPlan | None  # a plan: it was read from a file; None: no other sweep is in reach
    vote_batches: tuple[Int64Array, ...]  # clusters to be asked for their motion
    next_gap_s: float | None  # to the sweep that displacements are written to; None: none follows soon
    obstacle_rows: Int64Array  # (N,) rows of the points that are neither ground nor vehicle, ascending
    obstacles_ego: Float32Array  # (N, 3)
    num_points: int
    num_ground: int
    num_static: int


def observe_sweeps(reader: SegmentReader, config: LabelingConfig) -> Iterator[SweepObservation]:
    """Yield what each sweep of ``config.sweeps`` shows, in order, holding no more than a window of sweeps.

    Every sweep of the range is yielded once: one that cannot be used comes as rejected, with its reason. Sweeps outside
    the range are read where a window reaches them, so that a part of a segment is labelled as in the whole.

    Raises:
        InvalidInput: ``config.sweeps`` lies outside the segment.

    """
    for work in prepare_sweeps(reader, config, sweep_range(reader, config)):
        yield observe(work, config)


def observe(work: SweepWork | SweepObservation, config: LabelingConfig) -> SweepObservation:
    """Say what a prepared sweep shows: vote, plan, fit and finish."""
    if isinstance(work, SweepObservation):
        return work
    plan = vote_and_plan(work, config)
    return finish_sweep(work, plan, fit_plan(plan, config), config)


def prepare_sweeps(
    reader: SegmentReader, config: LabelingConfig, indices: range
) -> Iterator[SweepWork | SweepObservation]:
    """Yield the work of each sweep up to its votes, or the observation of a rejected one, in order.

    Any split of a segment into ranges gives the same work: windows reach beyond the range.
    """
    window = SweepWindow(reader, config)
    for index in indices:
        window.advance(index)
        yield prepare_sweep(window, index, config)


def prepare_sweep(window: SweepWindow, index: int, config: LabelingConfig) -> SweepWork | SweepObservation:
    """Find the points of a sweep that may move and their clusters; or say why it is rejected."""
    try:
        return _prepare_usable(window, index, config)
    except UnreadableSweep as error:
        reason = str(error)
    nothing = (0, 0, 0, 0, 0)
    return SweepObservation(index, window.timestamp_ns(index), np.eye(4), *nothing, reason, proposals=(), points=None)


def _prepare_usable(window: SweepWindow, index: int, config: LabelingConfig) -> SweepWork:
    grounded = window.grounded(index)
    sweep, ground, motion = grounded.sweep, grounded.ground, window.motion(index)
    clusters = decompose(sweep.points_ego, grounded.beams, motion.is_dynamic, config.decomposition)
    rows = clusters.point_rows
    dynamic = DynamicPoints(
        sweep_index=index,
        timestamp_ns=sweep.timestamp_ns,
        world_from_ego=sweep.world_from_ego,
        clusters=clusters,
        points_ego=sweep.points_ego[rows],
        beams=grounded.beams.of(rows),
        capture_offset_s=sweep.capture_offset_s[rows],
        height_m=ground.height_m[rows],
        is_vacated=window.is_vacated(index, rows),
    )
    flow = _flow_of(window, dynamic, sweep, config)
    obstacle_rows = np.flatnonzero(grounded.is_standing)
    return SweepWork(
        window.segment_id,
        dynamic,
        flow,
        cut_votes(flow, config.flow) if isinstance(flow, FlowScene) else (),
        window.next_gap_s(index),
        obstacle_rows,
        sweep.points_ego[obstacle_rows],
        num_points=sweep.num_points,
        num_ground=int(ground.is_ground.sum()),
        num_static=int(motion.is_static.sum()),
    )


def _flow_of(
    window: SweepWindow, dynamic: DynamicPoints, sweep: Sweep, config: LabelingConfig
) -> FlowScene | FlowPlan | None:
    targets = window.targets(sweep.index)
    rows, clusters = dynamic.clusters.point_rows, dynamic.clusters
    if targets and config.flow.external_folder is None:
        return FlowScene(
            dynamic.points_ego,
            dynamic.beams,
            clusters,
            tuple(target.asked_from(dynamic.points_ego) for target in targets),
            is_vacated=dynamic.is_vacated,
        )
    next_gap_s = window.next_gap_s(sweep.index)
    if targets and next_gap_s is not None:
        flow_ego_m = read_external_flow(window.listing, sweep.timestamp_ns, sweep.num_points)
        return FlowPlan(flow_ego_m[rows], next_gap_s, is_failed=np.zeros(clusters.num_clusters, dtype=bool))
    return None


def vote_and_plan(work: SweepWork, config: LabelingConfig) -> FlowPlan | None:
    """Find what is known of a sweep's flow before its nets; None: it has no flow."""
    return plan_sweep(work, [vote_sweep(work, batch, config) for batch in work.vote_batches], config)


def vote_sweep(work: SweepWork, batch: Int64Array, config: LabelingConfig) -> Vote:
    """Ask some clusters of a sweep, one of its batches or a part of one, for their motion."""
    assert isinstance(work.flow, FlowScene)  # else it has no batches
    return vote_flow(work.flow, batch, config.flow)


def plan_sweep(work: SweepWork, votes: Sequence[Vote], config: LabelingConfig) -> FlowPlan | None:
    """Make the plan of a sweep from the votes of all its batches, or parts of them, in any order."""
    if not isinstance(work.flow, FlowScene):
        return work.flow

    def rng_of_cluster(cluster: int) -> np.random.Generator:
        return rng_for(config, work.segment_id, work.dynamic.timestamp_ns, 1, cluster)

    return plan_flow(work.flow, votes, config.flow, rng_of_cluster)


def fit_batches(plan: FlowPlan | None) -> Sequence[Sequence[FitProblem]]:
    """Return the fits of a sweep, in batches."""
    return plan.batches if plan else ()


def fit_plan(plan: FlowPlan | None, config: LabelingConfig) -> list[list[FitResult]]:
    """Fit all nets of a sweep."""
    return [fit_nets(batch, config.flow) for batch in fit_batches(plan)]


def finish_sweep(
    work: SweepWork, plan: FlowPlan | None, fits: Sequence[Sequence[FitResult]], config: LabelingConfig
) -> SweepObservation:
    """Turn the fitted flow of a sweep into proposals and all else that is said of the sweep."""
    dynamic = work.dynamic
    flow = finish_flow(plan, fits) if plan else None
    proposals: tuple[Proposal, ...] = ()
    if flow is not None:
        velocity_mps = (flow.flow_ref_m / flow.gap_s).astype(np.float32)
        proposals = propose_boxes(dynamic, velocity_mps, config.proposals)
    elif config.flow.method == "none":
        proposals = propose_boxes(dynamic, None, config.proposals)
    return SweepObservation(
        sweep_index=dynamic.sweep_index,
        timestamp_ns=dynamic.timestamp_ns,
        world_from_ego=dynamic.world_from_ego,
        num_points=work.num_points,
        num_ground=work.num_ground,
        num_static=work.num_static,
        num_clusters=dynamic.clusters.num_clusters,
        num_failed_fits=int(flow.is_failed.sum()) if flow is not None else 0,
        reason="",
        proposals=proposals,
        points=_describe_points(work, flow),
    )


def _describe_points(work: SweepWork, flow: SweepFlow | None) -> SweepPoints:
    clusters = work.dynamic.clusters
    place = np.searchsorted(work.obstacle_rows, clusters.point_rows)
    is_dynamic = np.zeros(len(work.obstacle_rows), dtype=bool)
    is_dynamic[place] = True
    cluster_id = np.zeros(len(work.obstacle_rows), dtype=np.int32)
    cluster_id[place] = clusters.cluster_of_point
    flow_world_m = None
    if flow is not None and work.next_gap_s is not None:
        to_next = work.next_gap_s / flow.gap_s  # 1 but where sweeps are denser than the gaps that flow looks over
        flow_world_m = np.zeros((len(work.obstacle_rows), 3), dtype=np.float32)
        flow_world_m[place] = rotate_vectors(work.dynamic.world_from_ego, to_next * flow.flow_ref_m)
    return SweepPoints(work.obstacles_ego, work.obstacle_rows.astype(np.int32), is_dynamic, cluster_id, flow_world_m)


def label_tracks(
    proposals_of_sweeps: Sequence[Sequence[Proposal]],
    clock: SweepClock,
    config: LabelingConfig,
    segment_id: str,
    score: Scorer = score_rows,
) -> list[LabeledTrack]:
    """Link, complete and refine the proposals of a segment into labelled tracks, ordered by first sweep.

    Tracks that turn out to be pieces of one object, once completed, are joined, take up the proposals that no track has
    and that are pieces of theirs, and are completed again.
    """
    tracks = link_tracks(proposals_of_sweeps, clock, config, segment_id)
    labeled = [complete_track(track, clock, config, score) for track in tracks]
    for step in config.joining.regroupings:
        found = regroup_tracks(step, tracks, labeled, proposals_of_sweeps, config, segment_id)
        labeled = [labeled[t] if isinstance(t, int) else complete_track(t, clock, config, score) for t in found]
        tracks = [tracks[t] if isinstance(t, int) else t for t in found]
    return finish_tracks(labeled, config)


def link_tracks(
    proposals_of_sweeps: Sequence[Sequence[Proposal]], clock: SweepClock, config: LabelingConfig, segment_id: str
) -> list[Track]:
    """Link what was seen sweep after sweep."""
    has_flow = config.flow.method != "none"
    return link_proposals(proposals_of_sweeps, config.tracking, segment_id, clock.period_s, has_flow=has_flow)


def complete_track(track: Track, clock: SweepClock, config: LabelingConfig, score: Scorer = score_rows) -> LabeledTrack:
    """Find the whole object from its views. It depends on no other track."""
    return refine_track(register_track(track, config.registration), clock, config.refinement, score)


def regroup_tracks(
    step: Regrouping,
    tracks: Sequence[Track],
    labeled: Sequence[LabeledTrack],  # what each was completed to
    proposals_of_sweeps: Sequence[Sequence[Proposal]],
    config: LabelingConfig,
    segment_id: str,
) -> list[Track | int]:
    """Return the tracks, joined or with strays: of each that stays its position, and those still to complete."""
    if step == "tracks":
        found = join_tracks(tracks, labeled, config.joining, segment_id)
    else:
        found = adopt_strays(tracks, labeled, proposals_of_sweeps, config.joining, segment_id)
    position = {track: k for k, track in enumerate(tracks)}
    return [position.get(track, track) for track in found]


def finish_tracks(labeled: Sequence[LabeledTrack], config: LabelingConfig) -> list[LabeledTrack]:
    """Return the tracks of what moved, in the order in which they are written."""
    movers = [track for track in labeled if is_mover(track, config.refinement)]
    return sorted(movers, key=lambda track: (int(track.sweep_index[0]), track.track_id))


def make_clock(observations: Iterable[SweepObservation]) -> SweepClock:
    """Return when the usable sweeps were taken."""
    used = [(o.sweep_index, o.timestamp_ns) for o in observations if not o.is_rejected]
    table = np.array(used, dtype=np.int64).reshape(-1, 2)
    return SweepClock(table[:, 0], table[:, 1])
