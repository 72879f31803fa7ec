"""Attacks on a service that asks for API keys: each is refused, and says nothing that helps."""

import re
from datetime import UTC, datetime

import pytest
from fastapi.testclient import TestClient

from schemas.errors import InvalidInput
from service.access import Caller
from service.app import create_app
from service.keys import Scope, make_key, revoke_key
from workers.jobs.store import JobStore

URL = "http://127.0.0.1:8000"
BODY = {"dataset": "synthetic", "segments": ["synthetic:street?sweeps=30"]}


@pytest.fixture
def api(keyed):
    with TestClient(create_app(keyed), base_url=URL, raise_server_exceptions=False, follow_redirects=False) as client:
        yield client


@pytest.fixture
def body(settings):
    return BODY | {"output_uri": f"{settings.data_roots[0]}/out"}


def bearer(token):
    return {"Authorization": f"Bearer {token}"}


def assert_refused(answer, status, *tokens):
    assert answer.status_code == status, answer.text
    assert answer.headers["content-type"] == "application/problem+json"
    assert answer.headers["www-authenticate"].startswith('Bearer realm="motionlabel"')
    problem = answer.json()
    assert (problem["status"], "\n" in problem["detail"]) == (status, False)
    for token in tokens:
        assert token[12:] not in answer.text + str(answer.headers)


def test_a_key_lets_in_and_its_owner_is_kept(api, body, issue):
    headers = bearer(issue("ann"))
    answer = api.post("/v1/jobs", json=body, headers=headers)
    assert (answer.status_code, answer.json()["owner"]) == (202, "ann")
    (listed,) = api.get("/v1/jobs", headers=headers).json()["jobs"]
    assert listed == answer.json()


@pytest.mark.parametrize("scheme", ["Bearer", "bearer", "BEARER", "Bearer  "])
def test_the_scheme_is_read_as_http_says(api, issue, scheme):
    assert api.get("/v1/jobs", headers={"Authorization": f"{scheme} {issue()}"}).status_code == 200


WRONG = {
    "nothing": lambda token: None,
    "empty": lambda token: "",
    "scheme alone": lambda token: "Bearer",
    "no token": lambda token: "Bearer ",
    "no scheme": lambda token: token,
    "another scheme": lambda token: f"Basic {token}",
    "token as password": lambda token: f"Token {token}",
    "truncated": lambda token: f"Bearer {token[:-1]}",
    "without its secret": lambda token: f"Bearer {token[:12]}",
    "without its id": lambda token: f"Bearer {token[12:]}",
    "one letter more": lambda token: f"Bearer {token}A",
    "doubled": lambda token: f"Bearer {token}{token}",
    "twice in one header": lambda token: f"Bearer {token} {token}",
    "in a list": lambda token: f"Bearer {token}, Bearer {token}",
    "lower-cased": lambda token: f"Bearer {token.lower()}",
    "upper-cased": lambda token: f"Bearer {token.upper()}",
    "secret lower-cased": lambda token: f"Bearer {token[:12]}{token[12:].lower()}",
    "in quotes": lambda token: f'Bearer "{token}"',
    "tab before": lambda token: f"Bearer\t{token}",
    "of another id": lambda token: f"Bearer ml_00000000_{token[12:]}",
    "hash for token": lambda token: f"Bearer ml_{token[3:11]}_{'0' * 43}",
    "wide letters": lambda token: b"Bearer " + token.replace("m", "\uff4d").encode(),
    "full-width digits": lambda token: f"Bearer {token[:3]}".encode() + "\uff10\uff10".encode() + token[5:].encode(),
    "bytes that are no text": lambda token: b"Bearer \xff\xfe" + token.encode(),
    "NUL behind": lambda token: b"Bearer " + token.encode() + b"\x00",
    "newline in the middle": lambda token: b"Bearer " + token[:20].encode() + b"\n" + token[20:].encode(),
    "very long": lambda token: f"Bearer {token}{'A' * 50_000}",
}


@pytest.mark.parametrize("attack", WRONG)
@pytest.mark.parametrize(("method", "path"), [("GET", "/v1/jobs"), ("POST", "/v1/jobs")])
def test_what_is_no_key_is_refused(api, issue, attack, method, path, caplog):
    token = issue()
    value = WRONG[attack](token)
    headers = {} if value is None else {"Authorization": value}
    assert_refused(api.request(method, path, headers=headers, content=b"{}" if method == "POST" else None), 401, token)
    assert token[12:] not in caplog.text


