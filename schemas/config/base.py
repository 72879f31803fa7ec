"""What all parameter models share."""

from collections.abc import Mapping
from typing import Annotated, ClassVar, Final, Self

from pydantic import BaseModel, ConfigDict, Field, field_validator

MAX_GAPS: Final = 16  # of one list: each is a look at two more sweeps
Gap = Annotated[float, Field(gt=0, le=3600)]  # s, between two sweeps


class Params(BaseModel):
    """Frozen; unknown keys and numbers that are none fail. Every number and list is bounded: requests set them."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class StageParams(Params):
    """Parameters of a stage whose steps can be left out, each by its name and in one way: ``without``.

    Steps of the paper are there for its ablations. Those of ours are what profile ``paper`` is without.
    """

    PAPER_STEPS: ClassVar[Mapping[str, str]] = {}  # name -> what it does
    OUR_STEPS: ClassVar[Mapping[str, str]] = {}

    without: tuple[str, ...] = Field((), max_length=32)  # steps to leave out

    @field_validator("without", mode="before")
    @classmethod
    def _split(cls, value: object) -> object:
        return tuple(name.strip() for name in value.split(",") if name.strip()) if isinstance(value, str) else value

    @field_validator("without", mode="after")
    @classmethod
    def _check_names(cls, value: tuple[str, ...]) -> tuple[str, ...]:
        known = {**cls.PAPER_STEPS, **cls.OUR_STEPS}
        unknown = sorted(set(value) - known.keys())
        if unknown:
            raise ValueError(f"no step {unknown[0]!r}: expected some of {', '.join(known) or 'none'}")
        return tuple(sorted(set(value)))

    def leave_out(self, *steps: str) -> Self:
        """Return the parameters without some more steps."""
        return self.model_validate({**self.model_dump(), "without": (*self.without, *steps)})

    def has(self, step: str) -> bool:
        """Tell whether a step is taken."""
        assert step in self.PAPER_STEPS or step in self.OUR_STEPS, step
        return step not in self.without
