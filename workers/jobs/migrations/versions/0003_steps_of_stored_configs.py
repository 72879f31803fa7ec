"""Jobs that may label yet keep what their users chose: the options that left steps out became lists of steps.

What was counted in sweeps is in seconds now, as of the ten sweeps a second that every data set of then had. Limits that
noise or the way between rays set are multiples of a lidar's, as of one for which they were right.

An option that is no more is dropped where it has the value that it had by itself. Where somebody had chosen another,
it stays, and the dispatcher fails what is open of the job by its name: labels that were not asked for would be worse.
"""

from collections.abc import Mapping
from typing import Any, Final

import sqlalchemy as sa
from alembic import op

revision = "0003"
down_revision = "0002"

# Of each stage: options that are no more, with the value that left the step out.
_SWITCHES: Final[dict[str, dict[str, tuple[Any, str]]]] = {
    "ground": {"refine": (False, "local_surface")},
    "static": {"has_whole_objects": (False, "whole_objects")},
    "flow": {
        "has_backward_net": (False, "backward_net"),
        "has_expansion": (False, "expansion"),
        "has_pruning": (False, "pruning"),
        "has_standstill_test": (False, "standstill"),
        "follows_surfaces": (False, "surfaces"),
        "joins_pieces": (False, "pieces"),
        "splits_bodies": (False, "bodies"),
    },
    "proposals": {
        "has_flow_clustering": (False, "flow_clustering"),
        "has_deskewing": (False, "deskewing"),
        "parts_walkers": (False, "walkers"),
    },
    "registration": {
        "has_rotation_start": (False, "rotation_start"),
        "has_translation_grid": (False, "translation_grid"),
        "is_constrained": (False, "upright"),
        "has_motion_start": (False, "motion_start"),
        "has_slide_test": (False, "slide_test"),
    },
    "refinement": {
        "has_robust_extent": (False, "robust_extent"),
        "has_ground_anchor": (False, "ground_anchor"),
        "has_travel_heading": (False, "travel_heading"),
        "has_shape_heading": (False, "shape_heading"),
        "has_vehicle_completion": (False, "completion"),
        "has_smooth_motion": (False, "smooth_motion"),
    },
    "attribution": {"method": ("flow", "tracks")},
}
# Of each stage: options that are there still, with the values that left steps out, and what they are without need.
_LIMITS: Final[dict[str, list[tuple[dict[str, float], tuple[str, ...], dict[str, float]]]]] = {
    "flow": [
        (
            {"min_fit_residual_m": 0, "fit_resolution_rad": 0},
            ("sparse_nets",),
            {"min_fit_residual_m": 0.05, "fit_resolution_rad": 0.006},
        ),
        ({"max_grade": 1e6}, ("grade",), {"max_grade": 0.12}),
        ({"min_vacated_share": 0}, ("vacated",), {"min_vacated_share": 0.03}),
    ],
    "tracking": [
        ({"min_vacated_share": 0}, ("vacated",), {"min_vacated_share": 0.1}),
        ({"person_side_m": 0}, ("person_width",), {"person_side_m": 0.6}),
    ],
    "registration": [
        ({"joint_rounds": 0}, ("joint_rounds",), {"joint_rounds": 1}),
        ({"num_refined_starts": 25}, ("few_starts",), {"num_refined_starts": 3}),
    ],
    "joining": [({"rounds": 0}, ("tracks", "strays"), {"rounds": 2})],
    "refinement": [
        ({"min_top_speed_mps": 0}, ("movers_only",), {"min_top_speed_mps": 1.0}),
        ({"max_height_m": 1e6}, ("height_limit",), {"max_height_m": 5.0}),
    ],
}
# Of each stage: options that are multiples now, with their values of then and of now.
_MULTIPLES: Final[dict[str, dict[str, tuple[float, str, float]]]] = {
    "static": {"floor_m": (0.05, "noise_factor", 2.5), "resolution_rad": (0.004, "resolution_factor", 1.0)},
    "decomposition": {"radius_rad": (0.035, "resolution_factor", 8.75)},
    "flow": {
        "min_fit_residual_m": (0.05, "fit_noise_factor", 2.5),
        "fit_resolution_rad": (0.006, "fit_resolution_factor", 1.5),
    },
    "attribution": {"margin_m": (0.05, "noise_factor", 2.5)},
}
_PERIOD_S: Final = 0.1
_MIN_SWEEPS: Final = 3  # of a track at any rate
_VEHICLE_RADIUS_M: Final = 4.0  # the vehicle is found by itself now
_STARTS: Final[dict[tuple[Any, Any], tuple[str, ...]]] = {
    ("voted", "voted"): (),
    ("zero", "centroid"): ("voted_start",),
}