def test_two_headers_are_none_even_of_good_keys(api, issue):
    headers = [("Authorization", f"Bearer {issue()}"), ("Authorization", f"Bearer {issue()}")]
    assert_refused(api.get("/v1/jobs", headers=headers), 401)


@pytest.mark.parametrize("name", ["api_key", "access_token", "key", "token", "authorization"])
def test_a_key_in_the_query_is_none_and_is_not_repeated(api, issue, name, caplog):
    token = issue()
    assert_refused(api.get(f"/v1/jobs?{name}={token}"), 401, token)
    assert_refused(api.get(f"/v1/jobs?{name}=Bearer%20{token}"), 401, token)
    assert token[12:] not in caplog.text


@pytest.mark.parametrize("name", ["X-API-Key", "X-Forwarded-User", "X-Original-Authorization", "Proxy-Authorization"])
def test_other_headers_say_nothing(api, issue, name):
    assert_refused(api.get("/v1/jobs", headers={name: f"Bearer {issue()}"}), 401)


def test_a_key_of_another_service_is_refused(api, issue):
    issue()
    token = make_key("ann", [Scope.ADMIN])[1]
    assert_refused(api.get("/v1/jobs", headers=bearer(token)), 401, token)


def test_a_revoked_key_is_refused_at_once(api, issue, keyed):
    token, other = issue(), issue()
    assert api.get("/v1/jobs", headers=bearer(token)).status_code == 200
    revoke_key(keyed.api_keys_file, token[3:11])
    assert_refused(api.get("/v1/jobs", headers=bearer(token)), 401, token)
    assert api.get("/v1/jobs", headers=bearer(other)).status_code == 200


def test_an_expired_key_is_refused(api, issue):
    token = issue("ann", Scope.ADMIN, expires=datetime(2020, 1, 1, tzinfo=UTC))
    assert_refused(api.get("/v1/jobs", headers=bearer(token)), 401, token)


def test_a_key_that_comes_later_needs_no_restart(api, issue):
    assert_refused(api.get("/v1/jobs"), 401)
    assert api.get("/v1/jobs", headers=bearer(issue())).status_code == 200


@pytest.mark.parametrize("path", ["/v1/jobs", "/v1/jobs/nobody:cancel", "/v1/jobs/nobody:retry"])
@pytest.mark.parametrize(
    "further",
    [
        {},
        {"X-HTTP-Method-Override": "GET"},
        {"X-Scope": "admin"},
        {"X-Forwarded-Method": "GET"},
        {"Content-Type": "text/plain"},
    ],
    ids=str,
)
def test_who_may_only_look_changes_nothing(api, issue, body, path, further):
    token = issue("ann", Scope.READ)
    answer = api.post(path, json=body | {"scopes": ["admin"]}, headers=bearer(token) | further)
    assert_refused(answer, 403, token)
    assert 'error="insufficient_scope", scope="submit"' in answer.headers["www-authenticate"]
    assert api.get("/v1/jobs", headers=bearer(token)).json()["jobs"] == []


@pytest.mark.parametrize("method", ["PUT", "PATCH", "DELETE", "OPTIONS", "TRACE", "PROPFIND"])
def test_an_odd_method_is_no_way_round_the_scope(api, issue, method):
    assert api.request(method, "/v1/jobs", headers=bearer(issue("ann", Scope.READ))).status_code == 403
    assert api.request(method, "/v1/jobs").status_code == 401


@pytest.mark.parametrize(
    "path",
    [
        "/v1/jobs/", "//v1/jobs", "/healthz/../v1/jobs", "/v1/jobs/%2e%2e/status", "/dashboard/static/../../v1/jobs",
        "/healthz/", "/healthz%2f..%2fv1%2fjobs", "/readyz;/v1/jobs", "/V1/JOBS", "/openapi.json", "/nothing", "/",
        "/docs", "/dashboard/static/", "/dashboard/static/a/b", "/healthz%0a", "/healthz%00",
    ],
)  # fmt: skip
def test_no_spelling_of_a_path_gets_round_the_check(api, path):
    assert api.get(path).status_code == 401


