"""The version of a store's tables, and the way from any earlier one to ours: Alembic's scripts in ``migrations``."""

import threading
from typing import Final

from alembic import command
from alembic.config import Config
from sqlalchemy import Connection, column, inspect, select, table

from workers.jobs.tables import schema_version

STORE_VERSION: Final = "0005"  # what the last of the scripts makes, and ``tables`` describes
_ALEMBIC_VERSION: Final = table("alembic_version", column("version_num"))  # Alembic's own
_SCRIPTS: Final = "workers.jobs:migrations"
_ONE_AT_A_TIME: Final = threading.Lock()  # Alembic's scripts speak to one connection a process


def find_version(connection: Connection) -> str | None:
    """Return the version of the tables, None where there are none. Versions sort by age."""
    tables = inspect(connection).get_table_names()
    if _ALEMBIC_VERSION.name in tables:
        return connection.scalar(select(_ALEMBIC_VERSION.c.version_num))
    number = connection.scalar(select(schema_version.c.version)) if schema_version.name in tables else None
    return None if number is None else f"{number:04}"  # from before there were migrations


def upgrade(connection: Connection) -> None:
    """Bring tables of an earlier version, or none, to ours, in the transaction at hand: all of it or nothing."""
    config = Config(attributes={"connection": connection})
    config.set_main_option("script_location", _SCRIPTS)
    with _ONE_AT_A_TIME:
        version = find_version(connection)
        if version is not None:
            command.stamp(config, version)
        command.upgrade(config, "head")
