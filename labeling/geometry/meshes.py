"""Meshes: the surfaces between neighbouring beams of a lidar."""

from typing import Final

import numpy as np
from scipy.spatial import Delaunay, QhullError

from schemas.arrays import Float64Array, FloatArray, UInt8Array
from schemas.lidars import Beams

MAX_EDGE_M: Final = 1.0  # longer ones bridge two things
MIN_INCIDENCE: Final = 0.1  # cosine between ray and normal; less is the air beside an edge
JITTER_RAD: Final = 1e-5  # beams of one row are in line, and triangles without area are slow to search
LIDAR_STEP_RAD: Final = 100.0  # between the directions of two lidars


class SensorMesh:
    """Triangles between beams that are neighbours as their lidar sees them.

    Rows of points lie where the beams are, not where the object is: those of two sweeps are nearest to each other where
    row meets row. What lies between the rows does not depend on the beams.
    """

    def __init__(self, points: FloatArray, beams: Beams) -> None:
        """Triangulate (N, 3) points by their directions, those of each lidar by themselves."""
        self._origins = np.array([lidar.origin_m for lidar in beams.lidars])  # (L, 3)
        middle = (points - beams.origins_m).mean(axis=0) if len(points) else np.ones(3)
        self._middle_rad = float(np.arctan2(middle[1], middle[0]))  # directions count from here: none is cut at pi
        try:
            directions = self._directions(points, beams.of_point)
            directions += np.random.default_rng(0).uniform(-JITTER_RAD, JITTER_RAD, directions.shape)
            self._triangles = Delaunay(directions)
        except (QhullError, ValueError):  # too few
            self._triangles = None
            return
        corners = np.asarray(points, dtype=np.float64)[self._triangles.simplices]  # (T, 3, 3)
        edges = np.roll(corners, -1, axis=1) - corners
        normal = np.cross(edges[:, 0], edges[:, 1])
        normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12)
        lidar = beams.of_point[self._triangles.simplices]  # (T, 3)
        ray = corners.mean(axis=1) - self._origins[lidar[:, 0]]
        incidence = np.abs((normal * ray).sum(axis=1)) / np.linalg.norm(ray, axis=1)
        is_surface = (np.linalg.norm(edges, axis=2).max(axis=1) < MAX_EDGE_M) & (incidence > MIN_INCIDENCE)
        is_surface &= (lidar == lidar[:, :1]).all(axis=1)
        self._corner, self._normal = corners[:, 0], normal * is_surface[:, None]

    def heights(self, points: FloatArray, lidar_of_point: UInt8Array) -> tuple[Float64Array, Float64Array]:
        """Return (N, 3) normals of the surfaces in the direction of points, zero where there is none, and (N,) heights.

        A height is the distance from the surface along its normal, m. Points are held against surfaces of their lidar.
        """
        if self._triangles is None or len(points) == 0:
            return np.zeros((len(points), 3)), np.zeros(len(points))
        triangle = self._triangles.find_simplex(self._directions(points, lidar_of_point))
        normal = self._normal[triangle] * (triangle >= 0)[:, None]
        return normal, ((points - self._corner[triangle]) * normal).sum(axis=1)

    def _directions(self, points: FloatArray, lidar_of_point: UInt8Array) -> Float64Array:
        x, y, z = (points - self._origins[lidar_of_point]).T
        azimuth = (np.arctan2(y, x) - self._middle_rad + np.pi) % (2 * np.pi)
        return np.stack([azimuth + LIDAR_STEP_RAD * lidar_of_point, np.arctan2(z, np.hypot(x, y))], axis=1)
