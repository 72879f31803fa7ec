"""The dashboard's pages in process: a dispatcher is played by the test."""

import html
import importlib.resources
import json
import re
import sqlite3
import subprocess
import sys
import tomllib
from contextlib import closing
from html.parser import HTMLParser
from pathlib import Path

import pytest
from fastapi.testclient import TestClient
from sqlalchemy import Engine, event

from schemas.api.jobs import JobState
from service.app import create_app
from workers.jobs.claims import Dispatcher

ROOT = Path(__file__).resolve().parents[3]
POLICY = {
    "default-src 'none'",
    "script-src 'self'",
    "style-src 'self'",
    "img-src 'self'",
    "connect-src 'self'",
    "form-action 'self'",
    "frame-ancestors 'none'",
    "base-uri 'none'",
}
VOID = {"meta", "link", "input", "br"}


class Page(HTMLParser):
    """What a page is made of. Tags that do not match, and ids that are there twice, are refused."""

    def __init__(self, text):
        super().__init__()
        self.tags, self.text, self._open = [], "", []
        self.feed(text)
        assert not self._open
        ids = [attributes["id"] for _, attributes in self.tags if "id" in attributes]
        assert len(ids) == len(set(ids))

    def handle_starttag(self, tag, attrs):
        self.tags.append((tag, dict(attrs)))
        if tag not in VOID:
            self._open.append(tag)

    def handle_endtag(self, tag):
        assert self._open.pop() == tag

    def handle_data(self, data):
        self.text += data

    def all(self, tag):
        return [attributes for name, attributes in self.tags if name == tag]

    def by_id(self, name):
        return next(attributes for _, attributes in self.tags if attributes.get("id") == name)

    def links(self):
        return [attributes["href"].partition("#")[0] for attributes in self.all("a") if "href" in attributes]

    def job_links(self):
        return [link for link in self.links() if re.fullmatch("/dashboard/jobs/[0-9a-f]+", link)]


def read(answer, status=200):
    """The page in an answer, its headers checked."""
    assert answer.status_code == status, answer.text
    assert answer.headers["content-type"] == "text/html; charset=utf-8"
    assert set(answer.headers["content-security-policy"].split("; ")) == POLICY
    assert answer.headers["x-content-type-options"] == "nosniff"
    assert answer.headers["referrer-policy"] == "same-origin"
    assert answer.headers["cache-control"] == "no-store"
    page = Page(answer.text)
    # The policy lets none of these do anything; so there must be none.
    assert not page.all("style")
    assert all(script.get("src") for script in page.all("script"))
    for _, attributes in page.tags:
        assert not [name for name in attributes if name == "style" or re.match("on|hx-on|hx-vals|hx-vars", name)]
        assert "[" not in attributes.get("hx-trigger", "")
    return page


def test_without_jobs_the_page_says_how_to_submit_one(site):
    page = read(site.get("/dashboard"))
    assert 'motionlabel submit "synthetic:street?sweeps=20"' in page.text
    assert "No dispatcher has reported lately" in page.text
    assert not page.job_links()


def test_a_job_that_goes_on_is_shown_as_it_stands(site, submit, queue, finish):
    queue.heartbeat(Dispatcher(id="a", host="label-01", pid=42, code_version="1", num_workers=2))
    done, at_work, waiting = submit(), submit(2), submit()
    finish()
    finish("FAILED")
    page = read(site.get("/dashboard"))
    assert page.job_links() == [f"/dashboard/jobs/{job}" for job in (at_work, waiting, at_work, done)]
    assert page.by_id("last-InvalidInput")["href"] == f"/dashboard/jobs/{at_work}"
    text = " ".join(page.text.split())
    for said in ("label-01, process 42", "0 of 2 segments, 1 failed", "1 of 1 segment", "InvalidInput"):
        assert said in text
    assert "No dispatcher" not in text
    assert page.by_id("announcement")["role"] == "status"


def test_a_job_says_what_failed_and_what_to_do_about_it(site, submit, finish, end_jobs):
    job = submit(2)
    finish("FAILED")
    finish()
    assert end_jobs() == [JobState.PARTIAL]
    page = read(site.get(f"/dashboard/jobs/{job}"))
    text = " ".join(page.text.split())
    assert "no sweeps InvalidInput What to do: Mend the data that the message names and retry" in text
    assert "attempt 1 of 3" in text
    assert f"/v1/jobs/{job}/labels" in page.links()
    assert [form["action"] for form in page.all("form")] == [f"/dashboard/jobs/{job}/retry"]
    failed = read(site.get(f"/dashboard/jobs/{job}?state=FAILED"))
    assert sum(attributes.get("role") == "rowheader" for attributes in failed.all("th")) == 1


