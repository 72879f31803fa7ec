"""Parameters of the stage ``registration``."""

from pydantic import Field

from schemas.config.base import Params


class RegistrationParams(Params):
    """Sequential ICP to the growing target (paper Algorithm 2 and appendix)."""

    has_rotation_start: bool = True
    has_translation_grid: bool = True  # 5 x 5, strides of a quarter of the target box
    is_constrained: bool = True  # rotation about z only
    icp_iterations: int = Field(30, ge=1)  # not in the paper
    icp_cutoff_m: float = Field(1.0, gt=0)  # not in the paper
    has_motion_start: bool = True  # the neighbour view advanced by its flow as one more start; paper: no
    motion_margin_m: float = Field(0.005, ge=0)  # of mean error, by which another start must be better than that one
    has_slide_test: bool = True  # along a flat side that fits anywhere, a view lies where its flow led; paper: no
    joint_rounds: int = Field(1, ge=0)  # in which each view is aligned again, with all the others; paper: 0
    num_refined_starts: int = Field(3, ge=1)  # starts that ICP refines, best first; paper: all 25
    max_source_points: int = Field(256, ge=8)  # of one view; not in the paper
    max_target_points: int = Field(1024, ge=8)  # of the aggregate; not in the paper
