"""What stands in the name of a made-up segment, ``synthetic:street?sweeps=20&seed=1``, without making it up."""

from typing import Final, Literal
from urllib.parse import parse_qsl

from pydantic import BaseModel, ConfigDict, Field, ValidationError, field_validator

from schemas.errors import InvalidInput

SCHEME: Final = "synthetic:"
START_NS: Final = 1_700_000_000_000_000_000
_WORLDS: Final = ("street",)


class StreetOptions(BaseModel):
    """What stands behind the question mark of ``synthetic:street?…``."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    sweeps: int = Field(20, ge=1, le=2000)
    seed: int = Field(0, ge=0, lt=2**63)
    beams: int = Field(64, ge=8, le=128)
    azimuth_steps: int = Field(1800, ge=90, le=4000)
    rig: Literal["roof", "pair", "taxi", "rosette"] = "roof"  # with about so many rays, see labeling.synthetic.rigs
    hz: float = Field(10.0, ge=1, le=50)
    noise_m: float = Field(0.02, ge=0, le=0.5)
    dropout: float = Field(0.03, ge=0, le=0.9)
    movers: int | None = Field(None, ge=0, le=1000)  # None: all the street has
    body: Literal["none", "bonnet", "cab", "roof"] = "none"  # what the lidar sees of the vehicle that carries it
    start_ns: int = Field(START_NS, ge=0, lt=2**62)

    @field_validator("movers", mode="before")
    @classmethod
    def _read_movers(cls, value: object) -> object:
        return {"true": None, "false": 0}.get(value, value) if isinstance(value, str) else value

    @property
    def uri(self) -> str:
        """The one name of this street: the options that are not the default, sorted."""
        changed = self.model_dump(exclude_defaults=True)
        listed = "&".join(f"{name}={changed[name]}" for name in sorted(changed))
        return f"{SCHEME}street" + (f"?{listed}" if listed else "")

    @property
    def name(self) -> str:
        """What a reader of its labels may call it."""
        return f"street-s{self.seed}"


def read_options(uri: str) -> StreetOptions:
    """Read ``synthetic:WORLD?option=value&…``.

    Raises:
        InvalidInput: Unknown world or option, or a value out of bounds; the message names what is accepted.

    """
    if not uri.startswith(SCHEME):
        raise InvalidInput(f"{uri}: a synthetic segment is called like synthetic:street?sweeps=20&seed=1")
    world, _, query = uri.removeprefix(SCHEME).partition("?")
    if world not in _WORLDS:
        raise InvalidInput(f"{uri}: unknown world {world!r}: expected one of {', '.join(_WORLDS)}")
    accepted = ", ".join(StreetOptions.model_fields)
    try:
        pairs = parse_qsl(query, keep_blank_values=True, strict_parsing=bool(query))
    except ValueError:
        raise InvalidInput(f"{uri}: options must be name=value joined by &, got {query!r}") from None
    values = dict(pairs)
    if len(values) < len(pairs):
        raise InvalidInput(f"{uri}: an option is given twice")
    try:
        return StreetOptions.model_validate(values)
    except ValidationError as error:
        problem = error.errors()[0]
        name = ".".join(str(part) for part in problem["loc"])
        if problem["type"] == "extra_forbidden":
            raise InvalidInput(f"{uri}: unknown option {name!r}: expected {accepted}") from None
        raise InvalidInput(f"{uri}: option {name}={problem['input']!r}: {problem['msg']}") from None
