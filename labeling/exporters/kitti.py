"""KITTI tracking: label_02/SEGMENT.txt, 17 columns, boxes in the rectified frame of the camera."""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Final

import numpy as np

from labeling.exporters.exporter import ExportOptions
from labeling.exporters.kinds import Kind, names_of, require_category
from labeling.exporters.output import ExportFolder
from labeling.exporters.segments import SegmentLabels, SweepLabels
from labeling.geometry.boxes import bev_corners
from labeling.geometry.transforms import rotate_vectors, transform_points, wrap_angle
from labeling.storage import places
from labeling.storage.storage import open_storage
from schemas.arrays import Float64Array
from schemas.errors import InvalidInput
from schemas.objects import BOX_HEIGHT, BOX_LENGTH, BOX_WIDTH, BOX_YAW, BOX_Z

CATEGORIES: Final = ("Car", "Van", "Truck", "Pedestrian", "Person_sitting", "Cyclist", "Tram", "Misc")
_NAMES: Final = {
    Kind.PEDESTRIAN: "Pedestrian",
    Kind.CYCLIST: "Cyclist",
    Kind.CAR: "Car",
    Kind.TRUCK: "Truck",
}
_UNKNOWN_TRUNCATION: Final = -1
_UNKNOWN_OCCLUSION: Final = 3
_NO_RECTANGLE: Final = (-1.0, -1.0, -1.0, -1.0)
_MIN_DEPTH_M: Final = 0.1  # a corner nearer to the camera's plane, or behind it, has no place in the image
_RAW_FILES: Final = ("calib_velo_to_cam.txt", "calib_cam_to_cam.txt")


@dataclass(frozen=True, slots=True, eq=False)
class Calibration:
    """Where the camera is, and what it sees. The ego frame of KITTI is that of its Velodyne."""

    camera_from_ego: Float64Array  # (4, 4) rectified: x right, y down, z ahead
    image_from_camera: Float64Array  # (3, 4) projection of the left colour camera, px


def export(segments: Iterable[SegmentLabels], output: ExportFolder, options: ExportOptions) -> None:
    """Write a file a segment; see ``Exporter``. Frames are numbered as sweeps, tracks by their first boxes.

    Boxes all around are written: one that is not wholly ahead of the camera has -1 for its rectangle. Others have the
    projection of their corners, not cut at the edge of the image, whose size is not known here.
    """
    require_category(options.category, CATEGORIES)
    if options.calibration is None:
        raise InvalidInput(
            "format kitti has boxes in the frame of a camera: give the drive's calibration with --calibration (calib/"
            "SEQ.txt of the tracking data, or the folder of the date in the raw data)"
        )
    calibration = read_calibration(options.calibration)
    for segment in segments:
        lines = [line for sweep in segment for line in _lines(sweep, segment.track_numbers, calibration, options)]
        output.put(f"label_02/{segment.segment_id}.txt", "".join(lines).encode())


def _lines(
    sweep: SweepLabels, track_numbers: dict[str, int], calibration: Calibration, options: ExportOptions
) -> Iterable[str]:
    boxes = sweep.boxes_ego
    bottoms_ego = boxes[:, :3] - np.outer(boxes[:, BOX_HEIGHT] / 2, [0, 0, 1])
    locations = transform_points(calibration.camera_from_ego, bottoms_ego)
    headings_ego = np.stack([np.cos(boxes[:, BOX_YAW]), np.sin(boxes[:, BOX_YAW]), np.zeros(len(boxes))], axis=1)
    headings = rotate_vectors(calibration.camera_from_ego, headings_ego)
    rotation_y = np.arctan2(-headings[:, 2], headings[:, 0])  # about y, which points down; 0 along x
    alpha = wrap_angle(rotation_y - np.arctan2(locations[:, 0], locations[:, 2]))  # as the camera sees it
    names = names_of(boxes, _NAMES, options.category)
    sizes = boxes[:, [BOX_HEIGHT, BOX_WIDTH, BOX_LENGTH]]
    for row, track_id in enumerate(sweep.rows.track_id.tolist()):
        numbers = alpha[row], *_rectangle(boxes[row], calibration), *sizes[row], *locations[row], rotation_y[row]
        yield (
            f"{sweep.sweep_index} {track_numbers[track_id]} {names[row]} {_UNKNOWN_TRUNCATION} {_UNKNOWN_OCCLUSION} "
            + " ".join(f"{number:.6f}" for number in numbers)
            + "\n"
        )


