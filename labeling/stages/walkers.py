"""Walkers: people side by side are one cluster that moves as one -> the points of each.

Position tells them apart where velocity cannot: seen from above, the gap between two trunks is wider than any within
one of them.
"""

import numpy as np

from labeling.geometry.neighbors import connected_components
from schemas.arrays import FloatArray, Int64Array

MAX_SPEED_MPS = 3.0  # of walkers
MAX_GROUP_M = 3.0  # diagonal seen from above: what is larger is no group of a few people
MIN_PERSON_M, MAX_PERSON_M = 0.15, 1.2  # the same of one, arms and legs included: thinner are slivers of a vehicle
MIN_HEIGHT_M, MAX_HEIGHT_M = 0.3, 2.3  # of what is seen of them: heads and shoulders over a parked car, at least
MIN_GAP_M, MAX_GAP_M, GAP_FACTOR = 0.3, 0.38, 2.25  # between two trunks; of what the lidar tells in azimuth there
MIN_POINTS = 5  # of a person


def part_walkers(points: FloatArray, resolution_m: float, speed_mps: float) -> list[Int64Array]:
    """Return the rows of each person among (P, 3) points, P >= 1, z up; of anything else all rows, as one.

    ``resolution_m`` is how well azimuths are told there.
    What is too small to be a person goes to the nearest one. Source: ours; the paper's Algorithm 1 leaves them one.
    """
    is_group = _diagonal_m(points) <= MAX_GROUP_M and MIN_HEIGHT_M <= np.ptp(points[:, 2]) <= MAX_HEIGHT_M
    if speed_mps > MAX_SPEED_MPS or not is_group:
        return [np.arange(len(points))]
    seen_from_above = points * np.array([1, 1, 0], dtype=points.dtype)
    part = connected_components(seen_from_above, float(np.clip(GAP_FACTOR * resolution_m, MIN_GAP_M, MAX_GAP_M)))
    people = np.flatnonzero(np.bincount(part) >= MIN_POINTS)
    size_m = np.array([_diagonal_m(points[part == k]) for k in people])
    if len(people) < 2 or size_m.min() < MIN_PERSON_M or size_m.min() > MAX_PERSON_M:
        return [np.arange(len(points))]
    centers = np.stack([seen_from_above[part == k].mean(axis=0) for k in people])
    nearest = people[np.linalg.norm(seen_from_above[:, None] - centers, axis=2).argmin(axis=1)]
    person = np.where(np.isin(part, people), part, nearest)
    return [np.flatnonzero(person == k) for k in people]


def _diagonal_m(points: FloatArray) -> float:
    """Return the diagonal of (P, 3) points seen from above."""
    return float(np.hypot(*np.ptp(points[:, :2], axis=0)))
