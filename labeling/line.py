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
from labeling.stages.flow import FlowPlan, finish_flow, plan_flow
from labeling.stages.joining import join_tracks
from labeling.stages.nsfp import FitResult, fit_nets
from labeling.stages.proposals import propose_boxes
from labeling.stages.refinement import Scorer, SweepClock, is_mover, refine_track
from labeling.stages.registration import register_track
from labeling.stages.scoring import score_rows
from labeling.stages.tracking import link_proposals
from labeling.window import SweepWindow
from schemas.arrays import Float32Array, Int64Array
from schemas.config import LabelingConfig
from schemas.errors import UnreadableSweep
from schemas.frames import Sweep
from schemas.objects import DynamicPoints, LabeledTrack, Proposal, SweepFlow, SweepObservation, SweepPoints, Track


@dataclass(frozen=True, slots=True, eq=False)
class SweepWork:
    """One sweep between its two halves: what was found before the nets, and the fits still to do."""

    dynamic: DynamicPoints
    plan: FlowPlan | None  # None: no other sweep in reach of the flow
    obstacle_rows: Int64Array  # (N,) rows of the points that are not ground, ascending
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
        if isinstance(work, SweepObservation):
            yield work
        else:
            fits = [fit_nets(batch, config.flow) for batch in work.plan.batches] if work.plan else []
            yield finish_sweep(work, fits, config)


def prepare_sweeps(
    reader: SegmentReader, config: LabelingConfig, indices: range
) -> Iterator[SweepWork | SweepObservation]:
    """Yield the work of each sweep up to its fits, or the observation of a rejected one, in order.

    Any split of a segment into ranges gives the same work: windows reach beyond the range.
    """
    window = SweepWindow(reader, config)
    for index in indices:
        window.advance(index)
        try:
            yield _prepare_sweep(window, index, config)
        except UnreadableSweep as error:
            yield _rejected_observation(index, int(reader.timestamps_ns[index]), str(error))


def _prepare_sweep(window: SweepWindow, index: int, config: LabelingConfig) -> SweepWork:
    """Find the ground, the points that may move, their clusters, and the fits to do.

    Raises:
        UnreadableSweep: The sweep cannot be used; the message says why.

    """
    grounded = window.grounded(index)
    sweep, ground, motion = grounded.sweep, grounded.ground, window.motion(index)
    clusters = decompose(sweep.points_ego, motion.is_dynamic, config.decomposition)
    rows = clusters.point_rows
    dynamic = DynamicPoints(
        sweep_index=index,
        timestamp_ns=sweep.timestamp_ns,
        world_from_ego=sweep.world_from_ego,
        sensor_origin_ego=sweep.sensor_origins_ego.mean(axis=0, dtype=np.float64),
        clusters=clusters,
        points_ego=sweep.points_ego[rows],
        capture_offset_s=sweep.capture_offset_s[rows],
        height_m=ground.height_m[rows],
        is_vacated=window.is_vacated(index, rows),
    )
    obstacle_rows = np.flatnonzero(~ground.is_ground)
    return SweepWork(
        dynamic,
        _plan(window, dynamic, sweep, config),
        obstacle_rows,
        sweep.points_ego[obstacle_rows],
        num_points=sweep.num_points,
        num_ground=int(ground.is_ground.sum()),
        num_static=int(motion.is_static.sum()),
    )


def _plan(window: SweepWindow, dynamic: DynamicPoints, sweep: Sweep, config: LabelingConfig) -> FlowPlan | None:
    targets = window.targets(sweep.index)
    rows, clusters = dynamic.clusters.point_rows, dynamic.clusters
    if targets and config.flow.external_folder is None:
        return plan_flow(
            dynamic.points_ego,
            clusters,
            targets,
            config.flow,
            lambda cluster: rng_for(config, window.segment_id, sweep.timestamp_ns, 1, cluster),
            is_vacated=dynamic.is_vacated,
            scan=None if sweep.scan_of_point is None else sweep.scan_of_point[rows],
            origin_ref=dynamic.sensor_origin_ego,
        )
    if targets and targets[0].gap_s > 0:
        flow_ego_m = read_external_flow(window.listing, sweep.timestamp_ns, sweep.num_points)
        return FlowPlan(flow_ego_m[rows], targets[0].gap_s, clusters.num_clusters, batches=())
    return None


def finish_sweep(work: SweepWork, fits: Sequence[Sequence[FitResult]], config: LabelingConfig) -> SweepObservation:
    """Turn the fitted flow of a sweep into proposals and all else that is said of the sweep."""
    dynamic = work.dynamic
    flow = finish_flow(work.plan, fits) if work.plan else None
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
    if flow is not None and flow.gap_s > 0:
        flow_world_m = np.zeros((len(work.obstacle_rows), 3), dtype=np.float32)
        flow_world_m[place] = rotate_vectors(work.dynamic.world_from_ego, flow.flow_ref_m)
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
    done: dict[Track, LabeledTrack] = {}

    def complete(track: Track) -> LabeledTrack:
        if track not in done:
            done[track] = refine_track(register_track(track, config.registration), clock, config.refinement, score)
        return done[track]

    has_flow, joining = config.flow.method != "none", config.joining
    tracks = link_proposals(proposals_of_sweeps, config.tracking, segment_id, has_flow=has_flow)
    for _ in range(joining.rounds):
        if joining.has("tracks"):
            tracks = join_tracks(tracks, [complete(track) for track in tracks], joining, segment_id)
        if joining.has("strays"):
            completed = [complete(track) for track in tracks]
            tracks = adopt_strays(tracks, completed, proposals_of_sweeps, joining, segment_id)
    labeled = [complete(track) for track in tracks]
    labeled = [track for track in labeled if is_mover(track, config.refinement)]
    return sorted(labeled, key=lambda t: (int(t.sweep_index[0]), t.track_id))


def make_clock(observations: Iterable[SweepObservation]) -> SweepClock:
    """Return when the usable sweeps were taken."""
    used = [(o.sweep_index, o.timestamp_ns) for o in observations if not o.is_rejected]
    table = np.array(used, dtype=np.int64).reshape(-1, 2)
    return SweepClock(table[:, 0], table[:, 1])


def _rejected_observation(index: int, timestamp_ns: int, reason: str) -> SweepObservation:
    return SweepObservation(index, timestamp_ns, np.eye(4), 0, 0, 0, 0, 0, reason, proposals=(), points=None)
