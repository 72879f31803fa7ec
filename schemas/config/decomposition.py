"""Parameters of the stage ``decomposition``."""

from pydantic import Field

from schemas.config.base import Params


class DecompositionParams(Params):
    """Connected components of the dynamic points (paper section 3.1; radius not in the paper)."""

    radius_m: float = Field(0.6, gt=0, le=100)
    resolution_factor: float = Field(8.75, gt=0, le=100)  # of what the lidar tells there, where that is less
    min_radius_m: float = Field(0.3, gt=0, le=100)
