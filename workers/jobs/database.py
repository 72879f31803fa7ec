"""Open the job store's database: SQLite in a file, or PostgreSQL."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from typing import Any, Final

from sqlalchemy import Connection, Engine, create_engine, event, text
from sqlalchemy.engine import make_url
from sqlalchemy.exc import ArgumentError, DBAPIError, NoSuchModuleError

from schemas.errors import InvalidInput
from workers.jobs.versions import STORE_VERSION, find_version, upgrade

URL_VARIABLE: Final = "MOTIONLABEL_DATABASE_URL"  # a URL may hold a password, and everybody sees command lines
MAX_CONNECTIONS: Final = 15  # of one process
_WAIT_S: Final = 10.0  # for another's transaction, or a server
# Of PostgreSQL: a dispatcher that was stopped, or cut off, in mid-transaction does not keep the others out for long.
_IDLE_S: Final = 15
_SILENCE: Final = {"keepalives_idle": 5, "keepalives_interval": 2, "keepalives_count": 3, "tcp_user_timeout": 10_000}
_NOW_MS: Final = {
    "sqlite": text("SELECT CAST((julianday('now') - 2440587.5) * 86400000 AS INTEGER)"),
    "postgresql": text("SELECT CAST(EXTRACT(EPOCH FROM clock_timestamp()) * 1000 AS BIGINT)"),
}
_SCHEMA_LOCK: Final = text("SELECT pg_advisory_xact_lock(7305021)")  # any number of our own


class Database:
    """Connections to one job store. Safe to share between threads, not between processes."""

    def __init__(self, engine: Engine) -> None:
        self._engine = engine
        self._writing_engine = engine.execution_options(is_writing=True)

    @contextmanager
    def read(self) -> Iterator[Connection]:
        """Run one transaction that reads."""
        with self._engine.begin() as connection:
            yield connection

    @contextmanager
    def write(self) -> Iterator[Connection]:
        """Run one transaction that writes: committed at the end, undone by an exception."""
        with self._writing_engine.begin() as connection:
            yield connection

    def upgrade(self) -> str | None:
        """Bring earlier tables, or none, to this version, whoever else tries; return the version that was found."""
        with self.write() as connection:
            if connection.dialect.name == "postgresql":  # SQLite has one writer at a time anyway
                connection.execute(_SCHEMA_LOCK)
            version = find_version(connection)
            if version is None or version < STORE_VERSION:
                upgrade(connection)
        return version

    def close(self) -> None:
        """Close all connections."""
        self._engine.dispose()


def now_ms(connection: Connection) -> int:
    """Return the database's clock. Leases and deadlines know no other, whatever the machines' clocks say."""
    return int(connection.execute(_NOW_MS[connection.dialect.name]).scalar_one())


@dataclass(frozen=True, slots=True)
class Migration:
    """What was done to the tables of a store."""

    store: str  # its URL without the password
    before: str | None  # the version of its tables; None: there were none

    @property
    def is_upgrade(self) -> bool:
        """True when there were earlier tables."""
        return self.before not in (None, STORE_VERSION)

    def describe(self) -> str:
        """Return it as a line."""
        if self.before == STORE_VERSION:
            return f"job store {self.store}: has version {STORE_VERSION} already"
        return f"job store {self.store}: {self.before or 'no tables'} -> version {STORE_VERSION}"


def open_database(url: str, *, wait_s: float = _WAIT_S) -> Database:
    """Connect to a store, and create its tables where there are none.

    Args:
        url: ``sqlite:////absolute/path/jobs.sqlite3`` or ``postgresql://user@host/name``.
        wait_s: How long a transaction waits for another's before it fails with OperationalError.

    Raises:
        InvalidInput: Not such a URL, no database there, or tables of another version.

    """
    with _connected(url, wait_s) as (database, shown):
        with database.read() as connection:
            version = find_version(connection)
        if version is None:
            database.upgrade()
        elif version != STORE_VERSION:
            raise InvalidInput(_explain(shown, version))
    return database


def migrate_database(url: str) -> Migration:
    """Bring the tables of a store, or an empty database, to this version. Once more changes nothing.

    Raises:
        InvalidInput: As ``open_database``, but earlier versions are welcome.

    """
    with _connected(url, _WAIT_S) as (database, shown):
        before = database.upgrade()
        if before is not None and before > STORE_VERSION:
            raise InvalidInput(_explain(shown, before))
    database.close()
    return Migration(shown, before)


@contextmanager
def _connected(url: str, wait_s: float) -> Iterator[tuple[Database, str]]:
    """Yield a database and its name; close it again when what is done with it fails, and say so in one line."""
    engine = _make_engine(url, wait_s)
    database, shown = Database(engine), engine.url.render_as_string(hide_password=True)
    try:
        yield database, shown
    except BaseException as error:
        database.close()
        if isinstance(error, DBAPIError):
            raise InvalidInput(f"cannot open the job store {shown}: {str(error.orig).splitlines()[0]}") from None
        raise


def _explain(shown: str, version: str) -> str:
    if version < STORE_VERSION:
        relation, way_out = "earlier", "stop what uses it, then run `motionlabel migrate` with the same settings"
    else:
        relation, way_out = "later", "use the motionlabel that migrated it, or choose another database"
    return f"the job store {shown} has version {version}, {relation} than this motionlabel's {STORE_VERSION}: {way_out}"


def _make_engine(url: str, wait_s: float) -> Engine:
    pool = {"pool_size": MAX_CONNECTIONS, "max_overflow": 0, "pool_timeout": wait_s}
    expected = "expected sqlite:////absolute/path/jobs.sqlite3 or postgresql://user@host/name"
    try:
        parsed = make_url(url)
        backend = parsed.get_backend_name()
        if backend == "sqlite" and parsed.database not in (None, "", ":memory:"):
            engine = create_engine(parsed, connect_args={"timeout": wait_s}, **pool)
            event.listen(engine, "connect", _set_up_sqlite)
            event.listen(engine, "begin", _begin_sqlite)
            return engine
        if backend == "postgresql":
            # Prepared statements are off: planned for any value, "lease_ms <= now" looks like a third of the table.
            engine = create_engine(
                parsed.set(drivername="postgresql+psycopg"),
                pool_pre_ping=True,
                **pool,
                connect_args={"prepare_threshold": None, "connect_timeout": max(2, round(wait_s)), **_SILENCE},
            )
            event.listen(engine, "connect", partial(_set_up_postgresql, wait_s))
            return engine
    except (ArgumentError, NoSuchModuleError):
        pass
    except ModuleNotFoundError:
        raise InvalidInput("PostgreSQL needs psycopg: install motionlabel[postgres]") from None
    raise InvalidInput(f"cannot use {url.partition(':')[0]!r} as a job store: {expected}")


def _set_up_sqlite(connection: Any, _record: object) -> None:  # a DBAPI connection has no type of its own
    connection.isolation_level = None  # transactions begin where _begin_sqlite says, not where the driver guesses
    connection.execute("PRAGMA journal_mode=WAL")
    connection.execute("PRAGMA synchronous=NORMAL")
    connection.execute("PRAGMA foreign_keys=ON")


def _set_up_postgresql(wait_s: float, connection: Any, _record: object) -> None:
    connection.execute(f"SET lock_timeout = {round(1000 * wait_s)}")
    connection.execute(f"SET idle_in_transaction_session_timeout = {1000 * _IDLE_S}")
    connection.commit()


def _begin_sqlite(connection: Connection) -> None:
    # A transaction that reads and then writes must hold the write lock from its start: no time-out saves the upgrade.
    is_writing = connection.get_execution_options().get("is_writing", False)
    connection.exec_driver_sql("BEGIN IMMEDIATE" if is_writing else "BEGIN")
