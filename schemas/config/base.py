"""What all parameter models share."""

from pydantic import BaseModel, ConfigDict


class Params(BaseModel):
    """Frozen; unknown keys and numbers that are none fail."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)
