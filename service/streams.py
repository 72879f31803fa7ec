"""Answers that go on for long: so many at a time of one caller, and in all, and none when the service ends."""

from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from http import HTTPStatus
from typing import Final

from fastapi import HTTPException

_RETRY_AFTER_S: Final = "10"


class Streams:
    """Who has how many open. All of it happens in the API's one event loop, but for ``close``."""

    def __init__(self, max_in_all: int = 200, max_per_owner: int = 20) -> None:
        self._max_in_all = max_in_all
        self._max_per_owner = max_per_owner
        self._open: Counter[str] = Counter()
        self.is_closing = False

    @contextmanager
    def opened(self, owner: str) -> Iterator[None]:
        """Count one more until the end.

        Raises:
            HTTPException: 429, this owner has as many as one may, or all have as many as there may be.

        """
        for num_open, limit, whose in (
            (self._open[owner], self._max_per_owner, "you have"),
            (self._open.total(), self._max_in_all, "there are"),
        ):
            if num_open >= limit:
                detail = f"{whose} {num_open} streams of events open, and {limit} are allowed: close some, or poll"
                raise HTTPException(HTTPStatus.TOO_MANY_REQUESTS, detail, headers={"Retry-After": _RETRY_AFTER_S})
        self._open[owner] += 1
        try:
            yield
        finally:
            self._open[owner] -= 1
            if not self._open[owner]:
                del self._open[owner]

    def close(self) -> None:
        """Let all streams end soon, so that the server can."""
        self.is_closing = True
