"""Signing in at the dashboard with an API key: the cookie is worth nothing elsewhere, and nothing after the key."""

import http.cookies
import re
from datetime import UTC, datetime

import pytest
from fastapi.testclient import TestClient

from service.app import create_app
from service.keys import Scope, add_key, make_key, read_keys, revoke_key
from service.sessions import COOKIE, MAX_AGE_S

URL = "http://127.0.0.1:8000"
FOREIGN = ["https://evil.example", "null", "http://127.0.0.1:3000", "http://localhost:8000"]


def new_client(settings, url=URL):
    return TestClient(create_app(settings), base_url=url, raise_server_exceptions=False, follow_redirects=False)


@pytest.fixture
def site(keyed):
    with new_client(keyed) as client:
        yield client


@pytest.fixture
def sign_in(site):
    """Return a function that signs in and returns the session's cookie."""

    def run(token, **fields):
        answer = site.post("/dashboard/sign-in", data={"key": token} | fields, headers={"Origin": URL})
        assert answer.status_code == 303, answer.text
        return site.cookies[COOKIE]

    return run


def assert_form(answer, complaint=None):
    assert answer.status_code == 401
    assert answer.headers["content-type"] == "text/html; charset=utf-8"
    assert "form-action 'self'" in answer.headers["content-security-policy"]
    assert answer.headers["cache-control"] == "no-store"
    assert answer.headers["www-authenticate"].startswith("Bearer")
    assert answer.headers["hx-refresh"] == "true"
    assert '<input id="key" name="key" type="password"' in answer.text
    assert ('role="alert"' in answer.text) == (complaint is not None)
    assert (complaint or "") in answer.text


@pytest.mark.parametrize("path", ["", "/live", "/jobs/abc", "/jobs/abc/live", "/nothing", "?state=FAILED"])
def test_whoever_is_not_signed_in_meets_the_form(site, path):
    assert_form(site.get(f"/dashboard{path}"))


def test_with_the_form_come_its_files_and_nothing_else(site):
    text = site.get("/dashboard").text
    for path in re.findall(r'(?:src|href)="(/dashboard/static/[^"]+)"', text):
        assert site.get(path).status_code == 200
    assert "live-part" not in text
    assert "Signed in" not in text


def test_signing_in_leads_to_the_jobs_of_the_keys_owner(site, sign_in, issue, submit):
    token = issue("ann")
    sign_in(token)
    page = site.get("/dashboard")
    assert page.status_code == 200
    assert "Signed in as ann" in page.text
    assert submit() not in page.text  # it is nobody's
    assert token[12:] not in page.text
    assert site.get("/v1/jobs").status_code == 200  # the pages link there


def test_the_cookie_is_for_this_site_alone_and_holds_no_key(site, issue, caplog):
    token = issue()
    answer = site.post("/dashboard/sign-in", data={"key": f" {token}\n"}, headers={"Origin": URL})
    (morsel,) = http.cookies.SimpleCookie(answer.headers["set-cookie"]).values()
    assert (morsel["httponly"], morsel["samesite"], morsel["path"]) == (True, "strict", "/")
    assert (morsel["domain"], morsel["max-age"], morsel["expires"], morsel["secure"]) == ("", "", "", "")
    assert re.fullmatch(r"[\w-]{43}", morsel.value)
    assert not any(part in str(answer.headers) + answer.text for part in (token, token[12:], token[3:11]))
    assert token[12:] not in caplog.text


@pytest.mark.parametrize("kind", ["tls", "proxy"])
def test_over_tls_the_cookie_never_travels_without(keyed, issue, kind):
    changed = keyed.model_copy(update={"allowed_hosts": ("labels.example",)})
    with new_client(changed, "https://labels.example" if kind == "tls" else "http://labels.example") as site:
        headers = {"Origin": "https://labels.example"}
        for call, data in (("sign-in", {"key": issue()}), ("sign-out", {})):
            answer = site.post(f"/dashboard/{call}", data=data, headers=headers)
            assert answer.status_code == 303
            assert "Secure" in answer.headers["set-cookie"]


WRONG_FORMS = {
    "nothing": b"",
    "empty": b"key=",
    "no key": b"key=ml_00000000_" + b"A" * 43,
    "another field": b"token={token}",
    "twice": b"key={token}&key={token}",
    "lower-cased": b"key={lower}",
    "markup": b"key=%3Cscript%3Ealert(1)%3C/script%3E",
    "NUL": b"key={token}%00",
    "bytes": b"key=\xff\xfe",
    "JSON": b'{"key": "{token}"}',
    "newline": b"key={token}%0d%0aSet-Cookie:%20a=b",
}


