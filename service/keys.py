"""API keys: who holds one, what it opens, and the file that knows them, one JSON object a line.

A token is ``ml_<id>_<secret>``. The file holds its SHA-256 only. No slow hash is needed, as one is for passwords: the
secret is 256 random bits, and nobody can try so many.
"""

import fcntl
import hashlib
import hmac
import json
import logging
import os
import re
import secrets
import tempfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from datetime import UTC, datetime
from enum import StrEnum
from pathlib import Path
from typing import Annotated, Final

from pydantic import AwareDatetime, BaseModel, ConfigDict, Field, ValidationError, field_validator

from labeling.storage.places import canonical
from schemas.errors import InvalidInput

_LOGGER = logging.getLogger(__name__)
_TOKEN: Final = re.compile(r"ml_([0-9a-f]{8})_[0-9A-Za-z_-]{43}", re.ASCII)
_NO_DIGEST: Final = "0" * 64  # of no token that anybody knows
_WRITABLE_BY_OTHERS: Final = 0o022
_NEW_MODE: Final = 0o600


class Scope(StrEnum):
    """What a key opens. Each scope holds those before it."""

    READ = "read"  # look at the jobs of its owner
    SUBMIT = "submit"  # submit, cancel and retry them
    ADMIN = "admin"  # the same with jobs of all owners

    def holds(self, other: "Scope") -> bool:
        """Return whether this scope opens what the other one opens."""
        return list(Scope).index(self) >= list(Scope).index(other)


