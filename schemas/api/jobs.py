"""Jobs and their segments: what is asked for, and what is told about them."""

from collections import Counter
from datetime import datetime
from enum import StrEnum
from typing import Annotated, Any, Literal, Self

from pydantic import BaseModel, ConfigDict, Field, StringConstraints, field_validator, model_validator

from schemas.config import LabelingConfig, resolve_config
from schemas.errors import InvalidInput

MAX_SEGMENTS = 10_000  # of one job
MAX_DEADLINE_S = 366 * 86_400.0


class JobState(StrEnum):
    """Where a job stands."""

    QUEUED = "QUEUED"
    RUNNING = "RUNNING"
    CANCELLING = "CANCELLING"  # by a caller or by its deadline; segments that run are being stopped
    SUCCEEDED = "SUCCEEDED"
    PARTIAL = "PARTIAL"  # some labels are missing
    FAILED = "FAILED"  # no labels, through data or code
    CANCELLED = "CANCELLED"
    TIMED_OUT = "TIMED_OUT"
    CRASHED = "CRASHED"  # no labels, through lost machines

    @property
    def is_ended(self) -> bool:
        """True when nothing but a retry changes the job."""
        return self not in (JobState.QUEUED, JobState.RUNNING, JobState.CANCELLING)


class SegmentState(StrEnum):
    """Where one segment of a job stands."""

    QUEUED = "QUEUED"
    RUNNING = "RUNNING"
    SUCCEEDED = "SUCCEEDED"
    PARTIAL = "PARTIAL"  # a sweep was rejected, or a fit failed
    FAILED = "FAILED"
    CANCELLED = "CANCELLED"
    CRASHED = "CRASHED"

    @property
    def is_ended(self) -> bool:
        """True when nothing but a retry changes the segment."""
        return self not in (SegmentState.QUEUED, SegmentState.RUNNING)


class Body(BaseModel):
    """What all bodies share: strict, frozen, nothing unknown."""

    model_config = ConfigDict(strict=True, extra="forbid", frozen=True, allow_inf_nan=False)


Uri = Annotated[str, StringConstraints(min_length=1, max_length=2048, pattern=r"^[^\x00-\x1f\x7f]+$")]


class JobRequest(Body):
    """What to label, and how."""

    dataset: str = Field(min_length=1, max_length=64)
    # A list in JSON; the items stay strict. The first wrong one is told: there may be as many as there are segments.
    segments: tuple[Uri, ...] = Field(min_length=1, max_length=MAX_SEGMENTS, strict=False, fail_fast=True)
    output_uri: Uri
    profile: Literal["default", "paper", "fast"] = "default"
    overrides: dict[str, Any] = Field(default={}, max_length=200)  # what the config refuses, it refuses by name
    sweeps: tuple[int, int] | None = Field(default=None, strict=False, description="half-open range of sweep indices")
    write_points: bool = False
    priority: int = Field(default=0, ge=-100, le=100, description="higher goes first")
    deadline_s: float | None = Field(default=None, gt=0, le=MAX_DEADLINE_S, description="after submission or retry")
    client_job_id: str | None = Field(default=None, pattern=r"^[A-Za-z0-9_.:-]{1,255}$")

    @field_validator("segments", mode="before")
    @classmethod
    def _count(cls, value: object) -> object:
        if isinstance(value, list) and len(value) > MAX_SEGMENTS:
            raise ValueError(f"a job has at most {MAX_SEGMENTS} segments, got {len(value)}: submit several jobs")
        return value

    @model_validator(mode="after")
    def _check(self) -> Self:
        uri, count = Counter(self.segments).most_common(1)[0]
        if count > 1:
            raise ValueError(f"segment {uri} is given {count} times")
        if self.sweeps and not 0 <= self.sweeps[0] < self.sweeps[1]:
            raise ValueError(f"sweeps must be [start, stop] with 0 <= start < stop, got {list(self.sweeps)}")
        own = {"profile", "sweeps", "write_points"} & self.overrides.keys()
        if own:
            raise ValueError(f"{min(own)} is a field of the request, not an override")
        try:
            self.make_config()
        except InvalidInput as error:
            raise ValueError(str(error)) from None
        return self

    def make_config(self) -> LabelingConfig:
        """Return the resolved parameters."""
        changes = {**self.overrides, "sweeps": self.sweeps, "write_points": self.write_points}
        return resolve_config(self.profile, changes)


class Failure(Body):
    """Why there are no labels, or not all."""

    error: str  # the exception's class, or what the infrastructure did
    message: str  # one line


class JobStatus(Body):
    """One job. Times are UTC, by the clock of the job store."""

    id: str
    state: JobState
    dataset: str
    output_uri: str
    profile: str
    priority: int
    client_job_id: str | None
    owner: str = ""  # who submitted it; empty: nobody was asked
    generation: int  # 1, and one more with each retry
    cancel_requested: bool
    num_segments: int
    segments: dict[SegmentState, int]  # how many are in each state; every state is listed
    progress: float = Field(ge=0, le=1)
    eta_s: float | None  # None: nothing to estimate it from
    created_at: datetime
    deadline_at: datetime | None
    started_at: datetime | None  # of this generation
    finished_at: datetime | None
    failure: Failure | None


class SegmentStatus(Body):
    """One segment of a job."""

    position: int  # in the job's segments, sorted by URI, from 0
    uri: str
    segment_id: str | None  # None until it was opened
    state: SegmentState
    attempts: int
    stage: str | None
    sweeps_done: int
    num_sweeps: int | None
    started_at: datetime | None  # of the last attempt
    finished_at: datetime | None
    failure: Failure | None


class JobEvent(Body):
    """One thing that happened to a job or to one of its segments."""

    sequence: int  # in the job, from 1
    at: datetime
    kind: Literal["job", "segment"]
    position: int | None  # of the segment in its job
    state: str  # a JobState or a SegmentState, by kind: what it is in from then on
    attempt: int | None  # at the segment, from 1
    detail: str | None  # one line


class JobPage(Body):
    """Jobs, newest first."""

    jobs: tuple[JobStatus, ...] = Field(strict=False)
    next_page_token: str | None


class SegmentPage(Body):
    """Segments of one job, sorted by URI."""

    segments: tuple[SegmentStatus, ...] = Field(strict=False)
    next_page_token: str | None
