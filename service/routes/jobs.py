"""Jobs: submit, look, list, cancel, retry, and where the labels are."""

from typing import Annotated, Any, Final

from fastapi import APIRouter, Body, Depends, HTTPException, Path, Query, Response
from fastapi.exceptions import RequestValidationError
from pydantic import BaseModel, ConfigDict, Field

from labeling.readers.reader import canonical_segment, require_dataset
from labeling.storage.bucket import require_access
from labeling.storage.places import S3, canonical, is_below, under_root
from schemas.api.jobs import JobPage, JobRequest, JobState, JobStatus, SegmentPage, SegmentState
from schemas.api.labels import JobLabels
from schemas.errors import InvalidInput
from service.bodies import JsonRoute
from service.dependencies import CallerOf, DatabaseOf, SettingsOf, StoreOf
from service.errors import error_responses
from workers.jobs.labels import read_labels
from workers.jobs.store import MAX_PAGE_SIZE

router = APIRouter(prefix="/v1/jobs", tags=["jobs"], route_class=JsonRoute)

POLL_AFTER_S: Final = 2  # what Retry-After proposes
_EXAMPLES: Final[Any] = {
    "built-in street": {
        "value": {
            "dataset": "synthetic",
            "segments": ["synthetic:street?sweeps=20&seed=1"],
            "output_uri": "/data/labels/street",
            "client_job_id": "street-1",
        }
    },
    "two logs, faster, first half": {
        "value": {
            "dataset": "av2",
            "segments": ["/data/av2/val/log-a", "/data/av2/val/log-b"],
            "output_uri": "s3://bucket/labels/av2",
            "profile": "fast",
            "overrides": {"tracking.min_sweeps": 8},
            "sweeps": [0, 75],
            "write_points": True,
            "priority": 10,
            "deadline_s": 3600,
        }
    },
}

JobId = Annotated[str, Path(pattern="^[0-9A-Za-z]{1,64}$", description="The job's id", examples=["9f2c61d04b7e8a35"])]
PageSize = Annotated[int, Field(ge=1, le=MAX_PAGE_SIZE)]
PageToken = Annotated[str | None, Field(max_length=512, description="next_page_token of the page before")]


class JobQuery(BaseModel):
    """Which jobs to list."""

    model_config = ConfigDict(extra="forbid")

    state: JobState | None = None
    dataset: str | None = Field(None, pattern=r"^[^\x00-\x1f\x7f]{0,64}$")
    page_size: PageSize = 50
    page_token: PageToken = None


class SegmentQuery(BaseModel):
    """Which segments to list."""

    model_config = ConfigDict(extra="forbid")

    state: SegmentState | None = None
    page_size: PageSize = 50
    page_token: PageToken = None


