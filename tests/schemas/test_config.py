import json
from typing import get_args

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import BaseModel

from schemas.config import PLACES, PROFILES, LabelingConfig, our_steps, resolve_config
from schemas.errors import InvalidInput


def leaves(model, prefix=""):
    for name in type(model).model_fields:
        value = getattr(model, name)
        if isinstance(value, BaseModel):
            yield from leaves(value, f"{prefix}{name}.")
        else:
            yield f"{prefix}{name}", value


@pytest.mark.parametrize("profile", PROFILES)
def test_every_profile_resolves_and_changes_only_what_it_names(profile):
    config, default = resolve_config(profile), resolve_config()
    assert config.profile == profile
    changed = {name for name, value in leaves(config) if dict(leaves(default))[name] != value}
    named = {f"{stage}.{name}" for stage, params in PROFILES[profile].items() for name in params}
    assert changed - {"profile"} == named  # a named value that equals the default would be noise


PAPER = {
    "static.method": "chamfer",
    "static.max_speed_mps": 0.2,  # 20 cm/s, whatever the range
    "static.noise_factor": 0.0,
    "static.resolution_factor": 0.0,
    "flow.method": "nsfp++",
    "flow.hidden_layers": 8,  # NSFP's nets
    "flow.hidden_units": 128,
    "flow.learning_rate": 0.008,
    "flow.local_consistency": 0.1,
    "flow.max_buffer_m": 2.5,
    "proposals.min_speed_mps": 1.0,  # appendix
    "proposals.position_eps_m": 1.0,
    "tracking.min_iou": 0.1,
}


@pytest.mark.parametrize("name", PAPER)
def test_profile_paper_keeps_the_values_of_the_paper(name):
    values = dict(leaves(resolve_config("paper")))
    assert (values[name], type(values[name])) == (PAPER[name], type(PAPER[name]))


def test_profile_paper_takes_the_steps_of_the_paper_and_none_of_ours():
    config = resolve_config("paper")
    assert {stage for stage, _ in our_steps()} == set(PROFILES["paper"])
    assert not any(getattr(config, stage).has(step) for stage, step in our_steps())
    assert all(config.flow.has(step) for step in ("backward_net", "expansion", "pruning"))  # eq. 2, box query
    assert all(config.registration.has(step) for step in ("rotation_start", "translation_grid", "upright"))
    assert config.proposals.has("flow_clustering")  # algorithm 1


@pytest.mark.parametrize(("stage", "step"), our_steps())
def test_each_step_of_ours_can_be_left_out_by_its_name_alone(stage, step):
    less = resolve_config().leave_out(f"{stage}.{step}")
    assert less == resolve_config(overrides={f"{stage}.without": step})
    assert not getattr(less, stage).has(step)
    assert sum(getattr(less, other).has(name) for other, name in our_steps()) == len(our_steps()) - 1
    assert less.config_hash != resolve_config().config_hash


def test_steps_may_be_given_in_any_order_and_twice():
    one = resolve_config(overrides={"flow.without": ["surfaces", "pieces", "surfaces"]})
    assert one == resolve_config(overrides={"flow.without": " pieces,surfaces"})
    assert one.leave_out("flow.pieces") == one


def test_flows_of_profile_paper_cluster_within_a_tenth_of_a_metre_a_sweep():
    """The appendix gives the distance of flows, at ten sweeps a second; ours is of velocities."""
    assert resolve_config("paper").proposals.flow_eps_mps * 0.1 == pytest.approx(0.1)


def test_dotted_and_nested_overrides_are_the_same():
    dotted = resolve_config(overrides={"flow.iterations": 80, "seed": 3})
    assert dotted == resolve_config(overrides={"flow": {"iterations": 80}, "seed": 3})
    assert dotted.flow.iterations == 80


def test_overrides_win_over_the_profile_and_do_not_stick():
    assert resolve_config("paper", {"flow.hidden_layers": 2}).flow.hidden_layers == 2
    assert resolve_config("paper").flow.hidden_layers == 8
    assert resolve_config("paper", {"flow.hidden_layers": 2}).flow.hidden_units == 128


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        ({"nope": 1}, "unknown option nope: expected one of profile, seed, "),
        ({"flow.nope": 1}, "unknown option flow.nope: expected one of without, method, hidden_layers, "),
        ({"flow": 3, "flow.iterations": 5}, "flow.iterations is set below the value flow=3"),
        ({"flow.iterations": 3, "flow.iterations.x": 5}, "unknown option flow.iterations.x: expected one of without"),
        ({"flow": {"iterations": {"x": 5}}}, "option flow.iterations={'x': 5}: "),
        ({".".join("a" * 5000): 1}, "unknown option a: expected one of profile"),
        ({"flow." + ".".join("a" * 5000): 1}, "unknown option flow.a.a.a"),
        ({"x" * 10**6: 1}, "unknown option xxx"),
        ({"flow.iterations": "x" * 10**6}, "flow.iterations='xxx"),
        ({"flow.iterations": 10**5000}, "flow.iterations=a number of thousands of digits"),
        ({"flow.iterations": 1e12}, "less than or equal to"),
        ({"flow.hidden_units": 10**9}, "less than or equal to"),
        ({"static.vote_gaps_s": [0.5] * 10**5}, "at most 16 items"),
        ({"flow.slow_gaps_s": [1e9]}, "less than or equal to"),
        ({"flow.without": ["pieces"] * 10**5}, "at most"),
        ({"flow.without": "pieces," * 10**5}, "at most"),
        ({"flow.external_folder": "x" * 10**6, "flow.method": "external"}, "at most"),
        ({"sweeps": [0, 10**25]}, "sweeps"),
        ({"sweeps": [-1, 3]}, "option sweeps.0=-1: Input should be greater than or equal to 0"),
        ({"seed": 10**30}, "seed"),
        ({"flow.max_buffer_m": float("inf")}, "flow.max_buffer_m=inf"),
        ({"flow.iterations": 0}, "flow.iterations=0"),
        ({"flow.iterations": "many"}, "flow.iterations='many'"),
        ({"flow.learning_rate": float("nan")}, "flow.learning_rate"),
        ({"flow.method": "magic"}, "flow.method='magic'"),
        ({"flow": 3}, "flow=3"),
        ({"flow.without": "nets"}, "flow.without='nets': Value error, no step 'nets': expected some of backward_net, "),
        ({"tracking.min_iou": 1.0}, "tracking.min_iou=1.0"),
        ({"sweeps": [1, 2, 3]}, "sweeps"),
        ({"write_points": "perhaps"}, "write_points"),
    ],
    ids=lambda value: next(iter(value))[:30] if isinstance(value, dict) else "",
)
def test_bad_values_are_named_in_one_line(overrides, message):
    with pytest.raises(InvalidInput) as caught:
        resolve_config(overrides=overrides)
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)
    assert len(str(caught.value)) < 3000


