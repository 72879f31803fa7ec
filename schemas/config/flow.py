"""Parameters of the stage ``flow``."""

from collections.abc import Mapping
from typing import ClassVar, Literal

from pydantic import Field, model_validator

from schemas.config.base import MAX_GAPS, Gap, StageParams


class FlowParams(StageParams):
    """NSFP++: one pair of nets a cluster, fitted at run time (paper section 3.1, eq. 2)."""

    PAPER_STEPS: ClassVar[Mapping[str, str]] = {
        "backward_net": "a second net takes the cluster back (eq. 2)",
        "expansion": "box query with buffers, else the tight box",
        "pruning": "of the points found only those nearest to the centroid",
    }
    OUR_STEPS: ClassVar[Mapping[str, str]] = {
        "voted_start": "nets start from, and prune about, the velocity that a cluster votes for",
        "sparse_nets": "a cluster that one velocity explains to within the sampling gets no net",
        "standstill": "what standing still explains as well stands",
        "vacated": "only what left its place moves",
        "far_look": "what seems slow is looked at over longer gaps",
        "surfaces": "lay surfaces onto surfaces, not only points onto points",
        "pieces": "shreds go with the moving cluster beside them",
        "bodies": "two velocities for a cluster of two bodies that move apart",
        "grade": "no flow is steeper than a road, as the vehicle stands",
    }

    method: Literal["nsfp++", "nsfp", "rigid", "external", "none"] = "nsfp++"  # none: boxes by position, plain tracker
    hidden_layers: int = Field(3, ge=1, le=64)  # paper: 8
    hidden_units: int = Field(64, ge=1, le=4096)  # paper: 128
    learning_rate: float = Field(0.008, gt=0, le=1)  # NSFP's; not in the paper
    iterations: int = Field(60, ge=1, le=100_000)  # not in the paper
    patience: int = Field(12, ge=1, le=100_000)  # iterations without a better loss that end a fit; not in the paper
    max_buffer_m: float = Field(4.0, ge=0, le=100)  # paper: 2.5
    local_consistency: float = Field(0.5, ge=0, le=1000)  # alpha of eq. 2; paper: 0.1
    chamfer_cutoff_m: float = Field(2.0, gt=0, le=1000)  # matches beyond add nothing; NSFP's: sqrt(2)
    fit_noise_factor: float = Field(2.5, ge=0, le=100)  # of range noise: what one velocity leaves less of gets no net
    fit_resolution_factor: float = Field(1.5, ge=0, le=100)  # of what the lidar tells there, likewise; paper: 0
    max_fit_residual_share: float = Field(0.6, gt=0, le=1)  # of the voted start's, else the start stays
    max_points: int = Field(128, ge=8, le=1_000_000)  # of a cluster, by which its net is fitted
    min_points: int = Field(5, ge=1, le=1_000_000)  # smaller clusters get no fit: their flow is zero; not in the paper
    max_speed_mps: float = Field(40.0, gt=0, le=200)  # reach of the translation vote
    support_gaps_s: tuple[Gap, ...] = Field((0.1, 0.2), min_length=1, max_length=MAX_GAPS)  # either side; paper: next
    slow_speed_mps: float = Field(3.0, ge=0, le=200)  # what seems slower is looked at over longer gaps
    slow_gaps_s: tuple[Gap, ...] = Field((0.5,), max_length=MAX_GAPS)  # before and after
    standstill_margin_m: float = Field(0.01, ge=0, le=100)  # a motion must explain the points better by this much
    max_grade: float = Field(0.12, ge=0, le=100)  # that road users climb
    min_vacated_share: float = Field(0.03, ge=0, le=1)  # of a cluster, where rays passed before or after
    max_gap_s: float = Field(0.55, gt=0, le=60)  # a longer silence has no flow, unless sweeps are rarer than that
    device: Literal["cpu", "cuda"] = "cpu"  # that nets are fitted on: it rounds in its own way
    external_folder: str | None = Field(None, max_length=2048)  # external: FOLDER/<segment_id>/<timestamp_ns>.feather

    @model_validator(mode="after")
    def _check_external_folder(self) -> "FlowParams":
        if (self.method == "external") != (self.external_folder is not None):
            raise ValueError("flow.external_folder and flow.method=external go together: give both or neither")
        return self
