"""Parameters of the stage ``attribution``."""

from typing import Literal

from pydantic import Field

from schemas.config.base import Params


class AttributionParams(Params):
    """Flow and owner of each point, once tracks are finished (ours; written with ``write_points``)."""

    method: Literal["tracks", "flow"] = "tracks"  # paper: flow, as it was estimated before tracking
    min_claim_score: float = Field(0.5, ge=0, le=1)  # from here a box takes points that another object's proposal has
    margin_m: float = Field(0.05, ge=0)  # by which a box is grown to find its points: range noise
    min_speed_mps: float = Field(0.7, ge=0)  # slower objects stand, and their points with them
    min_stray_speed_mps: float = Field(1.0, ge=0)  # that the flow of a point of no object needs to call it dynamic
