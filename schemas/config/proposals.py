"""Parameters of the stage ``proposals``."""

from collections.abc import Mapping
from typing import ClassVar

from pydantic import Field

from schemas.config.base import StageParams


class ProposalParams(StageParams):
    """Spatio-temporal clustering (paper Algorithm 1)."""

    PAPER_STEPS: ClassVar[Mapping[str, str]] = {
        "flow_clustering": "cluster by flow too, not only by position",
    }
    OUR_STEPS: ClassVar[Mapping[str, str]] = {
        "deskewing": "carry points along their motion to one instant before boxing",
        "walkers": "people side by side are one proposal each",
    }

    min_speed_mps: float = Field(0.5, ge=0, le=200)  # slower points are in no box; paper: 1
    position_eps_m: float = Field(1.0, gt=0, le=100)
    flow_eps_mps: float = Field(1.0, gt=0, le=200)  # paper: 0.1 m a sweep at 10 Hz
    min_samples: int = Field(4, ge=1, le=1_000_000)  # not in the paper
    min_points: int = Field(5, ge=1, le=1_000_000)  # of a proposal; not in the paper
