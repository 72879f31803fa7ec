"""A job's events as a stream: whole, resumable, bounded in number, and holding nothing while it waits."""

import asyncio
import json
import threading

import httpx2
import pytest
from fastapi import HTTPException
from sqlalchemy.exc import OperationalError

from schemas.api.jobs import JobEvent
from service.routes import events
from service.streams import Streams


def parse(text):
    """Return (event, id, data) of each event of a stream, and its comments."""
    told, comments = [], []
    for block in text.strip().split("\n\n"):
        fields = [line.partition(": ")[::2] for line in block.splitlines()]
        if fields[0][0]:
            values = dict(fields)
            told.append((values["event"], int(values["id"]), json.loads(values["data"])))
        else:
            comments.append(fields[0][1])
    return told, comments


@pytest.fixture
def ended(submit, finish, end_jobs):
    """A job of two segments that has ended."""
    job = submit(segments=["synthetic:street?sweeps=30", "synthetic:street?sweeps=31"])
    finish()
    finish("FAILED")
    end_jobs()
    return job


def test_the_events_of_a_job_that_has_ended_are_told_and_the_stream_ends(api, ended):
    answer = api.get(f"/v1/jobs/{ended}/events")
    assert answer.headers["content-type"].startswith("text/event-stream")
    told, _ = parse(answer.text)
    assert [number for _, number, _ in told] == list(range(1, 8))
    assert [(kind, data["position"], data["state"]) for kind, _, data in told] == [
        ("job", None, "QUEUED"),
        ("job", None, "RUNNING"),
        ("segment", 0, "RUNNING"),
        ("segment", 0, "SUCCEEDED"),
        ("segment", 1, "RUNNING"),
        ("segment", 1, "FAILED"),
        ("job", None, "PARTIAL"),
    ]
    for _, number, data in told:
        assert JobEvent.model_validate_json(json.dumps(data)).sequence == number


def test_who_comes_back_gets_what_follows_and_in_the_end_nothing(api, ended):
    whole, _ = parse(api.get(f"/v1/jobs/{ended}/events").text)
    for last in range(7):
        told, _ = parse(api.get(f"/v1/jobs/{ended}/events", headers={"Last-Event-ID": str(last)}).text)
        assert told == whole[last:]
    for last in (7, 99):
        answer = api.get(f"/v1/jobs/{ended}/events", headers={"Last-Event-ID": str(last)})
        assert (answer.status_code, answer.content) == (204, b"")


def test_a_retry_goes_on_with_the_numbers(api, ended):
    api.post(f"/v1/jobs/{ended}:retry")
    api.post(f"/v1/jobs/{ended}:cancel")
    told, _ = parse(api.get(f"/v1/jobs/{ended}/events", headers={"Last-Event-ID": "7"}).text)
    assert [(number, data["state"]) for _, number, data in told] == [(8, "QUEUED"), (9, "CANCELLED")]


@pytest.mark.parametrize("number", ["-1", "x", "1.5", str(2**31), ""])
def test_what_is_no_number_of_an_event_is_refused(api, ended, number, assert_problem):
    assert_problem(api.get(f"/v1/jobs/{ended}/events", headers={"Last-Event-ID": number}), 422, "last-event-id")


def test_no_job_has_no_events(api, assert_problem):
    assert_problem(api.get(f"/v1/jobs/{'0' * 16}/events"), 404, "no job")


def test_head_does_not_wait_for_the_end(api, submit):
    answer = api.head(f"/v1/jobs/{submit()}/events")
    assert (answer.status_code, answer.content) == (200, b"")
    assert answer.headers["content-type"].startswith("text/event-stream")


