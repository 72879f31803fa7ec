"""Parameters of the stage ``flow``."""

from typing import Literal

from pydantic import Field, model_validator

from schemas.config.base import Params


class FlowParams(Params):
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
