"""A job store on SQLite, and the same on PostgreSQL where its server is installed."""

import itertools
import os
import pwd
import secrets
import shutil
import signal
import socket
import subprocess
import tempfile
import time
from pathlib import Path

import pytest

from schemas.api.jobs import JobRequest
from workers.jobs.claims import SegmentQueue
from workers.jobs.database import open_database
from workers.jobs.store import JobStore


@pytest.fixture(scope="session")
def postgres_url():
    """A PostgreSQL server of our own on a free port of 127.0.0.1, ended with the session."""
    psycopg = pytest.importorskip("psycopg", reason="psycopg is not installed")
    folders = sorted(Path("/usr/lib/postgresql").glob("*/bin/initdb"))
    initdb = shutil.which("initdb") or (str(folders[-1]) if folders else None)
    if initdb is None:
        pytest.skip("PostgreSQL's server is not installed")
    user = {}
    if os.geteuid() == 0:  # which initdb refuses to run as
        try:
            account = pwd.getpwnam("postgres")
        except KeyError:
            pytest.skip("PostgreSQL does not run as root, and there is no user postgres")
        user = {"user": account.pw_uid, "group": account.pw_gid, "extra_groups": []}
    folder = Path(tempfile.mkdtemp(prefix="mlpg-", dir="/tmp"))  # short: its socket's path must stay below 107 bytes
    if user:
        os.chown(folder, user["user"], user["group"])
    quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL, "cwd": folder, **user}
    data = folder / "data"
    command = [initdb, "-D", data, "-A", "trust", "-U", "motionlabel", "--no-sync", "--locale=C", "--encoding=UTF8"]
    subprocess.run(command, check=True, **quiet)
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    server = [Path(initdb).with_name("postgres"), "-D", data, "-h", "127.0.0.1", "-p", str(port), "-k", folder, "-F"]
    process = subprocess.Popen(server, **quiet)
    url = f"postgresql://motionlabel@127.0.0.1:{port}/postgres"
    try:
        for _ in range(300):
            try:
                psycopg.connect(url).close()
                break
            except psycopg.OperationalError:
                assert process.poll() is None, "PostgreSQL ended at its start"
                time.sleep(0.1)
        yield url
    finally:
        process.send_signal(signal.SIGINT)
        process.wait(30)
        shutil.rmtree(folder)


@pytest.fixture(params=["sqlite", "postgresql"])
def new_url(request, tmp_path):
    """A function that returns the URL of an empty job store, another one at each call."""
    if request.param == "sqlite":
        numbers = itertools.count(1)
        return lambda: f"sqlite:///{tmp_path}/jobs{next(numbers)}.sqlite3"
    server = request.getfixturevalue("postgres_url")

    def create_schema():
        name = f"jobs_{secrets.token_hex(4)}"
        with pytest.importorskip("psycopg").connect(server) as connection:
            connection.execute(f"CREATE SCHEMA {name}")
        return f"{server}?options=-csearch_path%3D{name}"

    return create_schema


@pytest.fixture
def url(new_url):
    """The URL of an empty job store."""
    return new_url()


@pytest.fixture
def database(url):
    database = open_database(url)
    yield database
    database.close()


@pytest.fixture
def store(database):
    return JobStore(database)


@pytest.fixture
def queue(database):
    return SegmentQueue(database)


@pytest.fixture
def make_request():
    def make(num_segments=2, **fields):
        uris = [f"synthetic:street?seed={i:04}" for i in range(num_segments)]
        return JobRequest.model_validate({"dataset": "synthetic", "segments": uris, "output_uri": "out", **fields})

    return make
