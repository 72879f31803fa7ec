"""Requests that wait for the job store: few of them, none for long."""

import sqlite3
import threading
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing

from fastapi.testclient import TestClient
from sqlalchemy.exc import IntegrityError

from service.app import create_app
from workers.jobs.database import MAX_CONNECTIONS
from workers.jobs.store import JobStore

URL = "http://127.0.0.1:8000"


def test_a_store_that_is_gone_is_said_without_a_trace(api, settings, caplog, assert_problem):
    with closing(sqlite3.connect(settings.data_dir / "jobs.sqlite3")) as connection:
        connection.execute("DROP TABLE segments")
    answer = api.get("/v1/status")
    assert_problem(answer, 503, "job store")
    assert answer.headers["retry-after"] == "5"
    assert_problem(api.get("/readyz"), 503)
    assert api.get("/healthz").status_code == 200


def test_a_store_that_is_damaged_is_said_without_a_trace(api, settings, submit, caplog, assert_problem):
    submit()
    path = settings.data_dir / "jobs.sqlite3"
    with closing(sqlite3.connect(path)) as connection:
        connection.execute("PRAGMA wal_checkpoint(TRUNCATE)")
    with path.open("r+b") as file:
        file.seek(4096)
        file.write(b"\xff" * (path.stat().st_size - 4096))
    answers = [api.get("/v1/jobs"), api.get("/v1/status")]
    for answer in answers:
        assert_problem(answer, 503, "job store")
    assert "malformed" in caplog.text


def test_a_query_that_the_store_refuses_is_our_own_fault(api, monkeypatch, assert_problem):
    def refuse(*_, **__):
        raise IntegrityError("INSERT", {}, Exception("twice"))

    monkeypatch.setattr(JobStore, "list_jobs", refuse)
    assert_problem(api.get("/v1/jobs"), 500, "internal error")


def test_an_outage_is_logged_when_it_begins_and_when_it_is_over(
    settings, request_body, monkeypatch, caplog, assert_problem
):
    monkeypatch.setattr("service.app.PATIENCE_S", 0.2)
    with TestClient(create_app(settings), base_url=URL, raise_server_exceptions=False) as api:
        with closing(sqlite3.connect(settings.data_dir / "jobs.sqlite3", isolation_level=None)) as other:
            other.execute("BEGIN IMMEDIATE")
            with ThreadPoolExecutor(30) as threads:
                answers = list(threads.map(lambda _: api.post("/v1/jobs", json=request_body()), range(30)))
        for answer in answers:
            assert_problem(answer, 503, "job store")
            assert answer.headers["retry-after"] == "5"
        (line,) = [record.getMessage() for record in caplog.records if record.name.startswith("service")]
        assert line == "the job store cannot be used: (sqlite3.OperationalError) database is locked"
        assert api.post("/v1/jobs", json=request_body()).status_code == 202
        assert caplog.records[-1].getMessage() == "the job store can be used again"


def test_who_finds_the_door_of_the_store_full_is_sent_away_and_health_is_told_at_once(
    settings, request_body, monkeypatch, assert_problem
):
    """80 submits at a store that does not answer: as many wait inside as there are connections."""
    is_inside, may_go = threading.Semaphore(0), threading.Event()
    submit = JobStore.submit

    def wait_inside(store, request, **owner):
        is_inside.release()
        assert may_go.wait(60)
        return submit(store, request, **owner)

    monkeypatch.setattr(JobStore, "submit", wait_inside)
    monkeypatch.setattr("service.app.PATIENCE_S", 1.0)
    with TestClient(create_app(settings), base_url=URL) as api, ThreadPoolExecutor(80) as threads:
        answers = [threads.submit(api.post, "/v1/jobs", json=request_body()) for _ in range(80)]
        for _ in range(MAX_CONNECTIONS):
            assert is_inside.acquire(timeout=60)
        assert api.get("/healthz").status_code == 200
        assert api.get("/v1/version").status_code == 200
        answer = api.get("/v1/status")
        assert_problem(answer, 503, "job store")
        assert answer.headers["retry-after"] == "5"
        may_go.set()
        codes = [answer.result().status_code for answer in answers]
    assert codes.count(202) >= MAX_CONNECTIONS
    assert set(codes) == {202, 503}