def test_every_route_asks_but_those_that_are_named(api):
    routers = [router.original_router for router in api.app.routes if hasattr(router, "original_router")]
    routes = [route for router in routers for route in router.routes]
    calls = [(method, re.sub(r"{\w+}", "a", route.path)) for route in routes for method in route.methods]
    assert len(calls) > 15
    is_open = {f"{method} {path}" for method, path in calls if api.request(method, path).status_code not in (401, 403)}
    assert is_open == {"GET /healthz", "GET /readyz", "GET /dashboard/static/a", "POST /dashboard/sign-out"}


def test_probes_are_answered_without_a_key(api):
    assert api.get("/healthz").json() == {"status": "ok"}
    assert api.head("/healthz").status_code == 200
    assert api.get("/readyz").status_code == 503  # no dispatcher here


def test_without_a_key_nothing_of_a_body_is_read(api):
    def never():
        pytest.fail("read")
        yield b""

    assert_refused(api.post("/v1/jobs", content=never(), headers={"Content-Length": str(10**9)}), 401)


def test_without_a_key_no_statement_reaches_the_store(api, keyed):
    keyed.data_dir.joinpath("jobs.sqlite3").unlink()
    for path in ("/v1/jobs", "/v1/status", "/v1/jobs/nobody"):
        assert_refused(api.get(path), 401)


def test_a_good_key_opens_nothing_to_a_foreign_page_or_name(api, issue, body):
    headers = bearer(issue())
    assert api.post("/v1/jobs", json=body, headers=headers | {"Origin": "https://evil.example"}).status_code == 403
    assert api.get("/v1/jobs", headers=headers | {"Host": "evil.example"}).status_code == 403
    assert api.get("/v1/jobs", headers=headers).json()["jobs"] == []


def test_a_broken_file_of_keys_stops_the_start_and_not_the_service(api, issue, keyed):
    token = issue()
    assert api.get("/v1/jobs", headers=bearer(token)).status_code == 200
    with keyed.api_keys_file.open("a") as file:
        file.write('{"id": ')
    assert api.get("/v1/jobs", headers=bearer(token)).status_code == 200
    assert_refused(api.get("/v1/jobs", headers=bearer(make_key("ann", [Scope.READ])[1])), 401)
    with pytest.raises(InvalidInput, match="line 2"):
        create_app(keyed)


def test_the_document_says_which_calls_need_a_key(api, issue):
    document = api.get("/openapi.json", headers=bearer(issue("ann", Scope.READ))).json()
    assert document["components"]["securitySchemes"]["key"]["scheme"] == "bearer"
    unasked = {
        path
        for path, methods in document["paths"].items()
        for operation in methods.values()
        if "security" not in operation
    }
    assert unasked == {"/healthz", "/readyz"}


@pytest.fixture
def owned(api, body, issue):
    """A job of Bob's, and the headers of each who asks for it."""
    headers = {
        "ann": bearer(issue("ann", Scope.SUBMIT)),
        "bob": bearer(issue("bob", Scope.SUBMIT)),
        "bob, who only looks": bearer(issue("bob", Scope.READ)),
        "admin": bearer(issue("chief", Scope.ADMIN)),
    }
    job = api.post("/v1/jobs", json=body | {"client_job_id": "night"}, headers=headers["bob"]).json()
    return job["id"], headers


CALLS = [
    ("GET", "/v1/jobs/{job}"),
    ("GET", "/v1/jobs/{job}/segments"),
    ("GET", "/v1/jobs/{job}/labels"),
    ("HEAD", "/v1/jobs/{job}/events"),
    ("GET", "/v1/jobs/{job}/segments/0/labels"),
    ("POST", "/v1/jobs/{job}:cancel"),
    ("POST", "/v1/jobs/{job}:retry"),
    ("GET", "/dashboard/jobs/{job}"),
    ("GET", "/dashboard/jobs/{job}/live"),
    ("POST", "/dashboard/jobs/{job}/cancel"),
    ("POST", "/dashboard/jobs/{job}/retry"),
]


@pytest.mark.parametrize(("method", "path"), CALLS)
def test_a_job_of_somebody_else_is_as_one_that_is_not_there(api, owned, method, path):
    job, headers = owned
    foreign = api.request(method, path.format(job=job), headers=headers["ann"])
    absent = api.request(method, path.format(job="0" * 16), headers=headers["ann"])
    assert foreign.status_code == absent.status_code == 404
    assert foreign.text.replace(job, "0" * 16) == absent.text
    for owner in ("bob", "admin"):
        assert api.request(method, path.format(job=job), headers=headers[owner]).status_code != 404
        assert api.get(f"/v1/jobs/{job}", headers=headers[owner]).json()["owner"] == "bob"