def test_every_page_can_be_used_by_keyboard_and_read_aloud(site, submit, finish):
    job = submit()
    finish("FAILED")
    for path, status in (("/dashboard", 200), (f"/dashboard/jobs/{job}", 200), ("/dashboard/nothing", 404)):
        page = read(site.get(path), status)
        assert page.all("html") == [{"lang": "en"}]
        assert page.links()[0] == ""  # the first thing that Tab reaches goes past the rest
        assert len(page.all("main")) == len(page.all("h1")) == len(page.all("header")) == len(page.all("footer")) == 1
        assert len(page.all("caption")) == len(page.all("table"))
        assert all(nav["aria-label"] for nav in page.all("nav"))
        assert all(bar["aria-label"] for bar in page.all("progress"))
        assert all(cell["scope"] for cell in page.all("th"))
        names = [name for table in page.all("section") for name in table["aria-labelledby"].split()]
        assert all(page.by_id(name) for name in names)


@pytest.mark.parametrize(
    "text", ["<script>alert(1)</script>", "\"onmouseover='alert(1)'", "{{ 7 * 7 }}", "</main>&amp;"]
)
def test_names_that_callers_choose_are_text(site, submit, queue, text):
    job = submit(segments=[f"/data/{text}"], dataset=text, output_uri=f"/labels/{text}")
    claim = queue.claim_segment("test", lease_s=60)
    queue.report_progress(claim, text, 1, 2)
    queue.heartbeat(Dispatcher(id="a", host=text, pid=1, code_version=text, num_workers=1))
    for path in ("/dashboard", f"/dashboard/jobs/{job}"):
        answer = site.get(path)
        page = read(answer)
        assert text in page.text
        assert len(page.all("script")) == 2
        assert html.escape(text, quote=False) in answer.text.replace("&#34;", '"').replace("&#39;", "'")


def test_of_3000_jobs_a_page_shows_25_and_leads_to_all_others(site, submit, queue):
    ids = [submit(client_job_id=f"job-{number}") for number in range(3000)]
    seen, url = [], "/dashboard"
    statements = []

    def count(_connection, _cursor, statement, *_):
        statements.append(statement)

    event.listen(Engine, "before_cursor_execute", count)
    try:
        for number in range(120):
            before = len(statements)
            page = read(site.get(url))
            assert len(statements) - before < 15  # of the store, whatever it holds
            seen += page.job_links()
            assert ("first-page" in [tag.get("id") for tag in page.all("a")]) == (number > 0)
            following = [tag["href"] for tag in page.all("a") if tag.get("rel") == "next"]
            url = following[0].partition("#")[0] if following else None
    finally:
        event.remove(Engine, "before_cursor_execute", count)
    assert url is None
    assert len(seen) == 3000
    assert set(seen) == {f"/dashboard/jobs/{job}" for job in ids}
    assert "3,000" in page.text


def test_a_state_is_kept_from_page_to_page_and_from_poll_to_poll(site, submit):
    ids = [submit() for _ in range(60)]
    for job in ids[:30]:
        assert site.post(f"/dashboard/jobs/{job}/cancel").status_code == 303
    page = read(site.get("/dashboard?state=CANCELLED"))
    url = next(tag["href"] for tag in page.all("a") if tag.get("rel") == "next")
    second = read(site.get(url))
    assert len(second.job_links()) == 5
    for shown in (page, second):
        polled = read(site.get(shown.by_id("live")["hx-get"].partition("&seen")[0]))
        assert polled.job_links() == shown.job_links()


def test_segments_of_a_job_come_in_pages(site, submit):
    job = submit(60)
    page = read(site.get(f"/dashboard/jobs/{job}"))
    counts = []
    while True:
        counts.append(sum(attributes.get("role") == "rowheader" for attributes in page.all("th")))
        following = [tag["href"] for tag in page.all("a") if tag.get("rel") == "next"]
        if not following:
            break
        page = read(site.get(following[0]))
    assert counts == [25, 25, 10]


