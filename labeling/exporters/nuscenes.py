"""nuScenes results: detection.json and tracking.json over all segments, boxes in the world frame."""

import json
from collections.abc import Iterable, Iterator
from contextlib import ExitStack
from typing import Any, Final

import numpy as np

from labeling.exporters.exporter import ExportOptions
from labeling.exporters.kinds import Kind, names_of, require_category
from labeling.exporters.output import ExportFolder
from labeling.exporters.segments import SegmentLabels, SweepLabels
from labeling.geometry.transforms import quaternions_of_yaw
from schemas.objects import BOX_HEIGHT, BOX_LENGTH, BOX_WIDTH, BOX_YAW
from schemas.tables.labels import LabelRows

CATEGORIES: Final = ("bicycle", "bus", "car", "motorcycle", "pedestrian", "trailer", "truck")  # those of both tasks
MAX_BOXES: Final = 500  # a sample, or the devkit refuses the file
_META: Final = {
    "use_camera": False,
    "use_lidar": True,
    "use_radar": False,
    "use_map": False,
    "use_external": False,
}
_NAMES: Final = {
    Kind.PEDESTRIAN: "pedestrian",
    Kind.CYCLIST: "bicycle",
    Kind.CAR: "car",
    Kind.TRUCK: "truck",
}
_MOVING_MPS: Final = 0.2  # slower than this is standing, as detectors of nuScenes commonly tell it
_DECIMALS: Final = 6

Box = dict[str, Any]  # of the devkit's own make


def sample_token(segment_id: str, timestamp_ns: int) -> str:
    """Return what stands for a sample token, which labels of other recordings do not have."""
    return f"{segment_id}_{timestamp_ns}"


def export(segments: Iterable[SegmentLabels], output: ExportFolder, options: ExportOptions) -> None:
    """Write two files for all segments, sample by sample; see ``Exporter``."""
    require_category(options.category, CATEGORIES)
    with ExitStack() as files:
        results = [files.enter_context(output.writing(f"{task}.json")) for task in ("detection", "tracking")]
        opening = f'{{"meta":{_dumps(_META)},"results":{{'
        for segment in segments:
            for sweep in segment:
                token = sample_token(segment.segment_id, sweep.timestamp_ns)
                for file, boxes in zip(results, _results(sweep, token, options.category), strict=True):
                    file.write(f"{opening}\n{_dumps(token)}:{_dumps(boxes)}".encode())
                opening = ","
        for file in results:
            file.write(f"{'' if opening == ',' else opening}}}}}\n".encode())


def _results(sweep: SweepLabels, token: str, category: str | None) -> tuple[list[Box], list[Box]]:
    """Return the boxes of one sample, for detection and for tracking."""
    best = np.argsort(-sweep.rows.score, kind="stable")[:MAX_BOXES]
    rows = sweep.rows.take(np.sort(best))
    names = names_of(rows.boxes, _NAMES, category)
    detections, tracks = [], []
    for row, (name, place) in enumerate(zip(names, _places(rows), strict=True)):
        score = round(float(rows.score[row]), _DECIMALS)
        is_moving = bool(np.hypot(*rows.velocity_mps[row, :2]) >= _MOVING_MPS)
        shared = {"sample_token": token, **place}
        attribute = _attribute(name, is_moving=is_moving)
        detections.append({**shared, "detection_name": name, "detection_score": score, "attribute_name": attribute})
        track_id = str(rows.track_id[row])
        tracks.append({**shared, "tracking_id": track_id, "tracking_name": name, "tracking_score": score})
    return detections, tracks


def _places(rows: LabelRows) -> Iterator[Box]:
    columns = {
        "translation": rows.boxes[:, :BOX_LENGTH],  # geometric centre
        "size": rows.boxes[:, [BOX_WIDTH, BOX_LENGTH, BOX_HEIGHT]],
        "rotation": quaternions_of_yaw(rows.boxes[:, BOX_YAW]),  # w, x, y, z
        "velocity": rows.velocity_mps[:, :2],
    }
    values = {name: column.round(_DECIMALS).tolist() for name, column in columns.items()}
    for row in range(len(rows)):
        yield {name: column[row] for name, column in values.items()}


def _attribute(name: str, *, is_moving: bool) -> str:
    if name == "pedestrian":
        return "pedestrian.moving" if is_moving else "pedestrian.standing"
    if name in ("bicycle", "motorcycle"):
        return "cycle.with_rider"  # it moves
    return "vehicle.moving" if is_moving else "vehicle.stopped"


def _dumps(value: Any) -> str:
    return json.dumps(value, separators=(",", ":"))
