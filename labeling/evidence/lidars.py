"""The lidars of a segment: given by its reader, or measured from its first sweeps."""

from collections.abc import Callable, Sequence
from itertools import islice
from typing import Final

import numpy as np
from scipy.spatial import cKDTree
from scipy.stats import chi2

from labeling.geometry.visibility import directions
from labeling.geometry.voxels import spread_rows
from labeling.readers.reader import SegmentReader
from schemas.arrays import Float64Array, FloatArray, Int64Array
from schemas.frames import Sweep
from schemas.lidars import NUM_WAYS, Lidar

NUM_SWEEPS: Final = 3  # that are measured
SAME_PLACE_M: Final = 0.02  # lidars nearer to each other, and in step, are one
MAX_RAYS: Final = 4000  # of a lidar in a sweep that are measured
MIN_RAYS: Final = 200  # with fewer nothing is said of it
MIN_RANGE_M: Final = 2.0  # nearer is the vehicle itself
MAX_ELEVATION_RAD: Final = np.deg2rad(60.0)  # azimuth says little beyond
MAX_NEIGHBORS: Final = 64  # in which the next row is looked for
TINY_RAD: Final = 1e-4  # nearer directions are one ray that came back twice
MAX_STEP_RAD: Final = np.deg2rad(5.0)
NUM_IN_PATCH: Final = 10  # rays about one, on what is taken for a plane
FLAT_QUANTILE: Final = 0.25  # of the patches: most others have an edge, a bend or leaves
MAX_NOISE_M: Final = 0.2  # a cloud with more is none of a lidar's
UNKNOWN: Final = (np.deg2rad(0.2), np.deg2rad(0.4), 0.02)  # steps and noise where points do not tell


def lidars_of(reader: SegmentReader, read: Callable[[int], Sweep | None]) -> tuple[Lidar, ...]:
    """Return the lidars of a segment, one for each number in ``Sweep.lidar_of_point``.

    What is measured follows from the first usable sweeps of the segment, whichever sweeps are labelled, and by whom.

    Args:
        reader: May know its lidars.
        read: Returns a sweep; None: it cannot be used.

    """
    if reader.lidars is not None:
        return reader.lidars
    usable = (sweep for index in range(len(reader.timestamps_ns)) if (sweep := read(index)) is not None)
    return measure_lidars(list(islice(usable, NUM_SWEEPS)))


def measure_lidars(sweeps: Sequence[Sweep]) -> tuple[Lidar, ...]:
    """Measure how lidars sample the world from some sweeps of one segment.

    Numbers at one place and in step are one lidar: they are measured together, and their records are equal.

    Returns:
        One record a number in ``lidar_of_point``. Steps are those of rays that go farther than most, where they matter;
        of beams that lie closest at the horizon that is their step there. Noise is that of ranges about planes through
        neighbouring rays.

    Source: ours.

    """
    num_lidars = max((len(sweep.sensor_origins_ego) for sweep in sweeps), default=1)
    alone = [_measure(sweeps, [k]) for k in range(num_lidars)]
    if num_lidars == 1:
        return tuple(alone)
    parts: list[list[int]] = []
    for k, lidar in enumerate(alone):
        part = next((part for part in parts if _are_one(alone[part[0]], lidar)), None)
        if part is None:
            parts.append([k])
        else:
            part.append(k)
    whole = {k: alone[k] if len(part) == 1 else _measure(sweeps, part) for part in parts for k in part}
    return tuple(whole[k] for k in range(num_lidars))


def _are_one(a: Lidar, b: Lidar) -> bool:
    return bool(np.linalg.norm(np.subtract(a.origin_m, b.origin_m)) <= SAME_PLACE_M) and a.is_in_step_with(b)


