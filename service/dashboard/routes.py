"""The addresses of the dashboard: pages for people, at the same store and under the same guards as the REST API."""

from http import HTTPStatus
from typing import Annotated, Final

from fastapi import APIRouter, Query, Request, Response
from fastapi.responses import RedirectResponse
from pydantic import BaseModel, ConfigDict, Field
from starlette.staticfiles import StaticFiles

from schemas.api.jobs import JobState, SegmentState
from service.access import Caller
from service.dashboard import pages, views
from service.dashboard.pages import ROOT, LivePart
from service.dependencies import CallerOf, StoreOf
from service.keys import Scope
from service.routes.jobs import JobId, PageToken
from workers.jobs.store import JobStore

router = APIRouter(prefix=ROOT, include_in_schema=False)

_PAGE_SIZE: Final = 25
_STATIC: Final = StaticFiles(packages=[("service.dashboard", "static")])
_STATIC_HEADERS: Final = {"X-Content-Type-Options": "nosniff", "Cache-Control": "no-cache"}  # asked for anew, by ETag
Mark = Annotated[str, Field(pattern="^[0-9a-f]{0,16}$")]


class _Query(BaseModel):
    """What a list shows."""

    model_config = ConfigDict(extra="forbid")

    page_token: PageToken = None


class OverviewQuery(_Query):
    """Which jobs the overview lists."""

    state: JobState | None = None


class JobQuery(_Query):
    """Which segments a job's page lists."""

    state: SegmentState | None = None


class OverviewPoll(OverviewQuery):
    """The same, and what the page shows already."""

    seen: Mark = ""
    said: Mark = ""


class JobPoll(JobQuery):
    """The same, and what the page shows already."""

    seen: Mark = ""
    said: Mark = ""


@router.get("")
def show_overview(query: Annotated[OverviewQuery, Query()], store: StoreOf, caller: CallerOf) -> Response:
    """Show the service and its jobs."""
    return pages.respond("page.html", account=_describe(caller), title="Overview", live=_overview(query, store))


@router.get("/live")
def poll_overview(query: Annotated[OverviewPoll, Query()], store: StoreOf) -> Response:
    """Send what changed of the overview."""
    return pages.respond_live(_overview(query, store), query.seen, query.said)


@router.get("/jobs/{job_id}")
def show_job(job_id: JobId, query: Annotated[JobQuery, Query()], store: StoreOf, caller: CallerOf) -> Response:
    """Show a job and its segments."""
    live = _job(job_id, query, store, caller)
    return pages.respond("page.html", account=_describe(caller), title=f"Job {job_id}", live=live)


@router.get("/jobs/{job_id}/live")
def poll_job(job_id: JobId, query: Annotated[JobPoll, Query()], store: StoreOf, caller: CallerOf) -> Response:
    """Send what changed of a job's page."""
    return pages.respond_live(_job(job_id, query, store, caller), query.seen, query.said)


@router.post("/jobs/{job_id}/cancel")
def cancel_job(job_id: JobId, store: StoreOf) -> Response:
    """Stop a job, as the REST call does, and show it."""
    store.request_cancel(job_id)
    return RedirectResponse(f"{ROOT}/jobs/{job_id}", HTTPStatus.SEE_OTHER)


@router.post("/jobs/{job_id}/retry")
def retry_job(job_id: JobId, store: StoreOf) -> Response:
    """Queue what has no labels once more, as the REST call does, and show the job."""
    store.retry_failed(job_id)
    return RedirectResponse(f"{ROOT}/jobs/{job_id}", HTTPStatus.SEE_OTHER)


@router.get("/static/{name}")
async def get_static(name: str, request: Request) -> Response:
    """Send a style sheet, a script or a picture of ours."""
    response = await _STATIC.get_response(name, request.scope)
    response.headers.update(_STATIC_HEADERS)
    return response


def _describe(caller: Caller) -> str:
    return caller.owner if caller.may(Scope.SUBMIT) else f"{caller.owner}, to look only"


def _overview(query: OverviewQuery, store: JobStore) -> LivePart:
    status = store.status()
    page = store.list_jobs(state=query.state, page_size=_PAGE_SIZE, page_token=query.page_token)
    content = pages.fill(
        "overview.html",
        figures=views.figures(status),
        warning=views.warning(status),
        reasons=views.reasons(status),
        dispatchers=[views.describe_dispatcher(dispatcher) for dispatcher in status.dispatchers],
        jobs=[views.describe_job(job) for job in page.jobs],
        choices=views.choices(ROOT, status.jobs, query.state),
        pager=views.turn_pages(ROOT, query.state, query.page_token, page.next_page_token),
    )
    shown = {"state": query.state, "page_token": query.page_token}
    return LivePart(f"{ROOT}/live", shown, content, views.announce_service(status))


def _job(job_id: str, query: JobQuery, store: JobStore, caller: Caller) -> LivePart:
    row = views.describe_job(store.get_job(job_id))
    page = store.list_segments(job_id, state=query.state, page_size=_PAGE_SIZE, page_token=query.page_token)
    path = f"{ROOT}/jobs/{job_id}"
    content = pages.fill(
        "job.html",
        row=row,
        may_change=caller.may(Scope.SUBMIT),
        segments=[views.describe_segment(segment) for segment in page.segments],
        choices=views.choices(path, row.job.segments, query.state),
        pager=views.turn_pages(path, query.state, query.page_token, page.next_page_token),
    )
    shown = {"state": query.state, "page_token": query.page_token}
    return LivePart(f"{path}/live", shown, content, views.announce_job(row))
