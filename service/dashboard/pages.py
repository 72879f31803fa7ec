"""Pages as responses: templates filled in, headers that let a browser load nothing but our own files."""

import hashlib
import re
from collections.abc import Mapping
from dataclasses import dataclass
from http import HTTPStatus
from typing import Any, Final

from fastapi import Request, Response
from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup

from service.dashboard.views import address

ROOT: Final = "/dashboard"
_HEADERS: Final = {
    "Content-Security-Policy": "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self'; "
    "connect-src 'self'; form-action 'self'; frame-ancestors 'none'; base-uri 'none'",
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "same-origin",  # with no-referrer a browser hides the Origin of our own forms
    "Cache-Control": "no-store",
}
_PAGE: Final = re.compile(rf"{ROOT}(/jobs/[0-9A-Za-z]{{1,64}})?")
_TEMPLATES: Final = Environment(
    loader=PackageLoader("service.dashboard"),
    autoescape=True,
    undefined=StrictUndefined,
    trim_blocks=True,
    lstrip_blocks=True,
)
_TEMPLATES.globals["root"] = ROOT


@dataclass(frozen=True, slots=True)
class LivePart:
    """The part of a page that is polled, and the sentence that a screen reader is told when it changes.

    The address of the next poll says what the page shows already: what did not change is not sent, and not read out.
    """

    path: str
    query: Mapping[str, str | None]
    content: Markup
    announcement: str

    @property
    def url(self) -> str:
        """Address of the next poll."""
        return address(self.path, **self.query, seen=self.seen, said=self.said)

    @property
    def seen(self) -> str:
        """Mark of the content."""
        return _mark(self.content)

    @property
    def said(self) -> str:
        """Mark of the announcement."""
        return _mark(self.announcement)


def fill(template: str, **values: Any) -> Markup:
    """Return a template filled in; whatever is no markup is escaped."""
    return Markup(_TEMPLATES.get_template(template).render(values))


def respond(
    template: str,
    status: int = HTTPStatus.OK,
    headers: Mapping[str, str] | None = None,
    *,
    account: str = "",
    **values: Any,
) -> Response:
    """Return a whole page; ``account`` is who is signed in, empty where nobody was asked."""
    page = fill(template, account=account, **values)
    # A text may hold half a surrogate pair, which UTF-8 has no bytes for.
    return _html(page.encode(errors="backslashreplace"), status, headers)


def respond_live(part: LivePart, seen: str, said: str) -> Response:
    """Return what a poll is answered: nothing (204) when the page shows it already."""
    if part.seen == seen and part.said == said:
        return _html(b"", HTTPStatus.NO_CONTENT)
    return respond("live.html", live=part, is_news=part.said != said)


def respond_problem(request: Request, problem: Mapping[str, Any], headers: Mapping[str, str] | None = None) -> Response:
    """Return a problem document as a page: that of a caller without a key is the one to sign in at."""
    if problem["status"] == HTTPStatus.UNAUTHORIZED:
        return _ask_for_key(request, problem, headers)
    again = _way_back(request, problem["status"])
    return respond("problem.html", problem["status"], headers, problem=problem, again=again)


def _ask_for_key(request: Request, problem: Mapping[str, Any], headers: Mapping[str, str] | None) -> Response:
    path = request.url.path
    complaint = problem["detail"] if path == f"{ROOT}/sign-in" else None
    reload = {"HX-Refresh": "true"}  # where htmx asked for a part of a page, the whole of it shall ask for the key
    return respond(
        "sign_in.html", problem["status"], reload | dict(headers or {}), to=page_to_return_to(path), complaint=complaint
    )


def page_to_return_to(path: str) -> str:
    """Return a page that one may want to see after signing in: no place out of the dashboard."""
    return path if _PAGE.fullmatch(path) else ROOT


def is_page(request: Request) -> bool:
    """Return whether a request asks for a page of the dashboard."""
    path = request.url.path
    return path == ROOT or path.startswith(f"{ROOT}/")


def _way_back(request: Request, status: int) -> str | None:
    """Return the page that may work: the same once more, or the one with the button that was pressed."""
    path = request.url.path
    if request.method == "POST":
        return path.rpartition("/")[0]
    return path if status >= HTTPStatus.INTERNAL_SERVER_ERROR else None


def _html(body: bytes, status: int, headers: Mapping[str, str] | None = None) -> Response:
    return Response(body, status, {**_HEADERS, **(headers or {})}, media_type="text/html")


def _mark(text: str) -> str:
    return hashlib.sha256(text.encode(errors="backslashreplace")).hexdigest()[:16]
