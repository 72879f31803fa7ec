"""Signing in with an API key, and out. Whoever is not signed in meets the form on every page."""

from http import HTTPStatus
from typing import Final
from urllib.parse import parse_qs

from fastapi import APIRouter, HTTPException, Request, Response
from fastapi.responses import RedirectResponse

from service.access import CHALLENGE
from service.dashboard.pages import ROOT, page_to_return_to
from service.sessions import COOKIE, Sessions

router = APIRouter(prefix=ROOT, include_in_schema=False)

_MAX_FORM_BYTES: Final = 4096
_MAX_FIELDS: Final = 10


@router.post("/sign-in")
async def sign_in(request: Request) -> Response:
    """Begin a session with the key of the form, and go on to the page that asked for one."""
    form = await _read_form(request)
    sessions: Sessions | None = request.app.state.sessions
    response = RedirectResponse(page_to_return_to(form.get("to", "")), HTTPStatus.SEE_OTHER)
    if sessions is None:
        return response
    key = sessions.keys.find(form.get("key", "").strip())
    if key is None:
        complaint = "This is no key of the service, or it was revoked or has expired."
        raise HTTPException(HTTPStatus.UNAUTHORIZED, complaint, {"WWW-Authenticate": CHALLENGE})
    sessions.end(request.cookies.get(COOKIE, ""))
    response.set_cookie(
        COOKIE, sessions.begin(key), path="/", httponly=True, samesite="strict", secure=_is_https(request)
    )
    return response


@router.post("/sign-out")
async def sign_out(request: Request) -> Response:
    """End the session, also for whoever kept its cookie."""
    sessions: Sessions | None = request.app.state.sessions
    if sessions is not None:
        sessions.end(request.cookies.get(COOKIE, ""))
    response = RedirectResponse(ROOT, HTTPStatus.SEE_OTHER)
    response.delete_cookie(COOKIE, path="/", httponly=True, samesite="strict", secure=_is_https(request))
    return response


def _is_https(request: Request) -> bool:
    """Return whether the browser speaks TLS, be it with a proxy: its page's own address says so."""
    return request.url.scheme == "https" or request.headers.get("origin", "").startswith("https://")


async def _read_form(request: Request) -> dict[str, str]:
    body = b""
    async for chunk in request.stream():
        body += chunk
        if len(body) > _MAX_FORM_BYTES:
            raise HTTPException(HTTPStatus.REQUEST_ENTITY_TOO_LARGE, f"the form is larger than {_MAX_FORM_BYTES} bytes")
    try:
        fields = parse_qs(body.decode("ascii", errors="replace"), max_num_fields=_MAX_FIELDS)
    except ValueError:
        raise HTTPException(HTTPStatus.BAD_REQUEST, "the form has too many fields") from None
    return {name: values[0] for name, values in fields.items() if len(values) == 1}
