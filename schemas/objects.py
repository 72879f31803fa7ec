"""Clusters, flows, proposals, tracks and labels.

A **box** is (x, y, z, length, width, height, yaw): geometric centre in metres, length along the heading, yaw in
(-pi, pi], anticlockwise seen from above, zero along +x of the stated frame. Corners, seen from above:

        1 ------- 0     x axis of the object (heading) points right,
        |    o->  |     y axis up; 0-3 at the bottom face, 4-7 above them
        2 ------- 3

Arrays of boxes are (B, 7) float64 with columns in that order.
"""

from dataclasses import dataclass, fields

import numpy as np

from schemas.arrays import BoolArray, Float32Array, Float64Array, Int32Array, Int64Array, read_only, require
from schemas.lidars import Beams

BOX_X, BOX_Y, BOX_Z, BOX_LENGTH, BOX_WIDTH, BOX_HEIGHT, BOX_YAW = range(7)


def _freeze(record: object) -> None:
    for field in fields(record):  # type: ignore[arg-type]  # dataclass instances only, called from __post_init__
        value = getattr(record, field.name)
        if isinstance(value, np.ndarray):
            object.__setattr__(record, field.name, read_only(value))


@dataclass(frozen=True, slots=True, eq=False)
class Clusters:
    """Connected components of the dynamic points of one sweep, largest structure of the decomposition.

    Points of cluster c are ``point_rows[offsets[c] : offsets[c + 1]]``.
    """

    point_rows: Int64Array  # (M,) rows into the sweep, grouped by cluster
    offsets: Int64Array  # (C + 1,)

    def __post_init__(self) -> None:
        """Check shapes and make all arrays read-only."""
        require("point_rows", self.point_rows, (None,), np.int64)
        require("offsets", self.offsets, (None,), np.int64)
        _freeze(self)

    @property
    def num_clusters(self) -> int:
        """Number of connected components."""
        return len(self.offsets) - 1

    @property
    def cluster_of_point(self) -> Int64Array:
        """(M,) cluster of each entry of ``point_rows``."""
        return np.repeat(np.arange(self.num_clusters), np.diff(self.offsets))


@dataclass(frozen=True, slots=True, eq=False)
class DynamicPoints:
    """The points of one sweep that may move, grouped by cluster: all that the stages after decomposition see of it."""

    sweep_index: int
    timestamp_ns: int
    world_from_ego: Float64Array  # (4, 4)
    clusters: Clusters
    points_ego: Float32Array  # (M, 3) row order of clusters.point_rows
    beams: Beams  # (M,)
    capture_offset_s: Float32Array  # (M,)
    height_m: Float32Array  # (M,) above the local ground
    is_vacated: BoolArray  # (M,) rays of another sweep passed through the place

    def __post_init__(self) -> None:
        """Check shapes and make all arrays read-only."""
        rows = len(self.clusters.point_rows)
        require("is_vacated", self.is_vacated, (rows,), np.bool_)
        require("points_ego", self.points_ego, (rows, 3), np.float32)
        require("beams.of_point", self.beams.of_point, (rows,), np.uint8)
        require("capture_offset_s", self.capture_offset_s, (rows,), np.float32)
        require("height_m", self.height_m, (rows,), np.float32)
        _freeze(self)


@dataclass(frozen=True, slots=True, eq=False)
class SweepFlow:
    """Flow of the dynamic points of one sweep to the target sweep."""

    flow_ref_m: Float32Array  # (M, 3) displacement in the axes of the ref frame, row order of Clusters.point_rows
    gap_s: float  # target time minus source time; negative for a backward fit
    is_failed: BoolArray  # (C,) the fit broke or did not stay finite: its flow is zero and is counted
    num_iterations: Int64Array  # (C,) 0 where no fit was needed
    final_loss_m2: Float32Array  # (C,) data term at the kept iterate, mean a point

    def __post_init__(self) -> None:
        """Check shapes and make all arrays read-only."""
        require("flow_ref_m", self.flow_ref_m, (None, 3), np.float32)
        _freeze(self)


@dataclass(frozen=True, slots=True, eq=False)
class Proposal:
    """The seen part of one moving object in one sweep. World frame."""

    sweep_index: int
    timestamp_ns: int  # mean capture time of the points
    box_visible: Float64Array  # (7,) tight box of the seen points, world
    velocity_mps: Float64Array  # (3,) world
    points_world: Float64Array  # (P, 3)
    point_rows: Int32Array  # (P,) rows in the source sweep
    ground_z_m: float  # height of the ground under the object, world
    sensor_origin_world: Float64Array  # (3,) of the lidar that saw most of it
    num_vacated: int  # points through whose place rays of another sweep passed
    range_noise_m: float  # of the lidar that saw most of it

    def __post_init__(self) -> None:
        """Check shapes and make all arrays read-only."""
        require("points_world", self.points_world, (None, 3), np.float64)
        require("point_rows", self.point_rows, (len(self.points_world),), np.int32)
        require("box_visible", self.box_visible, (7,), np.float64)
        _freeze(self)


