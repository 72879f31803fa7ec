"""Parameters of the stage ``static``."""

from collections.abc import Mapping
from typing import ClassVar, Literal

from pydantic import Field

from schemas.config.base import MAX_GAPS, Gap, StageParams


class StaticParams(StageParams):
    """Points that other sweeps saw at the same place (paper section 3.1)."""

    OUR_STEPS: ClassVar[Mapping[str, str]] = {
        "whole_objects": "objects decide as a whole, and long ones by their ends",
    }

    method: Literal["chamfer", "visibility", "none"] = "visibility"  # paper: chamfer; none: keep all points
    max_speed_mps: float = Field(0.2, gt=0, le=200)  # paper: 20 cm/s
    noise_factor: float = Field(2.5, ge=0, le=100)  # of the lidar's range noise: no threshold is smaller; paper: 0
    resolution_factor: float = Field(1.0, ge=0, le=100)  # of what the lidar tells there, likewise; paper: 0
    num_chamfer_sweeps: int = Field(1, ge=1, le=1000)  # earlier ones, of chamfer; the paper says "earlier frames"
    vote_gaps_s: tuple[Gap, ...] = Field((0.5, 1.0, 1.5, 2.0), min_length=1, max_length=MAX_GAPS)  # of visibility
    min_vote_share: float = Field(0.8, gt=0, le=1)  # occupied among occupied and empty
    min_known_share: float = Field(0.25, gt=0, le=1)  # occupied among all votes
    clear_margin_m: float = Field(0.25, gt=0, le=100)  # how far beyond a place rays must go to prove it empty
    object_radius_m: float = Field(0.35, gt=0, le=100)  # free-standing: no other point nearer
    max_object_length_m: float = Field(16.0, gt=0, le=1000)  # diagonal seen from above
    max_object_height_m: float = Field(4.5, gt=0, le=1000)
    min_dynamic_share: float = Field(0.25, gt=0, le=1)  # an object with more is dynamic as a whole
    max_stray_share: float = Field(0.12, ge=0, lt=1)  # an object with less is static as a whole
