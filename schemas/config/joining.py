"""Parameters of the stage ``joining``."""

from pydantic import Field

from schemas.config.base import Params


class JoiningParams(Params):
    """Pieces of one object -> one track (ours; off in profile ``paper``)."""

    rounds: int = Field(2, ge=0)  # each joins what the last one made larger; 0: off; paper: 0
    min_common_sweeps: int = Field(2, ge=1)
    min_shared_area: float = Field(0.3, gt=0, le=1)  # of the smaller amodal box, seen from above
    max_speed_difference_mps: float = Field(1.0, ge=0)
    max_speed_difference_share: float = Field(0.2, ge=0)  # of the faster one's speed, added
    max_silence_s: float = Field(1.5, ge=0)  # behind an occlusion; longer ones must be pauses
    max_pause_s: float = Field(20.0, ge=0)
    stray_reach_s: float = Field(0.5, ge=0)  # before and after a track, in which it looks for more of its object