@dataclass(frozen=True, slots=True, eq=False)
class Track:
    """Proposals of one object, ascending in time, at most one a sweep."""

    track_id: str
    proposals: tuple[Proposal, ...]

    @property
    def range_noise_m(self) -> float:
        """Median of the proposals'."""
        return float(np.median([proposal.range_noise_m for proposal in self.proposals]))


@dataclass(frozen=True, slots=True, eq=False)
class AlignedTrack:
    """A track whose views lie on each other.

    ``model_from_world[t]`` is a yaw and a translation: it carries view t into the model frame, which is the world
    frame shifted to the centroid of the densest view (so numbers stay small).
    """

    track: Track
    model_from_world: Float64Array  # (T, 4, 4)
    model_points: Float32Array  # (P, 3) aggregate of all views, m
    model_view: Int32Array  # (P,) view t that each model point came from
    model_yaw: float  # heading of the target view in the model frame
    target_view: int
    error_m: Float64Array  # (T,) mean distance of matched points; NaN for the target view when it is alone

    def __post_init__(self) -> None:
        """Make all arrays read-only."""
        _freeze(self)


@dataclass(frozen=True, slots=True, eq=False)
class LabeledTrack:
    """What is written: one amodal box a sweep, world frame. Rows without own points are interpolated."""

    track_id: str
    sweep_index: Int64Array  # (R,)
    timestamp_ns: Int64Array  # (R,)
    boxes: Float64Array  # (R, 7) world
    velocity_mps: Float64Array  # (R, 3) world
    score: Float64Array  # (R,) in [0, 1]
    num_points: Int64Array  # (R,)
    is_observed: BoolArray  # (R,) False: interpolated
    boxes_visible: Float64Array  # (R, 7) world, NaN where interpolated
    registration_error_m: Float64Array  # (R,) NaN where not registered
    point_rows: tuple[Int32Array, ...]  # R arrays: rows in the source sweep that belong to the object
    range_noise_m: float = 0.0  # of its points; 0: they are exact

    def __post_init__(self) -> None:
        """Check shapes and make all arrays read-only."""
        rows = len(self.sweep_index)
        require("boxes", self.boxes, (rows, 7), np.float64)
        require("boxes_visible", self.boxes_visible, (rows, 7), np.float64)
        require("velocity_mps", self.velocity_mps, (rows, 3), np.float64)
        _freeze(self)


@dataclass(frozen=True, slots=True, eq=False)
class SweepPoints:
    """The points of one sweep that are not ground, ascending by row."""

    points_ego: Float32Array  # (N, 3)
    point_index: Int32Array  # (N,) rows in the source sweep
    is_dynamic: BoolArray  # (N,) not called static
    cluster_id: Int32Array  # (N,) 0 where static
    flow_world_m: Float32Array | None  # (N, 3) world axes, to the next sweep; None in the last and before a gap

    def __post_init__(self) -> None:
        """Check shapes and make all arrays read-only."""
        rows = len(self.point_index)
        require("points_ego", self.points_ego, (rows, 3), np.float32)
        require("point_index", self.point_index, (rows,), np.int32)
        require("is_dynamic", self.is_dynamic, (rows,), np.bool_)
        require("cluster_id", self.cluster_id, (rows,), np.int32)
        if self.flow_world_m is not None:
            require("flow_world_m", self.flow_world_m, (rows, 3), np.float32)
        _freeze(self)

    def only_dynamic(self) -> "SweepPoints":
        """Return the points that were not called static."""
        kept = self.is_dynamic
        flow = None if self.flow_world_m is None else self.flow_world_m[kept]
        return SweepPoints(
            self.points_ego[kept], self.point_index[kept], self.is_dynamic[kept], self.cluster_id[kept], flow
        )


@dataclass(frozen=True, slots=True, eq=False)
class SweepObservation:
    """All that the first half of the line says of one sweep: what shards, tracking and reports need of it.

    A rejected sweep has a reason and zero counts.
    """

    sweep_index: int
    timestamp_ns: int
    world_from_ego: Float64Array  # (4, 4); the identity when the pose itself was missing
    num_points: int
    num_ground: int
    num_static: int
    num_clusters: int
    num_failed_fits: int
    reason: str  # empty: ok; else the sweep was rejected
    proposals: tuple[Proposal, ...]
    points: SweepPoints | None  # None when rejected, and where nobody asks for them

    def __post_init__(self) -> None:
        """Make all arrays read-only."""
        _freeze(self)

    @property
    def is_rejected(self) -> bool:
        """True when the sweep could not be used."""
        return bool(self.reason)
