"""The parameters of all stages together."""

import hashlib
import json
from collections.abc import Callable, Mapping
from functools import reduce
from typing import TYPE_CHECKING, Annotated, Any, Final, Literal

from pydantic import Field, model_validator

from schemas.config.attribution import AttributionParams
from schemas.config.base import Params, StageParams
from schemas.config.decomposition import DecompositionParams
from schemas.config.flow import FlowParams
from schemas.config.ground import GroundParams
from schemas.config.joining import JoiningParams
from schemas.config.proposals import ProposalParams
from schemas.config.refinement import RefinementParams
from schemas.config.registration import RegistrationParams
from schemas.config.static import StaticParams
from schemas.config.tracking import TrackingParams

if TYPE_CHECKING:
    from schemas.tables import Table  # brings pyarrow, which `--help` does without

SweepIndex = Annotated[int, Field(ge=0, lt=2**31)]  # the tables hold no larger one
PLACES: Final = ("flow.external_folder",)  # parameters that name places: what is there decides, not its name
_DECIDES_NOTHING: Final[dict[str, Any]] = {
    "profile": True,  # the name of a set of values
    "write_points": True,  # which tables are wanted
    "flow": {"external_folder"},  # what is in it is part of the segment's listing
}
_DECIDES_POINTS: Final[dict[str, Any]] = {"attribution": True}  # and no other table


class LabelingConfig(Params):
    """All that a user chooses. What of it decides a table is part of that table's identity."""

    profile: Literal["default", "paper", "fast"] = "default"
    seed: int = Field(0, ge=-(2**63), lt=2**63)
    sweeps: tuple[SweepIndex, SweepIndex] | None = None  # half-open range of sweep indices; None: all
    write_points: bool = False
    ground: GroundParams = GroundParams()
    static: StaticParams = StaticParams()
    decomposition: DecompositionParams = DecompositionParams()
    flow: FlowParams = FlowParams()
    proposals: ProposalParams = ProposalParams()
    tracking: TrackingParams = TrackingParams()
    registration: RegistrationParams = RegistrationParams()
    joining: JoiningParams = JoiningParams()
    refinement: RefinementParams = RefinementParams()
    attribution: AttributionParams = AttributionParams()

    @model_validator(mode="after")
    def _check_whole_scene(self) -> "LabelingConfig":
        if self.flow.method == "nsfp" and self.static.method != "none":
            raise ValueError("flow.method=nsfp fits the whole scene: set static.method=none with it")
        return self

    def leave_out(self, *steps: str) -> "LabelingConfig":
        """Return the config without some more steps, each named as ``flow.surfaces``."""
        stages: dict[str, StageParams] = {}
        for name in steps:
            stage, _, step = name.partition(".")
            stages[stage] = (stages.get(stage) or getattr(self, stage)).leave_out(step)
        return self.model_copy(update=stages)

    @property
    def places(self) -> dict[str, str]:
        """The places that the config names, by parameter."""
        named = {key: reduce(getattr, key.split("."), self) for key in PLACES}
        return {key: str(place) for key, place in named.items() if place is not None}

    def with_places(self, resolve: Callable[[str], str]) -> "LabelingConfig":
        """Return the config with ``resolve`` applied to each place that it names."""
        config = self
        for key, place in self.places.items():
            stage, _, name = key.partition(".")
            params = getattr(config, stage).model_copy(update={name: resolve(place)})
            config = config.model_copy(update={stage: params})
        return config

    def deciding(self, table: "Table") -> dict[str, Any]:
        """Return the values that decide what stands in a table, as JSON. ``labels`` and ``sweeps`` share them."""
        without: Any = _DECIDES_NOTHING if table == "points" else _DECIDES_NOTHING | _DECIDES_POINTS
        return self.model_dump(mode="json", exclude=without)

    @property
    def config_hash(self) -> str:
        """SHA-256 of all values, 16 hex digits."""
        return hash_values(self.model_dump(mode="json"))


def hash_values(values: Mapping[str, Any]) -> str:
    """Return the ``config_hash`` of a config's values as JSON, also when they are those of another version."""
    return hashlib.sha256(json.dumps(values, sort_keys=True).encode()).hexdigest()[:16]
