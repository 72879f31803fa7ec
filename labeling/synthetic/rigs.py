"""The lidars of the made-up vehicle: spinning ones, solid-state ones, and rigs of several."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

import numpy as np

from schemas.arrays import BoolArray, Float64Array, FloatArray
from schemas.lidars import NUM_WAYS, Lidar

CORNERS_M: Final = ((3.6, 0.9, 0.5), (3.6, -0.9, 0.5), (-0.9, -0.9, 0.5), (-0.9, 0.9, 0.5))  # of the vehicle
_WAYS_RAD: Final = (np.arange(NUM_WAYS) + 0.5) * (2 * np.pi / NUM_WAYS) - np.pi


@dataclass(frozen=True, slots=True, eq=False)
class Aim:
    """Where the rays of a sweep go: columns of beams, each column at one time and in one azimuth. Ego axes."""

    share: Float64Array  # (columns,) of the sweep's period, after its stamp
    azimuth: Float64Array  # (columns,) rad
    elevation: Float64Array  # (columns, beams) rad


@dataclass(frozen=True, slots=True)
class SpinningLidar:
    """Turns once a sweep, anticlockwise. Beams stand closest just below the horizon, where the street is far away."""

    num_beams: int = 32
    azimuth_steps: int = 900  # a turn
    noise_m: float = 0.02
    dropout: float = 0.03  # share of returns lost near by; several times as many far away or at grazing incidence
    min_range_m: float = 2.0
    max_range_m: float = 100.0
    origin_ego_m: tuple[float, float, float] = (1.35, 0.0, 1.64)
    has_rolling_shutter: bool = True  # False: the whole turn is seen at the stamp
    starts_at_rad: float = -np.pi  # azimuth at the stamp
    facing_rad: float = 0.0
    opening_rad: float = 2 * np.pi  # about where it faces; the vehicle hides the rest of the turn
    beam_shares: tuple[float, ...] = (0.0, 0.32, 0.88, 1.0)  # of the beams that lie below ...
    inclinations_deg: tuple[float, ...] = (-25.0, -7.0, 2.5, 15.0)  # ... these angles

    def inclinations_rad(self) -> Float64Array:
        """Return (B,) angles above the horizon, ascending."""
        share = (np.arange(self.num_beams) + 0.5) / self.num_beams
        return np.deg2rad(np.interp(share, self.beam_shares, self.inclinations_deg))

    def aim(self, start_s: float, period_s: float) -> Aim:
        """Return one turn; all are alike."""
        share = (np.arange(self.azimuth_steps) + 0.5) / self.azimuth_steps
        azimuth = self.starts_at_rad + 2 * np.pi * share
        seen = np.flatnonzero(self._looks(azimuth))
        elevation = np.broadcast_to(self.inclinations_rad(), (len(seen), self.num_beams))
        return Aim(share[seen] * self.has_rolling_shutter, azimuth[seen], elevation)

    def describe(self, period_s: float) -> Lidar:
        """Return the record; the step in elevation is that of most beams."""
        looks_s = (_WAYS_RAD - self.starts_at_rad) % (2 * np.pi) / (2 * np.pi) * period_s * self.has_rolling_shutter
        return Lidar(
            self.origin_ego_m,
            2 * np.pi / self.azimuth_steps,
            float(np.median(np.diff(self.inclinations_rad()))),
            self.noise_m,
            tuple(np.where(self._looks(_WAYS_RAD), looks_s, np.inf).tolist()),
        )

    def _looks(self, azimuth: FloatArray) -> BoolArray:
        aside = (azimuth - self.facing_rad + np.pi) % (2 * np.pi) - np.pi
        return np.asarray(np.abs(aside) <= self.opening_rad / 2)


@dataclass(frozen=True, slots=True)
class RosetteLidar:
    """A solid-state lidar whose prisms draw a rosette ahead, no two sweeps the same.

    The direction is the sum of two that turn against each other, as behind a pair of prisms; six beams share it.
    """

    num_rays: int = 24_000  # a sweep
    noise_m: float = 0.02
    dropout: float = 0.03
    min_range_m: float = 2.0
    max_range_m: float = 100.0
    origin_ego_m: tuple[float, float, float] = (1.6, 0.0, 1.6)
    opening_rad: float = np.deg2rad(70.0)  # in azimuth
    height_rad: float = np.deg2rad(25.0)
    tilt_rad: float = np.deg2rad(-3.0)  # of its middle
    num_beams: int = 6
    beam_step_rad: float = np.deg2rad(0.6)
    turns_per_s: tuple[float, float] = (121.57, -77.73)

    def aim(self, start_s: float, period_s: float) -> Aim:
        """Return the part of the rosette that is drawn in this sweep."""
        share = (np.arange(self.num_rays // self.num_beams) + 0.5) / (self.num_rays // self.num_beams)
        angles = 2 * np.pi * np.outer(self.turns_per_s, start_s + share * period_s)  # (2, columns)
        azimuth = np.cos(angles).sum(axis=0) * self.opening_rad / 4
        middle = np.sin(angles).sum(axis=0) * self._swing_rad / 4 + self.tilt_rad
        beams = (np.arange(self.num_beams) - (self.num_beams - 1) / 2) * self.beam_step_rad
        return Aim(share, azimuth, middle[:, None] + beams)

    def describe(self, period_s: float) -> Lidar:
        """Return the record: steps are those of a pattern without order that is as dense."""
        rays_per_rad2 = self.num_rays / (np.pi / 4 * self.opening_rad * self.height_rad)
        step_rad = float(np.sqrt(np.log(2) / rays_per_rad2))  # median way to the next ray in a quarter of directions
        looks_s = np.where(np.abs(_WAYS_RAD) <= self.opening_rad / 2, period_s / 2, np.inf)
        return Lidar(self.origin_ego_m, step_rad, step_rad, self.noise_m, tuple(looks_s.tolist()))

    @property
    def _swing_rad(self) -> float:
        return self.height_rad - (self.num_beams - 1) * self.beam_step_rad


Sensor = SpinningLidar | RosetteLidar
Rig = tuple[Sensor, ...]


def _roof(beams: int, azimuth_steps: int, noise_m: float, dropout: float) -> Rig:
    return (SpinningLidar(beams, azimuth_steps, noise_m, dropout),)


def _pair(beams: int, azimuth_steps: int, noise_m: float, dropout: float) -> Rig:
    """Return two lidars of half the beams, one above the other and half a turn apart."""
    upper = SpinningLidar(beams - beams // 2, azimuth_steps, noise_m, dropout)
    lower = SpinningLidar(
        beams // 2, azimuth_steps, noise_m, dropout, origin_ego_m=(1.35, 0.0, 1.53), starts_at_rad=0.0
    )
    return (upper, lower)


def _taxi(beams: int, azimuth_steps: int, noise_m: float, dropout: float) -> Rig:
    """Return a long-range lidar on the roof and four short ones, of half its beams and steps, at the corners."""
    corners = [
        SpinningLidar(
            beams // 2,
            azimuth_steps // 2,
            noise_m,
            dropout,
            min_range_m=0.5,
            max_range_m=30.0,
            origin_ego_m=place,
            starts_at_rad=k * np.pi / 2,
            facing_rad=float(np.arctan2(np.sign(place[1]), np.sign(place[0]))),
            opening_rad=np.deg2rad(200.0),
            beam_shares=(0.0, 1.0),
            inclinations_deg=(-40.0, 20.0),
        )
        for k, place in enumerate(CORNERS_M)
    ]
    return (*_roof(beams, azimuth_steps, noise_m, dropout), *corners)


def _rosette(beams: int, azimuth_steps: int, noise_m: float, dropout: float) -> Rig:
    """Return a solid-state lidar with as many rays as the lidar on the roof has in its view."""
    opening_rad = np.deg2rad(70.0)
    num_rays = round(beams * azimuth_steps * opening_rad / (2 * np.pi))
    return (RosetteLidar(num_rays, noise_m, dropout, opening_rad=opening_rad),)


RIGS: Final[dict[str, Callable[[int, int, float, float], Rig]]] = {
    "roof": _roof,
    "pair": _pair,
    "taxi": _taxi,
    "rosette": _rosette,
}
"""By name: what a vehicle carries, for beams and steps a turn of the lidar on its roof, range noise and dropout."""
