import json
import re
from pathlib import Path

from schemas.api.jobs import JobRequest
from service.app import create_app, render_openapi
from service.settings import Settings

ROOT = Path(__file__).resolve().parents[2]
DOCUMENT = json.loads(render_openapi())
OPERATIONS = {
    f"{method.upper()} {path}": operation
    for path, methods in DOCUMENT["paths"].items()
    for method, operation in methods.items()
}


def test_the_committed_document_is_what_the_app_says():
    assert (ROOT / "docs" / "openapi.json").read_text() == render_openapi(), "run `make openapi`"


def test_every_call_is_there_under_a_name_of_its_own():
    assert {call: operation["operationId"] for call, operation in OPERATIONS.items()} == {
        "POST /v1/jobs": "submit_job",
        "GET /v1/jobs": "list_jobs",
        "GET /v1/jobs/{job_id}": "get_job",
        "GET /v1/jobs/{job_id}/segments": "list_segments",
        "GET /v1/jobs/{job_id}/events": "stream_events",
        "GET /v1/jobs/{job_id}/labels": "get_labels",
        "GET /v1/jobs/{job_id}/segments/{position}/labels": "get_segment_labels",
        "POST /v1/jobs/{job_id}:cancel": "cancel_job",
        "POST /v1/jobs/{job_id}:retry": "retry_job",
        "GET /v1/status": "get_status",
        "GET /v1/version": "get_version",
        "GET /healthz": "get_health",
        "GET /readyz": "get_readiness",
    }


def test_every_error_is_a_problem_document():
    for call, operation in OPERATIONS.items():
        errors = {code: answer for code, answer in operation["responses"].items() if not code.startswith("2")}
        assert "default" in errors, call
        for answer in errors.values():
            assert list(answer["content"]) == ["application/problem+json"], call


def test_every_reference_leads_somewhere():
    references = set()

    def collect(part):
        if isinstance(part, dict):
            references.update({part["$ref"]} if isinstance(part.get("$ref"), str) else ())
            for inner in part.values():
                collect(inner)
        elif isinstance(part, list):
            for inner in part:
                collect(inner)

    collect(DOCUMENT)
    names = {f"#/components/schemas/{name}" for name in DOCUMENT["components"]["schemas"]}
    assert references == names


def test_the_examples_are_requests_that_pass():
    examples = OPERATIONS["POST /v1/jobs"]["requestBody"]["content"]["application/json"]["examples"]
    assert len(examples) == 2
    for example in examples.values():
        JobRequest.model_validate_json(json.dumps(example["value"]))


def test_the_page_shows_every_call_and_no_other():
    text = (ROOT / "docs" / "rest.md").read_text()
    shown = set()
    for call in re.findall(r"\bcurl -sN? (.*?)(?=\n```|\n *curl|\n}' \|)", text, re.DOTALL):
        method = "POST" if "-X POST" in call or " -d " in call else "GET"
        path = re.search(r"http://127\.0\.0\.1:8000([^\s?']*)", call)[1]
        path = path.replace("$JOB", "{job_id}").replace("/segments/0/", "/segments/{position}/")
        shown.add(f"{method} {path}")
        if " -d '" in call:
            body = call.partition(" -d '")[2].replace("""'"$PWD"'""", "/here") + "\n}"
            JobRequest.model_validate_json(body)
    assert shown == set(OPERATIONS)


def test_the_page_describes_every_field_of_a_submission():
    text = (ROOT / "docs" / "rest.md").read_text()
    assert set(JobRequest.model_fields) <= set(re.findall(r"^\| `(\w+)` \|", text, re.MULTILINE))


def test_the_app_serves_the_document(tmp_path):
    assert create_app(Settings(data_dir=tmp_path)).openapi() == DOCUMENT