def test_what_happens_is_told_as_it_happens(server, request_body, finish, end_jobs, monkeypatch):
    monkeypatch.setattr(events, "POLL_S", 0.01)
    with httpx2.Client(base_url=server, timeout=30) as client:
        job = client.post("/v1/jobs", json=request_body()).json()["id"]
        with client.stream("GET", f"/v1/jobs/{job}/events") as answer:
            lines = answer.iter_lines()
            states = (json.loads(line[6:])["state"] for line in lines if line.startswith("data: "))
            assert next(states) == "QUEUED"
            finish()
            assert [next(states) for _ in range(3)] == ["RUNNING", "RUNNING", "SUCCEEDED"]
            end_jobs()
            assert list(states) == ["SUCCEEDED"]


def test_so_many_streams_are_open_and_a_place_is_free_again(settings, running, request_body, monkeypatch):
    monkeypatch.setattr(events, "POLL_S", 0.01)
    monkeypatch.setattr("service.app.Streams", lambda: Streams(max_in_all=1))
    with running(settings) as server, httpx2.Client(base_url=server, timeout=30) as client:
        job = client.post("/v1/jobs", json=request_body()).json()["id"]
        with client.stream("GET", f"/v1/jobs/{job}/events") as answer:
            lines = answer.iter_lines()  # which would close the stream, were it let go
            assert next(lines) == "event: job"
            refused = client.get(f"/v1/jobs/{job}/events")
            assert refused.status_code == 429
            assert int(refused.headers["retry-after"]) > 0
            assert "1 streams of events open, and 1 are allowed" in refused.json()["detail"]
        for _ in range(500):  # until the server has noticed that its client is gone
            answer = client.head(f"/v1/jobs/{job}/events")
            if answer.status_code == 200:
                break
            threading.Event().wait(0.02)
        assert answer.status_code == 200


def test_owners_are_counted_each_and_together():
    streams = Streams(max_in_all=3, max_per_owner=2)
    with streams.opened("ann"), streams.opened("ann"):
        with pytest.raises(HTTPException, match="you have 2 streams"), streams.opened("ann"):
            pass
        with streams.opened("bob"), pytest.raises(HTTPException, match="there are 3"), streams.opened("chief"):
            pass
        with streams.opened("chief"):
            pass
    assert streams._open.total() == 0
    assert dict(streams._open) == {}


class Script:
    """A reader that is told what to find."""

    def __init__(self, *found):
        self.found = list(found)

    async def read(self):
        found = self.found.pop(0)
        if isinstance(found, Exception):
            raise found
        return found


def tell(reader, streams=None):
    async def collect():
        return [piece async for piece in events._tell(reader, [], False, streams or Streams())]

    return asyncio.run(collect())


def test_a_silent_stream_has_a_comment_at_times(monkeypatch):
    monkeypatch.setattr(events, "POLL_S", 0)
    monkeypatch.setattr(events, "HEARTBEAT_S", 0)
    assert tell(Script(([], False), ([], True))) == [b": waiting\n\n"] * 3
    monkeypatch.setattr(events, "HEARTBEAT_S", 1000)
    assert tell(Script(([], False), ([], True))) == []


def test_a_stream_outlives_an_outage_of_the_store(monkeypatch):
    monkeypatch.setattr(events, "POLL_S", 0)
    reader = Script(OperationalError("SELECT", {}, Exception("away")), ([], True))
    assert tell(reader) == []
    assert reader.found == []


def test_a_stream_ends_with_its_time_and_with_the_service(monkeypatch):
    streams = Streams()
    streams.close()
    assert tell(Script(), streams) == []
    monkeypatch.setattr(events, "MAX_STREAM_S", 0)
    assert tell(Script()) == []


def test_a_stream_that_waits_holds_no_place_at_the_store(api, submit, monkeypatch):
    job, door, free = submit(), api.app.state.door, []
    before = door._places._value

    async def look(_):
        free.append(door._places._value)
        api.app.state.streams.close()

    monkeypatch.setattr("service.routes.events.asyncio.sleep", look)
    told, _ = parse(api.get(f"/v1/jobs/{job}/events").text)
    assert [data["state"] for _, _, data in told] == ["QUEUED"]
    assert free == [before]
