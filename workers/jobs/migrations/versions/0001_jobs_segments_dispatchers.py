"""The tables as they were before there were migrations."""

import sqlalchemy as sa
from alembic import op

revision = "0001"
down_revision = None

_JOB_STATES = "'QUEUED', 'RUNNING', 'CANCELLING', 'SUCCEEDED', 'PARTIAL', 'FAILED', 'CANCELLED', 'TIMED_OUT', 'CRASHED'"
_SEGMENT_STATES = "'QUEUED', 'RUNNING', 'SUCCEEDED', 'PARTIAL', 'FAILED', 'CANCELLED', 'CRASHED'"


def upgrade() -> None:
    """Create them."""
    version = op.create_table("schema_version", sa.Column("version", sa.Integer, primary_key=True))
    op.bulk_insert(version, [{"version": 1}])
    op.create_table(
        "jobs",
        sa.Column("id", sa.String, primary_key=True),
        sa.Column("client_job_id", sa.String, unique=True),
        sa.Column("fingerprint", sa.String, nullable=False),
        sa.Column("dataset", sa.String, nullable=False),
        sa.Column("output_uri", sa.String, nullable=False),
        sa.Column("profile", sa.String, nullable=False),
        sa.Column("config", sa.JSON, nullable=False),
        sa.Column("priority", sa.Integer, nullable=False),
        sa.Column("deadline_s", sa.Float),
        sa.Column("num_segments", sa.Integer, nullable=False),
        sa.Column("state", sa.String, nullable=False),
        sa.Column("stop", sa.String),
        sa.Column("generation", sa.Integer, nullable=False),
        sa.Column("num_kept", sa.Integer, nullable=False),
        sa.Column("created_ms", sa.BigInteger, nullable=False),
        sa.Column("deadline_ms", sa.BigInteger),
        sa.Column("started_ms", sa.BigInteger),
        sa.Column("finished_ms", sa.BigInteger),
        sa.Column("failure", sa.JSON),
        sa.CheckConstraint(f"state IN ({_JOB_STATES})", name="state_known"),
    )
    op.create_index("jobs_by_age", "jobs", ["created_ms", "id"])
    op.create_index("jobs_by_state", "jobs", ["state", "created_ms", "id"])
    op.create_index("jobs_by_dataset", "jobs", ["dataset", "created_ms", "id"])
    op.create_table(
        "segments",
        sa.Column("job_id", sa.String, sa.ForeignKey("jobs.id"), primary_key=True),
        sa.Column("position", sa.Integer, primary_key=True),
        sa.Column("uri", sa.String, nullable=False),
        sa.Column("segment_id", sa.String),
        sa.Column("state", sa.String, nullable=False),
        sa.Column("attempts", sa.Integer, nullable=False),
        sa.Column("fence", sa.Integer, nullable=False),
        sa.Column("owner", sa.String),
        sa.Column("lease_ms", sa.BigInteger),
        sa.Column("stage", sa.String),
        sa.Column("sweeps_done", sa.Integer, nullable=False),
        sa.Column("num_sweeps", sa.Integer),
        sa.Column("queued_ms", sa.BigInteger),
        sa.Column("started_ms", sa.BigInteger),
        sa.Column("finished_ms", sa.BigInteger),
        sa.Column("error", sa.String),
        sa.Column("message", sa.String),
        sa.Column("entry", sa.JSON),
        sa.CheckConstraint(f"state IN ({_SEGMENT_STATES})", name="state_known"),
        sa.CheckConstraint("(state = 'QUEUED') = (queued_ms IS NOT NULL)", name="waits_since"),
        sa.CheckConstraint("(state = 'RUNNING') = (lease_ms IS NOT NULL)", name="held_until"),
    )
    op.create_index("segments_by_state", "segments", ["job_id", "state", "position"])
    op.create_index("segments_by_end", "segments", ["finished_ms"])
    for name, column in (("segments_by_wait", "queued_ms"), ("segments_by_lease", "lease_ms")):
        condition = sa.text(f"{column} IS NOT NULL")
        op.create_index(name, "segments", [column], sqlite_where=condition, postgresql_where=condition)
    op.create_table(
        "dispatchers",
        sa.Column("id", sa.String, primary_key=True),
        sa.Column("host", sa.String, nullable=False),
        sa.Column("pid", sa.Integer, nullable=False),
        sa.Column("code_version", sa.String, nullable=False),
        sa.Column("num_workers", sa.Integer, nullable=False),
        sa.Column("started_ms", sa.BigInteger, nullable=False),
        sa.Column("heartbeat_ms", sa.BigInteger, nullable=False),
    )
