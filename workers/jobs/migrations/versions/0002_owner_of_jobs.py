"""Who submitted a job is its owner; who has a segment at work is its holder, and was called its owner before."""

import sqlalchemy as sa
from alembic import op

revision = "0002"
down_revision = "0001"


def upgrade() -> None:
    """Add the one, rename the other, and tell a motionlabel from before migrations that this store is not for it."""
    op.add_column("jobs", sa.Column("owner", sa.String, nullable=False, server_default=""))
    op.alter_column("segments", "owner", new_column_name="holder")
    op.execute("UPDATE schema_version SET version = 2")
