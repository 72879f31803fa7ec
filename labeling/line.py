"""The whole line in one process, without Ray: the documentation of the method and the oracle of the distributed run.

reader -> ground -> static -> decomposition -> flow -> proposals | tracking -> registration -> refinement (-> joining)
            (per sweep, within a sliding window: observe_sweeps)      (over the segment: label_tracks)
"""

import hashlib
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from labeling.geometry.transforms import invert, rotate_vectors, transform_points
from labeling.geometry.visibility import is_vacated
from labeling.readers.external_flow import read_external_flow
from labeling.readers.reader import SegmentReader, sweep_range
from labeling.stages.adoption import adopt_strays
from labeling.stages.decomposition import decompose
from labeling.stages.flow import FlowPlan, finish_flow, plan_flow
from labeling.stages.ground import segment_ground
from labeling.stages.joining import join_tracks
from labeling.stages.nsfp import FitResult, fit_nets
from labeling.stages.proposals import propose_boxes
from labeling.stages.refinement import Scorer, SweepClock, is_mover, refine_track
from labeling.stages.registration import register_track
from labeling.stages.scoring import score_rows
from labeling.stages.static import GroundedSweep, remove_static, voting_sweeps
from labeling.stages.targets import FlowTarget
from labeling.stages.tracking import link_proposals
from schemas.arrays import BoolArray, Float32Array, Int64Array
from schemas.config import LabelingConfig
from schemas.errors import UnreadableSweep
from schemas.frames import MotionMask
from schemas.objects import DynamicPoints, LabeledTrack, Proposal, SweepFlow, SweepObservation, SweepPoints, Track

LONG_LOOK_S = 0.4  # in which a walker leaves his place
FAR_GAP_TOLERANCE = 0.2  # share by which the gap to a far sweep may differ from the wanted one


@dataclass(frozen=True, slots=True, eq=False)
class ObservedSweep:
    """A sweep with its ground and the points that may move: what the flow of its neighbours needs."""

    grounded: GroundedSweep
    motion: MotionMask


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
    window = _Window(reader, config)
    for index in indices:
        window.advance(index)
        try:
            yield window.prepare(index)
        except UnreadableSweep as error:
            yield _rejected_observation(index, int(reader.timestamps_ns[index]), str(error))


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

    has_flow = config.flow.method != "none"
    tracks = link_proposals(proposals_of_sweeps, config.tracking, segment_id, has_flow=has_flow)
    for _ in range(config.joining.rounds):
        tracks = join_tracks(tracks, [complete(track) for track in tracks], config.joining, segment_id)
        completed = [complete(track) for track in tracks]
        tracks = adopt_strays(tracks, completed, proposals_of_sweeps, config.joining, segment_id)
    labeled = [complete(track) for track in tracks]
    labeled = [track for track in labeled if is_mover(track, config.refinement)]
    return sorted(labeled, key=lambda t: (int(t.sweep_index[0]), t.track_id))


def make_clock(observations: Iterable[SweepObservation]) -> SweepClock:
    """Return when the usable sweeps were taken."""
    used = [(o.sweep_index, o.timestamp_ns) for o in observations if not o.is_rejected]
    table = np.array(used, dtype=np.int64).reshape(-1, 2)
    return SweepClock(table[:, 0], table[:, 1])


def rng_for(config: LabelingConfig, segment_id: str, timestamp_ns: int, *key: int) -> np.random.Generator:
    """Return a generator seeded by the data's own key: any worker, order or retry draws the same."""
    text = f"{config.seed}/{segment_id}/{timestamp_ns}/{key}"
    return np.random.default_rng(int.from_bytes(hashlib.sha256(text.encode()).digest()[:16], "little"))


