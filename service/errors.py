"""Every error of the API as ``application/problem+json`` (RFC 9457), and of the dashboard as a page.

Only this file gives errors a status code.
"""

import json
import logging
import secrets
from http import HTTPStatus
from typing import Any, Final

from fastapi import FastAPI, Request
from fastapi.exceptions import RequestValidationError
from fastapi.responses import Response
from pydantic import BaseModel
from sqlalchemy.exc import DatabaseError
from sqlalchemy.exc import TimeoutError as NoConnection
from starlette.exceptions import HTTPException
from starlette.routing import Match

from schemas.errors import (
    InvalidInput,
    JobConflict,
    JobNotFound,
    LabelingError,
    QueueFull,
    ShardConflict,
    StorageTrouble,
    shorten,
)
from service.dashboard import pages
from service.store_door import is_outage

_LOGGER = logging.getLogger(__name__)
MEDIA_TYPE: Final = "application/problem+json"
_RETRY_AFTER_S: Final = "5"
_RETRY_LATER: Final = {
    HTTPStatus.SERVICE_UNAVAILABLE: _RETRY_AFTER_S,
    HTTPStatus.TOO_MANY_REQUESTS: "30",  # until segments have ended
}
_MAX_NAMED: Final = 20  # wrong values of one request
_PHRASES: Final = {413: "Content Too Large", 422: "Unprocessable Content"}  # RFC 9110; they differ between Pythons
_STATUSES: Final[dict[type[LabelingError], HTTPStatus]] = {  # any other LabelingError is our own failure
    InvalidInput: HTTPStatus.UNPROCESSABLE_ENTITY,
    JobNotFound: HTTPStatus.NOT_FOUND,
    JobConflict: HTTPStatus.CONFLICT,
    ShardConflict: HTTPStatus.CONFLICT,
    QueueFull: HTTPStatus.TOO_MANY_REQUESTS,
    StorageTrouble: HTTPStatus.SERVICE_UNAVAILABLE,
}


class FieldProblem(BaseModel):
    """One value of a request that cannot be."""

    pointer: str  # JSON pointer into the body, or the name of a query parameter
    detail: str


class Problem(BaseModel):
    """What went wrong, for a program (``type``, ``status``) and for a person (``detail``)."""

    type: str
    title: str
    status: int
    detail: str
    instance: str
    errors: list[FieldProblem] | None = None
    error_id: str | None = None  # of an internal error: the server's log has the same


def install_error_handlers(app: FastAPI) -> None:
    """Make every error that leaves the app a problem document without a trace."""
    app.add_exception_handler(HTTPException, _on_http_error)
    app.add_exception_handler(RequestValidationError, _on_invalid_request)
    app.add_exception_handler(LabelingError, _on_labeling_error)
    for kind in (DatabaseError, NoConnection):
        app.add_exception_handler(kind, _on_unreachable_store)
    app.add_exception_handler(Exception, _on_internal_error)


def error_responses(*statuses: int) -> dict[int | str, dict[str, Any]]:
    """Return what OpenAPI says of these statuses; ``service.app`` adds the schema of problem documents."""
    return {status: {"description": _phrase(status)} for status in statuses}


def _phrase(status: int) -> str:
    return _PHRASES.get(status) or HTTPStatus(status).phrase


def problem_response(
    request: Request, status: int, detail: str, *, headers: dict[str, str] | None = None, **extensions: Any
) -> Response:
    """Return a problem document, or a page that says the same; ``detail`` becomes a line."""
    phrase = _phrase(status)
    content = {
        "type": f"urn:motionlabel:problem:{phrase.lower().replace(' ', '-')}",
        "title": phrase,
        "status": status,
        "detail": shorten(detail),
        "instance": shorten(request.url.path),
        **extensions,
    }
    if pages.is_page(request):
        return pages.respond_problem(request, content, headers)
    return Response(json.dumps(content), status, headers, media_type=MEDIA_TYPE)  # ASCII: a text may hold half a pair


async def _on_http_error(request: Request, error: Exception) -> Response:
    assert isinstance(error, HTTPException)
    is_plain = error.detail in (HTTPStatus(error.status_code).phrase, _phrase(error.status_code))  # no route: say which
    detail = f"{error.detail}: {request.method} {request.url.path}" if is_plain else error.detail
    headers = dict(error.headers or {})
    if error.status_code == HTTPStatus.METHOD_NOT_ALLOWED:  # the framework tells those of one route only
        headers["Allow"] = ", ".join(_allowed_methods(request))
    return problem_response(request, error.status_code, detail, headers=headers)


def _allowed_methods(request: Request) -> list[str]:
    def has(method: str) -> bool:
        scope = {**request.scope, "method": method}
        return any(route.matches(scope)[0] is Match.FULL for route in request.app.routes)

    found = [method for method in ("GET", "POST", "PUT", "PATCH", "DELETE") if has(method)]
    return (["HEAD"] if "GET" in found else []) + found


async def _on_invalid_request(request: Request, error: Exception) -> Response:
    assert isinstance(error, RequestValidationError)
    entries = error.errors()
    problems = [FieldProblem(pointer=_pointer(entry["loc"]), detail=_detail(entry)) for entry in entries[:_MAX_NAMED]]
    first = f"{problems[0].pointer}: {problems[0].detail}" if problems[0].pointer else problems[0].detail
    more = f" (and {len(entries) - 1} more)" if len(entries) > 1 else ""
    is_json = entries[0]["type"] != "json_invalid"
    status = HTTPStatus.UNPROCESSABLE_ENTITY if is_json else HTTPStatus.BAD_REQUEST
    return problem_response(request, status, first + more, errors=[problem.model_dump() for problem in problems])


def _pointer(location: tuple[str | int, ...]) -> str:
    """Return a JSON pointer into the body, or the name of a parameter."""
    place, *path = map(str, location)
    if place != "body":
        return shorten(path[0] if path else place)
    return shorten("".join("/" + part.replace("~", "~0").replace("/", "~1") for part in path))


def _detail(entry: dict[str, Any]) -> str:
    if entry["type"] == "json_invalid":
        return f"the body is not JSON: {entry['ctx']['error']}"
    if isinstance(entry.get("input"), bytes):
        return "the body was not read: send JSON with Content-Type: application/json"
    return shorten(str(entry["msg"]).removeprefix("Value error, "))


async def _on_labeling_error(request: Request, error: Exception) -> Response:
    status = next((status for kind, status in _STATUSES.items() if isinstance(error, kind)), None)
    if status is None:
        return await _on_internal_error(request, error)
    headers = {"Retry-After": _RETRY_LATER[status]} if status in _RETRY_LATER else None
    return problem_response(request, status, str(error), headers=headers)


async def _on_unreachable_store(request: Request, error: Exception) -> Response:
    if not is_outage(error):
        return await _on_internal_error(request, error)
    detail = "the job store cannot be used at the moment: try again; the log of the service says why"
    return problem_response(request, HTTPStatus.SERVICE_UNAVAILABLE, detail, headers={"Retry-After": _RETRY_AFTER_S})


async def _on_internal_error(request: Request, error: Exception) -> Response:
    error_id = secrets.token_hex(8)
    _LOGGER.error("error %s in %s %s", error_id, request.method, request.url.path, exc_info=error)
    detail = f"an internal error; the server's log has it under {error_id}"
    return problem_response(request, HTTPStatus.INTERNAL_SERVER_ERROR, detail, error_id=error_id)
