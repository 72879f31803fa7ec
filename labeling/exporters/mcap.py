"""Foxglove's messages in MCAP: SEGMENT.mcap with boxes, moving points, and the pose of the vehicle."""

import colorsys
from collections.abc import Iterable, Iterator
from typing import Any, Final

import numpy as np
from foxglove_schemas_protobuf.ArrowPrimitive_pb2 import ArrowPrimitive
from foxglove_schemas_protobuf.Color_pb2 import Color
from foxglove_schemas_protobuf.CubePrimitive_pb2 import CubePrimitive
from foxglove_schemas_protobuf.FrameTransform_pb2 import FrameTransform
from foxglove_schemas_protobuf.KeyValuePair_pb2 import KeyValuePair
from foxglove_schemas_protobuf.PackedElementField_pb2 import PackedElementField
from foxglove_schemas_protobuf.PointCloud_pb2 import PointCloud
from foxglove_schemas_protobuf.Pose_pb2 import Pose
from foxglove_schemas_protobuf.Quaternion_pb2 import Quaternion
from foxglove_schemas_protobuf.SceneEntity_pb2 import SceneEntity
from foxglove_schemas_protobuf.SceneEntityDeletion_pb2 import SceneEntityDeletion
from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate
from foxglove_schemas_protobuf.TextPrimitive_pb2 import TextPrimitive
from foxglove_schemas_protobuf.Vector3_pb2 import Vector3
from google.protobuf.timestamp_pb2 import Timestamp
from mcap_protobuf.writer import Writer
from scipy.spatial.transform import Rotation

from labeling.exporters.exporter import ExportOptions
from labeling.exporters.kinds import Kind, names_of
from labeling.exporters.output import ExportFolder
from labeling.exporters.segments import SegmentLabels, SweepLabels
from labeling.geometry.transforms import quaternions_of_yaw
from schemas.arrays import Float32Array, Float64Array, Int64Array
from schemas.objects import BOX_HEIGHT, BOX_LENGTH, BOX_YAW
from schemas.tables.labels import INTERPOLATED, OBSERVED

WORLD: Final = "world"
EGO: Final = "ego"
POSES: Final = "/tf"
BOXES: Final = "/labels/boxes"
POINTS: Final = "/labels/moving_points"
NO_TRACK: Final = -1

