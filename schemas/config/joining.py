"""Parameters of the stage ``joining``."""

from collections.abc import Mapping
from typing import ClassVar, Literal

from pydantic import Field

from schemas.config.base import StageParams

Regrouping = Literal["tracks", "strays"]


class JoiningParams(StageParams):
    """Pieces of one object -> one track (ours; off in profile ``paper``)."""

    OUR_STEPS: ClassVar[Mapping[str, str]] = {
        "tracks": "tracks that are pieces of one object become one",
        "strays": "tracks take up proposals that no track has",
    }

    rounds: int = Field(2, ge=1, le=16)  # each joins what the last one made larger
    min_common_s: float = Field(0.1, ge=0, le=3600)  # for which two tracks must be seen together to be compared
    min_shared_area: float = Field(0.3, gt=0, le=1)  # of the smaller amodal box, seen from above
    max_speed_difference_mps: float = Field(1.0, ge=0, le=200)
    max_speed_difference_share: float = Field(0.2, ge=0, le=1)  # of the faster one's speed, added
    max_silence_s: float = Field(1.5, ge=0, le=3600)  # behind an occlusion; longer ones must be pauses
    max_pause_s: float = Field(20.0, ge=0, le=3600)
    stray_reach_s: float = Field(0.5, ge=0, le=3600)  # before and after a track: there may be more of its object

    @property
    def regroupings(self) -> tuple[Regrouping, ...]:
        """The steps that are taken, one after the other: those of each round."""
        steps: tuple[Regrouping, ...] = ("tracks", "strays")
        return self.rounds * tuple(step for step in steps if self.has(step))