class Key(BaseModel):
    """A key as the file holds it. Whoever reads this cannot call the service with it."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    id: Annotated[str, Field(pattern="^[0-9a-f]{8}$")]
    owner: Annotated[str, Field(pattern="^[0-9A-Za-z][0-9A-Za-z._-]{0,63}$")]
    scopes: Annotated[tuple[Scope, ...], Field(min_length=1)]
    sha256: Annotated[str, Field(pattern="^[0-9a-f]{64}$")]  # of the whole token
    expires: AwareDatetime | None = None
    roots: Annotated[tuple[str, ...], Field(min_length=1)] | None = None  # that its jobs stay below

    @field_validator("roots", mode="after")
    @classmethod
    def _make_canonical(cls, value: tuple[str, ...] | None) -> tuple[str, ...] | None:
        try:
            return None if value is None else tuple(map(canonical, value))
        except InvalidInput as error:
            raise ValueError(str(error)) from None

    def is_expired(self, now: datetime) -> bool:
        """Return whether its time is over."""
        return self.expires is not None and now >= self.expires


def make_key(
    owner: str, scopes: Sequence[Scope], expires: datetime | None = None, roots: Sequence[str] | None = None
) -> tuple[Key, str]:
    """Return a new key and its token, which is kept nowhere.

    Raises:
        InvalidInput: A name, or a root, that cannot be.

    """
    key_id = secrets.token_hex(4)
    token = f"ml_{key_id}_{secrets.token_urlsafe(32)}"
    values = {"owner": owner, "scopes": tuple(scopes), "expires": expires, "roots": roots and tuple(roots)}
    try:
        return Key(id=key_id, sha256=_digest(token), **values), token
    except ValidationError as error:
        raise InvalidInput(_explain(error)) from None


def read_keys(path: Path) -> tuple[Key, ...]:
    """Return the keys of a file, expired ones too.

    Raises:
        InvalidInput: The file cannot be read, others may write it, or a line is no key.

    """
    try:
        with path.open(encoding="utf-8") as file:
            mode = os.fstat(file.fileno()).st_mode
            lines = file.read().splitlines()
    except OSError as error:
        raise InvalidInput(
            f"cannot read the API keys {path}: {error.strerror}; `motionlabel key new --owner NAME` makes one"
        ) from None
    except UnicodeDecodeError:
        raise InvalidInput(f"{path} holds no API keys: it is no text") from None
    if mode & _WRITABLE_BY_OTHERS:
        raise InvalidInput(f"{path} may be written by other users, who could add keys of their own: chmod go-w {path}")
    keys: dict[str, Key] = {}
    for number, line in enumerate(lines, start=1):
        if line.strip():
            key = _read_line(line, f"{path}, line {number}")
            if keys.setdefault(key.id, key) is not key:
                raise InvalidInput(f"{path}, line {number}: key {key.id} is there twice")
    return tuple(keys.values())


def _read_line(line: str, place: str) -> Key:
    try:
        return Key.model_validate(json.loads(line))
    except ValidationError as error:
        raise InvalidInput(f"{place}: {_explain(error)}") from None
    except (ValueError, RecursionError):
        raise InvalidInput(f"{place}: expected a JSON object, as `motionlabel key new` writes it") from None


def _explain(error: ValidationError) -> str:
    """Return the first complaint without what was found: somebody may have pasted a token."""
    problem = error.errors(include_input=False, include_url=False)[0]
    name = problem["loc"][0] if problem["loc"] else ""
    return f"{name if name in Key.model_fields else 'a field'} of a key: {problem['msg']}"


def add_key(path: Path, key: Key) -> None:
    """Add a key to a file, which is made if there is none. Whoever reads it meanwhile finds all of it or nothing.

    Raises:
        InvalidInput: The file cannot be read or written.

    """
    _change(path, lambda keys: [*keys, key])


def revoke_key(path: Path, key_id: str) -> None:
    """Take a key out of a file.

    Raises:
        InvalidInput: There is no such key, or the file cannot be read or written.

    """

    def leave_out(keys: Sequence[Key]) -> list[Key]:
        rest = [key for key in keys if key.id != key_id]
        if len(rest) == len(keys):
            raise InvalidInput(f"{path} has no key of this id: `motionlabel key list` shows them")
        return rest

    _change(path, leave_out)


def _change(path: Path, change: Callable[[Sequence[Key]], Sequence[Key]]) -> None:
    place = Path(os.path.realpath(path))  # of a link, the file that it points to
    try:
        with _only_writer(place.parent):
            keys = change(read_keys(place) if place.exists() else ())
            _replace(place, "".join(f"{key.model_dump_json(exclude_none=True)}\n" for key in keys))
    except OSError as error:
        raise InvalidInput(f"cannot write the API keys {path}: {error.strerror}") from None


@contextmanager
def _only_writer(folder: Path) -> Iterator[None]:
    """Keep other commands that change keys waiting. The lock is on the folder: the file is replaced."""
    descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX)
        yield
    finally:
        os.close(descriptor)


def _replace(path: Path, text: str) -> None:
    """Put a whole new file in the place of an old one, with the mode and the owner that it had."""
    before = path.stat() if path.exists() else None
    descriptor, name = tempfile.mkstemp(prefix=f".{path.name}-", dir=path.parent)
    try:
        with os.fdopen(descriptor, "w", encoding="utf-8") as file:
            os.fchmod(descriptor, _NEW_MODE if before is None else before.st_mode & 0o777)
            if before is not None:
                with suppress(PermissionError):
                    os.fchown(descriptor, before.st_uid, before.st_gid)
            file.write(text)
            file.flush()
            os.fsync(descriptor)
        Path(name).replace(path)
    except BaseException:
        Path(name).unlink(missing_ok=True)
        raise


class KeyRing:
    """The keys of a file, as it stands now. One that cannot be read any more leaves those that were read last."""

    def __init__(self, path: Path) -> None:
        """Read the file.

        Raises:
            InvalidInput: As ``read_keys``.

        """
        self._path = path
        self._mark = self._look()  # before reading: what changes meanwhile is read again
        self._keys = {key.id: key for key in read_keys(path)}
        self._is_broken = False

    def find(self, token: str, now: datetime | None = None) -> Key | None:
        """Return the key of a token; None: it is none, or it was revoked or has expired."""
        parts = _TOKEN.fullmatch(token)
        key = self.get(parts[1], now) if parts else None
        expected = _NO_DIGEST if key is None else key.sha256
        return key if hmac.compare_digest(_digest(token), expected) else None

    def get(self, key_id: str, now: datetime | None = None) -> Key | None:
        """Return the key of an id, unless it was revoked or has expired."""
        self._refresh()
        key = self._keys.get(key_id)
        return None if key is None or key.is_expired(now or datetime.now(UTC)) else key

    def _refresh(self) -> None:
        mark = self._look()
        if mark == self._mark:
            return
        self._mark = mark
        try:
            self._keys = {key.id: key for key in read_keys(self._path)}
        except InvalidInput as error:
            self._is_broken = True
            _LOGGER.error("the API keys that were read last stay in use: %s", error)
            return
        if self._is_broken:
            self._is_broken = False
            _LOGGER.error("the API keys can be read again")

    def _look(self) -> tuple[int, ...] | None:
        try:
            found = self._path.stat()
        except OSError:
            return None
        return found.st_mtime_ns, found.st_size, found.st_ino, found.st_mode


def _digest(token: str) -> str:
    return hashlib.sha256(token.encode(errors="surrogateescape")).hexdigest()
