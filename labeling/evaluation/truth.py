"""The truth of one segment: annotated boxes, who moves when, and what its points do.

When a box speaks. A lidar turns while objects drive. An annotated cuboid stands where the beam met its object, so it
speaks for the mean capture time of that object's points (the sweep's stamp, where no point tells). A label row does the
same: its ``timestamp_ns`` is that mean capture time and its box is where the object was then. Truth and label of one
sweep are therefore compared as they stand, both in the ego frame at the sweep's stamp, and neither is moved in time.
Speeds divide by the difference of capture times where both ends have one.

Who moves. Speed is the horizontal central difference of the world centre over the annotations within +-0.25 s,
one-sided at the ends; where annotations are sparser than that, over the neighbouring ones. A *mover* exceeds 1 m/s in
at least three consecutive annotated sweeps of the log (in all of them where a log has fewer); it is *moving* in those
sweeps where it exceeds 1 m/s. Annotations of instants whose sweep is not there tell of motion all the same.
"""

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from labeling.geometry.boxes import points_in_box
from labeling.geometry.times import seconds_between
from labeling.geometry.transforms import invert, transform_points, yaw_translation
from labeling.readers.reader import AnnotatedBetweenSweeps, SegmentReader
from schemas.arrays import BoolArray, Float32Array, Float64Array, FloatArray, Int64Array
from schemas.errors import UnreadableSweep
from schemas.frames import Annotations, PointTruth, Sweep
from schemas.objects import BOX_HEIGHT, BOX_LENGTH, BOX_WIDTH, BOX_YAW

BOX_MARGIN_M: Final = 0.05  # a truth box is grown by this before its points are counted
MOVING_MPS: Final = 1.0
SPEED_WINDOW_NS: Final = 250_000_000  # half width of the central difference
MIN_MOVING_RUN: Final = 3  # consecutive annotated sweeps
MAX_GAP_S: Final = 0.55  # after a longer silence a sweep has no flow
DOMAIN_M: Final = 50.0  # |x|, |y| of the points that count
GROUND_CELL_M: Final = 1.0
GROUND_HEIGHT_M: Final = 0.3


@dataclass(frozen=True, slots=True, eq=False)
class SegmentTruth:
    """Annotated boxes of a segment, one row per (sweep, object), ordered by sweep.

    Rows of sweep t are ``row_offsets[t] : row_offsets[t + 1]``.
    """

    segment_id: str
    timestamps_ns: Int64Array  # (T,)
    world_from_ego: Float64Array  # (T, 4, 4); NaN where the sweep cannot be read
    is_annotated: BoolArray  # (T,)
    row_offsets: Int64Array  # (T + 1,)
    object_ids: tuple[str, ...]  # K
    is_mover: BoolArray  # (K,)
    object_index: Int64Array  # (R,)
    boxes_ego: Float64Array  # (R, 7) ego frame of their sweep
    speed_mps: Float64Array  # (R,) horizontal
    num_points: Int64Array  # (R,) in the grown box
    is_moving: BoolArray  # (R,)

    def rows_of(self, sweep_index: int) -> slice:
        """Return the rows of one sweep."""
        return slice(int(self.row_offsets[sweep_index]), int(self.row_offsets[sweep_index + 1]))

    def gap_s(self, sweep_index: int) -> float:
        """Return the time to the next sweep, infinite for the last one."""
        if sweep_index + 1 >= len(self.timestamps_ns):
            return float("inf")
        return seconds_between(int(self.timestamps_ns[sweep_index + 1]), int(self.timestamps_ns[sweep_index]))


@dataclass(frozen=True, slots=True, eq=False)
class SweepPointTruth:
    """What the points of one sweep truly do. Rows are the source sweep's."""

    is_domain: BoolArray  # (N,) within reach and view, not ground, and known to move or not
    is_in_box: BoolArray  # (N,) of any annotated object
    is_moving: BoolArray  # (N,)
    flow_ego_m: (
        Float64Array | None
    )  # (N, 3) to the next sweep, ego motion removed, NaN rows unknown; None: no flow here


