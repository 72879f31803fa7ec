"""Profiles: named sets of overrides, and how a config is made from one.

Where the paper gives no value, the field says "not in the paper" and profile ``paper`` keeps ours.
"""

from typing import Any, Final

from pydantic import ValidationError

from schemas.config.base import StageParams
from schemas.config.labeling import LabelingConfig
from schemas.errors import InvalidInput, quote, shorten

_STAGES: Final = {
    name: field.annotation
    for name, field in LabelingConfig.model_fields.items()
    if isinstance(field.annotation, type) and issubclass(field.annotation, StageParams)
}


def our_steps() -> tuple[tuple[str, str], ...]:
    """Return stage and name of each step that is not in the paper: what an ablation leaves out one at a time."""
    return tuple((stage, step) for stage, params in _STAGES.items() for step in params.OUR_STEPS)


_PAPER_VALUES: Final[dict[str, dict[str, Any]]] = {
    "static": {"method": "chamfer", "noise_factor": 0.0, "resolution_factor": 0.0},
    "flow": {
        "local_consistency": 0.1,
        "hidden_layers": 8,
        "hidden_units": 128,
        "iterations": 1000,
        "patience": 100,
        "max_buffer_m": 2.5,
        "max_points": 8192,
    },
    "proposals": {"min_speed_mps": 1.0},
}

PROFILES: Final[dict[str, dict[str, Any]]] = {
    "default": {},
    "paper": {
        stage: {**_PAPER_VALUES.get(stage, {}), "without": tuple(sorted(params.OUR_STEPS))}
        for stage, params in _STAGES.items()
        if params.OUR_STEPS
    },
    "fast": {"flow": {"method": "rigid"}},
}


def resolve_config(profile: str = "default", overrides: dict[str, Any] | None = None) -> LabelingConfig:
    """Return the config of a profile with overrides, as ``{"flow.iterations": 80}`` (dotted) or nested.

    Raises:
        InvalidInput: Unknown profile or key, or a value out of bounds; the message names the key and what it takes.

    """
    if profile not in PROFILES:
        raise InvalidInput(f"unknown profile {profile!r}: expected one of {', '.join(PROFILES)}")
    values: dict[str, Any] = {"profile": profile}
    for stage, params in PROFILES[profile].items():
        values[stage] = dict(params)
    for key, value in (overrides or {}).items():
        _put(values, key, value)
    try:
        return LabelingConfig.model_validate(values)
    except ValidationError as error:
        raise InvalidInput("; ".join(_describe(problem) for problem in error.errors())) from None


def _put(values: dict[str, Any], key: str, value: Any) -> None:
    stage, is_nested, option = key.partition(".")
    if not is_nested and isinstance(value, dict):
        for name, inner in value.items():
            _put(values, f"{stage}.{name}", inner)
    elif not is_nested:
        values[stage] = value
    elif not isinstance(values.setdefault(stage, {}), dict):
        raise InvalidInput(f"option {shorten(key)} is set below the value {shorten(stage)}={quote(values[stage])}")
    else:
        values[stage][option] = value


def _describe(problem: Any) -> str:
    key = shorten(".".join(str(part) for part in problem["loc"]))
    if problem["type"] == "extra_forbidden":
        model: Any = LabelingConfig  # of the stage the key is in
        for stage in problem["loc"][:-1]:
            model = model.model_fields[stage].annotation
        return f"unknown option {key}: expected one of {', '.join(model.model_fields)}"
    return f"option {key}={quote(problem.get('input'))}: {problem['msg']}"