class _Window:
    """The sweeps around the current one: each read once, judged once, dropped when out of reach."""

    def __init__(self, reader: SegmentReader, config: LabelingConfig) -> None:
        self._reader, self._config = reader, config
        self._grounded: dict[int, GroundedSweep] = {}
        self._motion: dict[int, MotionMask] = {}
        self._rejected: dict[int, str] = {}

    def advance(self, index: int) -> None:
        """Forget the sweeps that no later sweep needs."""
        oldest = min(self._voters(index, reach=1), default=index)
        oldest = min([oldest, *self._flow_neighbors(index), *self._far_neighbors(index)])
        for held in [k for k in self._grounded if k < oldest]:
            del self._grounded[held]
            self._motion.pop(held, None)

    def prepare(self, index: int) -> SweepWork:
        """Find the ground, the dynamic points and the fits of one sweep.

        Raises:
            UnreadableSweep: The sweep cannot be used; the message says why.

        """
        current = self._observed(index)
        if current is None:
            raise UnreadableSweep(self._rejected[index])
        config, segment_id = self._config, self._reader.segment_id
        sweep, ground, motion = current.grounded.sweep, current.grounded.ground, current.motion
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
            is_vacated=self._vacated(index, sweep.points_ego[rows]),
        )
        targets = self._targets(index)

        def rng_of_cluster(cluster: int) -> np.random.Generator:
            return rng_for(config, segment_id, sweep.timestamp_ns, 1, cluster)

        plan = None
        if targets and config.flow.external_folder is None:
            scan = None if sweep.scan_of_point is None else sweep.scan_of_point[rows]
            plan = plan_flow(
                dynamic.points_ego,
                clusters,
                targets,
                config.flow,
                rng_of_cluster,
                is_vacated=dynamic.is_vacated,
                scan=scan,
                origin_ref=dynamic.sensor_origin_ego,
            )
        elif targets and targets[0].gap_s > 0:
            folder = str(config.flow.external_folder)
            flow_ego_m = read_external_flow(folder, segment_id, sweep.timestamp_ns, sweep.num_points)
            plan = FlowPlan(flow_ego_m[rows], targets[0].gap_s, clusters.num_clusters, batches=())
        num_ground, num_static = int(ground.is_ground.sum()), int(motion.is_static.sum())
        obstacle_rows = np.flatnonzero(~ground.is_ground)
        obstacles_ego = sweep.points_ego[obstacle_rows]
        return SweepWork(dynamic, plan, obstacle_rows, obstacles_ego, sweep.num_points, num_ground, num_static)

    def _read(self, index: int) -> GroundedSweep | None:
        if index in self._grounded:
            return self._grounded[index]
        if index in self._rejected:
            return None
        try:
            sweep = self._reader.read_sweep(index)
        except UnreadableSweep as error:
            self._rejected[index] = str(error)
            return None
        rng = rng_for(self._config, self._reader.segment_id, sweep.timestamp_ns, 0)
        self._grounded[index] = GroundedSweep(sweep, segment_ground(sweep.points_ego, self._config.ground, rng))
        return self._grounded[index]

    def _voters(self, index: int, reach: int = 0) -> Int64Array:
        """Return the sweeps that judge sweep ``index`` or one ``reach`` flow neighbours away."""
        neighbors = [index, *self._flow_neighbors(index), *self._far_neighbors(index)] if reach else [index]
        timestamps = self._reader.timestamps_ns
        return np.unique(np.concatenate([voting_sweeps(timestamps, k, self._config.static) for k in neighbors]))

    def _observed(self, index: int) -> ObservedSweep | None:
        grounded = self._read(index)
        if grounded is None:
            return None
        if index not in self._motion:
            others = [self._read(int(k)) for k in self._voters(index)]
            window = [other for other in others if other is not None]
            self._motion[index] = remove_static(grounded, window, self._config.static)
        return ObservedSweep(grounded, self._motion[index])

    def _flow_neighbors(self, index: int) -> list[int]:
        """Return the sweeps flow looks at, first the one whose displacement is wanted; [] when none is in reach."""
        params = self._config.flow
        if params.method == "none":
            return []
        gap_s = (self._reader.timestamps_ns - self._reader.timestamps_ns[index]) * 1e-9
        is_usable = (np.abs(gap_s) <= params.max_gap_s) & (gap_s != 0)
        is_usable[list(self._rejected)] = False
        later = [int(k) for k in np.flatnonzero(is_usable & (gap_s > 0))]
        earlier = [int(k) for k in np.flatnonzero(is_usable & (gap_s < 0))[::-1]]
        primary, secondary = (later, earlier) if later else (earlier, later)
        num_support = params.support_sweeps if params.method in ("nsfp++", "rigid") else 0
        return [*primary[:1], *primary[1:num_support], *secondary[:num_support]]

    def _far_neighbors(self, index: int) -> list[int]:
        """Return the sweeps that what seems slow is looked at in besides: those nearest to the wanted gaps."""
        params = self._config.flow
        if params.method not in ("nsfp++", "rigid"):
            return []
        gap_s = (self._reader.timestamps_ns - self._reader.timestamps_ns[index]) * 1e-9
        far = []
        for wanted_s in [sign * gap for gap in params.slow_gaps_s for sign in (1, -1)]:
            nearest = int(np.abs(gap_s - wanted_s).argmin())
            if np.abs(gap_s[nearest] - wanted_s) <= FAR_GAP_TOLERANCE * np.abs(wanted_s):
                far.append(nearest)
        return far

    def _vacated(self, index: int, points_ego: Float32Array) -> BoolArray:
        """Return (M,) which points of a sweep lie where another one of the window saw nothing.

        All of them when no other is LONG_LOOK_S away: that an object did not leave its place by then tells nothing.
        """
        others = {*self._voters(index).tolist(), *self._flow_neighbors(index), *self._far_neighbors(index)}
        held = [other for k in sorted(others) if (other := self._read(k)) is not None]
        current = self._grounded[index].sweep
        if all(abs(other.sweep.timestamp_ns - current.timestamp_ns) < LONG_LOOK_S * 1e9 for other in held):
            return np.ones(len(points_ego), dtype=bool)
        sights = [other.sight_from(current) for other in held]
        return is_vacated(sights, points_ego, self._config.static.clear_margin_m)

    def _targets(self, index: int) -> list[FlowTarget]:
        """Return the sweeps that flow looks at, carried to the frame of sweep ``index``."""
        while any(self._read(neighbor) is None for neighbor in self._flow_neighbors(index)):
            pass  # the unreadable one is rejected now, and the next one steps in
        near = self._flow_neighbors(index)
        far = [k for k in self._far_neighbors(index) if k not in near] if near else []
        targets = []
        current = self._grounded[index].sweep
        for neighbor in [*near, *far]:
            observed = self._observed(neighbor)
            if observed is None:
                continue
            sweep = observed.grounded.sweep
            ref_from_ego = invert(current.world_from_ego) @ sweep.world_from_ego
            points = transform_points(ref_from_ego, sweep.points_ego).astype(np.float32)
            scan, stands = sweep.scan_of_point, ~observed.grounded.ground.is_ground
            targets.append(
                FlowTarget(
                    (sweep.timestamp_ns - current.timestamp_ns) * 1e-9,
                    points[observed.motion.is_dynamic],
                    points[stands],
                    is_far=neighbor in far,
                    scan=None if scan is None else scan[observed.motion.is_dynamic],
                    standing_scan=None if scan is None else scan[stands],
                    origin_ref=transform_points(ref_from_ego, sweep.sensor_origins_ego.mean(axis=0, keepdims=True))[0],
                )
            )
        return targets


def _rejected_observation(index: int, timestamp_ns: int, reason: str) -> SweepObservation:
    return SweepObservation(index, timestamp_ns, np.eye(4), 0, 0, 0, 0, 0, reason, proposals=(), points=None)
