"""Parameters of the stage ``refinement``."""

from collections.abc import Mapping
from typing import ClassVar

from pydantic import Field

from schemas.config.base import StageParams


class RefinementParams(StageParams):
    """Amodal boxes, carried back to each sweep (paper Algorithm 2, last lines; what is marked is ours)."""

    OUR_STEPS: ClassVar[Mapping[str, str]] = {
        "robust_extent": "sides where most views support them, else the extreme points",
        "ground_anchor": "boxes reach down to the ground, else to the lowest point",
        "travel_heading": "head where the views travelled, else along the flow of the densest view",
        "shape_heading": "turn to flat sides where travel is unsure",
        "completion": "sides no ray met, from the proportions of vehicles and people",
        "smooth_motion": "smooth the poses and their velocity",
        "movers_only": "a track that stays slow stands, and is dropped",
        "height_limit": "what is taller than any road user is none",
    }

    min_top_speed_mps: float = Field(1.0, ge=0, le=200)  # a track that stays slower stands
    min_fast_s: float = Field(0.2, ge=0, le=3600)  # for which it has to be as fast as this
    max_height_m: float = Field(5.0, gt=0, le=1000)  # what is taller is no road user: no code allows more
