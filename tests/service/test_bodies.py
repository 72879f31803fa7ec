"""Bodies of requests: bounded, parsed beside the other requests, quoted in a line."""

import json
import threading

import pytest
from fastapi.testclient import TestClient

from service.app import create_app

URL = "http://127.0.0.1:8000"


@pytest.mark.parametrize("body", [b"", b"{", b"\xff", b'{"dataset": "a" "b"}', b"[" * 100_000, b"1" * 10_000])
def test_what_is_not_json_is_refused(api, body, assert_problem):
    answer = api.post("/v1/jobs", content=body, headers={"content-type": "application/json"})
    assert_problem(answer, 422 if body == b"" else 400)


@pytest.mark.parametrize("body", [b"null", b"[]", b"1"])
def test_json_of_another_kind_is_refused(api, body, assert_problem):
    assert_problem(api.post("/v1/jobs", content=body, headers={"content-type": "application/json"}), 422)


def test_forms_are_refused(api, request_body, assert_problem):
    headers = {"content-type": "text/plain"}  # what a foreign web page may send without asking
    assert_problem(api.post("/v1/jobs", content=json.dumps(request_body()), headers=headers), 422, "Content-Type")


HUGE = {
    "lists": b'{"overrides": {"flow.iterations": [' + b"[]," * 2_700_000 + b"[]]}}",
    "numbers": b'{"segments": [' + b"1," * 4_000_000 + b"1]}",
    "gaps": b'{"overrides": {"static.vote_gaps_s": [' + b"0.5," * 1_500_000 + b"0.5]}}",
    "keys": b"{" + b",".join(b'"%d":1' % i for i in range(600_000)) + b"}",
}


@pytest.mark.parametrize("body", HUGE.values(), ids=HUGE)
def test_a_body_of_more_values_than_a_job_needs_is_refused_unparsed(api, body, assert_problem):
    answer = api.post("/v1/jobs", content=body, headers={"content-type": "application/json"})
    assert_problem(answer, 413, "more than 100000 commas and brackets: submit fewer segments")


LARGE = {
    "names": {"segments": ["x" * 2000 + str(i) for i in range(3000)], "dataset": "av2"},
    "numbers": {"segments": list(range(10_000))},
    "keys": {str(i): 1 for i in range(50_000)},
    "overrides": {"overrides": {f"flow.{i}": 1 for i in range(50_000)}},
    "nested": {"overrides": {"flow": {f"{i}": 1 for i in range(50_000)}}},
    "gaps": {"overrides": {"static.vote_gaps_s": [0.5] * 90_000}},
    "text": {"overrides": {"flow.iterations": "9" * 10**6}},
    "key": {"x" * 10**6: 1},
    "dots": {"overrides": {"a." * 5000: 1}},
    "dots of an option": {"overrides": {"flow." + "a." * 5000: 1}},
    "dataset": {"dataset": "x" * 10**6},
    "output": {"output_uri": "/" + "x" * 2000},
    "deep": {"overrides": {"flow.iterations": json.loads("[" * 900 + "]" * 900)}},
}


@pytest.mark.parametrize("changes", LARGE.values(), ids=LARGE)
def test_of_a_large_mistake_at_most_a_line_is_quoted(api, request_body, changes, assert_problem):
    answer = api.post("/v1/jobs", json=request_body(**changes))
    problem = assert_problem(answer, 422)
    assert len(problem["detail"]) < 1200
    assert len(answer.content) < 30_000
    assert len(problem["errors"]) <= 20


def test_bodies_are_parsed_beside_the_other_requests(api, request_body, monkeypatch):
    threads = []

    def parse(body):
        threads.append(threading.current_thread())
        return json.loads(body)

    monkeypatch.setattr("service.bodies._parse", parse)
    serving = api.portal.call(threading.current_thread)
    assert api.post("/v1/jobs", json=request_body()).status_code == 202
    assert threads
    assert serving not in threads


def test_too_large_a_body_is_refused(api, monkeypatch, settings, assert_problem):
    monkeypatch.setattr("service.app.MAX_BODY_BYTES", 1000)
    with TestClient(create_app(settings), base_url=URL) as client:
        assert_problem(client.post("/v1/jobs", json={"segments": ["x" * 1000]}), 413, "fewer segments")
        chunks = iter([b" " * 600, b" " * 600])  # of no declared length
        headers = {"content-type": "application/json"}
        assert_problem(client.post("/v1/jobs", content=chunks, headers=headers), 413, "fewer segments")
