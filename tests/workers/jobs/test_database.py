import pytest
from sqlalchemy import insert, update
from sqlalchemy.exc import IntegrityError, OperationalError

from schemas.errors import InvalidInput
from workers.jobs.database import now_ms, open_database
from workers.jobs.tables import dispatchers

ROW = {"host": "h", "pid": 1, "code_version": "v", "num_workers": 1, "started_ms": 0, "heartbeat_ms": 0}


def test_opening_again_keeps_what_is_there(url):
    for expected in (0, 1):
        database = open_database(url)
        with database.write() as connection:
            assert len(connection.execute(dispatchers.select()).all()) == expected
            connection.execute(insert(dispatchers).values(id=str(expected), **ROW))
        database.close()


@pytest.mark.parametrize(
    ("url", "message"),
    [
        ("jobs.sqlite3", "expected sqlite:////absolute/path"),
        ("sqlite://", "expected sqlite:////absolute/path"),
        ("sqlite:///:memory:", "expected sqlite:////absolute/path"),
        ("mysql://u@h/d", "cannot use 'mysql' as a job store"),
        ("nosuch://x", "cannot use 'nosuch' as a job store"),
        ("sqlite:////no/such/folder/jobs.sqlite3", "unable to open database file"),
        ("postgresql://u:secret@127.0.0.1:1/d", "cannot open the job store"),
    ],
)
def test_what_cannot_be_opened_is_named_without_its_password(url, message):
    if url.startswith("postgresql"):
        pytest.importorskip("psycopg", reason="psycopg is not installed")
    with pytest.raises(InvalidInput) as caught:
        open_database(url)
    text = str(caught.value)
    assert message in text
    assert "\n" not in text
    assert "secret" not in text


def test_an_exception_undoes_the_transaction(database):
    def insert_twice():
        with database.write() as connection:
            connection.execute(insert(dispatchers).values(id="a", **ROW))
            connection.execute(insert(dispatchers).values(id="a", **ROW))

    with pytest.raises(IntegrityError):
        insert_twice()
    with database.read() as connection:
        assert connection.execute(dispatchers.select()).all() == []


def test_readers_see_committed_rows_only_and_need_not_wait(database):
    with database.write() as writing, database.read() as reading:
        writing.execute(insert(dispatchers).values(id="a", **ROW))
        assert reading.execute(dispatchers.select()).all() == []
    with database.read() as reading:
        assert len(reading.execute(dispatchers.select()).all()) == 1


def test_whoever_finds_the_store_locked_waits_no_longer_than_it_said(url, database):
    impatient = open_database(url, wait_s=0.1)
    with database.write() as connection:
        connection.execute(insert(dispatchers).values(id="a", **ROW))
    with database.write() as connection:
        connection.execute(update(dispatchers).values(pid=2))
        with pytest.raises(OperationalError), impatient.write() as other:
            other.execute(update(dispatchers).values(pid=3))
    with impatient.write() as other:
        other.execute(update(dispatchers).values(pid=3))
    impatient.close()


def test_the_clock_is_the_databases_and_does_not_run_backwards(database):
    with database.read() as connection:
        times = [now_ms(connection) for _ in range(50)]
    assert times == sorted(times)
    assert 1.7e12 < times[0] < 4e12  # milliseconds since 1970
