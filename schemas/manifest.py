"""The manifest: what a label folder holds, who made it and whether it is whole."""

from typing import Any, Final, Literal

from pydantic import BaseModel, ConfigDict

from schemas.tables import SCHEMA_VERSION, Table

RECOMMENDED_MIN_SCORE: Final = 0.5  # below it, labels are more often wrong than right


class Shard(BaseModel):
    """One published file."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    table: Table
    path: str  # relative to the label folder
    rows: int
    bytes: int
    sha256: str
    label_version: int | None = None  # that it says it was made by; None: from before there were label versions
    code_version: str = ""  # the same; for information


class SegmentEntry(BaseModel):
    """What became of one segment."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    segment_id: str
    uri: str
    state: Literal["SUCCEEDED", "PARTIAL", "FAILED"]
    reason: str = ""  # one line; empty when SUCCEEDED
    num_sweeps: int = 0
    num_rejected_sweeps: int = 0
    num_failed_fits: int = 0
    num_tracks: int = 0
    shards: tuple[Shard, ...] = ()


class Manifest(BaseModel):
    """OUT/manifests/<identity>.json."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    schema_version: int = SCHEMA_VERSION
    identity: str
    dataset: str
    config: dict[str, Any]  # the resolved LabelingConfig, as JSON
    config_hash: str
    label_version: int | None = None  # of the run that wrote this; what each shard was made by stands beside it
    code_version: str  # the same
    recommended_min_score: float
    segments: tuple[SegmentEntry, ...]

    @property
    def is_complete(self) -> bool:
        """True when no segment failed."""
        return all(segment.state != "FAILED" for segment in self.segments)
