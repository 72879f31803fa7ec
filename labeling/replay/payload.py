"""What a page shows of a segment: its sweeps one at a time, then the tracks and what is told of the whole.

Places are in the axes of the world, moved so that the vehicle starts at the origin: a browser computes in float32.
"""

from collections.abc import Iterator
from dataclasses import asdict, dataclass
from typing import Any, Final

import numpy as np

from labeling.exporters.segments import SegmentLabels, SweepLabels
from labeling.geometry.boxes import transform_boxes
from labeling.geometry.times import seconds_between
from labeling.readers.reader import SegmentReader
from labeling.replay.points import GRID_M, GRID_MPS, NO_FLOW, NO_TRACK, REACH_M, ReplayPoints, quantize, thin
from labeling.replay.tracks import doubt, summarize
from schemas.arrays import BoolArray, Float64Array
from schemas.errors import InvalidInput
from schemas.tables.labels import LabelRows
from schemas.tables.points import PointRows

MAX_POINTS: Final = 4_000_000  # of all sweeps: 2.5 to 4.5 bytes each in the page, which is to stay under 20 MB

_MILLIMETRES: Final = 3  # decimals
_YAW_DECIMALS: Final = 5  # a corner 20 m from its centre moves by less than a millimetre
_POSE_DECIMALS: Final = 7

Json = dict[str, Any]


@dataclass(frozen=True, slots=True, eq=False)
class ReplaySweep:
    """One sweep of the page."""

    sweep_index: int
    time_s: float  # since the first sweep
    world_from_ego: Float64Array  # (4, 4) from the page's origin
    points: ReplayPoints
    num_recorded: int
    num_far: int  # beyond REACH_M: left out
    voxel_m: float  # of which one point was kept where nothing moves; 0: all were
    truth: list[Json]  # boxes that people made

    def header(self) -> Json:
        """Return all but the points."""
        return {
            "index": self.sweep_index,
            "time_s": round(self.time_s, 6),
            "world_from_ego": np.round(self.world_from_ego, _POSE_DECIMALS).ravel().tolist(),  # row by row
            "num_static": self.points.num_static,
            "num_moving": len(self.points.tracks),
            "num_recorded": self.num_recorded,
            "num_far": self.num_far,
            "voxel_m": round(self.voxel_m, 3),
            "truth": self.truth,
        }


def read_sweeps(
    segment: SegmentLabels, reader: SegmentReader, *, max_points: int = MAX_POINTS, with_truth: bool = False
) -> Iterator[ReplaySweep]:
    """Read the sweeps one at a time; ``max_points`` of all together are kept, and all that move.

    Raises:
        InvalidInput: No usable sweep, no table of points, no truth that was asked for, or the recording has changed.
        UnreadableSweep: A sweep cannot be read now.

    """
    if not segment.sweeps:
        raise InvalidInput(
            f"{segment.folder.storage.root}: segment {segment.segment_id} has no sweep that was labelled"
        )
    max_of_sweep = max_points // len(segment.sweeps)
    num_annotated = 0
    for sweep, rows in segment.with_points():
        truth = _read_truth(segment, reader, sweep) if with_truth else None
        num_annotated += truth is not None
        yield _read_sweep(segment, reader, sweep, rows, max_of_sweep, truth or [])
    if with_truth and not num_annotated:
        raise InvalidInput(f"--truth: {reader.uri} has no annotations of any sweep that was labelled")


def describe(segment: SegmentLabels, headers: list[Json], height_m: tuple[float, float]) -> Json:
    """Return what the page knows beside the points; ``headers`` are those of all sweeps."""
    position = {sweep.sweep_index: number for number, sweep in enumerate(segment.sweeps)}
    origin = _origin(segment)
    tracks = list(segment.tracks(min_score=0.0))
    return {
        "segment": segment.segment_id,
        "dataset": segment.dataset,
        "min_score": segment.folder.recommended_min_score,
        "grid_m": GRID_M,
        "grid_mps": GRID_MPS,
        "no_flow": NO_FLOW,
        "height_m": [round(limit, 2) for limit in height_m],
        "rejected": list(segment.rejected_sweeps),
        "sweeps": headers,
        "tracks": [
            {
                **{name: _rounded(value) for name, value in asdict(summary).items()},
                "number": segment.track_numbers[summary.track_id],
                "boxes": _boxes_of(rows, position, origin),
            }
            for summary, rows in sorted(((summarize(rows), rows) for rows in tracks), key=lambda pair: doubt(pair[0]))
        ],
    }


