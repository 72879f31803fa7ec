"""The API in process, on a job store of its own. A dispatcher is played by the test."""

import base64
import http.server
import json
import subprocess
import sys
import threading
from pathlib import Path

import pytest
from fastapi.testclient import TestClient
from sqlalchemy import Engine, event

from schemas.api.jobs import JobState
from schemas.config import resolve_config
from service.app import create_app
from workers.jobs.claims import Dispatcher

ROOT = Path(__file__).resolve().parents[2]
URL = "http://127.0.0.1:8000"
STREET = "synthetic:street?sweeps=30"


def external(folder):
    return {"flow.method": "external", "flow.external_folder": folder}


def test_a_job_goes_in_and_can_be_looked_at(api, request_body, settings):
    answer = api.post("/v1/jobs", json=request_body(priority=3, deadline_s=60, profile="fast"))
    assert answer.status_code == 202
    job = answer.json()
    assert answer.headers["location"] == f"/v1/jobs/{job['id']}"
    assert int(answer.headers["retry-after"]) > 0
    assert (job["state"], job["num_segments"], job["progress"], job["priority"]) == ("QUEUED", 1, 0.0, 3)
    assert job["output_uri"] == f"{settings.data_roots[0]}/out"
    assert api.get(answer.headers["location"]).json() == job
    (segment,) = api.get(f"/v1/jobs/{job['id']}/segments").json()["segments"]
    assert (segment["uri"], segment["state"]) == (STREET, "QUEUED")


def test_the_same_request_under_the_same_name_is_the_same_job(api, submit, request_body, assert_problem):
    first = submit(client_job_id="mine")
    assert submit(client_job_id="mine") == first
    answer = api.post("/v1/jobs", json=request_body(client_job_id="mine", priority=1))
    assert_problem(answer, 409, "mine")
    assert submit() != first
    assert len(api.get("/v1/jobs").json()["jobs"]) == 2


@pytest.mark.parametrize(
    ("changes", "pointer", "detail"),
    [
        ({"priority": True}, "/priority", "integer"),
        ({"priority": "1"}, "/priority", "integer"),
        ({"priority": 101}, "/priority", "100"),
        ({"write_points": 1}, "/write_points", "boolean"),
        ({"deadline_s": 0}, "/deadline_s", "greater than 0"),
        ({"deadline_s": True}, "/deadline_s", "number"),
        ({"segments": []}, "/segments", "at least 1"),
        ({"segments": [1]}, "/segments/0", "string"),
        ({"segments": "synthetic:street"}, "/segments", "tuple"),
        ({"sweeps": [5, 5]}, "", "sweeps"),
        ({"sweeps": [0, 5, 9]}, "/sweeps", "2"),
        ({"sweeps": [0.0, True]}, "/sweeps/0", "integer"),
        ({"profile": "best"}, "/profile", "'default', 'paper' or 'fast'"),
        ({"overrides": {"flow.iterations": 0}}, "", "flow.iterations"),
        ({"overrides": {"flow.no_such": 0}}, "", "unknown option flow.no_such"),
        ({"client_job_id": "a b"}, "/client_job_id", "pattern"),
        ({"dataset": "waymo"}, "/dataset", "expected one of av2, "),
        ({"colour": 1}, "/colour", "not permitted"),
        ({"a/b~c": 1}, "/a~1b~0c", "not permitted"),
        ({"output_uri": "/half a pair \ud800"}, "/output_uri", "unicode"),
        ({"output_uri": "/elsewhere"}, "/output_uri", "under no data root"),
        ({"output_uri": "out"}, "/output_uri", "absolute path"),
        ({"output_uri": "{root}/../out"}, "/output_uri", '".."'),
        ({"output_uri": "s3://bucket/out"}, "/output_uri", "under no data root"),
        ({"segments": [STREET, "{root}/log"]}, "/segments/1", "called like synthetic:street"),
        ({"segments": ["synthetic:street?swps=3"]}, "/segments/0", "unknown option 'swps'"),
        ({"dataset": "av2", "segments": [STREET]}, "/segments/0", "expected an absolute path"),
        ({"dataset": "av2", "segments": ["{root}/a", "/etc"]}, "/segments/1", "under no data root"),
        (
            {"dataset": "av2", "segments": ["{root}/a", "{root}/b", "file://{root}/a/"]},
            "/segments/2",
            "file://{root}/a/ and {root}/a are one segment: {root}/a",
        ),
        (
            {"segments": ["synthetic:street?sweeps=4&seed=9", "synthetic:street?seed=9&hz=10&sweeps=4"]},
            "/segments/1",
            "seed=9&hz=10&sweeps=4 and synthetic:street?sweeps=4&seed=9 are one segment: ",
        ),
        ({"segments": [STREET, STREET]}, "", "given 2 times"),
    ],
)
def test_what_cannot_be_is_refused_and_nothing_is_queued(
    api, request_body, settings, changes, pointer, detail, assert_problem
):
    body = json.dumps(request_body(**changes)).replace("{root}", settings.data_roots[0])
    answer = api.post("/v1/jobs", content=body, headers={"content-type": "application/json"})
    problem = assert_problem(answer, 422, detail.replace("{root}", settings.data_roots[0]))
    assert pointer in [error["pointer"] for error in problem["errors"]]
    assert api.get("/v1/jobs").json()["jobs"] == []


