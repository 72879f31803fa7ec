"""Connections that have not sent their request yet: few of them, none for long."""

import asyncio
import resource
from typing import Final

import h11
from uvicorn.protocols.http.h11_impl import H11Protocol

PATIENCE_S: Final = 30.0  # for a whole request, from its first byte, or from the beginning of its connection
_SHARE_OF_FILES: Final = 4  # of the files that a process may open, one part waits for requests
_MOST_WAITING: Final = 1000
_ARRIVING: Final = (h11.IDLE, h11.SEND_BODY)


def bounded_protocol(patience_s: float = PATIENCE_S, most_waiting: int | None = None) -> type[H11Protocol]:
    """Return uvicorn's protocol with a limit to requests that are sent by halves.

    A request that does not arrive in time is not waited for. Where more connections wait for theirs than the process
    has files to spare, the one that has waited longest is closed: an honest request arrives within a blink.

    Args:
        patience_s: For a whole request.
        most_waiting: Connections; None: a quarter of the files that the process may open.

    """
    most = most_waiting or min(resource.getrlimit(resource.RLIMIT_NOFILE)[0] // _SHARE_OF_FILES, _MOST_WAITING)
    waiting: dict[H11Protocol, asyncio.TimerHandle] = {}  # in the order in which they began to wait

    def forget(protocol: H11Protocol) -> None:
        if timer := waiting.pop(protocol, None):
            timer.cancel()

    class BoundedProtocol(H11Protocol):
        def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]  # as uvicorn's own
            super().connection_made(transport)
            self._note()

        def data_received(self, data: bytes) -> None:
            super().data_received(data)
            self._note()

        def connection_lost(self, exc: Exception | None) -> None:
            forget(self)
            super().connection_lost(exc)

        def _note(self) -> None:
            if self.conn.their_state not in _ARRIVING:
                forget(self)
            elif self not in waiting:
                if len(waiting) >= most:
                    oldest = next(iter(waiting))
                    forget(oldest)  # at once: many may come before its connection is lost
                    oldest.transport.abort()
                waiting[self] = self.loop.call_later(patience_s, self.transport.abort)

    return BoundedProtocol
