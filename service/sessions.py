"""Who is signed in at the dashboard. A browser's cookie holds a random number that means nothing but here."""

import hashlib
import secrets
import time
from dataclasses import dataclass
from typing import Final

from service.keys import Key, KeyRing

COOKIE: Final = "motionlabel_session"
MAX_AGE_S: Final = 12 * 3600
_MAX_PER_KEY: Final = 20  # browsers that are signed in with one key; the oldest makes room


@dataclass(frozen=True, slots=True)
class _Session:
    key: Key
    ends_at_s: float


class Sessions:
    """Sessions in memory: they end by signing out, with their key, after a day's work, and with the process."""

    def __init__(self, keys: KeyRing) -> None:
        self.keys = keys
        self._sessions: dict[str, _Session] = {}  # by the SHA-256 of their number, oldest first

    def begin(self, key: Key) -> str:
        """Return the number of a new session."""
        self._sessions = {mark: session for mark, session in self._sessions.items() if self._is_alive(session)}
        earlier = [mark for mark, session in self._sessions.items() if session.key.id == key.id]
        for mark in earlier[: max(0, len(earlier) + 1 - _MAX_PER_KEY)]:
            del self._sessions[mark]
        number = secrets.token_urlsafe(32)
        self._sessions[_mark(number)] = _Session(key, time.monotonic() + MAX_AGE_S)
        return number

    def find(self, number: str) -> Key | None:
        """Return the key that a session was begun with, as it is now; None: there is no such session any more."""
        session = self._sessions.get(_mark(number))
        return self.keys.get(session.key.id) if session is not None and self._is_alive(session) else None

    def end(self, number: str) -> None:
        """Forget a session, if there is one."""
        self._sessions.pop(_mark(number), None)

    def _is_alive(self, session: _Session) -> bool:
        key = self.keys.get(session.key.id)
        return key is not None and key.sha256 == session.key.sha256 and time.monotonic() < session.ends_at_s


def _mark(number: str) -> str:
    """Return what a session is found by: how long that takes tells nothing of any number."""
    return hashlib.sha256(number.encode(errors="surrogateescape")).hexdigest()
