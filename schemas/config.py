"""All parameters of the method: one frozen model a stage, defaults that work, the paper's value beside ours.

A profile is a set of overrides of the defaults. Unknown keys fail. Where the paper gives no value, the field says
"not in the paper" and profile ``paper`` keeps ours.
"""

import hashlib
import json
from typing import Any, Final, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from schemas.errors import InvalidInput


class _Params(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class GroundParams(_Params):
    """Close-to-horizontal plane by RANSAC, then refined locally (paper section 3.1; the refinement is ours)."""

    max_slope_rad: float = Field(0.17, gt=0, lt=0.8, description="tilt of the plane RANSAC may propose")
    ransac_iterations: int = Field(200, ge=1)  # not in the paper
    inlier_distance_m: float = Field(0.2, gt=0)  # "points in its vicinity"; not in the paper
    refine: bool = True  # paper: one plane
    cell_m: float = Field(1.0, gt=0)  # of the local refinement
    max_height_m: float = Field(0.2, gt=0)  # above the local ground


class StaticParams(_Params):
    """Points that other sweeps saw at the same place (paper section 3.1)."""

    method: Literal["chamfer", "visibility", "none"] = "visibility"  # paper: chamfer; none: keep all points
    max_speed_mps: float = Field(0.2, gt=0)  # paper: 20 cm/s
    floor_m: float = Field(0.05, ge=0)  # no threshold is smaller: range noise, float16 files; paper: 0
    resolution_rad: float = Field(0.004, ge=0)  # no threshold is smaller than this times the range; paper: 0
    num_chamfer_sweeps: int = Field(1, ge=1)  # earlier sweeps of method chamfer; the paper says "earlier frames"
    vote_gaps_s: tuple[float, ...] = (0.5, 1.0, 1.5, 2.0)  # before and after, of method visibility
    min_vote_share: float = Field(0.8, gt=0, le=1)  # occupied among occupied and empty
    min_known_share: float = Field(0.25, gt=0, le=1)  # occupied among all votes
    clear_margin_m: float = Field(0.25, gt=0)  # how far beyond a place rays must go to prove it empty
    vehicle_radius_m: float = Field(4.0, ge=0)  # of the ego frame's origin: where the recording vehicle sees itself
    has_whole_objects: bool = True  # objects decide as a whole, and long ones by their ends
    object_radius_m: float = Field(0.35, gt=0)  # free-standing: no other point nearer
    max_object_length_m: float = Field(16.0, gt=0)  # diagonal seen from above
    max_object_height_m: float = Field(4.5, gt=0)
    min_dynamic_share: float = Field(0.25, gt=0, le=1)  # an object with more is dynamic as a whole
    max_stray_share: float = Field(0.12, ge=0, lt=1)  # an object with less is static as a whole

    @model_validator(mode="after")
    def _check_gaps(self) -> "StaticParams":
        if not self.vote_gaps_s or min(self.vote_gaps_s) <= 0:
            raise ValueError(f"static.vote_gaps_s must be positive seconds, got {list(self.vote_gaps_s)}")
        return self


class DecompositionParams(_Params):
    """Connected components of the dynamic points (paper section 3.1; radius not in the paper)."""

    radius_m: float = Field(0.6, gt=0)
    radius_rad: float = Field(0.035, gt=0)  # times range, where that is less: beams lie dense near by
    min_radius_m: float = Field(0.3, gt=0)


class FlowParams(_Params):
    """NSFP++: one pair of nets a cluster, fitted at run time (paper section 3.1, eq. 2)."""

    method: Literal["nsfp++", "nsfp", "rigid", "external", "none"] = "nsfp++"  # none: boxes by position, plain tracker
    hidden_layers: int = Field(3, ge=1)  # paper: 8
    hidden_units: int = Field(64, ge=1)  # paper: 128
    learning_rate: float = Field(0.008, gt=0)  # NSFP's; not in the paper
    iterations: int = Field(60, ge=1)  # not in the paper
    patience: int = Field(12, ge=1)  # iterations without a better loss before a cluster stops; not in the paper
    has_backward_net: bool = True
    has_expansion: bool = True  # box query with buffers, else the tight box
    max_buffer_m: float = Field(4.0, ge=0)  # paper: 2.5
    has_pruning: bool = True
    prune_about: Literal["centroid", "voted"] = "voted"  # paper: centroid
    local_consistency: float = Field(0.5, ge=0)  # alpha of eq. 2; paper: 0.1
    chamfer_cutoff_m: float = Field(2.0, gt=0)  # matches beyond add nothing; NSFP's: sqrt(2)
    start: Literal["zero", "voted"] = "voted"  # paper: zero
    min_fit_residual_m: float = Field(0.05, ge=0)  # a cluster that one velocity explains better gets no net; paper: 0
    fit_resolution_rad: float = Field(0.006, ge=0)  # the same, times its range; paper: 0
    max_fit_residual_share: float = Field(0.6, gt=0, le=1)  # of the voted start's, else the start stays
    max_points: int = Field(128, ge=8)  # of a cluster that the fit sees; the field is evaluated everywhere
    min_points: int = Field(5, ge=1)  # smaller clusters get no fit: their flow is zero; not in the paper
    max_speed_mps: float = Field(40.0, gt=0)  # reach of the translation vote
    support_sweeps: int = Field(2, ge=1)  # sweeps before and after that the vote looks at; paper: the next one
    slow_speed_mps: float = Field(3.0, ge=0)  # what seems slower is looked at over longer gaps
    slow_gaps_s: tuple[float, ...] = (0.5,)  # before and after
    has_standstill_test: bool = True  # paper: no
    standstill_margin_m: float = Field(0.01, ge=0)  # a motion must explain the points better by this much
    follows_surfaces: bool = True  # lay surfaces onto surfaces, not only points onto points; paper: no
    joins_pieces: bool = True  # shreds go with the moving cluster beside them; paper: no
    max_grade: float = Field(0.12, ge=0)  # that road users climb, as the vehicle stands; paper: no limit
    splits_bodies: bool = True  # two velocities for a cluster of two bodies that move apart; paper: no
    min_vacated_share: float = Field(0.03, ge=0, le=1)  # of a cluster, where rays passed before or after; paper: 0
    max_gap_s: float = Field(0.55, gt=0)  # a longer silence between sweeps has no flow
    external_folder: str | None = None  # of method external: FOLDER/<segment_id>/<timestamp_ns>.feather

    @model_validator(mode="after")
    def _check_external_folder(self) -> "FlowParams":
        if (self.method == "external") != (self.external_folder is not None):
            raise ValueError("flow.external_folder and flow.method=external go together: give both or neither")
        return self


class ProposalParams(_Params):
    """Spatio-temporal clustering (paper Algorithm 1)."""

    min_speed_mps: float = Field(0.5, ge=0)  # a track that is never faster than ``refinement`` asks for goes; paper: 1
    position_eps_m: float = Field(1.0, gt=0)
    flow_eps_mps: float = Field(1.0, gt=0)  # paper: 0.1 m a sweep at 10 Hz
    has_flow_clustering: bool = True
    parts_walkers: bool = True  # people side by side are one proposal each; paper: no
    has_deskewing: bool = True  # carry points along their motion to one instant before boxing; not in the paper
    min_samples: int = Field(4, ge=1)  # not in the paper
    min_points: int = Field(5, ge=1)  # of a proposal; not in the paper


class TrackingParams(_Params):
    """Flow-advanced association with a Kalman filter (paper section 3.2)."""

    min_iou: float = Field(0.1, gt=0, lt=1)
    person_side_m: float = Field(0.6, ge=0)  # to which narrow upright boxes are widened to be matched; paper: 0
    max_missed_s: float = Field(0.35, gt=0)  # silence after which a track ends; not in the paper
    min_sweeps: int = Field(5, ge=1)  # shorter tracks are dropped; the number is not in the paper
    min_vacated_share: float = Field(0.1, ge=0, le=1)  # of a track's points, as in ``flow``; paper: 0
    process_noise_mps2: float = Field(3.0, gt=0)  # Kalman; not in the paper
    position_noise_m: float = Field(0.3, gt=0)
    velocity_noise_mps: float = Field(0.5, gt=0)


class RegistrationParams(_Params):
    """Sequential ICP to the growing target (paper Algorithm 2 and appendix)."""

    has_rotation_start: bool = True
    has_translation_grid: bool = True  # 5 x 5, strides of a quarter of the target box
    is_constrained: bool = True  # rotation about z only
    icp_iterations: int = Field(30, ge=1)  # not in the paper
    icp_cutoff_m: float = Field(1.0, gt=0)  # not in the paper
    has_motion_start: bool = True  # the neighbour view advanced by its flow as one more start; paper: no
    motion_margin_m: float = Field(0.005, ge=0)  # of mean error, by which another start must be better than that one
    has_slide_test: bool = True  # along a flat side that fits anywhere, a view lies where its flow led; paper: no
    joint_rounds: int = Field(1, ge=0)  # in which each view is aligned again, with all the others; paper: 0
    num_refined_starts: int = Field(3, ge=1)  # starts that ICP refines, best first; paper: all 25
    max_source_points: int = Field(256, ge=8)  # of one view; not in the paper
    max_target_points: int = Field(1024, ge=8)  # of the aggregate; not in the paper


class JoiningParams(_Params):
    """Pieces of one object -> one track (ours; off in profile ``paper``)."""

    rounds: int = Field(2, ge=0)  # each joins what the last one made larger; 0: off; paper: 0
    min_common_sweeps: int = Field(2, ge=1)
    min_shared_area: float = Field(0.3, gt=0, le=1)  # of the smaller amodal box, seen from above
    max_speed_difference_mps: float = Field(1.0, ge=0)
    max_speed_difference_share: float = Field(0.2, ge=0)  # of the faster one's speed, added
    max_silence_s: float = Field(1.5, ge=0)  # behind an occlusion; longer ones must be pauses
    max_pause_s: float = Field(20.0, ge=0)
    stray_reach_s: float = Field(0.5, ge=0)  # before and after a track, in which it looks for more of its object


class RefinementParams(_Params):
    """Amodal boxes, carried back to each sweep (paper Algorithm 2, last lines; what is marked is ours)."""

    has_robust_extent: bool = True  # paper: extreme points
    has_ground_anchor: bool = True  # box reaches down to the ground; paper: lowest point
    has_travel_heading: bool = True  # the direction the views travelled; paper: the flow of the densest view
    has_shape_heading: bool = True  # turn to flat sides where travel is unsure; paper: no
    has_vehicle_completion: bool = True  # sides no ray met, from the proportions of vehicles and people; paper: no
    has_smooth_motion: bool = True  # paper: no
    min_top_speed_mps: float = Field(1.0, ge=0)  # a track that stays slower stands, and is dropped; paper: 0
    min_fast_sweeps: int = Field(3, ge=1)  # that it has to be as fast as this
    max_height_m: float = Field(5.0, gt=0)  # what is taller is no road user: no code allows more; paper: no limit


class AttributionParams(_Params):
    """Flow and owner of each point, once tracks are finished (ours; written with ``write_points``)."""

    method: Literal["tracks", "flow"] = "tracks"  # paper: flow, as it was estimated before tracking
    min_claim_score: float = Field(0.5, ge=0, le=1)  # from here a box takes points that another object's proposal has
    margin_m: float = Field(0.05, ge=0)  # by which a box is grown to find its points: range noise
    min_speed_mps: float = Field(0.7, ge=0)  # slower objects stand, and their points with them
    min_stray_speed_mps: float = Field(1.0, ge=0)  # that the flow of a point of no object needs to call it dynamic


class LabelingConfig(_Params):
    """Everything that decides the labels of a segment. Its hash is part of a shard's identity."""

    profile: Literal["default", "paper", "fast"] = "default"
    seed: int = 0
    sweeps: tuple[int, int] | None = None  # half-open range of sweep indices; None: all
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

    @property
    def config_hash(self) -> str:
        """SHA-256 of the resolved values, 16 hex digits."""
        text = json.dumps(self.model_dump(mode="json"), sort_keys=True)
        return hashlib.sha256(text.encode()).hexdigest()[:16]


PROFILES: Final[dict[str, dict[str, Any]]] = {
    "default": {},
    "paper": {
        "ground": {"refine": False},
        "static": {"method": "chamfer", "floor_m": 0.0, "resolution_rad": 0.0},
        "flow": {
            "local_consistency": 0.1,
            "hidden_layers": 8,
            "hidden_units": 128,
            "iterations": 1000,
            "patience": 100,
            "max_buffer_m": 2.5,
            "prune_about": "centroid",
            "start": "zero",
            "min_fit_residual_m": 0.0,
            "fit_resolution_rad": 0.0,
            "max_points": 8192,
            "has_standstill_test": False,
            "follows_surfaces": False,
            "joins_pieces": False,
            "max_grade": 1e6,
            "splits_bodies": False,
            "min_vacated_share": 0.0,
        },
        "proposals": {"has_deskewing": False, "parts_walkers": False, "min_speed_mps": 1.0},
        "tracking": {"min_vacated_share": 0.0, "person_side_m": 0.0},
        "joining": {"rounds": 0},
        "registration": {
            "has_motion_start": False,
            "has_slide_test": False,
            "num_refined_starts": 25,
            "joint_rounds": 0,
        },
        "refinement": {
            "has_robust_extent": False,
            "has_ground_anchor": False,
            "has_travel_heading": False,
            "has_shape_heading": False,
            "has_vehicle_completion": False,
            "has_smooth_motion": False,
            "min_top_speed_mps": 0.0,
            "max_height_m": 1e6,
        },
        "attribution": {"method": "flow"},
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
        _put(values, key.split("."), value)
    try:
        return LabelingConfig.model_validate(values)
    except ValidationError as error:
        raise InvalidInput("; ".join(_describe(problem) for problem in error.errors())) from None


def _put(values: dict[str, Any], path: list[str], value: Any) -> None:
    if len(path) == 1 and isinstance(value, dict):
        for key, inner in value.items():
            _put(values, [*path, key], inner)
    elif len(path) == 1:
        values[path[0]] = value
    elif not isinstance(values.setdefault(path[0], {}), dict):
        raise InvalidInput(f"option {'.'.join(path)} is set below the value {path[0]}={values[path[0]]!r}")
    else:
        _put(values[path[0]], path[1:], value)


def _describe(problem: Any) -> str:
    key = ".".join(str(part) for part in problem["loc"])
    if problem["type"] == "extra_forbidden":
        model: Any = LabelingConfig  # of the stage the key is in
        for stage in problem["loc"][:-1]:
            model = model.model_fields[stage].annotation
        return f"unknown option {key}: expected one of {', '.join(model.model_fields)}"
    return f"option {key}={problem.get('input')!r}: {problem['msg']}"
