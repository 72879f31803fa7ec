"""The service as a whole: its queue, its dispatchers, its failures."""

from datetime import datetime

from pydantic import Field

from schemas.api.jobs import Body, JobState

MAX_SILENCE_S = 15.0  # of a dispatcher


class DispatcherStatus(Body):
    """One dispatcher: the process that claims segments and drives the workers."""

    id: str
    host: str
    pid: int
    code_version: str
    num_workers: int
    started_at: datetime
    heartbeat_age_s: float

    @property
    def is_fresh(self) -> bool:
        """False when it was silent for so long that it counts as gone."""
        return self.heartbeat_age_s < MAX_SILENCE_S


class ServiceStatus(Body):
    """The whole service at one moment."""

    jobs: dict[JobState, int]  # how many are in each state; every state is listed
    queued_segments: int
    running_segments: int
    oldest_queued_age_s: float | None
    running_by_stage: dict[str, int]
    segments_per_hour: int  # ended with labels in the last hour
    sweeps_per_hour: int
    # Of that hour, from the first start of these segments to their last end, or to now while others run; None: none.
    measured_s: float | None = None
    failures_by_error: dict[str, int]  # segments that failed or crashed in the last day
    last_failed_job_by_error: dict[str, str] = Field(default={})  # the job of the latest of these
    dispatchers: tuple[DispatcherStatus, ...] = Field(strict=False)
