"""The dashboard in process and on a port."""

import contextlib
import itertools
import threading
import time

import pytest
import uvicorn
from fastapi.testclient import TestClient

from schemas.api.jobs import JobRequest
from service.app import create_app
from workers.jobs.database import open_database
from workers.jobs.store import JobStore

URL = "http://127.0.0.1:8000"


@pytest.fixture
def site(settings):
    """A client of the dashboard that follows no redirect."""
    with TestClient(
        create_app(settings), base_url=URL, raise_server_exceptions=False, follow_redirects=False
    ) as client:
        yield client


@pytest.fixture
def submit(settings):
    """A function that submits a job past the API's checks of places, and returns its id."""
    database = open_database(settings.store_url)
    store, numbers = JobStore(database), itertools.count()

    def run(num_segments=1, **changes):
        uris = [f"synthetic:street?seed={next(numbers)}" for _ in range(num_segments)]
        body = {"dataset": "synthetic", "segments": uris, "output_uri": "/labels", **changes}
        return store.submit(JobRequest.model_validate(body)).id

    yield run
    database.close()


@pytest.fixture
def address(settings):
    """The address of a service on a port of its own, without a dispatcher."""
    with serving(settings) as url:
        yield url


@pytest.fixture
def keyed_address(keyed):
    """The same, of a service that asks for API keys."""
    with serving(keyed) as url:
        yield url


@contextlib.contextmanager
def serving(settings):
    server = uvicorn.Server(uvicorn.Config(create_app(settings), port=0, log_level="critical"))
    thread = threading.Thread(target=server.run)
    thread.start()
    while not server.started:
        assert thread.is_alive()
        time.sleep(0.01)
    yield f"http://127.0.0.1:{server.servers[0].sockets[0].getsockname()[1]}"
    server.should_exit = True
    thread.join()