def test_every_wrong_value_is_named(api, assert_problem):
    problem = assert_problem(api.post("/v1/jobs", json={"dataset": 1, "segments": [], "x": 0}), 422, "(and 3 more)")
    assert {error["pointer"] for error in problem["errors"]} == {"/dataset", "/segments", "/output_uri", "/x"}


def test_a_path_is_quoted_in_a_line(api):
    answer = api.get("/" + "x" * 10_000)
    assert len(answer.json()["detail"]) + len(answer.json()["instance"]) < 2500


def test_a_link_out_of_the_roots_is_refused_and_one_inside_followed(
    api, request_body, settings, tmp_path, assert_problem
):
    root = Path(settings.data_roots[0])
    (root / "away").symlink_to(tmp_path)
    (root / "log").mkdir()
    (root / "link").symlink_to("log")
    body = request_body(dataset="av2", segments=[f"{root}/away/log"])
    assert_problem(api.post("/v1/jobs", json=body), 422, "under no data root")
    job = api.post("/v1/jobs", json=body | {"segments": [f"file://{root}/link"]}).json()
    (segment,) = api.get(f"/v1/jobs/{job['id']}/segments").json()["segments"]
    assert segment["uri"] == f"{root}/log"


def test_a_segment_is_kept_by_its_one_name(api, submit):
    job = submit(segments=["synthetic:street?sweeps=4&seed=9&hz=10"])
    (segment,) = api.get(f"/v1/jobs/{job}/segments").json()["segments"]
    assert segment["uri"] == "synthetic:street?seed=9&sweeps=4"


@pytest.fixture
def in_buckets(settings, bucket, request_body):
    """An API that may use two buckets, of which one is there; and a request for a segment in that one."""
    changed = settings.model_copy(update={"data_roots": (bucket, "s3://another-bucket", *settings.data_roots)})
    with TestClient(create_app(changed), base_url=URL, raise_server_exceptions=False) as api:
        yield api, request_body(dataset="av2", segments=[f"{bucket}/log"])


def test_segments_and_output_in_a_bucket_that_lets_us_in_are_taken(in_buckets, bucket):
    api, body = in_buckets
    assert api.post("/v1/jobs", json=body | {"output_uri": f"{bucket}/out"}).status_code == 202


@pytest.mark.parametrize(
    ("changes", "pointer"),
    [
        ({"segments": ["s3://another-bucket/log", "s3://another-bucket/log2"]}, "/segments/0"),
        ({"output_uri": "s3://another-bucket/out"}, "/output_uri"),
        ({"overrides": external("s3://another-bucket/flow")}, "/overrides"),
    ],
)
def test_a_bucket_that_is_not_there_is_refused_at_once(in_buckets, changes, pointer, assert_problem):
    api, body = in_buckets
    problem = assert_problem(api.post("/v1/jobs", json=body | changes), 422, "no such bucket")
    assert [error["pointer"] for error in problem["errors"]] == [pointer]


