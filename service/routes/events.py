"""What happens to a job, as server-sent events."""

import asyncio
import time
from collections.abc import AsyncIterator
from http import HTTPStatus
from typing import Annotated, Final

from fastapi import APIRouter, Depends, Header, Request, Response
from fastapi.responses import StreamingResponse
from fastapi.sse import format_sse_event
from sqlalchemy.exc import OperationalError
from sqlalchemy.exc import TimeoutError as NoConnection
from starlette.concurrency import run_in_threadpool

from schemas.api.jobs import JobEvent
from service.bodies import is_head
from service.dependencies import CallerOf, DoorOf
from service.errors import error_responses
from service.routes.jobs import JobId
from service.store_door import StoreDoor
from service.streams import Streams
from workers.jobs.events import PAGE_EVENTS, read_events

router = APIRouter(prefix="/v1/jobs", tags=["jobs"])

MEDIA_TYPE: Final = "text/event-stream"
POLL_S: Final = 1.0
HEARTBEAT_S: Final = 15.0  # proxies close connections that are silent for longer, often for 60 s
MAX_STREAM_S: Final = 600.0  # clients resume by themselves, and a key that was revoked meanwhile opens nothing more
_HEARTBEAT: Final = format_sse_event(comment="waiting")
_HEADERS: Final = {"Cache-Control": "no-store", "X-Accel-Buffering": "no"}  # nginx would keep events back

LastEventId = Annotated[int, Header(ge=0, lt=2**31, description="Number of the last event that the caller has")]


class _Reader:
    """Reads one job's events on, each time through the store's door: between two times it holds nothing."""

    def __init__(self, door: StoreDoor, job_id: str, owner: str | None, after: int) -> None:
        self._door = door
        self._job_id = job_id
        self._owner = owner
        self._after = after

    async def read(self) -> tuple[list[JobEvent], bool]:
        """Return the next events, and whether they are the last ones."""
        async with self._door.enter() as database:
            events, is_last = await run_in_threadpool(
                read_events, database, self._job_id, self._after, owner=self._owner
            )
        self._after = events[-1].sequence if events else self._after
        return events, is_last


async def _streams(request: Request, caller: CallerOf) -> AsyncIterator[Streams]:
    streams: Streams = request.app.state.streams
    with streams.opened(caller.owner):  # until the answer is sent, or the caller gone
        yield streams


StreamsOf = Annotated[Streams, Depends(_streams, scope="request")]


@router.get(
    "/{job_id}/events",
    response_class=StreamingResponse,  # FastAPI's own for events can only begin: no 204, no end with the service
    responses={
        200: {"description": "Events, numbered by `id`, until the job's last", "content": {MEDIA_TYPE: {}}},
        204: {"description": "The caller has the job's last event: there is nothing to wait for"},
        **error_responses(404, 422, 429, 503),
    },
)
async def stream_events(
    job_id: JobId, caller: CallerOf, door: DoorOf, streams: StreamsOf, request: Request, last_event_id: LastEventId = 0
) -> Response:
    """Tell what happens to a job and its segments as it happens, from the first event or that after `Last-Event-ID`."""
    reader = _Reader(door, job_id, caller.sees, last_event_id)
    events, is_last = await reader.read()
    if is_last and not events:
        return Response(status_code=HTTPStatus.NO_CONTENT)
    if is_head(request):
        return Response(headers=_HEADERS, media_type=MEDIA_TYPE)
    return StreamingResponse(_tell(reader, events, is_last, streams), headers=_HEADERS, media_type=MEDIA_TYPE)


async def _tell(reader: _Reader, events: list[JobEvent], is_last: bool, streams: Streams) -> AsyncIterator[bytes]:
    """Yield the first events, and go on reading until there are no more, with a comment in each longer silence."""
    began_s = spoke_s = time.monotonic()
    while True:
        if events:
            yield b"".join(map(_format, events))
            spoke_s = time.monotonic()
        elif time.monotonic() - spoke_s >= HEARTBEAT_S:
            yield _HEARTBEAT
            spoke_s = time.monotonic()
        if is_last or streams.is_closing or time.monotonic() - began_s >= MAX_STREAM_S:
            return
        if len(events) < PAGE_EVENTS:
            await asyncio.sleep(POLL_S)
        try:
            events, is_last = await reader.read()
        except (OperationalError, NoConnection):  # the door has logged it; the store may come back
            events, is_last = [], False


def _format(event: JobEvent) -> bytes:
    return format_sse_event(data_str=event.model_dump_json(), event=event.kind, id=str(event.sequence))