@pytest.mark.parametrize("attack", WRONG_FORMS)
def test_a_wrong_key_is_told_and_begins_nothing(site, issue, attack, caplog):
    token = issue()
    form = WRONG_FORMS[attack].replace(b"{token}", token.encode()).replace(b"{lower}", token.lower().encode())
    answer = site.post("/dashboard/sign-in", content=form, headers={"Origin": URL})
    assert_form(answer, "This is no key of the service")
    assert "set-cookie" not in answer.headers
    assert not any(part in answer.text + caplog.text for part in (token[12:], token[12:].lower(), "alert(1)"))


@pytest.mark.parametrize(("content", "status"), [(b"a" * 5000, 413), (b"&".join([b"a=b"] * 500), 400)])
def test_a_form_is_small(site, content, status):
    assert site.post("/dashboard/sign-in", content=content).status_code == status


def test_revoked_and_expired_keys_sign_nobody_in(site, issue, keyed):
    revoked, expired = issue(), issue(expires=datetime(2020, 1, 1, tzinfo=UTC))
    revoke_key(keyed.api_keys_file, revoked[3:11])
    for token in (revoked, expired):
        assert_form(site.post("/dashboard/sign-in", data={"key": token}), "This is no key of the service")


@pytest.mark.parametrize("call", ["sign-in", "sign-out"])
@pytest.mark.parametrize("origin", FOREIGN)
def test_a_foreign_page_signs_nobody_in_or_out(site, sign_in, issue, origin, call):
    sign_in(issue("ann"))
    answer = site.post(f"/dashboard/{call}", data={"key": issue("eve")}, headers={"Origin": origin})
    assert (answer.status_code, "set-cookie" in answer.headers) == (403, False)
    assert "Signed in as ann" in site.get("/dashboard").text


@pytest.mark.parametrize("origin", FOREIGN)
def test_a_foreign_page_presses_no_button_of_somebody_signed_in(site, sign_in, issue, settings, origin):
    sign_in(issue("ann"))
    body = {"dataset": "synthetic", "segments": ["synthetic:street"], "output_uri": f"{settings.data_roots[0]}/out"}
    job = site.post("/v1/jobs", json=body, headers={"Origin": URL}).json()["id"]
    for path in (f"/dashboard/jobs/{job}/cancel", f"/v1/jobs/{job}:cancel", "/v1/jobs"):
        assert site.post(path, headers={"Origin": origin}).status_code == 403
    (found,) = site.get("/v1/jobs").json()["jobs"]
    assert found["state"] == "QUEUED"
    assert site.post(f"/dashboard/jobs/{job}/cancel", headers={"Origin": URL}).status_code == 303
    assert site.get(f"/v1/jobs/{job}").json()["state"] == "CANCELLED"


@pytest.mark.parametrize(
    ("to", "place"),
    [
        ("/dashboard/jobs/abc", "/dashboard/jobs/abc"),
        ("/dashboard", "/dashboard"),
        ("", "/dashboard"),
        ("//evil.example", "/dashboard"),
        ("https://evil.example/dashboard", "/dashboard"),
        ("/dashboard/../v1/jobs", "/dashboard"),
        ("/dashboard/jobs/abc\r\nSet-Cookie: a=b", "/dashboard"),
        ("/dashboard/jobs/abc\n", "/dashboard"),
        ("/dashboard@evil.example", "/dashboard"),
        ("/dashboard/sign-out", "/dashboard"),
        ("\\\\evil.example", "/dashboard"),
    ],
)
def test_signing_in_leads_nowhere_else(site, issue, to, place):
    answer = site.post("/dashboard/sign-in", data={"key": issue(), "to": to}, headers={"Origin": URL})
    assert (answer.status_code, answer.headers["location"]) == (303, place)


def test_the_page_that_asked_is_the_one_that_comes(site, sign_in, issue):
    assert 'name="to" value="/dashboard/jobs/abc"' in site.get("/dashboard/jobs/abc?state=FAILED").text
    assert 'name="to" value="/dashboard"' in site.get("/dashboard/jobs/abc/live").text


def test_a_cookie_is_worth_nothing_after_signing_out(site, sign_in, issue):
    cookie = sign_in(issue())
    answer = site.post("/dashboard/sign-out", headers={"Origin": URL})
    assert (answer.status_code, answer.headers["location"]) == (303, "/dashboard")
    assert COOKIE not in site.cookies
    site.cookies.set(COOKIE, cookie)
    assert_form(site.get("/dashboard"))
    assert site.get("/v1/jobs").status_code == 401


def test_signing_in_anew_ends_the_session_before_and_takes_no_number_of_a_callers(site, sign_in, issue):
    site.cookies.set(COOKIE, "chosen-by-somebody-else")
    token = issue()
    answer = site.post("/dashboard/sign-in", data={"key": token}, headers={"Origin": URL})
    assert "chosen" not in answer.headers["set-cookie"]
    site.cookies.clear()
    first = sign_in(token)
    assert sign_in(token) != first
    site.cookies.clear()
    site.cookies.set(COOKIE, first)
    assert_form(site.get("/dashboard"))


