"""Who asks, and what they may: every request is refused unless its key opens it, whatever routes there are."""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from http import HTTPStatus
from itertools import product
from typing import Final

from fastapi import Request, Response
from starlette.types import ASGIApp, Receive, Send
from starlette.types import Scope as Connection

from labeling.storage.places import is_below
from service.errors import problem_response
from service.keys import Scope
from service.sessions import COOKIE, Sessions

# Nobody is asked who they are: probes, what the page to sign in at is made of, and its form.
_OPEN: Final = re.compile(r"GET /(healthz|readyz|dashboard/static/[^/]+)|POST /dashboard/sign-(in|out)")
_CALLER: Final = "motionlabel.caller"  # in the connection's own dictionary
CHALLENGE: Final = 'Bearer realm="motionlabel"'


@dataclass(frozen=True, slots=True)
class Caller:
    """Whoever asks, and what they may."""

    owner: str = ""  # of the jobs that they submit; empty: nobody was asked
    scopes: tuple[Scope, ...] = ()
    roots: tuple[str, ...] | None = None  # that their jobs stay below; None: the service's

    @property
    def sees(self) -> str | None:
        """The owner whose jobs this caller may see and change; None: those of all."""
        return None if self.may(Scope.ADMIN) else self.owner

    def may(self, scope: Scope) -> bool:
        """Return whether this caller may do what needs ``scope``."""
        return any(mine.holds(scope) for mine in self.scopes)

    def roots_within(self, data_roots: Sequence[str]) -> Sequence[str]:
        """Return the places that jobs of this caller stay below: those that the key and the service both name."""
        if self.roots is None:
            return data_roots
        pairs = product(self.roots, data_roots)
        return [max(mine, root, key=len) for mine, root in pairs if is_below(mine, root) or is_below(root, mine)]


_ANYBODY: Final = Caller(scopes=(Scope.ADMIN,))  # of a service without keys
_NOBODY: Final = Caller()  # at what is open to all


async def caller_of(request: Request) -> Caller:
    """Return who asks; ``KeyCheck`` has let them in."""
    caller: Caller = request.scope[_CALLER]
    return caller


def is_open(method: str, path: str) -> bool:
    """Return whether a call needs no key."""
    return _OPEN.fullmatch(f"{method} {path}") is not None


class KeyCheck:
    """Middleware that lets in whoever has a key, or is signed in with one.

    Looking needs the scope read, all else the scope submit.
    """

    def __init__(self, app: ASGIApp, sessions: Sessions | None) -> None:
        """Take the keys and who is signed in with them; None: nobody is asked."""
        self._app = app
        self._sessions = sessions

    async def __call__(self, scope: Connection, receive: Receive, send: Send) -> None:
        """Refuse before anything of the body is read, or pass on with the caller."""
        if scope["type"] == "http":
            caller = self._identify(Request(scope))
            needed = Scope.READ if scope["method"] == "GET" else Scope.SUBMIT
            if caller is None or not (caller is _NOBODY or caller.may(needed)):
                await _refuse(Request(scope), caller, needed)(scope, receive, send)
                return
            scope[_CALLER] = caller
        await self._app(scope, receive, send)

    def _identify(self, request: Request) -> Caller | None:
        if self._sessions is None:
            return _ANYBODY
        if is_open(request.method, request.scope["path"]):
            return _NOBODY
        given = request.headers.getlist("authorization")
        if not given:
            key = self._sessions.find(request.cookies.get(COOKIE, ""))
        else:
            scheme, _, token = given[0].partition(" ") if len(given) == 1 else ("", "", "")
            key = self._sessions.keys.find(token.strip(" ")) if scheme.lower() == "bearer" else None
        return None if key is None else Caller(key.owner, key.scopes, key.roots)


def _refuse(request: Request, caller: Caller | None, needed: Scope) -> Response:
    """Return what is said to a caller without a key that counts, or whose key does not open this."""
    if caller is None:
        is_given = "authorization" in request.headers
        detail = "this is no key of the service, or it has expired" if is_given else "this service asks for an API key"
        detail += ": send Authorization: Bearer ml_..., in one header, as `motionlabel key new` prints it"
        challenge = f'{CHALLENGE}, error="invalid_token"' if is_given else CHALLENGE
        return problem_response(request, HTTPStatus.UNAUTHORIZED, detail, headers={"WWW-Authenticate": challenge})
    detail = f"the key has no scope {needed}, which this needs"
    challenge = f'{CHALLENGE}, error="insufficient_scope", scope="{needed}"'
    return problem_response(request, HTTPStatus.FORBIDDEN, detail, headers={"WWW-Authenticate": challenge})
