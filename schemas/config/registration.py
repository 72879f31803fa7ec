"""Parameters of the stage ``registration``."""

from collections.abc import Mapping
from typing import ClassVar

from pydantic import Field

from schemas.config.base import StageParams


class RegistrationParams(StageParams):
    """Sequential ICP to the growing target (paper Algorithm 2 and appendix)."""

    PAPER_STEPS: ClassVar[Mapping[str, str]] = {
        "rotation_start": "turn a view by the difference of headings",
        "translation_grid": "5 x 5 starts, strides of a quarter of the target box",
        "upright": "rotation about z only",
    }
    OUR_STEPS: ClassVar[Mapping[str, str]] = {
        "motion_start": "the neighbour view advanced by its flow is one more start",
        "slide_test": "along a flat side that fits anywhere, a view lies where its flow led",
        "joint_rounds": "each view is aligned again, with all the others",
        "few_starts": "only the most promising starts are refined",
    }

    icp_iterations: int = Field(30, ge=1, le=10_000)  # not in the paper
    icp_cutoff_m: float = Field(1.0, gt=0, le=100)  # not in the paper
    motion_margin_m: float = Field(0.005, ge=0, le=100)  # of mean error, by which another start must be better
    joint_rounds: int = Field(1, ge=1, le=16)  # in which each view is aligned again
    num_refined_starts: int = Field(3, ge=1, le=1000)  # best first
    max_source_points: int = Field(256, ge=8, le=1_000_000)  # of one view; not in the paper
    max_target_points: int = Field(1024, ge=8, le=1_000_000)  # of the aggregate; not in the paper