def test_a_restart_ends_every_session(site, sign_in, issue, keyed):
    cookie = sign_in(issue())
    with new_client(keyed) as other:
        other.cookies.set(COOKIE, cookie)
        assert_form(other.get("/dashboard"))


def test_a_session_ends_with_its_key(site, sign_in, issue, keyed):
    token = issue()
    sign_in(token)
    assert site.get("/dashboard").status_code == 200
    revoke_key(keyed.api_keys_file, token[3:11])
    assert_form(site.get("/dashboard"))
    assert_form(site.get("/dashboard/live"))
    assert site.get("/v1/jobs").status_code == 401


def test_a_session_follows_its_key(site, sign_in, issue, keyed):
    """Scopes are those that the file has now, and another key under the same id is another one."""
    token = issue("ann", Scope.SUBMIT)
    sign_in(token)
    path = keyed.api_keys_file
    path.write_text(path.read_text().replace('"submit"', '"read"'))
    assert site.post("/dashboard/jobs/abc/cancel", headers={"Origin": URL}).status_code == 403
    (key,) = read_keys(path)
    revoke_key(path, key.id)
    add_key(path, key.model_copy(update={"sha256": "0" * 64}))
    assert_form(site.get("/dashboard"))


@pytest.mark.parametrize("value", ["", "x", "x" * 50_000, "ml_00000000_x", "\u00e4", "../../keys", '"', "a=b"])
def test_other_cookies_let_nobody_in(site, issue, value):
    issue()
    assert_form(site.get("/dashboard", headers={"Cookie": f"{COOKIE}={value}".encode()}))


def test_the_token_itself_is_no_cookie(site, issue):
    assert_form(site.get("/dashboard", headers={"Cookie": f"{COOKIE}={issue()}"}))


def test_a_wrong_header_beside_a_good_cookie_is_refused(site, sign_in, issue):
    sign_in(issue())
    assert site.get("/v1/jobs", headers={"Authorization": "Bearer x"}).status_code == 401


def test_who_may_only_look_has_no_buttons(site, issue, settings, sign_in):
    body = {"dataset": "synthetic", "segments": ["synthetic:street"], "output_uri": f"{settings.data_roots[0]}/out"}
    headers = {"Authorization": f"Bearer {issue('ann')}"}
    job = site.post("/v1/jobs", json=body, headers=headers).json()["id"]
    sign_in(issue("ann", Scope.READ))
    page = site.get(f"/dashboard/jobs/{job}").text
    assert "Signed in as ann, to look only" in page
    assert 'id="cancel"' not in page
    assert 'id="sign-out"' in page
    refused = site.post(f"/dashboard/jobs/{job}/cancel", headers={"Origin": URL})
    assert (refused.status_code, "no scope submit" in refused.text) == (403, True)
    assert site.post("/dashboard/sign-out", headers={"Origin": URL}).status_code == 303
    sign_in(issue("ann"))
    assert 'id="cancel"' in site.get(f"/dashboard/jobs/{job}").text


def test_without_keys_nobody_is_asked(settings):
    with new_client(settings) as site:
        page = site.get("/dashboard")
        assert (page.status_code, "sign-out" in page.text) == (200, False)
        for call in ("sign-in", "sign-out"):
            answer = site.post(f"/dashboard/{call}", data={"key": "x"}, headers={"Origin": URL})
            assert (answer.status_code, answer.headers["location"]) == (303, "/dashboard")


@pytest.fixture
def key(keyed):
    key = make_key("ann", [Scope.READ])[0]
    add_key(keyed.api_keys_file, key)
    return key


@pytest.fixture
def sessions(keyed, key):
    return new_client(keyed).app.state.sessions


def test_sessions_end_by_themselves(sessions, key, monkeypatch):
    now_s = 1000.0
    monkeypatch.setattr("service.sessions.time.monotonic", lambda: now_s)
    number = sessions.begin(key)
    now_s += MAX_AGE_S - 1
    assert sessions.find(number) == key
    now_s += 1
    assert sessions.find(number) is None
    sessions.begin(key)
    assert len(sessions._sessions) == 1


def test_nobody_fills_the_memory_by_signing_in(sessions, key, keyed):
    other = make_key("bob", [Scope.READ])[0]
    add_key(keyed.api_keys_file, other)
    kept = sessions.begin(other)
    numbers = [sessions.begin(key) for _ in range(50)]
    assert [sessions.find(number) is not None for number in numbers] == [False] * 30 + [True] * 20
    assert sessions.find(kept) == other
    assert len(sessions._sessions) == 21
    assert not any(number in str(sessions._sessions) for number in numbers)
