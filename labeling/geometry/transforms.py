"""Rigid transforms. (4, 4) float64, named target first: ``world_from_ego`` carries ego coordinates to world."""

import numpy as np
from scipy.spatial.transform import Rotation

from schemas.arrays import Float64Array, FloatArray


def transform_points(target_from_source: Float64Array, points: FloatArray) -> Float64Array:
    """Apply (4, 4) to (N, 3) points: rotate, then translate. Float64 out."""
    return points.astype(np.float64) @ target_from_source[:3, :3].T + target_from_source[:3, 3]


def rotate_vectors(target_from_source: Float64Array, vectors: FloatArray) -> Float64Array:
    """Apply the rotation only: flow and velocity do not translate. (N, 3) or (3,)."""
    return vectors.astype(np.float64) @ target_from_source[:3, :3].T


def invert(target_from_source: Float64Array) -> Float64Array:
    """Return source_from_target of a rigid (4, 4)."""
    inverse = np.eye(4)
    inverse[:3, :3] = target_from_source[:3, :3].T
    inverse[:3, 3] = -target_from_source[:3, :3].T @ target_from_source[:3, 3]
    return inverse


def yaw_translation(yaw: float, translation: FloatArray) -> Float64Array:
    """Return the (4, 4) that turns by ``yaw`` about z, then moves by ``translation`` (3,)."""
    transform = np.eye(4)
    transform[:2, :2] = [[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]]
    transform[:3, 3] = translation
    return transform


def yaw_of(target_from_source: Float64Array) -> float:
    """Return the heading of the source x axis in the target's xy plane, (-pi, pi]."""
    return float(np.arctan2(target_from_source[1, 0], target_from_source[0, 0]))


def rotation_from_quaternion(w: FloatArray, x: FloatArray, y: FloatArray, z: FloatArray) -> Float64Array:
    """Return (B, 3, 3) rotations of (B,) quaternion parts of any length; NaN where they have none."""
    parts = np.stack([w, x, y, z], axis=-1).astype(np.float64)
    has_direction = np.isfinite(parts).all(axis=-1) & parts.any(axis=-1)
    rotations = np.full((len(parts), 3, 3), np.nan)
    rotations[has_direction] = Rotation.from_quat(parts[has_direction], scalar_first=True).as_matrix()
    return rotations


def quaternions_of_yaw(yaw: FloatArray) -> Float64Array:
    """Return (B, 4) unit quaternions w, x, y, z that turn by (B,) ``yaw`` about z."""
    zeros = np.zeros(len(yaw))
    return np.stack([np.cos(yaw / 2), zeros, zeros, np.sin(yaw / 2)], axis=1)


def wrap_angle(angle: FloatArray | float) -> Float64Array:
    """Wrap radians into (-pi, pi]."""
    return np.pi - np.mod(np.pi - np.asarray(angle, dtype=np.float64), 2 * np.pi)