def points_in_boxes(
    points: Float32Array,  # (N, 3)
    boxes: Float64Array,  # (B, 7) same frame
) -> list[Int64Array]:
    """Return the rows of the points in each box grown by BOX_MARGIN_M, ascending."""
    order = np.argsort(points[:, 0], kind="stable")
    sorted_x = points[order, 0]
    reach = np.hypot(boxes[:, BOX_LENGTH], boxes[:, BOX_WIDTH]) / 2 + 3 * BOX_MARGIN_M
    starts = np.searchsorted(sorted_x, boxes[:, 0] - reach, side="left")
    stops = np.searchsorted(sorted_x, boxes[:, 0] + reach, side="right")
    rows = []
    for box, start, stop in zip(boxes, starts, stops, strict=True):
        near = order[start:stop]
        rows.append(np.sort(near[points_in_box(points[near], box, BOX_MARGIN_M)]))
    return rows


def horizontal_speed_mps(
    stamps_ns: Int64Array,  # (S,) ascending stamps of one object's annotations
    capture_s: Float64Array,  # (S,) capture time of its points after the stamp; NaN where it has none
    centers_world: Float64Array,  # (S, 3)
) -> Float64Array:
    """Return (S,) speeds by central difference over +-0.25 s; zero where an object is known at one instant only."""
    position = np.arange(len(stamps_ns))
    first = np.searchsorted(stamps_ns, stamps_ns - SPEED_WINDOW_NS, side="left")
    last = np.searchsorted(stamps_ns, stamps_ns + SPEED_WINDOW_NS, side="right") - 1
    is_sparse = first == last
    first = np.where(is_sparse, np.maximum(position - 1, 0), first)
    last = np.where(is_sparse, np.minimum(position + 1, len(position) - 1), last)
    duration_s = seconds_between(stamps_ns[last], stamps_ns[first])
    duration_s += np.nan_to_num(capture_s[last] - capture_s[first])
    distance_m = np.linalg.norm((centers_world[last] - centers_world[first])[:, :2], axis=1)
    speed: Float64Array = np.divide(distance_m, duration_s, out=np.zeros(len(position)), where=duration_s > 0)
    return speed


def has_moving_run(is_fast: BoolArray, ordinal: Int64Array, min_run: int) -> bool:
    """Tell whether ``min_run`` consecutive ordinals are fast; ``ordinal`` numbers the annotated instants of the log."""
    fast = ordinal[is_fast]
    if len(fast) < min_run:
        return False
    return bool((fast[min_run - 1 :] - fast[: len(fast) - min_run + 1] == min_run - 1).any())


def decide_motion(
    stamps_ns: Int64Array,  # (R,) stamp of each row's annotation
    object_index: Int64Array,  # (R,)
    centers_world: Float64Array,  # (R, 3); NaN where no pose tells
    capture_s: Float64Array,  # (R,) NaN where unknown
    num_objects: int,
) -> tuple[Float64Array, BoolArray]:
    """Return the (R,) speed of each row, NaN without a pose, and which of the (K,) objects are movers."""
    annotated_ns = np.unique(stamps_ns)
    min_run = min(MIN_MOVING_RUN, len(annotated_ns))
    ordinal = np.searchsorted(annotated_ns, stamps_ns)
    speed_mps = np.full(len(stamps_ns), np.nan)
    is_mover = np.zeros(num_objects, dtype=bool)
    by_object = np.lexsort((stamps_ns, object_index))
    bounds = np.searchsorted(object_index[by_object], np.arange(num_objects + 1))
    for index in range(num_objects):
        rows = by_object[bounds[index] : bounds[index + 1]]
        rows = rows[np.isfinite(centers_world[rows]).all(axis=1)]
        speed_mps[rows] = horizontal_speed_mps(stamps_ns[rows], capture_s[rows], centers_world[rows])
        is_mover[index] = has_moving_run(speed_mps[rows] > MOVING_MPS, ordinal[rows], min_run)
    return speed_mps, is_mover


