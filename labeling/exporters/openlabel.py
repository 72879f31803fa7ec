"""ASAM OpenLABEL 1.0.0: SEGMENT.json, cuboids in the ego frame, with the pose of the vehicle in each frame."""

import json
from collections.abc import Iterable, Sequence
from typing import Any, Final

import numpy as np
from scipy.spatial.transform import Rotation

from labeling.exporters.exporter import ExportOptions
from labeling.exporters.kinds import Kind, names_of
from labeling.exporters.output import ExportFolder
from labeling.exporters.segments import SegmentLabels, SweepLabels
from labeling.geometry.transforms import invert, quaternions_of_yaw, rotate_vectors
from schemas.arrays import Float64Array
from schemas.objects import BOX_LENGTH, BOX_YAW
from schemas.tables.labels import INTERPOLATED, OBSERVED

SCHEMA_VERSION: Final = "1.0.0"
WORLD: Final = "world"
EGO: Final = "vehicle-iso8855"  # x forward, y left, z up, as ours
_NAMES: Final = {kind: kind.value for kind in Kind}
_DECIMALS: Final = 6  # micrometres, and microradians

Json = dict[str, Any]  # of the standard's own make


def export(segments: Iterable[SegmentLabels], output: ExportFolder, options: ExportOptions) -> None:
    """Write a file a segment; see ``Exporter``. Any text is a category, for the standard names none."""
    for segment in segments:
        content = json.dumps({"openlabel": _document(segment, options.category)}, separators=(",", ":"))
        output.put(f"{segment.segment_id}.json", content.encode() + b"\n")


def _document(segment: SegmentLabels, category: str | None) -> Json:
    indices = [sweep.sweep_index for sweep in segment]
    return {
        "metadata": {"schema_version": SCHEMA_VERSION, "name": segment.segment_id, "annotator": "motionlabel"},
        "coordinate_systems": {
            WORLD: {"type": "scene_cs", "parent": "", "children": [EGO]},
            EGO: {"type": "local_cs", "parent": WORLD, "children": []},
        },
        "objects": _objects(segment, category),
        "frame_intervals": _intervals(indices),
        "frames": {str(sweep.sweep_index): _frame(sweep) for sweep in segment},
    }


def _objects(segment: SegmentLabels, category: str | None) -> Json:
    rows = segment.rows
    types = dict(zip(rows.track_id.tolist(), names_of(rows.boxes, _NAMES, category), strict=True))
    return {
        track_id: {
            "name": f"{types[track_id]} {number}",
            "type": types[track_id],
            "frame_intervals": _intervals(rows.sweep_index[rows.track_id == track_id].tolist()),
        }
        for track_id, number in segment.track_numbers.items()
    }


def _intervals(indices: Sequence[int]) -> list[dict[str, int]]:
    """Return the runs of ascending numbers; both ends belong to a run."""
    known = set(indices)
    starts = [number for number in indices if number - 1 not in known]
    stops = [number for number in indices if number + 1 not in known]
    return [{"frame_start": start, "frame_end": stop} for start, stop in zip(starts, stops, strict=True)]


def _frame(sweep: SweepLabels) -> Json:
    rotation = Rotation.from_matrix(sweep.world_from_ego[:3, :3]).as_quat(canonical=True)  # x, y, z, w
    pose = {"quaternion": _rounded(rotation), "translation": _rounded(sweep.world_from_ego[:3, 3])}
    return {
        "frame_properties": {
            "timestamp": round(sweep.timestamp_ns * 1e-9, _DECIMALS),
            "transforms": {f"{EGO}_to_{WORLD}": {"src": EGO, "dst": WORLD, "transform_src_to_dst": pose}},
        },
        "objects": {
            track_id: {"object_data": {"cuboid": [cuboid]}}
            for track_id, cuboid in zip(sweep.rows.track_id.tolist(), _cuboids(sweep), strict=True)
        },
    }


def _cuboids(sweep: SweepLabels) -> Iterable[Json]:
    rows, boxes = sweep.rows, sweep.boxes_ego
    rotations = np.roll(quaternions_of_yaw(boxes[:, BOX_YAW]), -1, axis=1)  # x, y, z, w
    values = np.concatenate([boxes[:, :BOX_LENGTH], rotations, boxes[:, BOX_LENGTH:BOX_YAW]], axis=1)
    velocities = rotate_vectors(invert(sweep.world_from_ego), rows.velocity_mps)
    for row, value in enumerate(values):
        yield {
            "name": "shape",
            "coordinate_system": EGO,
            "val": _rounded(value),
            "attributes": {
                "num": [
                    {"name": "score", "val": round(float(rows.score[row]), _DECIMALS)},
                    {"name": "num_points", "val": int(rows.num_points[row])},
                ],
                "text": [{"name": "box_source", "val": OBSERVED if rows.is_observed[row] else INTERPOLATED}],
                "vec": [{"name": "velocity_mps", "val": _rounded(velocities[row])}],
            },
        }


def _rounded(values: Float64Array) -> list[float]:
    return [round(value, _DECIMALS) for value in values.tolist()]