def test_a_bucket_without_the_extra_is_refused_at_once(in_buckets, monkeypatch, assert_problem):
    api, body = in_buckets
    monkeypatch.setitem(sys.modules, "obstore.store", None)
    assert_problem(api.post("/v1/jobs", json=body), 422, "pip install motionlabel[s3]")


def test_many_segments_cost_one_look_at_their_bucket(in_buckets, bucket, monkeypatch):
    api, body = in_buckets
    looked = []
    monkeypatch.setattr("service.routes.jobs.require_access", looked.append)
    uris = [f"{bucket}/log-{i}" for i in range(100)]
    assert api.post("/v1/jobs", json=body | {"segments": uris, "output_uri": f"{bucket}/o"}).status_code == 202
    assert looked == [uris[0]]
    assert api.post("/v1/jobs", json=body | {"segments": [*uris, "/etc"]}).status_code == 422
    assert looked == [uris[0]]  # nothing is asked for a request that is refused anyway


@pytest.mark.parametrize(("status", "expected"), [(403, 422), (401, 422), (500, 503)])
def test_a_bucket_that_lets_nobody_in_is_refused_and_one_in_trouble_asked_again(
    in_buckets, monkeypatch, answer_with, status, expected, assert_problem
):
    api, body = in_buckets
    monkeypatch.setenv("AWS_ENDPOINT_URL", answer_with(status))
    answer = api.post("/v1/jobs", json=body)
    assert_problem(answer, expected, body["segments"][0])
    assert ("retry-after" in answer.headers) == (expected == 503)


@pytest.fixture
def answer_with():
    """Return a function that starts a server which gives every request the same status, and tells its address."""
    servers = []

    def start(status):
        class Handler(http.server.BaseHTTPRequestHandler):
            def do_GET(self):
                self.send_response(status)
                self.send_header("Content-Length", "0")
                self.end_headers()

            def log_message(self, *_):
                pass

        servers.append(http.server.ThreadingHTTPServer(("127.0.0.1", 0), Handler))
        threading.Thread(target=servers[-1].serve_forever, daemon=True).start()
        return f"http://127.0.0.1:{servers[-1].server_address[1]}"

    yield start
    for server in servers:
        server.shutdown()
        server.server_close()


@pytest.mark.parametrize("place", ["", "/out", "/link/out"])
def test_the_data_folder_of_the_service_is_no_output(settings, request_body, place, assert_problem):
    changed = settings.model_copy(update={"data_roots": (str(settings.data_dir.parent),)})
    (settings.data_dir / "link").symlink_to(".")
    with TestClient(create_app(changed), base_url=URL) as api:
        body = request_body(output_uri=f"{settings.data_dir}{place}")
        problem = assert_problem(api.post("/v1/jobs", json=body), 422, "the service's own data folder")
        assert [error["pointer"] for error in problem["errors"]] == ["/output_uri"]
        assert api.post("/v1/jobs", json=body | {"output_uri": f"{settings.data_dir}2"}).status_code == 202


@pytest.mark.parametrize(
    "overrides",
    [
        external("/etc"),
        external("file:///etc/"),
        external("s3://bucket/flow"),
        external("{root}/../flow"),
        external("{root}/away"),
        external("flow"),
        {"flow": {"method": "external", "external_folder": "/etc"}},
        {**external("{root}/flow"), "flow": {"external_folder": "/etc"}},
        {"flow": {"method": "external", "external_folder": "{root}/flow"}, "flow.external_folder": "/etc"},
    ],
)
def test_what_an_override_names_lies_under_a_root_too(api, request_body, settings, tmp_path, overrides, assert_problem):
    root = Path(settings.data_roots[0])
    (root / "away").symlink_to(tmp_path)
    body = json.dumps(request_body(overrides=overrides)).replace("{root}", str(root))
    problem = assert_problem(api.post("/v1/jobs", content=body, headers={"content-type": "application/json"}), 422)
    assert [error["pointer"] for error in problem["errors"]] == ["/overrides"]
    assert api.get("/v1/jobs").json()["jobs"] == []