def test_a_poll_is_answered_when_something_changed_and_spoken_when_a_state_did(site, submit, queue):
    queue.heartbeat(Dispatcher(id="a", host="h", pid=1, code_version="1", num_workers=1))
    job = submit()
    claim = queue.claim_segment("test", lease_s=60)
    url = read(site.get(f"/dashboard/jobs/{job}")).by_id("live")["hx-get"]
    unchanged = site.get(url)
    assert (unchanged.status_code, unchanged.content) == (204, b"")
    queue.report_progress(claim, "sweeps", 50, 100)
    changed = read(site.get(url))
    assert "50 of 100" in changed.text
    assert "announcement" not in [attributes.get("id") for _, attributes in changed.tags]
    url = changed.by_id("live")["hx-get"]
    site.post(f"/dashboard/jobs/{job}/cancel")
    spoken = read(site.get(url))
    assert spoken.by_id("announcement")["hx-swap-oob"] == "innerHTML"
    assert "Job is CANCELLING" in spoken.text


def test_buttons_do_what_the_calls_do(site, submit, finish, end_jobs):
    job = submit()
    for action, state in (("cancel", "CANCELLED"), ("retry", "QUEUED")):
        (form,) = read(site.get(f"/dashboard/jobs/{job}")).all("form")
        assert form["method"] == "post"
        answer = site.post(form["action"], headers={"origin": "http://127.0.0.1:8000"})
        assert (answer.status_code, answer.headers["location"]) == (303, f"/dashboard/jobs/{job}")
        assert form["action"].endswith(action)
        assert site.get(f"/v1/jobs/{job}").json()["state"] == state
    finish()
    end_jobs()
    page = read(site.get(f"/dashboard/jobs/{job}"))
    assert not page.all("form")
    refused = read(site.post(f"/dashboard/jobs/{job}/retry"), 409)
    assert "nothing to retry" in refused.text
    assert f"/dashboard/jobs/{job}" in refused.links()
    read(site.post(f"/dashboard/jobs/{job}/cancel"), 409)


@pytest.mark.parametrize("origin", ["https://evil.example", "null", "http://127.0.0.1:9000"])
def test_a_foreign_page_presses_no_button(site, submit, origin):
    job = submit()
    page = read(site.post(f"/dashboard/jobs/{job}/cancel", headers={"origin": origin}), 403)
    assert "may not change anything here" in page.text
    assert site.get(f"/v1/jobs/{job}").json()["state"] == "QUEUED"


def test_a_look_changes_nothing(site, submit):
    job = submit()
    for action in ("cancel", "retry"):
        answer = site.get(f"/dashboard/jobs/{job}/{action}")
        read(answer, 405)
        assert answer.headers["allow"] == "POST"
    assert site.get(f"/v1/jobs/{job}").json()["state"] == "QUEUED"


@pytest.mark.parametrize(
    ("path", "status"),
    [
        ("/dashboard/nothing", 404),
        ("/dashboard/<script>alert(1)</script>", 404),
        ("/dashboard/%ED%A0%80", 404),
        ("/dashboard/jobs/0123456789abcdef", 404),
        ("/dashboard/jobs/%00", 422),
        ("/dashboard/jobs/..%2f..%2fetc", 404),
        ("/dashboard/jobs/" + "a" * 65, 422),
        ("/dashboard/jobs/%3Cscript%3E", 422),
        ("/dashboard?state=NOTHING", 422),
        ("/dashboard?page_token=nothing", 422),
        ("/dashboard?unknown=1", 422),
        ("/dashboard/live?seen=%3Cscript%3E", 422),
        ("/dashboard/static/nothing.js", 404),
        ("/dashboard/static/%00", 404),
        ("/dashboard/static/" + "a" * 5000, 404),
        ("/dashboard/static/.", 404),
        ("/dashboard/static/..%2froutes.py", 404),
        ("/dashboard/static/%2e%2e%2f%2e%2e%2fapp.py", 404),
    ],
)
def test_what_is_not_there_is_a_page_too(site, path, status):
    answer = site.get(path)
    page = read(answer, status)
    assert f"{status} " in page.text
    assert "/dashboard" in page.links()
    assert len(page.all("script")) == 2
    assert "Traceback" not in answer.text


def test_beside_the_dashboard_errors_are_documents(site):
    for path in ("/dashboards", "/v1/jobs/0123456789abcdef", "/v1/dashboard"):
        assert site.get(path).headers["content-type"] == "application/problem+json"