@pytest.mark.parametrize(("method", "path"), CALLS)
def test_who_only_looks_presses_nothing_of_the_same_owners(api, owned, method, path):
    job, headers = owned
    status = api.request(method, path.format(job=job), headers=headers["bob, who only looks"]).status_code
    assert (status == 403) == (method == "POST")
    assert api.get(f"/v1/jobs/{job}", headers=headers["bob"]).json()["state"] == "QUEUED"


def test_lists_hold_the_jobs_of_their_owner_and_those_of_all_for_an_admin(api, owned, body):
    job, headers = owned
    mine = api.post("/v1/jobs", json=body, headers=headers["ann"]).json()["id"]
    seen = {
        name: {found["id"] for found in api.get("/v1/jobs", headers=each).json()["jobs"]}
        for name, each in headers.items()
    }
    assert seen == {"ann": {mine}, "bob": {job}, "bob, who only looks": {job}, "admin": {job, mine}}
    assert job not in api.get("/dashboard", headers=headers["ann"]).text
    assert mine in api.get("/dashboard", headers=headers["ann"]).text


def test_a_page_token_of_somebody_else_shows_nothing_of_theirs(api, owned, body):
    _, headers = owned
    for owner in ("bob", "bob", "ann", "bob", "ann"):
        api.post("/v1/jobs", json=body, headers=headers[owner])
    token = api.get("/v1/jobs?page_size=1", headers=headers["bob"]).json()["next_page_token"]
    found = api.get("/v1/jobs", params={"page_token": token}, headers=headers["ann"]).json()["jobs"]
    assert {job["owner"] for job in found} <= {"ann"}


def test_a_name_that_somebody_else_has_used_is_free_and_tells_nothing(api, owned, body):
    job, headers = owned
    answer = api.post("/v1/jobs", json=body | {"client_job_id": "night", "priority": 1}, headers=headers["ann"])
    assert (answer.status_code, answer.json()["owner"]) == (202, "ann")
    assert job not in answer.text
    again = api.post("/v1/jobs", json=body | {"client_job_id": "night", "priority": 2}, headers=headers["ann"])
    assert (again.status_code, job in again.text) == (409, False)


@pytest.mark.parametrize("field", ["owner", "scopes", "roots", "key"])
def test_a_body_names_no_owner(api, owned, body, field):
    _, headers = owned
    assert api.post("/v1/jobs", json=body | {field: "bob"}, headers=headers["ann"]).status_code == 422
    assert api.get("/v1/jobs?owner=bob", headers=headers["ann"]).status_code == 422


def test_numbers_of_the_service_name_no_job_of_somebody_else(api, owned, finish, end_jobs):
    job, headers = owned
    finish("FAILED")
    end_jobs()
    assert api.get("/v1/status", headers=headers["bob"]).json()["last_failed_job_by_error"] == {"InvalidInput": job}
    for path in ("/v1/status", "/dashboard"):
        assert job not in api.get(path, headers=headers["ann"]).text
        assert job in api.get(path, headers=headers["admin"]).text


def test_jobs_from_before_there_were_keys_are_the_admins(settings, keyed, body, issue):
    with TestClient(create_app(settings), base_url=URL) as api:
        job = api.post("/v1/jobs", json=body).json()["id"]
    with TestClient(create_app(keyed), base_url=URL) as api:
        assert api.get(f"/v1/jobs/{job}", headers=bearer(issue())).status_code == 404
        assert api.get(f"/v1/jobs/{job}", headers=bearer(issue("chief", Scope.ADMIN))).status_code == 200


@pytest.fixture
def rooted(settings, issue, tmp_path):
    """The folder that jobs of a key stay below, and the key."""
    root = tmp_path / "data" / "ann"
    for folder in (root / "in", tmp_path / "data" / "bob", tmp_path / "data" / "annex"):
        folder.mkdir(parents=True)
    for link, target in {"up": "..", "bob": "../bob", "out": tmp_path, "in/link": "../../bob"}.items():
        (root / link).symlink_to(target)
    return root, bearer(issue("ann", Scope.SUBMIT, roots=[str(root)]))