@pytest.mark.parametrize("is_nested", [False, True])
def test_a_place_in_an_override_is_kept_by_its_one_name(submit, queue, settings, is_nested):
    root = Path(settings.data_roots[0])
    (root / "link").symlink_to("flow")
    overrides = external(f"file://{root}/link/")
    submit(
        overrides={"flow": {key.removeprefix("flow."): value for key, value in overrides.items()}}
        if is_nested
        else overrides
    )
    claim = queue.claim_segment("test", lease_s=60)
    assert claim.config["flow"]["external_folder"] == f"{root}/flow"


@pytest.mark.parametrize(
    ("method", "path"),
    [("GET", ""), ("GET", "/segments"), ("GET", "/labels"), ("POST", ":cancel"), ("POST", ":retry")],
)
def test_an_unknown_job_is_not_found(api, method, path, assert_problem):
    assert_problem(api.request(method, f"/v1/jobs/nobody{path}"), 404, "no job nobody")


def make_token(*key):
    return base64.urlsafe_b64encode(json.dumps(key).encode()).decode().rstrip("=")


NOT_FOR_A_DATABASE = [
    *[(method, f"/v1/jobs/{name}{rest}") for name in ("%00", "a%00b", "%0a", "x" * 65, "%C3%A4") for method, rest in
      [("GET", ""), ("GET", "/segments"), ("GET", "/labels"), ("POST", ":cancel"), ("POST", ":retry")]],
    *[("GET", f"/v1/jobs?dataset={dataset}") for dataset in ("%00", "av2%00", "a%1f", "x" * 65)],
    *[("GET", f"/v1/jobs?page_token={make_token(*key)}") for key in [(2**63, "a"), (-1, "a"), (True, "a"), (1, "a\0")]],
    *[("GET", f"/v1/jobs/a/segments?page_token={make_token(key)}") for key in (2**63 - 1, 2**31, -1, 1.5, "a")],
]  # fmt: skip


@pytest.mark.parametrize(("method", "path"), NOT_FOR_A_DATABASE)
def test_what_no_database_holds_never_reaches_the_store(api, method, path):
    statements = []

    def note(connection, cursor, statement, *_):
        statements.append(statement)

    event.listen(Engine, "before_cursor_execute", note)
    try:
        answer = api.request(method, path)
    finally:
        event.remove(Engine, "before_cursor_execute", note)
    assert answer.status_code in (404, 422)
    assert answer.headers["content-type"] == "application/problem+json"
    assert statements == []


def test_unknown_paths_and_methods_are_problems_too(api, assert_problem):
    assert_problem(api.get("/v2/jobs"), 404)


@pytest.mark.parametrize(
    ("path", "allowed"),
    [("/v1/jobs", "HEAD, GET, POST"), ("/v1/jobs/a", "HEAD, GET"), ("/v1/jobs/a:cancel", "HEAD, GET, POST")],
)
def test_another_method_is_told_all_that_are_there(api, path, allowed, assert_problem):
    answer = api.delete(path)
    assert_problem(answer, 405)
    assert answer.headers["allow"] == allowed


@pytest.mark.parametrize("path", ["/v1/jobs", "/healthz", "/v1/jobs/nobody", "/nothing"])
def test_head_is_get_without_its_body(api, path):
    head, get = api.head(path), api.get(path)
    assert (head.status_code, head.content) == (get.status_code, b"")
    assert head.headers["content-length"] == get.headers["content-length"] == str(len(get.content))


def test_pages_hold_every_job_once_newest_first(api, submit):
    ids = [submit() for _ in range(7)]
    found, token, sizes = [], None, []
    while True:
        page = api.get("/v1/jobs", params={"page_size": 3} | ({"page_token": token} if token else {})).json()
        found += [job["id"] for job in page["jobs"]]
        sizes.append(len(page["jobs"]))
        token = page["next_page_token"]
        if token is None:
            break
        submit()  # what comes in meanwhile moves nothing
    assert sorted(found) == sorted(ids)
    assert sizes == [3, 3, 1]