def test_an_unknown_profile_is_refused_with_the_choices():
    with pytest.raises(InvalidInput, match="unknown profile 'best': expected one of default, paper, fast"):
        resolve_config("best")


def test_config_is_frozen():
    with pytest.raises(ValueError, match="frozen"):
        resolve_config().seed = 3


@given(seed=st.integers(0, 10), iterations=st.integers(1, 200), points=st.booleans())
def test_equal_configs_and_only_those_have_equal_hashes(seed, iterations, points):
    one = resolve_config(overrides={"seed": seed, "flow.iterations": iterations, "write_points": points})
    again = resolve_config(overrides={"write_points": points, "flow": {"iterations": iterations}, "seed": seed})
    assert one.config_hash == again.config_hash
    assert (one == LabelingConfig()) == (one.config_hash == LabelingConfig().config_hash)


@pytest.mark.parametrize("profile", PROFILES)
def test_config_survives_json(profile):
    config = resolve_config(profile, {"sweeps": [2, 8]})
    again = LabelingConfig.model_validate(json.loads(json.dumps(config.model_dump(mode="json"))))
    assert again == config
    assert again.config_hash == config.config_hash


def test_the_hash_counts_every_value():
    def changed(value):
        return {bool: lambda v: not v, int: lambda v: v + 1, float: lambda v: v * 0.5 + 0.01}[type(value)](value)

    config = LabelingConfig()
    hashes = {config.config_hash}
    numbers = [(name, value) for name, value in leaves(config) if isinstance(value, int | float)]
    for name, value in numbers:
        hashes.add(resolve_config(overrides={name: changed(value)}).config_hash)
    assert len(hashes) == len(numbers) + 1


def texts(model, prefix=""):
    """Yield the parameters that take any text."""
    for name, field in model.model_fields.items():
        kinds = {field.annotation, *get_args(field.annotation)}
        stage = next((kind for kind in kinds if isinstance(kind, type) and issubclass(kind, BaseModel)), None)
        if stage is not None:
            yield from texts(stage, f"{prefix}{name}.")
        elif str in kinds:
            yield f"{prefix}{name}"


def test_every_parameter_that_takes_any_text_is_a_place_or_a_list_of_known_steps():
    """A request names places through one gate: a parameter that is one has to be known as such."""
    assert {name for name in texts(LabelingConfig) if not name.endswith(".without")} == set(PLACES)


def bounds(model, prefix=""):
    """Yield the JSON schema of each parameter, and of what its lists hold."""
    for name, schema in model.items():
        for part in (schema, *schema.get("anyOf", ())):
            yield f"{prefix}{name}", part
            if isinstance(part.get("items"), dict):
                yield f"{prefix}{name}[]", part["items"]


def test_every_number_list_and_free_text_is_bounded():
    """One request cannot ask for more than a machine has."""
    stages = LabelingConfig.model_json_schema()
    models = [stages, *stages["$defs"].values()]
    parameters = [bound for model in models for bound in bounds(model["properties"])]
    assert len(parameters) > 90
    for name, schema in parameters:
        kind = schema.get("type")
        if kind in ("integer", "number"):
            assert schema.keys() & {"maximum", "exclusiveMaximum"}, name
            assert schema.keys() & {"minimum", "exclusiveMinimum"}, name
        elif kind == "array":
            assert "maxItems" in schema, name
        elif kind == "string" and "enum" not in schema and name != "without[]":  # a step's name is a known one
            assert "maxLength" in schema, name


def test_places_are_named_and_resolved():
    config = resolve_config(overrides={"flow": {"method": "external", "external_folder": "flow"}})
    assert config.places == {"flow.external_folder": "flow"}
    assert config.with_places(lambda place: f"/data/{place}").places == {"flow.external_folder": "/data/flow"}
    assert resolve_config().places == {}
    assert resolve_config().with_places(str.upper) == resolve_config()
