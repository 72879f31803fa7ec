"""Parameters of the stage ``ground``."""

from pydantic import Field

from schemas.config.base import Params


class GroundParams(Params):
    """Close-to-horizontal plane by RANSAC, then refined locally (paper section 3.1; the refinement is ours)."""

    max_slope_rad: float = Field(0.17, gt=0, lt=0.8, description="tilt of the plane RANSAC may propose")
    ransac_iterations: int = Field(200, ge=1)  # not in the paper
    inlier_distance_m: float = Field(0.2, gt=0)  # "points in its vicinity"; not in the paper
    refine: bool = True  # paper: one plane
    cell_m: float = Field(1.0, gt=0)  # of the local refinement
    max_height_m: float = Field(0.2, gt=0)  # above the local ground
