"""Parameters of the stage ``ground``."""

from collections.abc import Mapping
from typing import ClassVar

from pydantic import Field

from schemas.config.base import StageParams


class GroundParams(StageParams):
    """Close-to-horizontal plane by RANSAC, then refined locally (paper section 3.1; the refinement is ours)."""

    OUR_STEPS: ClassVar[Mapping[str, str]] = {
        "local_surface": "refine the plane by a coarse and a fine height map",
    }

    max_slope_rad: float = Field(0.17, gt=0, lt=0.8, description="tilt of the plane RANSAC may propose")
    ransac_iterations: int = Field(200, ge=1, le=100_000)  # not in the paper
    inlier_distance_m: float = Field(0.2, gt=0, le=10)  # "points in its vicinity"; not in the paper
    cell_m: float = Field(1.0, gt=0, le=100)  # of the local refinement
    max_height_m: float = Field(0.2, gt=0, le=10)  # above the local ground