def _locate_all(
    body: Annotated[JobRequest, Body(openapi_examples=_EXAMPLES)], settings: SettingsOf, caller: CallerOf
) -> JobRequest:
    """Return the request with canonical names of all that is to be read and written. Asks no store.

    Raises:
        RequestValidationError: Places that are not allowed or let nobody in, a segment twice, or a data set that there
            is no reader for.
        StorageTrouble: A bucket cannot be reached now.

    """
    buckets: dict[str, tuple[str, tuple[str | int, ...]]] = {}  # the first place in each, and who named it

    roots = caller.roots_within(settings.data_roots)
    problems: list[dict[str, Any]] = []
    spellings: dict[str, str] = {}  # by segment

    def refuse(message: str, *location: str | int) -> None:
        problems.append({"type": "value_error", "loc": ("body", *location), "msg": message})

    def locate(place: str, *location: str | int) -> str:
        located = under_root(place, roots)
        if located.startswith(S3):
            buckets.setdefault(located.removeprefix(S3).partition("/")[0], (located, location))
        return located

    try:
        require_dataset(body.dataset)
    except InvalidInput as error:
        refuse(str(error), "dataset")
    for index, uri in enumerate(body.segments if not problems else ()):
        try:
            segment = canonical_segment(body.dataset, uri)
            if body.dataset != "synthetic":
                segment = locate(segment, "segments", index)
        except InvalidInput as error:
            refuse(str(error), "segments", index)
            continue
        if spellings.setdefault(segment, uri) != uri:
            refuse(f"{uri} and {spellings[segment]} are one segment: {segment}", "segments", index)
    try:
        output_uri = locate(body.output_uri, "output_uri")
        if is_below(output_uri, canonical(str(settings.data_dir))):
            raise InvalidInput(f"{body.output_uri} lies in the service's own data folder: choose another place")
    except InvalidInput as error:
        refuse(str(error), "output_uri")
    try:
        config = body.make_config().with_places(lambda place: locate(place, "overrides"))
    except InvalidInput as error:
        refuse(str(error), "overrides")
    for place, location in buckets.values() if not problems else ():
        try:
            require_access(place)
        except InvalidInput as error:
            refuse(str(error), *location)
    if problems:
        raise RequestValidationError(problems)
    others = {key: value for key, value in body.overrides.items() if key not in config.places}
    overrides = others | config.places  # the last one counts: a place may be given twice, as flow.x and flow: {x}
    return body.model_copy(update={"segments": tuple(spellings), "output_uri": output_uri, "overrides": overrides})


LocatedRequest = Annotated[JobRequest, Depends(_locate_all)]


@router.post("", status_code=202, responses=error_responses(400, 409, 413, 422, 429, 503))
def submit_job(located: LocatedRequest, caller: CallerOf, response: Response, store: StoreOf) -> JobStatus:
    """Queue a job. The same request with the same `client_job_id` returns the job that is there already."""
    job = store.submit(located, owner=caller.owner)
    response.headers["Location"] = f"{router.prefix}/{job.id}"
    response.headers["Retry-After"] = str(POLL_AFTER_S)
    return job


@router.get("", responses=error_responses(422, 503))
def list_jobs(query: Annotated[JobQuery, Query()], store: StoreOf) -> JobPage:
    """List jobs, newest first."""
    return store.list_jobs(**dict(query))


@router.get("/{job_id}", responses=error_responses(404, 503))
def get_job(job_id: JobId, store: StoreOf) -> JobStatus:
    """Show how a job stands."""
    return store.get_job(job_id)


@router.get("/{job_id}/segments", responses=error_responses(404, 422, 503))
def list_segments(job_id: JobId, query: Annotated[SegmentQuery, Query()], store: StoreOf) -> SegmentPage:
    """List a job's segments, sorted by URI."""
    return store.list_segments(job_id, **dict(query))


@router.get("/{job_id}/labels", responses=error_responses(404, 409, 503))
def get_labels(job_id: JobId, caller: CallerOf, database: DatabaseOf) -> JobLabels:
    """Tell which labels a job has published so far, and whether they are all."""
    labels = read_labels(database, job_id, owner=caller.sees)
    if not labels.segments:
        if labels.state.is_ended:
            raise HTTPException(404, f"job {job_id} has ended {labels.state} without labels")
        raise HTTPException(409, f"job {job_id} is {labels.state}: no segment of it is labelled yet")
    return labels


@router.post("/{job_id}:cancel", status_code=202, responses=error_responses(404, 409, 503))
def cancel_job(job_id: JobId, store: StoreOf) -> JobStatus:
    """Stop a job: what waits is cancelled at once, what runs soon. What is labelled stays. Asking again is harmless."""
    return store.request_cancel(job_id)


@router.post("/{job_id}:retry", status_code=202, responses=error_responses(404, 409, 429, 503))
def retry_job(job_id: JobId, store: StoreOf) -> JobStatus:
    """Queue the segments of an ended job that have no labels once more; its generation grows by one."""
    return store.retry_failed(job_id)
