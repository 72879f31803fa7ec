"""How lidars sample the world, and which of them saw a point: what of its place is theirs, and not the object's."""

from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np

from schemas.arrays import BoolArray, Float64Array, FloatArray, Int64Array, UInt8Array, read_only, require
from schemas.errors import InvalidInput

NUM_WAYS = 72  # sectors of 5 degrees, from straight behind anticlockwise
MIN_RESOLUTION_RAD, MIN_NOISE_M = 0.004, 0.02  # poses and capture times tell directions and places no better
APART_S = 0.01  # between two lidars that see a place at different times: what drives has moved on


@dataclass(frozen=True, slots=True)
class Lidar:
    """One lidar of a vehicle. Records that are equal speak of the same one."""

    origin_m: tuple[float, float, float]  # where its rays start; ego frame, unless said otherwise
    azimuth_step_rad: float  # between neighbouring rays, where it sees far
    elevation_step_rad: float
    range_noise_m: float  # standard deviation of a range
    look_times_s: tuple[float, ...] = (np.inf,) * NUM_WAYS  # its phase: when it looks each way, inf: never or unknown

    @property
    def azimuth_resolution_rad(self) -> float:
        """How well azimuths are told: what lies between two rays is nearer to one of them than half of their step."""
        return max(self.azimuth_step_rad / 2, MIN_RESOLUTION_RAD)

    @property
    def elevation_resolution_rad(self) -> float:
        """How well elevations are told."""
        return max(self.elevation_step_rad / 2, MIN_RESOLUTION_RAD)

    @property
    def resolution_rad(self) -> float:
        """How well directions are told."""
        return max(self.azimuth_resolution_rad, self.elevation_resolution_rad)

    @property
    def noise_m(self) -> float:
        """How well ranges are told, a standard deviation."""
        return max(self.range_noise_m, MIN_NOISE_M)

    def is_in_step_with(self, other: "Lidar") -> bool:
        """Tell whether both look the same ways at the same times, as far as is known and both look there."""
        mine, its = np.array(self.look_times_s), np.array(other.look_times_s)
        both = np.isfinite(mine) & np.isfinite(its)
        return not both.any() or bool(np.median(np.abs(mine[both] - its[both])) <= APART_S)


@dataclass(frozen=True, slots=True, eq=False)
class Beams:
    """Which lidar saw each of N points; origins are in the frame of the points."""

    lidars: tuple[Lidar, ...]
    of_point: UInt8Array  # (N,) position in ``lidars``

    def __post_init__(self) -> None:
        """Check shapes and make all arrays read-only."""
        require("of_point", self.of_point, (None,), np.uint8)
        if len(self.of_point) and int(self.of_point.max()) >= len(self.lidars):
            raise InvalidInput(f"of_point names lidar {self.of_point.max()}, of {len(self.lidars)}")
        object.__setattr__(self, "of_point", read_only(self.of_point))

    def of(self, rows: Int64Array | BoolArray | slice) -> "Beams":
        """Return those of some points."""
        return Beams(self.lidars, self.of_point[rows])

    def moved(self, target_from_source: Float64Array) -> "Beams":
        """Return them with origins in another frame."""
        origins = np.array([lidar.origin_m for lidar in self.lidars]) @ target_from_source[:3, :3].T
        moved = [tuple(origin) for origin in (origins + target_from_source[:3, 3]).tolist()]
        return Beams(tuple(replace(a, origin_m=b) for a, b in zip(self.lidars, moved, strict=True)), self.of_point)

    @property
    def scan_of_point(self) -> UInt8Array:
        """(N,) numbers shared by lidars in step. Those that are not show what moves at two places of one sweep."""
        return np.array(scans_of(self.lidars), dtype=np.uint8)[self.of_point]

    @property
    def noise_m(self) -> Float64Array:
        """(N,) how well their ranges are told, standard deviations."""
        return np.array([lidar.noise_m for lidar in self.lidars])[self.of_point]

    @property
    def origins_m(self) -> Float64Array:
        """(N, 3) where the rays started."""
        return np.array([lidar.origin_m for lidar in self.lidars])[self.of_point]

    def resolution_m(self, points: FloatArray) -> Float64Array:
        """Return (N,) how well places across the rays are told at (N, 3) points."""
        resolution_rad = np.array([lidar.resolution_rad for lidar in self.lidars])[self.of_point]
        return np.asarray(resolution_rad * np.linalg.norm(points - self.origins_m, axis=1))

    @property
    def main(self) -> Lidar:
        """The lidar that saw most of the points, N >= 1."""
        return self.lidars[int(np.bincount(self.of_point).argmax())]


@lru_cache(maxsize=64)
def scans_of(lidars: tuple[Lidar, ...]) -> tuple[int, ...]:
    """Return a number for each lidar, shared by those that are all in step with each other."""
    scans: list[list[Lidar]] = []
    numbers = []
    for lidar in lidars:
        number = next((k for k, scan in enumerate(scans) if all(map(lidar.is_in_step_with, scan))), len(scans))
        if number == len(scans):
            scans.append([])
        scans[number].append(lidar)
        numbers.append(number)
    return tuple(numbers)