def read_truth(reader: SegmentReader, progress: Callable[[int], None] | None = None) -> SegmentTruth:
    """Read annotations and sweeps of a segment, one sweep in memory at a time.

    A sweep that cannot be read keeps its annotations: an object's speed and number of points there are those it has
    in its nearest readable sweep.

    Args:
        reader: The segment.
        progress: Called with 1 after each sweep.

    """
    num_sweeps = len(reader.timestamps_ns)
    poses = np.full((num_sweeps, 4, 4), np.nan)
    is_annotated = np.zeros(num_sweeps, dtype=bool)
    index_of_object: dict[str, int] = {}
    objects: list[int] = []
    boxes, centers, points = [np.zeros((0, 7))], [np.zeros((0, 3))], [np.zeros((0, 2))]
    num_rows = np.zeros(num_sweeps, dtype=np.int64)
    for index in range(num_sweeps):
        annotations = reader.read_annotations(index)
        sweep = _read_sweep(reader, index)
        if sweep is not None:
            poses[index] = sweep.world_from_ego
        if annotations is not None:
            is_annotated[index] = True
            num_rows[index] = len(annotations.track_ids)
            objects.extend(index_of_object.setdefault(name, len(index_of_object)) for name in annotations.track_ids)
            boxes.append(annotations.boxes_ego)
            centers.append(transform_points(poses[index], annotations.boxes_ego[:, :3]))
            points.append(_count_points(sweep, annotations.boxes_ego))
        if progress is not None:
            progress(1)

    stamps_ns = np.repeat(reader.timestamps_ns, num_rows)
    num_own = len(stamps_ns)
    for timestamp_ns, world_from_ego, annotations in _annotations_between(reader):
        stamps_ns = np.append(stamps_ns, np.full(len(annotations.track_ids), timestamp_ns))
        objects.extend(index_of_object.setdefault(name, len(index_of_object)) for name in annotations.track_ids)
        centers.append(transform_points(world_from_ego, annotations.boxes_ego[:, :3]))
        points.append(_count_points(None, annotations.boxes_ego))
    object_index = np.array(objects, dtype=np.int64)
    num_points, capture_s = np.concatenate(points).T
    speed_mps, is_mover = decide_motion(
        stamps_ns, object_index, np.concatenate(centers), capture_s, len(index_of_object)
    )
    stamps_ns, object_index, speed_mps = stamps_ns[:num_own], object_index[:num_own], speed_mps[:num_own]
    source = _nearest_known(stamps_ns, object_index, np.isfinite(speed_mps))
    speed_mps = np.nan_to_num(speed_mps[source])
    return SegmentTruth(
        segment_id=reader.segment_id,
        timestamps_ns=reader.timestamps_ns,
        world_from_ego=poses,
        is_annotated=is_annotated,
        row_offsets=np.concatenate([[0], np.cumsum(num_rows)]),
        object_ids=tuple(index_of_object),
        is_mover=is_mover,
        object_index=object_index,
        boxes_ego=np.concatenate(boxes),
        speed_mps=speed_mps,
        num_points=num_points[source].astype(np.int64),
        is_moving=is_mover[object_index] & (speed_mps > MOVING_MPS),
    )


def _annotations_between(reader: SegmentReader) -> Iterable[tuple[int, Float64Array, Annotations]]:
    return reader.read_annotations_between() if isinstance(reader, AnnotatedBetweenSweeps) else ()


def _read_sweep(reader: SegmentReader, index: int) -> Sweep | None:
    try:
        return reader.read_sweep(index)
    except UnreadableSweep:
        return None  # the sweeps table of the label folder says so, and why


def _count_points(sweep: Sweep | None, boxes_ego: Float64Array) -> Float64Array:
    """Return (B, 2): number of points in each box and their mean capture time after the stamp, NaN for none."""
    counted = np.full((len(boxes_ego), 2), [0.0, np.nan])
    if sweep is not None:
        for box, rows in enumerate(points_in_boxes(sweep.points_ego, boxes_ego)):
            if len(rows):
                counted[box] = len(rows), np.mean(sweep.capture_offset_s[rows], dtype=np.float64)
    return counted


def _nearest_known(stamps_ns: Int64Array, object_index: Int64Array, is_known: BoolArray) -> Int64Array:
    """Return (R,) for each row itself when known, else the same object's known row nearest in time, else itself."""
    source = np.arange(len(stamps_ns))
    for row in np.flatnonzero(~is_known):
        known = np.flatnonzero(is_known & (object_index == object_index[row]))
        if len(known):
            source[row] = known[np.argmin(np.abs(stamps_ns[known] - stamps_ns[row]))]
    return source


def is_ground_by_height(points_ego: Float32Array) -> BoolArray:
    """Return (N,) True for points within DOMAIN_M less than 0.3 m above the lowest of their cell and the 8 around."""
    cells_a_side = 2 * int(DOMAIN_M / GROUND_CELL_M) + 4  # the domain and a rim of neighbours
    cell = np.floor(points_ego[:, :2] / GROUND_CELL_M).astype(np.int64) + cells_a_side // 2
    is_near = ((cell >= 0) & (cell < cells_a_side)).all(axis=1)
    row, column = cell[is_near].T
    lowest = np.full((cells_a_side + 2, cells_a_side + 2), np.inf, dtype=np.float32)
    np.minimum.at(lowest, (row + 1, column + 1), points_ego[is_near, 2])
    around = sliding_window_view(lowest, (3, 3)).min(axis=(2, 3))
    is_ground = np.zeros(len(points_ego), dtype=bool)
    is_ground[is_near] = points_ego[is_near, 2] < around[row, column] + GROUND_HEIGHT_M
    return is_ground


