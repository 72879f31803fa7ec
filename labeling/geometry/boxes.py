"""Boxes: corners, points inside, tight fit, transform, IoU. The convention is drawn in schemas/objects.py."""

import numpy as np

from labeling.geometry.transforms import transform_points, wrap_angle, yaw_of
from schemas.arrays import BoolArray, Float64Array, FloatArray
from schemas.objects import BOX_HEIGHT, BOX_LENGTH, BOX_WIDTH, BOX_YAW, BOX_Z

_CORNER_SIGNS = np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]], dtype=np.float64) / 2


def bev_corners(boxes: Float64Array) -> Float64Array:
    """Return (B, 4, 2) corners seen from above, anticlockwise from front left, of (B, 7) boxes."""
    local = _CORNER_SIGNS[None] * boxes[:, None, BOX_LENGTH : BOX_WIDTH + 1]
    cos, sin = np.cos(boxes[:, BOX_YAW, None]), np.sin(boxes[:, BOX_YAW, None])
    rotated = np.stack([local[..., 0] * cos - local[..., 1] * sin, local[..., 0] * sin + local[..., 1] * cos], axis=-1)
    return rotated + boxes[:, None, :2]


def to_box_frame(points: FloatArray, box: Float64Array) -> Float64Array:
    """Carry (N, 3) points into the frame of one (7,) box: centre at 0, x along its heading."""
    cos, sin = np.cos(box[BOX_YAW]), np.sin(box[BOX_YAW])
    offset = points.astype(np.float64) - box[:3]
    return np.stack(
        [offset[:, 0] * cos + offset[:, 1] * sin, offset[:, 1] * cos - offset[:, 0] * sin, offset[:, 2]], axis=1
    )


def points_in_box(
    points: FloatArray,  # (N, 3)
    box: Float64Array,  # (7,) same frame
    margin_m: float = 0.0,
) -> BoolArray:
    """Return (N,) True where a point is inside the box grown by ``margin_m`` on each side."""
    radius = np.hypot(box[BOX_LENGTH], box[BOX_WIDTH]) / 2 + 2 * margin_m
    is_near = (np.abs(points[:, 0] - box[0]) <= radius) & (np.abs(points[:, 1] - box[1]) <= radius)
    inside = np.zeros(len(points), dtype=bool)
    local = to_box_frame(points[is_near], box)
    inside[is_near] = (np.abs(local) <= box[BOX_LENGTH : BOX_HEIGHT + 1] / 2 + margin_m).all(axis=1)
    return inside


def tight_box(points: FloatArray, yaw: float) -> Float64Array:
    """Return the (7,) smallest box with heading ``yaw`` around (N, 3) points, N >= 1.

    Source: MinAreaBBoxAlongDirection of Algorithms 1 and 2: with the direction given, the tight box is the smallest.
    """
    local = to_box_frame(points, np.array([0, 0, 0, 0, 0, 0, yaw]))
    low, high = local.min(axis=0), local.max(axis=0)
    cos, sin = np.cos(yaw), np.sin(yaw)
    x, y, z = (low + high) / 2
    return np.array([x * cos - y * sin, x * sin + y * cos, z, *(high - low), float(wrap_angle(yaw))])


def transform_boxes(target_from_source: Float64Array, boxes: Float64Array) -> Float64Array:
    """Carry (B, 7) boxes to another frame; roll and pitch of the transform turn centres, not boxes."""
    moved = boxes.copy()
    moved[:, :3] = transform_points(target_from_source, boxes[:, :3])
    moved[:, BOX_YAW] = wrap_angle(boxes[:, BOX_YAW] + yaw_of(target_from_source))
    return moved


def bev_intersection_m2(boxes_a: Float64Array, boxes_b: Float64Array) -> Float64Array:
    """Return (A, B) areas shared seen from above.

    Own clipping instead of a library's exact overlay: that one may find no area in rectangles that are equal but for
    the last bit.
    """
    area = np.zeros((len(boxes_a), len(boxes_b)))
    radius_a = np.hypot(boxes_a[:, BOX_LENGTH], boxes_a[:, BOX_WIDTH]) / 2
    radius_b = np.hypot(boxes_b[:, BOX_LENGTH], boxes_b[:, BOX_WIDTH]) / 2
    distance = np.linalg.norm(boxes_a[:, None, :2] - boxes_b[None, :, :2], axis=-1)
    row, column = np.nonzero(distance <= radius_a[:, None] + radius_b[None, :])
    if len(row):
        area[row, column] = paired_bev_intersection_m2(boxes_a[row], boxes_b[column])
    return area


