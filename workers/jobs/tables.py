"""The tables of the job store. Times are int64 milliseconds since 1970, by the database's own clock.

A change here is a new script in ``migrations`` and a new ``STORE_VERSION``: tests hold the two against each other.
"""

from collections.abc import Iterable
from enum import StrEnum
from typing import Any

from sqlalchemy import (
    JSON,
    BigInteger,
    CheckConstraint,
    Column,
    Float,
    ForeignKey,
    Index,
    Integer,
    MetaData,
    String,
    Table,
    UniqueConstraint,
    text,
)

from schemas.api.jobs import SegmentState
from workers.jobs.states import JOB_TRANSITIONS, SEGMENT_TRANSITIONS

metadata = MetaData()

# Where the version stood before Alembic kept it. A motionlabel from then reads 2 here, and refuses the store by name.
schema_version = Table("schema_version", metadata, Column("version", Integer, primary_key=True))


def _state_known(states: Iterable[StrEnum]) -> CheckConstraint:
    return CheckConstraint(f"state IN ({', '.join(repr(str(state)) for state in states)})", name="state_known")


def _where(condition: str) -> dict[str, Any]:
    return {f"{dialect}_where": text(condition) for dialect in ("sqlite", "postgresql")}


jobs = Table(
    "jobs",
    metadata,
    Column("id", String, primary_key=True),
    Column("client_job_id", String),
    Column("fingerprint", String, nullable=False),  # SHA-256 of the whole request
    Column("dataset", String, nullable=False),
    Column("output_uri", String, nullable=False),
    Column("profile", String, nullable=False),
    Column("config", JSON, nullable=False),  # the resolved LabelingConfig
    Column("priority", Integer, nullable=False),
    Column("deadline_s", Float),
    Column("num_segments", Integer, nullable=False),
    Column("state", String, nullable=False),
    Column("stop", String),  # CANCELLED or TIMED_OUT, from the moment the job was told to stop
    Column("generation", Integer, nullable=False),
    Column("num_kept", Integer, nullable=False),  # segments that had ended when this generation began
    Column("created_ms", BigInteger, nullable=False),
    Column("deadline_ms", BigInteger),
    Column("started_ms", BigInteger),
    Column("finished_ms", BigInteger),
    Column("failure", JSON(none_as_null=True)),
    Column("owner", String, nullable=False, server_default=""),  # who submitted it; empty: nobody was asked
    _state_known(JOB_TRANSITIONS),
    Index("jobs_by_age", "created_ms", "id"),
    Index("jobs_by_state", "state", "created_ms", "id"),
    Index("jobs_by_dataset", "dataset", "created_ms", "id"),
    Index("jobs_by_owner", "owner", "created_ms", "id"),
    Index("jobs_by_owner_and_state", "owner", "state", "created_ms", "id"),  # counted from it alone
    UniqueConstraint("owner", "client_job_id"),
)

segments = Table(
    "segments",
    metadata,
    Column("job_id", ForeignKey("jobs.id"), primary_key=True),
    Column("position", Integer, primary_key=True),  # in the job's segments, sorted by URI
    Column("uri", String, nullable=False),
    Column("segment_id", String),
    Column("state", String, nullable=False),
    Column("attempts", Integer, nullable=False),
    Column("fence", Integer, nullable=False),  # grows with each claim, so that a former holder is known as such
    Column("holder", String),  # the dispatcher that has it at work; null unless RUNNING
    Column("lease_ms", BigInteger),  # until when it is held; null unless RUNNING
    Column("stage", String),
    Column("sweeps_done", Integer, nullable=False),
    Column("num_sweeps", Integer),
    Column("queued_ms", BigInteger),  # since when it waits; null unless QUEUED
    Column("started_ms", BigInteger),
    Column("finished_ms", BigInteger),
    Column("error", String),
    Column("message", String),
    Column("entry", JSON(none_as_null=True)),  # the manifest's SegmentEntry
    _state_known(SEGMENT_TRANSITIONS),
    Index("segments_by_state", "job_id", "state", "position"),
    Index("segments_by_end", "finished_ms"),
    # What waits and what runs is little beside what is done: partial indices stay small. Their conditions are on null,
    # not on the state: a state arrives as a parameter, and a plan for any parameter cannot use an index for one.
    CheckConstraint(f"(state = '{SegmentState.QUEUED}') = (queued_ms IS NOT NULL)", name="waits_since"),
    CheckConstraint(f"(state = '{SegmentState.RUNNING}') = (lease_ms IS NOT NULL)", name="held_until"),
    Index("segments_by_wait", "queued_ms", **_where("queued_ms IS NOT NULL")),
    Index("segments_by_lease", "lease_ms", **_where("lease_ms IS NOT NULL")),
)

events = Table(
    "events",
    metadata,
    Column("job_id", ForeignKey("jobs.id"), primary_key=True),
    Column("sequence", Integer, primary_key=True),  # of the job: from 1, without gaps; the oldest are forgotten
    Column("at_ms", BigInteger, nullable=False),
    Column("position", Integer),  # of the segment that it happened to; null: to the job
    Column("state", String, nullable=False),  # that the segment or the job is in from then on
    Column("attempt", Integer),  # of the segment
    Column("detail", String),  # one line
)

dispatchers = Table(
    "dispatchers",
    metadata,
    Column("id", String, primary_key=True),
    Column("host", String, nullable=False),
    Column("pid", Integer, nullable=False),
    Column("code_version", String, nullable=False),
    Column("num_workers", Integer, nullable=False),
    Column("started_ms", BigInteger, nullable=False),
    Column("heartbeat_ms", BigInteger, nullable=False),
)
