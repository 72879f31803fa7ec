"""Parameters of the stage ``tracking``."""

from collections.abc import Mapping
from typing import ClassVar

from pydantic import Field

from schemas.config.base import StageParams


class TrackingParams(StageParams):
    """Flow-advanced association with a Kalman filter (paper section 3.2)."""

    OUR_STEPS: ClassVar[Mapping[str, str]] = {
        "vacated": "only what left its place moves",
        "either_way": "either box's flow leads to the other, which may be off the more the longer the gap",
        "person_width": "narrow upright boxes are matched as wide as a person",
    }

    min_iou: float = Field(0.1, gt=0, lt=1)
    person_side_m: float = Field(0.6, ge=0, le=100)  # to which narrow upright boxes are widened
    max_acceleration_mps2: float = Field(3.0, ge=0, le=1000)  # of road users, by which boxes are off after a gap
    max_missed_s: float = Field(0.35, gt=0, le=3600)  # silence after which a track ends; not in the paper
    min_duration_s: float = Field(0.4, ge=0, le=3600)  # that has the fewest sweeps a track is seen in; not in the paper
    min_sweeps: int = Field(3, ge=1, le=1000)  # the same at any rate
    min_vacated_share: float = Field(0.1, ge=0, le=1)  # of a track's points, as in ``flow``
    process_noise_mps2: float = Field(3.0, gt=0, le=1000)  # Kalman; not in the paper
    position_noise_m: float = Field(0.3, gt=0, le=1000)
    velocity_noise_mps: float = Field(0.5, gt=0, le=1000)