def upgrade() -> None:
    """Say the configs of these jobs in the new words. What is labelled keeps the words that its manifest has."""
    jobs = sa.table("jobs", sa.column("id", sa.String), sa.column("state", sa.String), sa.column("config", sa.JSON))
    segments = sa.table("segments", sa.column("job_id", sa.String), sa.column("state", sa.String))
    labelled = ("SUCCEEDED", "PARTIAL")
    unlabelled = sa.select(segments.c.job_id).where(segments.c.state.not_in(labelled))
    may_label = jobs.c.state.not_in(labelled) | jobs.c.id.in_(unlabelled)
    connection = op.get_bind()
    for job_id in connection.scalars(sa.select(jobs.c.id).where(may_label)).all():
        this = jobs.c.id == job_id
        config = connection.execute(sa.select(jobs.c.config).where(this)).scalar_one()
        if "refine" in config.get("ground", {}):  # every config of then spells all options out
            connection.execute(sa.update(jobs).where(this).values(config=_translate(config)))


def _translate(config: Mapping[str, Any]) -> dict[str, Any]:
    stages = {name: dict(values) for name, values in config.items() if isinstance(values, Mapping)}
    without: dict[str, set[str]] = {name: set() for name in _SWITCHES | _LIMITS}
    static, flow = stages["static"], stages["flow"]
    if config["profile"] == "paper":  # steps that it took no notice of then, and is without now
        if static["method"] == "chamfer":
            without["static"].add("whole_objects")
        if (flow["start"], flow["prune_about"], flow["has_standstill_test"]) == ("zero", "centroid", False):
            without["flow"].add("far_look")
        without["tracking"].add("either_way")
    if static["vehicle_radius_m"] == _VEHICLE_RADIUS_M:
        del static["vehicle_radius_m"]
    start = (flow["start"], flow["prune_about"])
    if start in _STARTS:
        del flow["start"], flow["prune_about"]
        without["flow"].update(_STARTS[start])
    flow["support_gaps_s"] = [_PERIOD_S * k for k in range(1, flow.pop("support_sweeps") + 1)]
    stages["joining"]["min_common_s"] = _PERIOD_S * (stages["joining"].pop("min_common_sweeps") - 1)
    stages["refinement"]["min_fast_s"] = _PERIOD_S * (stages["refinement"].pop("min_fast_sweeps") - 1)
    tracking = stages["tracking"]
    tracking["min_duration_s"] = _PERIOD_S * (tracking["min_sweeps"] - 1)
    tracking["min_sweeps"] = min(_MIN_SWEEPS, tracking["min_sweeps"])
    tracking["max_acceleration_mps2"] = 3.0  # of step either_way
    for stage, switches in _SWITCHES.items():
        for option, (off, step) in switches.items():
            if stages[stage].pop(option) == off:
                without[stage].add(step)
    for stage, limits in _LIMITS.items():
        for off_values, steps, usual in limits:
            if off_values.items() <= stages[stage].items():
                without[stage].update(steps)
                stages[stage].update(usual)
    for stage, multiples in _MULTIPLES.items():
        for option, (then, name, factor) in multiples.items():
            stages[stage][name] = factor * (stages[stage].pop(option) / then)
    for stage, steps_left_out in without.items():
        stages[stage]["without"] = sorted(steps_left_out)
    flow["device"] = "cpu"
    return {**config, **stages}
