"""A job's name is its owner's: two owners may use the same one. Jobs of one owner are listed and counted by indices."""

from alembic import op

revision = "0004"
down_revision = "0003"

_OF_ALL = "UNIQUE (client_job_id)"
_OF_ONE = "UNIQUE (owner, client_job_id)"


def upgrade() -> None:
    """Let names be unique within an owner only."""
    if op.get_bind().dialect.name == "sqlite":
        _rebuild_jobs()
    else:
        op.drop_constraint("jobs_client_job_id_key", "jobs")
        op.create_unique_constraint(None, "jobs", ["owner", "client_job_id"])
    op.create_index("jobs_by_owner", "jobs", ["owner", "created_ms", "id"])
    op.create_index("jobs_by_owner_and_state", "jobs", ["owner", "state", "created_ms", "id"])


def _rebuild_jobs() -> None:
    """Make the table anew: SQLite drops no constraint. Segments look for their jobs again when all is done."""
    connection = op.get_bind()
    of_jobs = "SELECT sql FROM sqlite_master WHERE tbl_name = 'jobs' AND type = '{}' AND sql IS NOT NULL"
    (table,) = connection.exec_driver_sql(of_jobs.format("table")).scalars()
    indices = connection.exec_driver_sql(of_jobs.format("index")).scalars().all()
    connection.exec_driver_sql("PRAGMA defer_foreign_keys = ON")  # until the transaction ends
    statements = [
        "CREATE TABLE jobs_before AS SELECT * FROM jobs",
        "DROP TABLE jobs",
        table.replace(_OF_ALL, _OF_ONE),
        "INSERT INTO jobs SELECT * FROM jobs_before",
        "DROP TABLE jobs_before",
        *indices,
    ]
    for statement in statements:
        connection.exec_driver_sql(statement)
