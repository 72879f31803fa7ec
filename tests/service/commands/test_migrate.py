"""`motionlabel migrate`: one line says what was done, the exit code whether it could be."""

import subprocess
import sys
from pathlib import Path

import pytest
from sqlalchemy import create_engine, text

from workers.jobs.database import open_database

ROOT = Path(__file__).resolve().parents[3]


@pytest.fixture
def url(tmp_path):
    return f"sqlite:///{tmp_path}/jobs.sqlite3"


@pytest.fixture
def migrate(cli, tmp_path):
    return lambda: cli("migrate", "--data-dir", tmp_path)


def test_an_old_store_is_brought_up_once(migrate, make_old_store, url):
    make_old_store(url)
    assert migrate() == (0, f"job store {url}: 0001 -> version 0005\n", [])
    assert migrate() == (0, f"job store {url}: has version 0005 already\n", [])
    open_database(url).close()


@pytest.mark.parametrize("name", ["ques?tion", "per%20cent", "sp ace", "ha#sh", "a:b@c", "ü", "pl+us"])
def test_a_data_folder_is_called_as_it_is_written(cli, tmp_path, name):
    folder = tmp_path / name
    folder.mkdir()
    assert cli("migrate", "--data-dir", folder)[0] == 0
    assert [path.name for path in folder.glob("*.sqlite3")] == ["jobs.sqlite3"]
    assert list(tmp_path.iterdir()) == [folder]


def test_a_dispatcher_does_not_migrate_by_the_way(make_old_store, url, tmp_path):
    make_old_store(url)
    command = [sys.executable, "-m", "service", "dispatch", "--data-dir", tmp_path]
    ended = subprocess.run(command, capture_output=True, text=True, cwd=ROOT)
    assert (ended.returncode, ended.stdout, ended.stderr.count("\n")) == (2, "", 1)
    assert "run `motionlabel migrate` with the same settings" in ended.stderr


def test_the_variable_names_the_store_and_an_empty_one_gets_its_tables(cli, url, monkeypatch):
    monkeypatch.setenv("MOTIONLABEL_DATABASE_URL", url)
    assert cli("migrate") == (0, f"job store {url}: no tables -> version 0005\n", [])


def test_a_later_store_is_wrong_input(migrate, url):
    open_database(url).close()
    engine = create_engine(url)
    with engine.begin() as connection:
        connection.execute(text("UPDATE alembic_version SET version_num = '0007'"))
    engine.dispose()
    code, out, (line,) = migrate()
    assert (code, out) == (2, "")
    assert f"motionlabel: the job store {url} has version 0007, later than" in line


def test_a_folder_that_is_not_there_is_wrong_input(cli, tmp_path):
    code, out, (line,) = cli("migrate", "--data-dir", tmp_path / "missing")
    assert (code, out) == (2, "")
    assert "unable to open database file" in line