def paired_bev_intersection_m2(boxes_a: Float64Array, boxes_b: Float64Array) -> Float64Array:
    """Return (P,) areas shared by pairs of boxes seen from above: a's corners, in b's frame, clipped by b's sides."""
    local = boxes_a.copy()
    local[:, :2] -= boxes_b[:, :2]
    cos, sin = np.cos(boxes_b[:, BOX_YAW, None]), np.sin(boxes_b[:, BOX_YAW, None])
    corner = bev_corners(local)
    x, y = corner[..., 0] * cos + corner[..., 1] * sin, corner[..., 1] * cos - corner[..., 0] * sin  # (P, 4)
    half_length, half_width = boxes_b[:, BOX_LENGTH, None] / 2, boxes_b[:, BOX_WIDTH, None] / 2
    for limit in (half_length, half_width, half_length, half_width):
        x, y = _clip(x, y, limit)
        x, y = y, -x  # a quarter turn: the next side is ahead
    return np.abs((x * np.roll(y, -1, axis=1) - np.roll(x, -1, axis=1) * y).sum(axis=1)) / 2


def _clip(x: Float64Array, y: Float64Array, limit: Float64Array) -> tuple[Float64Array, Float64Array]:
    """Cut (P, V) polygons at x = ``limit`` (P, 1): (P, 2 V), what lies beyond is pressed flat onto the cut."""
    step_x, step_y = np.roll(x, -1, axis=1) - x, np.roll(y, -1, axis=1) - y
    is_crossing = (x < limit) != (x + step_x < limit)
    way = np.divide(limit - x, step_x, out=np.zeros_like(x), where=is_crossing & (step_x != 0))
    cut_x = np.stack([x, x + way * step_x], axis=2).reshape(len(x), -1)
    cut_y = np.stack([y, y + way * step_y], axis=2).reshape(len(y), -1)
    return np.minimum(cut_x, limit), cut_y


def bev_iou(boxes_a: Float64Array, boxes_b: Float64Array) -> Float64Array:
    """Return (A, B) intersection over union of the rectangles seen from above."""
    shared = bev_intersection_m2(boxes_a, boxes_b)
    return _bev_ratio(shared, boxes_a[:, None], boxes_b[None])


def paired_bev_iou(boxes_a: Float64Array, boxes_b: Float64Array) -> Float64Array:
    """Return (P,) intersections over unions of pairs of rectangles seen from above."""
    return _bev_ratio(paired_bev_intersection_m2(boxes_a, boxes_b), boxes_a, boxes_b)


def _bev_ratio(shared_m2: Float64Array, boxes_a: Float64Array, boxes_b: Float64Array) -> Float64Array:
    area_a, area_b = (boxes[..., BOX_LENGTH] * boxes[..., BOX_WIDTH] for boxes in (boxes_a, boxes_b))
    union = area_a + area_b - shared_m2
    iou: Float64Array = np.divide(shared_m2, union, out=np.zeros_like(shared_m2), where=union > 0)
    return iou


def overlap_of_smaller(boxes_a: Float64Array, boxes_b: Float64Array) -> Float64Array:
    """Return (A, B) areas shared seen from above over that of the smaller box; 0 where one box is above the other."""
    shared = np.where(_shared_height_m(boxes_a, boxes_b) > 0, bev_intersection_m2(boxes_a, boxes_b), 0.0)
    area_a, area_b = (boxes[:, BOX_LENGTH] * boxes[:, BOX_WIDTH] for boxes in (boxes_a, boxes_b))
    smaller = np.minimum(area_a[:, None], area_b[None])
    share: Float64Array = np.divide(shared, smaller, out=np.zeros_like(shared), where=smaller > 0)
    return share


def _shared_height_m(boxes_a: Float64Array, boxes_b: Float64Array) -> Float64Array:
    top = np.minimum(
        (boxes_a[:, BOX_Z] + boxes_a[:, BOX_HEIGHT] / 2)[:, None],
        (boxes_b[:, BOX_Z] + boxes_b[:, BOX_HEIGHT] / 2)[None],
    )
    bottom = np.maximum(
        (boxes_a[:, BOX_Z] - boxes_a[:, BOX_HEIGHT] / 2)[:, None],
        (boxes_b[:, BOX_Z] - boxes_b[:, BOX_HEIGHT] / 2)[None],
    )
    height: Float64Array = np.clip(top - bottom, 0, None)
    return height


def iou_3d(boxes_a: Float64Array, boxes_b: Float64Array) -> Float64Array:
    """Return (A, B) intersection over union of the volumes."""
    shared = bev_intersection_m2(boxes_a, boxes_b) * _shared_height_m(boxes_a, boxes_b)
    volume_a = boxes_a[:, BOX_LENGTH : BOX_HEIGHT + 1].prod(axis=1)
    volume_b = boxes_b[:, BOX_LENGTH : BOX_HEIGHT + 1].prod(axis=1)
    union = volume_a[:, None] + volume_b[None, :] - shared
    iou: Float64Array = np.divide(shared, union, out=np.zeros_like(shared), where=union > 0)
    return iou
