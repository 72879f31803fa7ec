"""Who may call: by which names the service is reached, and from which pages."""

import pytest
from fastapi.testclient import TestClient

from service.app import create_app

URL = "http://127.0.0.1:8000"


OWN = ["127.0.0.1:8000", "localhost", "LOCALHOST:9", "localhost.:8000", "[::1]:8000", "127.0.0.1"]
FOREIGN = [
    "evil.example",
    "evil.example:8000",
    "127.0.0.1.evil.example",
    "",
    "localhost:x",
    "a@localhost",
    "localhost/",
]
FOREIGN += ["10.1.2.3", "localhost,evil.example", "[::1", "0.0.0.0", "2130706433"]


@pytest.mark.parametrize("method", ["GET", "POST"])
@pytest.mark.parametrize("host", OWN)
def test_the_service_answers_to_its_own_names(api, request_body, method, host):
    answer = api.request(method, "/v1/jobs", headers={"host": host}, json=request_body() if method == "POST" else None)
    assert answer.status_code in (200, 202)


@pytest.mark.parametrize("path", ["/v1/jobs", "/healthz", "/openapi.json", "/nothing"])
@pytest.mark.parametrize("host", FOREIGN)
def test_a_foreign_name_is_refused(api, path, host, assert_problem):
    answer = api.get(path, headers={"host": host})
    assert_problem(answer, 403, "MOTIONLABEL_ALLOWED_HOSTS")


@pytest.mark.parametrize(
    ("listening", "allowed", "host", "status"),
    [
        ("0.0.0.0", (), "10.1.2.3:8000", 200),
        ("::", (), "[fd00::1]:8000", 200),
        ("0.0.0.0", (), "evil.example", 403),
        ("labels.local", (), "labels.local:8000", 200),
        ("10.1.2.3", (), "10.1.2.4", 403),
        ("127.0.0.1", ("labels.Example",), "LABELS.example:80", 200),
    ],
)
def test_names_come_from_the_address_and_from_the_operator(settings, listening, allowed, host, status):
    changed = settings.model_copy(update={"host": listening, "allowed_hosts": allowed})
    with TestClient(create_app(changed), base_url=URL) as api:
        assert api.get("/healthz", headers={"host": host}).status_code == status


@pytest.mark.parametrize(
    "origin", ["https://evil.example", "null", "http://127.0.0.1:3000", "http://localhost:8000", "x"]
)
def test_a_foreign_page_changes_nothing(api, submit, request_body, origin, assert_problem):
    job = submit()
    for path in ("/v1/jobs", f"/v1/jobs/{job}:cancel", f"/v1/jobs/{job}:retry"):
        assert_problem(api.post(path, json=request_body(), headers={"origin": origin}), 403, origin)
    (listed,) = api.get("/v1/jobs", headers={"origin": origin}).json()["jobs"]
    assert listed["state"] == "QUEUED"


@pytest.mark.parametrize("origin", [URL, "https://labels.example"])
def test_a_page_of_the_service_itself_may(settings, request_body, origin):
    changed = settings.model_copy(update={"allowed_hosts": ("labels.example",)})
    with TestClient(create_app(changed), base_url=URL) as api:
        assert api.post("/v1/jobs", json=request_body(), headers={"origin": origin}).status_code == 202
