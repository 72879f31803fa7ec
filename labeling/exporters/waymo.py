"""Waymo Open Dataset v2: lidar_box/SEGMENT.parquet, boxes in the vehicle's frame."""

from collections.abc import Iterable
from typing import Final

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from labeling.exporters.exporter import ExportOptions
from labeling.exporters.kinds import Kind, names_of, require_category
from labeling.exporters.output import ExportFolder
from labeling.exporters.segments import SegmentLabels
from schemas.objects import BOX_YAW
from schemas.tables.columns import make_table, repeat

_BOX: Final = "[LiDARBoxComponent]"
SCHEMA: Final = pa.schema(
    [
        pa.field("key.segment_context_name", pa.string()),
        pa.field("key.frame_timestamp_micros", pa.int64()),
        pa.field("key.laser_object_id", pa.string()),
        *(pa.field(f"{_BOX}.box.center.{axis}", pa.float64()) for axis in "xyz"),
        *(pa.field(f"{_BOX}.box.size.{axis}", pa.float64()) for axis in "xyz"),  # length, width, height
        pa.field(f"{_BOX}.box.heading", pa.float64()),  # [-pi, pi)
        pa.field(f"{_BOX}.type", pa.int8()),
        pa.field(f"{_BOX}.num_lidar_points_in_box", pa.int64()),
        pa.field(f"{_BOX}.num_top_lidar_points_in_box", pa.int64()),
        *(pa.field(f"{_BOX}.speed.{axis}", pa.float64()) for axis in "xyz"),  # WORLD axes, m/s
        *(pa.field(f"{_BOX}.acceleration.{axis}", pa.float64()) for axis in "xyz"),
        *(pa.field(f"{_BOX}.difficulty_level.{task}", pa.int8()) for task in ("detection", "tracking")),
    ]
)
TYPES: Final = ("UNKNOWN", "VEHICLE", "PEDESTRIAN", "SIGN", "CYCLIST")  # by their numbers
_NAMES: Final = {
    Kind.PEDESTRIAN: "PEDESTRIAN",
    Kind.CYCLIST: "CYCLIST",
    Kind.CAR: "VEHICLE",
    Kind.TRUCK: "VEHICLE",
}
_UNKNOWN_DIFFICULTY: Final = 0


def export(segments: Iterable[SegmentLabels], output: ExportFolder, options: ExportOptions) -> None:
    """Write a file a segment; see ``Exporter``. What is not known of a box is null: points by lidar, acceleration."""
    require_category(options.category, TYPES)
    for segment in segments:
        with (
            output.writing(f"lidar_box/{segment.segment_id}.parquet") as file,
            pq.ParquetWriter(file, SCHEMA, compression="zstd") as parquet,
        ):
            parquet.write_table(_table(segment, options.category))


def _table(segment: SegmentLabels, category: str | None) -> pa.Table:
    rows, size = segment.rows, len(segment.rows)
    boxes_ego = segment.boxes_ego
    unknown = pa.nulls(size)
    return make_table(
        SCHEMA,
        [
            repeat(segment.segment_id, size),
            segment.timestamps_ns // 1000,
            rows.track_id,
            *boxes_ego[:, :BOX_YAW].T,
            np.mod(boxes_ego[:, BOX_YAW] + np.pi, 2 * np.pi) - np.pi,
            np.array([TYPES.index(name) for name in names_of(boxes_ego, _NAMES, category)], dtype=np.int8),
            rows.num_points,
            unknown,
            *rows.velocity_mps.T,
            *[unknown] * 3,
            *[np.full(size, _UNKNOWN_DIFFICULTY)] * 2,
        ],
    )
