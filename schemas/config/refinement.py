"""Parameters of the stage ``refinement``."""

from pydantic import Field

from schemas.config.base import Params


class RefinementParams(Params):
    """Amodal boxes, carried back to each sweep (paper Algorithm 2, last lines; what is marked is ours)."""

    has_robust_extent: bool = True  # paper: extreme points
    has_ground_anchor: bool = True  # box reaches down to the ground; paper: lowest point
    has_travel_heading: bool = True  # the direction the views travelled; paper: the flow of the densest view
    has_shape_heading: bool = True  # turn to flat sides where travel is unsure; paper: no
    has_vehicle_completion: bool = True  # sides no ray met, from the proportions of vehicles and people; paper: no
    has_smooth_motion: bool = True  # paper: no
    min_top_speed_mps: float = Field(1.0, ge=0)  # a track that stays slower stands, and is dropped; paper: 0
    min_fast_sweeps: int = Field(3, ge=1)  # that it has to be as fast as this
    max_height_m: float = Field(5.0, gt=0)  # what is taller is no road user: no code allows more; paper: no limit