_NAMES: Final = {kind: kind.value for kind in Kind}
_IDENTITY: Final = Pose(position=Vector3(), orientation=Quaternion(w=1.0))
_POINT: Final = np.dtype([("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("track", "<i4")])
_FIELDS: Final = [
    PackedElementField(
        name=name,
        offset=offset,
        type=PackedElementField.INT32 if kind == np.dtype("<i4") else PackedElementField.FLOAT32,
    )
    for name, (kind, offset, *_) in (_POINT.fields or {}).items()
]
_NEXT_HUE: Final = 0.618034  # the golden ratio: however many tracks, hues of neighbours lie far apart
_OPACITY: Final = 0.4
_TEXT_M: Final = 0.6
_ARROW_M: Final = (0.1, 0.5, 0.3)  # diameter of the shaft, length and diameter of the head


def export(segments: Iterable[SegmentLabels], output: ExportFolder, options: ExportOptions) -> None:
    """Write a file a segment; see ``Exporter``. A message a topic and sweep.

    Points that move are there where the labels have a table of points; they are read from the recording.
    """
    for segment in segments:
        with output.writing(f"{segment.segment_id}.mcap") as file, Writer(file) as mcap:
            for topic, timestamp_ns, message in _messages(segment, options.category):
                mcap.write_message(topic, message, log_time=timestamp_ns, publish_time=timestamp_ns)


def _messages(segment: SegmentLabels, category: str | None) -> Iterator[tuple[str, int, Any]]:
    if segment.folder.shard("points", segment.segment_id) is None:
        for sweep in segment:
            yield from _boxes_and_pose(sweep, segment.track_numbers, category)
        return
    reader = segment.open_recording()
    for sweep, moving in segment.with_points():
        yield from _boxes_and_pose(sweep, segment.track_numbers, category)
        points_ego = segment.read_recorded(reader, sweep).points_ego[moving.point_index]
        numbers = [segment.track_numbers.get(track_id, NO_TRACK) for track_id in moving.track_ids]
        track = np.array([*numbers, NO_TRACK])[moving.track]  # -1, of no track, is the last
        yield POINTS, sweep.timestamp_ns, _points(points_ego, track, _time(sweep))


def _boxes_and_pose(
    sweep: SweepLabels, track_numbers: dict[str, int], category: str | None
) -> Iterator[tuple[str, int, Any]]:
    time = _time(sweep)
    rotation = Rotation.from_matrix(sweep.world_from_ego[:3, :3]).as_quat(canonical=True, scalar_first=True)
    yield (
        POSES,
        sweep.timestamp_ns,
        FrameTransform(
            timestamp=time,
            parent_frame_id=WORLD,
            child_frame_id=EGO,
            translation=_vector(sweep.world_from_ego[:3, 3]),
            rotation=_quaternion(rotation),
        ),
    )
    names = names_of(sweep.rows.boxes, _NAMES, category)
    yield (
        BOXES,
        sweep.timestamp_ns,
        SceneUpdate(
            deletions=[SceneEntityDeletion(timestamp=time, type=SceneEntityDeletion.ALL)],
            entities=[
                _entity(sweep, row, name, track_numbers[str(sweep.rows.track_id[row])], time)
                for row, name in enumerate(names)
            ],
        ),
    )


def _entity(sweep: SweepLabels, row: int, name: str, number: int, time: Timestamp) -> SceneEntity:
    """Return the box of one row, with an arrow along its heading and its name above."""
    rows, box = sweep.rows, sweep.rows.boxes[row]
    orientation = _quaternion(quaternions_of_yaw(box[BOX_YAW:])[0])
    speed_mps = float(np.linalg.norm(rows.velocity_mps[row]))
    above = _vector(box[:BOX_LENGTH] + np.array([0.0, 0.0, box[BOX_HEIGHT] / 2 + _TEXT_M]))
    shaft_m, head_m, head_wide_m = _ARROW_M
    told = {
        "kind": name,
        "score": f"{rows.score[row]:.3f}",
        "speed_mps": f"{speed_mps:.2f}",
        "num_points": str(rows.num_points[row]),
        "box_source": OBSERVED if rows.is_observed[row] else INTERPOLATED,
    }
    pose = Pose(position=_vector(box[:BOX_LENGTH]), orientation=orientation)
    return SceneEntity(
        timestamp=time,
        frame_id=WORLD,
        id=str(rows.track_id[row]),
        metadata=[KeyValuePair(key=key, value=value) for key, value in told.items()],
        cubes=[CubePrimitive(pose=pose, size=_vector(box[BOX_LENGTH:BOX_YAW]), color=_color(number, _OPACITY))],
        arrows=[
            ArrowPrimitive(
                pose=pose,
                shaft_length=box[BOX_LENGTH] / 2,
                shaft_diameter=shaft_m,
                head_length=head_m,
                head_diameter=head_wide_m,
                color=_color(number, 1.0),
            )
        ],
        texts=[
            TextPrimitive(
                pose=Pose(position=above, orientation=_IDENTITY.orientation),
                billboard=True,
                font_size=_TEXT_M,
                color=_color(number, 1.0),
                text=f"{number} {name} {speed_mps:.1f} m/s",
            )
        ],
    )


def _points(points_ego: Float32Array, track: Int64Array, time: Timestamp) -> PointCloud:
    packed = np.empty(len(points_ego), dtype=_POINT)
    for axis, column in zip("xyz", points_ego.T, strict=True):
        packed[axis] = column
    packed["track"] = track
    return PointCloud(
        timestamp=time,
        frame_id=EGO,
        pose=_IDENTITY,
        point_stride=_POINT.itemsize,
        fields=_FIELDS,
        data=packed.tobytes(),
    )


def _time(sweep: SweepLabels) -> Timestamp:
    seconds, nanos = divmod(sweep.timestamp_ns, 10**9)
    return Timestamp(seconds=seconds, nanos=nanos)


def _vector(values: Float64Array) -> Vector3:
    x, y, z = values.tolist()
    return Vector3(x=x, y=y, z=z)


def _quaternion(wxyz: Float64Array) -> Quaternion:
    w, x, y, z = wxyz.tolist()
    return Quaternion(x=x, y=y, z=z, w=w)


def _color(number: int, opacity: float) -> Color:
    red, green, blue = colorsys.hsv_to_rgb(number * _NEXT_HUE % 1.0, 0.7, 1.0)
    return Color(r=red, g=green, b=blue, a=opacity)
