"""Bodies of requests, bounded by what a job of ``MAX_SEGMENTS`` can need, and read while other requests go on."""

import json
from collections.abc import Callable, Coroutine
from http import HTTPStatus
from typing import Any, Final

from fastapi import HTTPException, Request, Response
from fastapi.routing import APIRoute
from starlette.concurrency import run_in_threadpool
from starlette.datastructures import Headers
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from service.errors import problem_response

MAX_BODY_BYTES: Final = 8 * 2**20  # 800 a segment
MAX_MARKS: Final = 100_000  # commas and brackets: each value costs a hundred times its bytes until it is refused
_IS_HEAD: Final = "motionlabel.is_head"  # in the connection's own dictionary
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


class BodyLimit:
    """Middleware that refuses bodies of more than ``max_bytes``. FastAPI's own does so without a problem document."""

    def __init__(self, app: ASGIApp, max_bytes: int) -> None:
        self._app = app
        self._max_bytes = max_bytes

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Refuse by the declared length before anything is read, else by what really comes in."""
        declared = Headers(scope=scope).get("content-length", "") if scope["type"] == "http" else ""
        detail = f"the body is larger than {self._max_bytes} bytes: {_ADVICE}"
        if declared.isdecimal() and int(declared) > self._max_bytes:
            await problem_response(Request(scope), HTTPStatus.REQUEST_ENTITY_TOO_LARGE, detail)(scope, receive, send)
            return
        num_bytes = 0

        async def receive_counted() -> Message:
            nonlocal num_bytes
            message = await receive()
            num_bytes += len(message.get("body", b""))
            if num_bytes > self._max_bytes:
                raise HTTPException(HTTPStatus.REQUEST_ENTITY_TOO_LARGE, detail)
            return message

        await self._app(scope, receive_counted, send)


def _parse(body: bytes) -> Any:
    if sum(body.count(mark) for mark in (b",", b"[", b"{")) > MAX_MARKS:
        raise HTTPException(
            HTTPStatus.REQUEST_ENTITY_TOO_LARGE, f"the body has more than {MAX_MARKS} commas and brackets: {_ADVICE}"
        )
    return json.loads(body)


class HeadAsGet:
    """Middleware that answers HEAD as GET, without the body."""

    def __init__(self, app: ASGIApp) -> None:
        self._app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass on."""
        if scope["type"] != "http" or scope["method"] != "HEAD":
            await self._app(scope, receive, send)
            return

        async def send_head(message: Message) -> None:
            await send({**message, "body": b""} if message["type"] == "http.response.body" else message)

        await self._app({**scope, "method": "GET", _IS_HEAD: True}, receive, send_head)


def is_head(request: Request) -> bool:
    """Return whether what looks like GET is HEAD: an answer without end need not begin."""
    return _IS_HEAD in request.scope