def test_a_store_that_is_gone_is_said_in_the_same_look(site, settings, submit):
    job = submit()
    with closing(sqlite3.connect(settings.data_dir / "jobs.sqlite3")) as connection:
        connection.execute("DROP TABLE segments")
    for path in ("/dashboard", f"/dashboard/jobs/{job}", "/dashboard/live"):
        answer = site.get(path)
        page = read(answer, 503)
        assert answer.headers["retry-after"] == "5"
        assert "the job store cannot be used at the moment" in page.text
        assert path in page.links()  # once more
    assert site.get("/dashboard/static/dashboard.css").status_code == 200


def test_a_locked_store_takes_no_button_and_says_so(settings, submit, monkeypatch):
    job = submit()
    monkeypatch.setattr("service.app.PATIENCE_S", 0.2)
    with (
        TestClient(create_app(settings), base_url="http://127.0.0.1:8000") as site,
        closing(sqlite3.connect(settings.data_dir / "jobs.sqlite3", isolation_level=None)) as other,
    ):
        other.execute("BEGIN IMMEDIATE")
        page = read(site.post(f"/dashboard/jobs/{job}/cancel"), 503)
        assert f"/dashboard/jobs/{job}" in page.links()
        read(site.get(f"/dashboard/jobs/{job}"))  # who only looks is not kept out
        other.execute("ROLLBACK")


def test_an_error_of_ours_names_its_line_in_the_log(site, monkeypatch, caplog):
    def fail(*_):
        raise RuntimeError("secret")

    monkeypatch.setattr("workers.jobs.store.JobStore.status", fail)
    page = read(site.get("/dashboard"), 500)
    assert "secret" not in page.text
    assert re.search(r"under ([0-9a-f]{16})", page.text)[1] in caplog.text


def test_files_are_ours_and_are_asked_for_anew(site):
    page = read(site.get("/dashboard"))
    wanted = [tag["src"] for tag in page.all("script")] + [tag["href"] for tag in page.all("link")]
    assert len(wanted) == 4
    for path in wanted:
        answer = site.get(path)
        assert answer.status_code == 200
        assert answer.headers["x-content-type-options"] == "nosniff"
        assert answer.headers["cache-control"] == "no-cache"
        again = site.get(path, headers={"if-none-match": answer.headers["etag"]})
        assert (again.status_code, again.content) == (304, b"")
    types = [site.get(path).headers["content-type"].partition(";")[0] for path in wanted]
    assert types[1].endswith("/javascript")
    assert types[2:] == ["image/svg+xml", "text/css"]


def test_htmx_may_neither_evaluate_nor_style(site):
    page = read(site.get("/dashboard"))
    config = json.loads(next(tag["content"] for tag in page.all("meta") if tag.get("name") == "htmx-config"))
    assert config["includeIndicatorStyles"] is config["allowEval"] is config["allowScriptTags"] is False
    assert config["selfRequestsOnly"] is True


def test_nothing_comes_from_elsewhere():
    """No address of another host is in our files: there may be no internet, and nobody else needs to know."""
    files = importlib.resources.files("service.dashboard")
    for folder in ("templates", "static"):
        for file in files.joinpath(folder).iterdir():
            if not file.name.startswith("htmx."):
                text = file.read_text().replace("http://www.w3.org/2000/svg", "")
                assert "//" not in re.sub(r"^\s*//.*", "", text, flags=re.MULTILINE), file.name


def test_the_package_has_all_files_and_htmx_its_licence():
    patterns = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["setuptools"]["package-data"]
    assert patterns["service.dashboard"] == ["static/*", "templates/*"]
    files = importlib.resources.files("service.dashboard")
    names = {folder: {file.name for file in files.joinpath(folder).iterdir()} for folder in ("static", "templates")}
    assert {"dashboard.css", "dashboard.js", "htmx.min.js", "htmx.LICENSE", "icon.svg"} == names["static"]
    assert {"base.html", "overview.html", "job.html", "problem.html"} < names["templates"]
    assert "Zero-Clause BSD" in files.joinpath("static/htmx.LICENSE").read_text()


def test_the_pages_are_no_part_of_the_api(site):
    assert not [path for path in site.get("/openapi.json").json()["paths"] if "dashboard" in path]


def test_the_dashboard_loads_nothing_heavy():
    code = "import sys, service.dashboard.routes; print(*sorted({name.partition('.')[0] for name in sys.modules}))"
    loaded = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True)
    assert set(loaded.stdout.split()) & {"ray", "torch", "open3d", "scipy", "sklearn", "matplotlib"} == set()