def test_pages_hold_every_segment_once(api, submit):
    uris = [f"synthetic:street?seed={seed}" for seed in range(10, 15)]
    job = submit(segments=uris[::-1])
    first = api.get(f"/v1/jobs/{job}/segments?page_size=3").json()
    rest = api.get(f"/v1/jobs/{job}/segments", params={"page_token": first["next_page_token"]}).json()
    assert [segment["uri"] for segment in first["segments"] + rest["segments"]] == uris
    assert rest["next_page_token"] is None


def test_listings_are_filtered(api, submit, settings, finish):
    street = submit(segments=[STREET, f"{STREET}0"])
    drive = submit(dataset="av2", segments=[f"{settings.data_roots[0]}/log"])
    finish("FAILED")

    def ids(**query):
        return {job["id"] for job in api.get("/v1/jobs", params=query).json()["jobs"]}

    assert ids(dataset="av2") == {drive}
    assert ids(state="RUNNING") == {street}
    assert ids(state="QUEUED", dataset="synthetic") == set()
    (failed,) = api.get(f"/v1/jobs/{street}/segments?state=FAILED").json()["segments"]
    assert failed["failure"] == {"error": "InvalidInput", "message": "no sweeps"}


@pytest.mark.parametrize(
    "query",
    [
        "page_size=0",
        "page_size=201",
        "state=DONE",
        "stat=QUEUED",
        "page_token=x",
        "page_token=WzEwMDAwMDAwMDAwMDAwMDAwMDAwMCwgImEiXQ",  # a number that no database holds
        "page_token=WzEsICJcdWQ4MDAiXQ",  # half a surrogate pair
        "page_token=" + "A" * 600,
    ],
)
def test_wrong_queries_are_refused(api, query, assert_problem):
    assert_problem(api.get(f"/v1/jobs?{query}"), 422)


def test_cancel_stops_what_waits_and_can_be_asked_again(api, submit):
    job = submit()
    for _ in range(2):
        answer = api.post(f"/v1/jobs/{job}:cancel")
        assert answer.status_code == 202
        assert answer.json()["state"] == "CANCELLED"


def test_cancel_of_what_runs_and_of_what_is_done(api, submit, finish, end_jobs, assert_problem):
    job = submit(segments=[STREET, f"{STREET}0"])
    finish()
    assert api.post(f"/v1/jobs/{job}:cancel").json()["state"] == "CANCELLING"
    assert end_jobs() == [JobState.CANCELLED]
    done = submit()
    finish()
    end_jobs()
    assert_problem(api.post(f"/v1/jobs/{done}:cancel"), 409, "SUCCEEDED")


def test_retry_opens_what_failed_again(api, submit, finish, end_jobs, assert_problem):
    job = submit(segments=[STREET, f"{STREET}0"])
    assert_problem(api.post(f"/v1/jobs/{job}:retry"), 409, "wait until it has ended")
    finish()
    finish("FAILED")
    assert end_jobs() == [JobState.PARTIAL]
    answer = api.post(f"/v1/jobs/{job}:retry")
    assert answer.status_code == 202
    again = answer.json()
    assert (again["state"], again["generation"]) == ("QUEUED", 2)
    assert (again["segments"]["SUCCEEDED"], again["segments"]["QUEUED"]) == (1, 1)
    finish()
    assert end_jobs() == [JobState.SUCCEEDED]
    assert_problem(api.post(f"/v1/jobs/{job}:retry"), 409, "nothing to retry")


@pytest.fixture
def narrow(settings):
    """A service whose owners have two open segments at most."""
    settings = settings.model_copy(update={"max_open_segments": 2})
    with TestClient(create_app(settings), base_url=URL, raise_server_exceptions=False) as client:
        yield client


def test_a_full_queue_says_when_to_ask_again(narrow, request_body, assert_problem):
    body = request_body(segments=[STREET, "synthetic:street?sweeps=31"])
    job = narrow.post("/v1/jobs", json=body).json()["id"]
    refused = narrow.post("/v1/jobs", json=request_body())
    assert_problem(refused, 429, "one owner may have 2 (MOTIONLABEL_MAX_OPEN_SEGMENTS)")
    assert int(refused.headers["retry-after"]) > 0
    narrow.post(f"/v1/jobs/{job}:cancel")
    assert narrow.post("/v1/jobs", json=request_body()).status_code == 202
    assert_problem(narrow.post(f"/v1/jobs/{job}:retry"), 429, "3 segments would wait or run, 1 without")


