"""Parameters of the stage ``attribution``."""

from collections.abc import Mapping
from typing import ClassVar

from pydantic import Field

from schemas.config.base import StageParams


class AttributionParams(StageParams):
    """Flow and owner of each point, once tracks are finished (ours; written with ``write_points``)."""

    OUR_STEPS: ClassVar[Mapping[str, str]] = {
        "tracks": "points move as the tracks that they belong to, else by the flow as it was estimated",
    }

    min_claim_score: float = Field(0.5, ge=0, le=1)  # from here a box takes points that another object's proposal has
    noise_factor: float = Field(2.5, ge=0, le=100)  # of range noise, by which a box is grown to find its points
    min_speed_mps: float = Field(0.7, ge=0, le=200)  # slower objects stand, and their points with them
    min_stray_speed_mps: float = Field(1.0, ge=0, le=200)  # by which a point of no object is dynamic