def _rectangle(box: Float64Array, calibration: Calibration) -> tuple[float, ...]:
    """Return left, top, right, bottom of a (7,) box in the image, px."""
    low, high = box[BOX_Z] - box[BOX_HEIGHT] / 2, box[BOX_Z] + box[BOX_HEIGHT] / 2
    around = bev_corners(box[None])[0]
    corners_ego = np.concatenate([np.column_stack([around, np.full(4, z)]) for z in (low, high)])
    corners = transform_points(calibration.camera_from_ego, corners_ego)
    projected = corners @ calibration.image_from_camera[:, :3].T + calibration.image_from_camera[:, 3]
    if projected[:, 2].min() < _MIN_DEPTH_M:
        return _NO_RECTANGLE
    pixels = projected[:, :2] / projected[:, 2:]
    return (*pixels.min(axis=0), *pixels.max(axis=0))


def read_calibration(place: str) -> Calibration:
    """Read a calibration file of the tracking (or object) data, or the folder of a date of the raw data.

    Raises:
        InvalidInput: It is missing, or a matrix is.

    """
    name = places.canonical(places.absolute(place))
    folder, file = places.split(name)
    values: dict[str, Float64Array] = {}
    if open_storage(folder).size(file) is not None:
        values = _read_matrices(folder, file)
    elif open_storage(name).has_folder():
        values = {key: matrix for raw in _RAW_FILES for key, matrix in _read_matrices(name, raw).items()}
    else:
        raise InvalidInput(f"--calibration {place}: no such file or folder")

    def matrix(shape: tuple[int, int], *keys: str) -> Float64Array:
        found = next((values[key] for key in keys if key in values), None)
        if found is None or len(found) != shape[0] * shape[1] or not np.isfinite(found).all():
            raise InvalidInput(
                f"--calibration {place}: expected a line {' or '.join(keys)} of {shape[0] * shape[1]} numbers, as in "
                "calib/SEQ.txt of KITTI's tracking data or the folder of the date of its raw data"
            )
        return found.reshape(shape)

    camera_from_ego, rectified_from_camera = np.eye(4), np.eye(4)
    if "R" in values:  # raw data
        camera_from_ego[:3] = np.column_stack([matrix((3, 3), "R"), matrix((3, 1), "T")])
        rectified_from_camera[:3, :3], projection = matrix((3, 3), "R_rect_00"), matrix((3, 4), "P_rect_02")
    else:
        camera_from_ego[:3] = matrix((3, 4), "Tr_velo_cam", "Tr_velo_to_cam")
        rectified_from_camera[:3, :3], projection = matrix((3, 3), "R_rect", "R0_rect"), matrix((3, 4), "P2")
    return Calibration(rectified_from_camera @ camera_from_ego, projection)


def _read_matrices(folder: str, file: str) -> dict[str, Float64Array]:
    """Return the numbers of each line by its name; KITTI writes some names with a colon and some without."""
    try:
        text = open_storage(folder).read(file).decode(errors="replace")
    except FileNotFoundError:
        raise InvalidInput(f"--calibration {places.join(folder, file)}: no such file") from None
    matrices: dict[str, Float64Array] = {}
    for name, *numbers in filter(None, map(str.split, text.splitlines())):
        try:
            matrices.setdefault(name.rstrip(":"), np.array(numbers, dtype=np.float64))
        except ValueError:  # the line of a date
            continue
    return matrices
