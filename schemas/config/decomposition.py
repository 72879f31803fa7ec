"""Parameters of the stage ``decomposition``."""

from pydantic import Field

from schemas.config.base import Params


class DecompositionParams(Params):
    """Connected components of the dynamic points (paper section 3.1; radius not in the paper)."""

    radius_m: float = Field(0.6, gt=0, le=100)
    radius_rad: float = Field(0.035, gt=0, le=1)  # times range, where that is less: beams lie dense near by
    min_radius_m: float = Field(0.3, gt=0, le=100)
