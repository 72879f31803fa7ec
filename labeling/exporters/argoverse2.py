"""Argoverse 2 sensor data set: SEGMENT/annotations.feather, boxes in the ego frame at the time of their sweep."""

from collections.abc import Iterable
from typing import Final

import pyarrow as pa

from labeling.exporters.exporter import ExportOptions
from labeling.exporters.kinds import Kind, names_of, require_category
from labeling.exporters.output import ExportFolder
from labeling.exporters.segments import SegmentLabels
from labeling.geometry.transforms import quaternions_of_yaw
from schemas.objects import BOX_LENGTH, BOX_YAW
from schemas.tables.columns import make_table

SCHEMA: Final = pa.schema(
    [
        pa.field("timestamp_ns", pa.int64()),
        pa.field("track_uuid", pa.string()),
        pa.field("category", pa.string()),
        *(pa.field(name, pa.float64()) for name in ("length_m", "width_m", "height_m")),
        *(pa.field(name, pa.float64()) for name in ("qw", "qx", "qy", "qz")),
        *(pa.field(name, pa.float64()) for name in ("tx_m", "ty_m", "tz_m")),  # geometric centre
        pa.field("num_interior_pts", pa.int64()),
    ]
)
CATEGORIES: Final = (
    "ANIMAL", "ARTICULATED_BUS", "BICYCLE", "BICYCLIST", "BOLLARD", "BOX_TRUCK", "BUS", "CONSTRUCTION_BARREL",
    "CONSTRUCTION_CONE", "DOG", "LARGE_VEHICLE", "MESSAGE_BOARD_TRAILER", "MOBILE_PEDESTRIAN_CROSSING_SIGN",
    "MOTORCYCLE", "MOTORCYCLIST", "OFFICIAL_SIGNALER", "PEDESTRIAN", "RAILED_VEHICLE", "REGULAR_VEHICLE", "SCHOOL_BUS",
    "SIGN", "STOP_SIGN", "STROLLER", "TRAFFIC_LIGHT_TRAILER", "TRUCK", "TRUCK_CAB", "VEHICULAR_TRAILER", "WHEELCHAIR",
    "WHEELED_DEVICE", "WHEELED_RIDER",
)  # fmt: skip
_NAMES: Final = {
    Kind.PEDESTRIAN: "PEDESTRIAN",
    Kind.CYCLIST: "BICYCLIST",
    Kind.CAR: "REGULAR_VEHICLE",
    Kind.TRUCK: "LARGE_VEHICLE",
}


def export(segments: Iterable[SegmentLabels], output: ExportFolder, options: ExportOptions) -> None:
    """Write a file a segment; see ``Exporter``. Its rows have no score: the cut decides what is there."""
    require_category(options.category, CATEGORIES)
    for segment in segments:
        with (
            output.writing(f"{segment.segment_id}/annotations.feather") as file,
            pa.ipc.new_file(file, SCHEMA) as feather,
        ):
            feather.write_table(_table(segment, options.category))


def _table(segment: SegmentLabels, category: str | None) -> pa.Table:
    rows = segment.rows
    boxes_ego = segment.boxes_ego
    return make_table(
        SCHEMA,
        [
            segment.timestamps_ns,
            rows.track_id,
            pa.array(names_of(boxes_ego, _NAMES, category), pa.string()),
            *boxes_ego[:, BOX_LENGTH:BOX_YAW].T,
            *quaternions_of_yaw(boxes_ego[:, BOX_YAW]).T,
            *boxes_ego[:, :BOX_LENGTH].T,
            rows.num_points,
        ],
    )