@pytest.mark.parametrize(
    "place",
    [
        "{root}/../bob", "{root}/..", "{data}", "{data}/bob", "{data}/annex", "{root}x", "/", "/etc", "s3://bucket/ann",
        "file://{data}/bob", "file://{root}/%2e%2e/bob", "file://{root}/..%2fbob", "{root}/up", "{root}/up/bob",
        "{root}/bob", "{root}/out", "{root}/out/state", "{root}/in/link", "{root}/in/link/log", "{root}/./../bob",
        "file://evil.example{root}", "ann", "~/ann", "{root}/in\u0000", "{root}/in/../../bob",
    ],
)  # fmt: skip
@pytest.mark.parametrize("field", ["output", "segment", "override"])
def test_no_name_leads_out_of_the_roots_of_a_key(api, rooted, place, field, keyed):
    root, headers = rooted
    named = place.format(root=root, data=keyed.data_roots[0])
    body = BODY | {"output_uri": f"{root}/out-of-ann"}
    match field:
        case "output":
            body |= {"output_uri": named}
        case "segment":
            body |= {"dataset": "av2", "segments": [named]}
        case "override":
            body |= {"overrides": {"flow.method": "external", "flow.external_folder": named}}
    answer = api.post("/v1/jobs", json=body, headers=headers)
    assert answer.status_code == 422
    assert answer.json()["errors"][0]["pointer"].split("/")[1] in ("output_uri", "segments", "overrides", "")
    assert api.get("/v1/jobs", headers=headers).json()["jobs"] == []


def test_below_the_roots_of_a_key_its_jobs_may_read_and_write(api, rooted, issue, keyed):
    root, headers = rooted
    for place in (f"{root}", f"{root}/labels", f"file://{root}/in", f"{root}/up/ann/in"):
        assert api.post("/v1/jobs", json=BODY | {"output_uri": place}, headers=headers).status_code == 202
    wide = bearer(issue("ann", Scope.SUBMIT))
    assert api.post("/v1/jobs", json=BODY | {"output_uri": f"{root}/../bob"}, headers=wide).status_code == 422
    assert api.post("/v1/jobs", json=BODY | {"output_uri": f"{root.parent}/bob"}, headers=wide).status_code == 202


@pytest.mark.parametrize("place", ["", "/x", "/state/out"])
def test_roots_of_a_key_open_nothing_that_the_service_does_not(api, issue, tmp_path, place):
    headers = bearer(issue("ann", Scope.SUBMIT, roots=["/", "s3://bucket"]))
    refused = api.post("/v1/jobs", json=BODY | {"output_uri": f"{tmp_path}{place}"}, headers=headers)
    assert (refused.status_code, f"({tmp_path}/data)" in refused.text) == (422, True)
    assert api.post("/v1/jobs", json=BODY | {"output_uri": f"{tmp_path}/data/x"}, headers=headers).status_code == 202
    assert api.post("/v1/jobs", json=BODY | {"output_uri": "s3://bucket/x"}, headers=headers).status_code == 422


def test_what_is_open_to_all_is_open_to_nobody_in_particular(api, monkeypatch):
    """Were a route behind an open address to look for jobs, it would find none that has an owner."""
    seen = []

    def look(database, *, sees, **_):
        seen.append(sees)
        return JobStore(database)

    monkeypatch.setattr("service.dependencies.JobStore", look)
    api.get("/readyz")
    assert seen == [""]


@pytest.mark.parametrize(
    ("mine", "roots", "allowed"),
    [
        (None, ["/data", "/more"], ["/data", "/more"]),
        (["/data/ann"], ["/data", "/more"], ["/data/ann"]),
        (["/data"], ["/data"], ["/data"]),
        (["/"], ["/data", "s3://bucket"], ["/data"]),
        (["/data"], ["/data/a", "/data/b", "/database"], ["/data/a", "/data/b"]),
        (["/data/ann", "s3://bucket/ann"], ["/", "s3://bucket"], ["/data/ann", "s3://bucket/ann"]),
        (["/elsewhere", "s3://other"], ["/data", "s3://bucket"], []),
        (["/dat", "s3://buck"], ["/data", "s3://bucket"], []),
    ],
)
def test_places_are_those_that_key_and_service_both_name(mine, roots, allowed):
    assert list(Caller("ann", (Scope.SUBMIT,), mine and tuple(mine)).roots_within(roots)) == allowed
