"""What the API says of a job's labels."""

from typing import Any

from pydantic import BaseModel, ConfigDict

from schemas.api.jobs import JobState
from schemas.manifest import SegmentEntry
from schemas.tables import SCHEMA_VERSION


class JobLabels(BaseModel):
    """The labels that a job has published so far, as its manifest lists them."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    job_id: str
    state: JobState
    is_complete: bool  # False: a segment has no labels, or misses sweeps or fits
    dataset: str
    output_uri: str  # of the label folder; the shards' paths are relative to it
    schema_version: int = SCHEMA_VERSION
    config: dict[str, Any]  # the resolved LabelingConfig, as JSON
    config_hash: str
    recommended_min_score: float
    num_segments: int  # of the job, with those that have no labels
    segments: tuple[SegmentEntry, ...]  # those that have labels, sorted by URI