def _measure(sweeps: Sequence[Sweep], numbers: Sequence[int]) -> Lidar:
    """Measure the lidar that has these numbers."""
    origin = np.zeros(3)
    found, times_s = [], []
    for sweep in sweeps:
        origin = sweep.sensor_origins_ego[numbers[0]].astype(np.float64)
        rows = np.flatnonzero(np.isin(sweep.lidar_of_point, numbers))
        azimuth, elevation, range_m = directions(sweep.points_ego[rows], origin)
        is_far = range_m >= np.median(range_m) if len(rows) else range_m > 0  # a moving vehicle turns what is near
        times_s.append(_look_times_s(azimuth[is_far], sweep.capture_offset_s[rows[is_far]]))
        is_clear = (range_m > MIN_RANGE_M) & (np.abs(elevation) < MAX_ELEVATION_RAD)
        if is_clear.sum() >= MIN_RAYS:
            rays = np.stack([azimuth, elevation], axis=1)[is_clear]
            measured = _measure_rays(rays, range_m[is_clear])
            found.append(measured if measured[-1] <= MAX_NOISE_M else UNKNOWN)
    azimuth_step, elevation_step, noise_m = np.median(found, axis=0).tolist() if found else UNKNOWN
    look_times_s = tuple(np.median(times_s, axis=0).tolist()) if times_s else (np.inf,) * NUM_WAYS
    x_m, y_m, z_m = origin.tolist()
    return Lidar((x_m, y_m, z_m), azimuth_step, elevation_step, noise_m, look_times_s)


def _look_times_s(azimuth: Float64Array, capture_offset_s: FloatArray) -> Float64Array:
    """Return (NUM_WAYS,) mean capture times by direction, inf where nothing came back or no times are known."""
    way = np.clip(np.floor((azimuth + np.pi) * (NUM_WAYS / (2 * np.pi))), 0, NUM_WAYS - 1).astype(np.int64)
    count = np.bincount(way, minlength=NUM_WAYS)
    total_s = np.bincount(way, weights=capture_offset_s, minlength=NUM_WAYS)
    is_known = (count > 0) & bool(capture_offset_s.any())
    return np.where(is_known, total_s / np.maximum(count, 1), np.inf)


def _measure_rays(rays: Float64Array, range_m: Float64Array) -> tuple[float, float, float]:
    """Return steps in azimuth and elevation and the range noise of (N, 2) rays."""
    far = np.flatnonzero(range_m >= np.median(range_m))
    steps = _steps(rays, far[spread_rows(len(far), MAX_RAYS)])
    return *steps, _noise_m(rays / steps, range_m, spread_rows(len(range_m), MAX_RAYS))


def _steps(rays: Float64Array, asked: Int64Array) -> tuple[float, float]:
    """Return the median way from a ray to the next one in azimuth, and in elevation.

    Next in azimuth is the nearest of those whose direction differs more in azimuth than in elevation: within a row, or
    in whatever pattern.
    """
    _, neighbors = cKDTree(rays).query(rays[asked], k=min(MAX_NEIGHBORS, len(rays)), p=np.inf)
    along, up = np.moveaxis(rays[neighbors] - rays[asked, None], 2, 0)
    is_row = np.abs(up) <= np.abs(along)
    azimuth = np.where(is_row & (along > TINY_RAD), along, np.inf).min(axis=1)
    elevation = np.where(~is_row & (up > TINY_RAD), up, np.inf).min(axis=1)
    return min(float(np.median(azimuth)), MAX_STEP_RAD), min(float(np.median(elevation)), MAX_STEP_RAD)


def _noise_m(rays_in_steps: Float64Array, range_m: Float64Array, asked: Int64Array) -> float:
    """Return the standard deviation of ranges about planes through neighbouring rays.

    The inverse range of a plane is linear in the direction, for small angles.
    """
    _, patch = cKDTree(rays_in_steps).query(rays_in_steps[asked], k=NUM_IN_PATCH)
    offset = rays_in_steps[patch] - rays_in_steps[asked, None]  # (n, NUM_IN_PATCH, 2)
    design = np.concatenate([np.ones((*patch.shape, 1)), offset], axis=2)
    inverse = 1 / range_m[patch][..., None]
    normal = np.swapaxes(design, 1, 2) @ design + 1e-9 * np.eye(3)  # rays of one row only do not tell a tilt
    residual = inverse - design @ np.linalg.solve(normal, np.swapaxes(design, 1, 2) @ inverse)
    freedom = NUM_IN_PATCH - 3
    deviation_m = np.sqrt((residual[..., 0] ** 2).sum(axis=1) / freedom) * range_m[asked] ** 2
    return float(np.quantile(deviation_m, FLAT_QUANTILE) / np.sqrt(chi2.ppf(FLAT_QUANTILE, freedom) / freedom))
