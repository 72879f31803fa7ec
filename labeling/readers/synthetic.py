"""Segments of the built-in world: ``synthetic:street?sweeps=20&seed=1``."""

from typing import Final
from urllib.parse import parse_qsl

from pydantic import BaseModel, ConfigDict, Field, ValidationError, field_validator

from labeling.synthetic.lidar import Lidar
from labeling.synthetic.scene import START_NS, SceneReader
from labeling.synthetic.street import build_street
from schemas.errors import InvalidInput

_SCHEME: Final = "synthetic:"
_WORLDS: Final = ("street",)


class StreetOptions(BaseModel):
    """What stands behind the question mark of ``synthetic:street?…``."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    sweeps: int = Field(20, ge=1, le=2000)
    seed: int = Field(0, ge=0, lt=2**63)
    beams: int = Field(64, ge=8, le=128)
    azimuth_steps: int = Field(1800, ge=90, le=4000)
    hz: float = Field(10.0, ge=5, le=50)
    noise_m: float = Field(0.02, ge=0, le=0.5)
    dropout: float = Field(0.03, ge=0, le=0.9)
    movers: int | None = Field(None, ge=0, le=1000)  # None: all the street has
    start_ns: int = Field(START_NS, ge=0, lt=2**62)

    @field_validator("movers", mode="before")
    @classmethod
    def _read_movers(cls, value: object) -> object:
        return {"true": None, "false": 0}.get(value, value) if isinstance(value, str) else value


def open_segment(uri: str) -> SceneReader:
    """Open ``synthetic:WORLD?option=value&…``; the reader's URI lists the options that are not the default, sorted.

    Raises:
        InvalidInput: Unknown world or option, or a value out of bounds; the message names what is accepted.

    """
    if not uri.startswith(_SCHEME):
        raise InvalidInput(f"{uri}: a synthetic segment is called like synthetic:street?sweeps=20&seed=1")
    world, _, query = uri.removeprefix(_SCHEME).partition("?")
    if world not in _WORLDS:
        raise InvalidInput(f"{uri}: unknown world {world!r}: expected one of {', '.join(_WORLDS)}")
    options = _read_options(uri, query)
    changed = options.model_dump(exclude_defaults=True)
    listed = "&".join(f"{name}={changed[name]}" for name in sorted(changed))
    lidar = Lidar(options.beams, options.azimuth_steps, options.noise_m, options.dropout)
    return build_street(options.seed, options.sweeps / options.hz, options.movers).reader(
        options.sweeps,
        options.hz,
        lidar,
        seed=options.seed,
        name=f"{world}-s{options.seed}",
        uri=f"{_SCHEME}{world}" + (f"?{listed}" if listed else ""),
        start_ns=options.start_ns,
    )


def _read_options(uri: str, query: str) -> StreetOptions:
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
