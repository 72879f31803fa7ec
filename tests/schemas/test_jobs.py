import json
from datetime import UTC, datetime

import pytest
from pydantic import ValidationError

from schemas.api.jobs import MAX_SEGMENTS, JobPage, JobRequest, JobState, JobStatus, SegmentState
from schemas.config import PROFILES, resolve_config

BODY = {"dataset": "av2", "segments": ["file:///logs/b", "file:///logs/a"], "output_uri": "s3://bucket/out"}


def test_the_shortest_request_means_the_defaults():
    request = JobRequest.model_validate(BODY)
    assert request.segments == ("file:///logs/b", "file:///logs/a")
    assert request.make_config() == resolve_config()
    assert (request.priority, request.deadline_s, request.client_job_id) == (0, None, None)


def test_fields_and_overrides_reach_the_config():
    changes = {"profile": "fast", "overrides": {"flow.iterations": 80}, "sweeps": [2, 9], "write_points": True}
    config = JobRequest.model_validate(BODY | changes).make_config()
    assert (config.profile, config.flow.iterations, config.sweeps, config.write_points) == ("fast", 80, (2, 9), True)


def test_every_profile_can_be_asked_for():
    for profile in PROFILES:
        assert JobRequest.model_validate({**BODY, "profile": profile}).make_config().profile == profile


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"priority": False}, "valid integer"),
        ({"priority": "1"}, "valid integer"),
        ({"priority": 101}, "less than or equal to 100"),
        ({"deadline_s": 0}, "greater than 0"),
        ({"deadline_s": float("inf")}, "finite"),
        ({"write_points": 1}, "valid boolean"),
        ({"sweeps": ["0", "3"]}, "valid integer"),
        ({"sweeps": [0, 3, 4]}, "at most 2"),
        ({"sweeps": [3, 3]}, "0 <= start < stop, got [3, 3]"),
        ({"sweeps": [-1, 3]}, "0 <= start < stop"),
        ({"segments": []}, "at least 1"),
        ({"segments": [1]}, "valid string"),
        ({"segments": [""]}, "at least 1"),
        ({"segments": ["a\nb"]}, "match pattern"),
        ({"segments": ["a", "b", "a"]}, "segment a is given 2 times"),
        (
            {"segments": [str(i) for i in range(MAX_SEGMENTS + 1)]},
            f"at most {MAX_SEGMENTS} segments, got 10001: submit",
        ),
        ({"profile": "best"}, "'default', 'paper' or 'fast'"),
        ({"overrides": {"flow.iteration": 80}}, "unknown option flow.iteration: expected one of without, method, "),
        ({"overrides": {"flow.iterations": 0}}, "option flow.iterations=0: "),
        ({"overrides": {"sweeps": [0, 3]}}, "sweeps is a field of the request, not an override"),
        ({"client_job_id": "a b"}, "match pattern"),
        ({"owner": "me"}, "Extra inputs"),
    ],
)
def test_what_is_wrong_is_named(change, message):
    with pytest.raises(ValidationError) as caught:
        JobRequest.model_validate(BODY | change)
    assert message in caught.value.errors()[0]["msg"]


def test_the_largest_request_is_accepted():
    uris = [f"s3://bucket/logs/{i}" for i in range(MAX_SEGMENTS)]
    assert len(JobRequest.model_validate(BODY | {"segments": uris}).segments) == MAX_SEGMENTS


def test_a_page_survives_json_with_zones_and_states():
    now = datetime(2026, 11, 22, 4, 0, 0, 123000, tzinfo=UTC)
    job = JobStatus(
        id="j", state=JobState.RUNNING, dataset="av2", output_uri="out", profile="fast", priority=0,
        client_job_id=None, generation=1, cancel_requested=False, num_segments=2,
        segments={SegmentState.RUNNING: 2}, progress=0.5, eta_s=None, created_at=now, deadline_at=None,
        started_at=now, finished_at=None, failure=None,
    )  # fmt: skip
    page = JobPage(jobs=(job,), next_page_token="t")
    text = page.model_dump_json()
    assert json.loads(text)["jobs"][0]["created_at"] == "2026-11-22T04:00:00.123000Z"
    assert JobPage.model_validate_json(text) == page


def test_three_job_states_and_two_segment_states_are_open():
    assert {str(state) for state in JobState if not state.is_ended} == {"QUEUED", "RUNNING", "CANCELLING"}
    assert {str(state) for state in SegmentState if not state.is_ended} == {"QUEUED", "RUNNING"}
