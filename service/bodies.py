"""Bodies of requests, bounded by what a job of ``MAX_SEGMENTS`` can need, and read while other requests go on."""

import json
from collections.abc import Callable, Coroutine
from http import HTTPStatus
from typing import Any, Final

from fastapi import HTTPException, Request, Response
from fastapi.routing import APIRoute
from starlette.concurrency import run_in_threadpool

MAX_BODY_BYTES: Final = 8 * 2**20  # 800 a segment
MAX_MARKS: Final = 100_000  # commas and brackets: each value costs a hundred times its bytes until it is refused
_ADVICE: Final = "submit fewer segments a job"


class JsonRoute(APIRoute):
    """A route whose body is parsed in a thread."""

    def get_route_handler(self) -> Callable[[Request], Coroutine[Any, Any, Response]]:
        """Return FastAPI's handler, on a request of ours."""
        handle = super().get_route_handler()

        async def handle_json(request: Request) -> Response:  # a lambda would not be awaited
            return await handle(_JsonRequest(request.scope, request.receive))

        return handle_json


class _JsonRequest(Request):
    async def json(self) -> Any:
        return await run_in_threadpool(_parse, await self.body())


def describe_limit(max_bytes: int) -> str:
    """Return what to say of a larger body."""
    return f"the body is larger than {max_bytes} bytes: {_ADVICE}"


def _parse(body: bytes) -> Any:
    if sum(body.count(mark) for mark in (b",", b"[", b"{")) > MAX_MARKS:
        raise HTTPException(
            HTTPStatus.REQUEST_ENTITY_TOO_LARGE, f"the body has more than {MAX_MARKS} commas and brackets: {_ADVICE}"
        )
    return json.loads(body)
