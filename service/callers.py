"""Who may call, by the names that browsers send: a page of somebody else must not reach the API through its visitor."""

import ipaddress
from collections.abc import Collection
from http import HTTPStatus
from typing import Final
from urllib.parse import urlsplit

from fastapi import Request
from starlette.datastructures import Headers
from starlette.types import ASGIApp, Receive, Scope, Send

from service.errors import problem_response

_LOOPBACK: Final = frozenset({"localhost", "127.0.0.1", "::1"})
_READING: Final = ("GET", "HEAD", "OPTIONS")


class CallerCheck:
    """Middleware that refuses names that are not this service's, and changes that a foreign page asks for.

    A foreign name in ``Host`` is DNS rebinding: the page's own name was pointed at this machine. Its ``Origin`` is then
    the same as ``Host``, so both have to be right.
    """

    def __init__(self, app: ASGIApp, host: str, allowed_hosts: Collection[str]) -> None:
        """Take the address that is listened on, and further names of the service, without ports."""
        self._app = app
        self._names = _LOOPBACK | {host.lower()} | {name.lower() for name in allowed_hosts}
        self._takes_addresses = host in ("0.0.0.0", "::")  # all of the machine's; no page is called so
        self._further = frozenset(name.lower() for name in allowed_hosts)

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Refuse, or pass on."""
        reason = self._objection(scope["method"], Headers(scope=scope)) if scope["type"] == "http" else None
        app = self._app if reason is None else problem_response(Request(scope), HTTPStatus.FORBIDDEN, reason)
        await app(scope, receive, send)

    def _objection(self, method: str, headers: Headers) -> str | None:
        hosts = headers.getlist("host")
        name = _hostname(f"//{hosts[0]}") if len(hosts) == 1 else None
        if name is None or not (name in self._names or (self._takes_addresses and _is_address(name))):
            return (
                f"Host {', '.join(hosts) or 'is missing and'} is no name of this service: "
                "MOTIONLABEL_ALLOWED_HOSTS of the server lists further ones"
            )
        origin = headers.get("origin")
        if method in _READING or origin is None or _netloc(origin) == hosts[0].lower():
            return None
        return None if _hostname(origin) in self._further else f"a page of {origin} may not change anything here"


def _netloc(url: str) -> str | None:
    try:
        return urlsplit(url).netloc.lower()
    except ValueError:
        return None


def _hostname(url: str) -> str | None:
    try:
        parts = urlsplit(url)
        _ = parts.port  # raises where it is no number
    except ValueError:
        return None
    is_plain = parts.username is None and not (parts.path or parts.query or parts.fragment)
    return parts.hostname.removesuffix(".") if is_plain and parts.hostname else None


def _is_address(name: str) -> bool:
    try:
        ipaddress.ip_address(name)
    except ValueError:
        return False
    return True