def is_in_view(points_ego: FloatArray, azimuth_deg: float | None) -> BoolArray:
    """Return (N,) True within +-``azimuth_deg`` of straight ahead, seen from the ego origin; all of them when None."""
    if azimuth_deg is None:
        return np.ones(len(points_ego), dtype=bool)
    is_inside: BoolArray = np.abs(np.arctan2(points_ego[:, 1], points_ego[:, 0])) <= np.deg2rad(azimuth_deg)
    return is_inside


def sweep_point_truth(
    truth: SegmentTruth, sweep: Sweep, point_truth: PointTruth | None, azimuth_deg: float | None
) -> SweepPointTruth | None:
    """Say what each point of a sweep does, or None where nobody knows: no annotations and no point-wise truth.

    Point-wise truth wins over boxes where it is present and finite. A point in several boxes belongs to the smallest. A
    mover that is not annotated in the next sweep has unknown flow. Moving is a point of a moving object or, by
    point-wise truth, one faster than 1 m/s.
    """
    if point_truth is None and not truth.is_annotated[sweep.index]:
        return None
    rows = truth.rows_of(sweep.index)
    boxes, objects = truth.boxes_ego[rows], truth.object_index[rows]
    gap_s = truth.gap_s(sweep.index)
    has_next = gap_s <= MAX_GAP_S
    flow = np.zeros((sweep.num_points, 3))
    is_in_box, is_moving = np.zeros((2, sweep.num_points), dtype=bool)
    members = points_in_boxes(sweep.points_ego, boxes)
    for box in np.argsort(-boxes[:, BOX_LENGTH : BOX_HEIGHT + 1].prod(axis=1), kind="stable"):
        inside = members[box]
        is_in_box[inside] = True
        is_moving[inside] = truth.is_moving[rows][box]
        flow[inside] = 0.0
        if truth.is_mover[objects[box]] and has_next:
            flow[inside] = _box_flow(truth, sweep, rows.start + int(box), sweep.points_ego[inside])
    is_known = np.full(sweep.num_points, bool(truth.is_annotated[sweep.index]))
    has_flow = has_next and bool(truth.is_annotated[sweep.index] and truth.is_annotated[sweep.index + 1])
    if point_truth is not None and has_next:
        is_told = np.isfinite(point_truth.flow_ref_m).all(axis=1)
        if is_told.any():
            if not has_flow:
                flow[:] = np.nan
            flow[is_told] = point_truth.flow_ref_m[is_told]
            is_moving[is_told] = np.linalg.norm(flow[is_told], axis=1) > MOVING_MPS * gap_s
            is_known |= is_told
            has_flow = True
    is_ground = is_ground_by_height(sweep.points_ego) if point_truth is None else point_truth.is_ground
    is_near = (np.abs(sweep.points_ego[:, :2]) <= DOMAIN_M).all(axis=1)
    return SweepPointTruth(
        is_domain=is_near & is_in_view(sweep.points_ego, azimuth_deg) & ~is_ground & is_known,
        is_in_box=is_in_box,
        is_moving=is_moving,
        flow_ego_m=flow if has_flow else None,
    )


def _box_flow(truth: SegmentTruth, sweep: Sweep, row: int, points_ego: Float32Array) -> Float64Array:
    """Rigid motion of a box to the next sweep at some of its points, ego axes, ego motion removed; NaN when unknown."""
    later = truth.rows_of(sweep.index + 1)
    found = np.flatnonzero(truth.object_index[later] == truth.object_index[row])
    if not len(found):
        return np.full((len(points_ego), 3), np.nan)
    box, next_box = truth.boxes_ego[row], truth.boxes_ego[later][found[0]]
    world_from_object = truth.world_from_ego[sweep.index + 1] @ yaw_translation(float(next_box[BOX_YAW]), next_box[:3])
    object_from_ego = invert(yaw_translation(float(box[BOX_YAW]), box[:3]))
    moved_ego = transform_points(invert(sweep.world_from_ego) @ world_from_object @ object_from_ego, points_ego)
    return moved_ego - points_ego
