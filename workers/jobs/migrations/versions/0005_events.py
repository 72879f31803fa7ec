"""What happens to jobs and their segments is kept as numbered events; of a job that is there, the state it is in."""

import sqlalchemy as sa
from alembic import op

revision = "0005"
down_revision = "0004"


def upgrade() -> None:
    """Create the table, with a first event for each job."""
    op.create_table(
        "events",
        sa.Column("job_id", sa.String, sa.ForeignKey("jobs.id"), primary_key=True),
        sa.Column("sequence", sa.Integer, primary_key=True),
        sa.Column("at_ms", sa.BigInteger, nullable=False),
        sa.Column("position", sa.Integer),
        sa.Column("state", sa.String, nullable=False),
        sa.Column("attempt", sa.Integer),
        sa.Column("detail", sa.String),
    )
    op.execute(
        "INSERT INTO events (job_id, sequence, at_ms, state) "
        "SELECT id, 1, COALESCE(finished_ms, started_ms, created_ms), state FROM jobs"
    )