def _boxes_of(rows: LabelRows, position: dict[int, int], origin: Float64Array) -> list[list[float]]:
    """Return of each box: sweep, x, y, z, length, width, height, yaw, velocity x and y, score, points, whether seen."""
    return [
        [position[sweep_index], *box, *np.round(velocity[:2], 2).tolist(), round(score, 3), num_points, int(is_seen)]
        for sweep_index, box, velocity, score, num_points, is_seen in zip(
            rows.sweep_index.tolist(),
            _rounded_boxes(rows.boxes, origin),
            rows.velocity_mps,
            rows.score.tolist(),
            rows.num_points.tolist(),
            rows.is_observed.tolist(),
            strict=True,
        )
    ]


def _rounded_boxes(boxes: Float64Array, origin: Float64Array) -> list[list[float]]:
    moved = boxes.copy()
    moved[:, :3] -= origin
    return [[*row[:6], yaw] for row, yaw in zip(
        np.round(moved, _MILLIMETRES).tolist(), np.round(moved[:, 6], _YAW_DECIMALS).tolist(), strict=True
    )]  # fmt: skip


def _rounded(value: str | float) -> str | float:
    return round(value, _MILLIMETRES) if isinstance(value, float) else value


def _origin(segment: SegmentLabels) -> Float64Array:
    return segment.sweeps[0].world_from_ego[:3, 3]


def _read_truth(segment: SegmentLabels, reader: SegmentReader, sweep: SweepLabels) -> list[Json] | None:
    found = reader.read_annotations(sweep.sweep_index)
    if found is None:
        return None
    boxes = _rounded_boxes(transform_boxes(sweep.world_from_ego, found.boxes_ego), _origin(segment))
    return [{"category": category, "box": box} for category, box in zip(found.categories, boxes, strict=True)]


def _read_sweep(
    segment: SegmentLabels,
    reader: SegmentReader,
    sweep: SweepLabels,
    rows: PointRows,
    max_points: int,
    truth: list[Json],
) -> ReplaySweep:
    points_ego = segment.read_recorded(reader, sweep).points_ego
    is_near: BoolArray = np.all(np.abs(points_ego) <= REACH_M, axis=1)
    is_static = is_near.copy()
    is_static[rows.point_index] = False
    static_ego = points_ego[is_static]
    kept, voxel_m = thin(static_ego, max_points - len(rows))

    numbers = np.array([*(segment.track_numbers.get(track_id, NO_TRACK) for track_id in rows.track_ids), NO_TRACK])
    is_shown = is_near[rows.point_index]
    world_from_ego = sweep.world_from_ego.copy()
    world_from_ego[:3, 3] -= _origin(segment)
    return ReplaySweep(
        sweep_index=sweep.sweep_index,
        time_s=seconds_between(sweep.timestamp_ns, segment.sweeps[0].timestamp_ns),
        world_from_ego=world_from_ego,
        points=quantize(
            static_ego[kept],
            points_ego[rows.point_index][is_shown],
            _velocity_mps(reader, sweep, rows)[is_shown],
            numbers[rows.track][is_shown],
        ),
        num_recorded=sweep.num_points,
        num_far=int((~is_near).sum()),
        voxel_m=voxel_m,
        truth=truth,
    )


def _velocity_mps(reader: SegmentReader, sweep: SweepLabels, rows: PointRows) -> Float64Array:
    """Return (M, 2) what the flow to the recording's next sweep says; at its end there is none."""
    following = sweep.sweep_index + 1
    if following >= len(reader.timestamps_ns):
        return np.full((len(rows), 2), np.nan)
    gap_s = seconds_between(int(reader.timestamps_ns[following]), sweep.timestamp_ns)
    return rows.flow_world_m[:, :2].astype(np.float64) / gap_s