def test_labels_are_listed_as_they_come_and_say_whether_they_are_all(
    api, submit, finish, end_jobs, settings, assert_problem
):
    job = submit(segments=[STREET, f"{STREET}0"], profile="fast")
    assert_problem(api.get(f"/v1/jobs/{job}/labels"), 409, "no segment of it is labelled yet")
    finish()
    labels = api.get(f"/v1/jobs/{job}/labels").json()
    assert (labels["state"], labels["is_complete"], labels["num_segments"]) == ("RUNNING", False, 2)
    assert [entry["uri"] for entry in labels["segments"]] == [STREET]
    assert labels["segments"][0]["shards"][0]["rows"] == 7
    assert labels["output_uri"] == f"{settings.data_roots[0]}/out"
    assert labels["config_hash"] == resolve_config("fast").config_hash
    finish()
    end_jobs()
    labels = api.get(f"/v1/jobs/{job}/labels").json()
    assert (labels["state"], labels["is_complete"], len(labels["segments"])) == ("SUCCEEDED", True, 2)


def test_labels_of_a_partial_job_stay_readable_and_say_so(api, submit, finish, end_jobs):
    job = submit(segments=[STREET, f"{STREET}0"])
    finish("PARTIAL")
    finish("FAILED")
    assert end_jobs() == [JobState.PARTIAL]
    labels = api.get(f"/v1/jobs/{job}/labels").json()
    assert (labels["state"], labels["is_complete"]) == ("PARTIAL", False)
    assert [entry["state"] for entry in labels["segments"]] == ["PARTIAL"]


def test_a_job_that_failed_has_no_labels(api, submit, finish, end_jobs, assert_problem):
    job = submit()
    finish("FAILED")
    assert end_jobs() == [JobState.FAILED]
    assert_problem(api.get(f"/v1/jobs/{job}/labels"), 404, "has ended FAILED without labels")


def test_status_counts(api, submit, finish):
    submit()
    submit()
    finish()
    status = api.get("/v1/status").json()
    assert status["jobs"]["RUNNING"] == status["jobs"]["QUEUED"] == status["queued_segments"] == 1
    assert status["segments_per_hour"] == 1


def test_version(api):
    answer = api.get("/v1/version").json()
    assert answer["code_version"].startswith(answer["version"] + "+")
    assert answer["schema_version"] == 1


def test_ready_means_that_a_dispatcher_reports(api, queue, monkeypatch, assert_problem):
    assert api.get("/healthz").json() == {"status": "ok"}
    assert_problem(api.get("/readyz"), 503, "no dispatcher")
    queue.heartbeat(Dispatcher(id="a", host="h", pid=1, code_version="1", num_workers=2))
    assert api.get("/readyz").json() == {"status": "ready", "dispatchers": 1, "workers": 2}
    monkeypatch.setattr("schemas.api.status.MAX_SILENCE_S", -1.0)
    assert_problem(api.get("/readyz"), 503, "no dispatcher")


def test_an_error_of_ours_is_named_by_an_id_that_the_log_has(api, monkeypatch, caplog, assert_problem):
    def fail(*_):
        raise RuntimeError("secret")

    monkeypatch.setattr("workers.jobs.store.JobStore.status", fail)
    answer = api.get("/v1/status")
    problem = assert_problem(answer, 500, "internal error")
    assert "secret" not in answer.text
    assert problem["error_id"] in caplog.text


def test_the_app_loads_nothing_heavy():
    code = "import sys, service.app; print(*sorted({name.partition('.')[0] for name in sys.modules}))"
    loaded = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True)
    assert set(loaded.stdout.split()) & {"ray", "torch", "open3d", "scipy", "sklearn", "matplotlib"} == set()
    assert "fastapi" in loaded.stdout.split()
