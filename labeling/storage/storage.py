"""Where a label folder lives: a local folder or an ``s3://`` prefix, behind one protocol.

A file is complete or absent: readers never see half of one. ``publish`` is create-only: the first complete writer wins
and writing again is a no-op. Paths are relative to the folder, with ``/`` between their parts. Whatever the disk or the
network refuses is raised as ``OSError`` with a message of one line.
"""

import contextlib
import os
import secrets
from collections.abc import Iterator
from datetime import timedelta
from pathlib import Path
from typing import Any, Protocol

from schemas.errors import InvalidInput


class Storage(Protocol):
    """The files of one label folder."""

    root: str  # as the user may write it: a path or an s3:// URI

    def prepare(self, folders: tuple[str, ...]) -> None:
        """Make the folders and prove that files can be published in them, before any work is done.

        Raises:
            InvalidInput: Something stands in the way; the message says what.

        """
        ...

    def publish(self, path: str, source: Path | bytes) -> bool:
        """Publish a local file, or bytes, under ``path``; return False when that path exists (it stays as it is)."""
        ...

    def replace(self, path: str, content: bytes) -> None:
        """Put ``content`` at ``path`` in one step, whatever was there."""
        ...

    def read(self, path: str) -> bytes:
        """Return the bytes at ``path``; raise FileNotFoundError when there are none."""
        ...

    def list_files(self, folder: str) -> tuple[str, ...]:
        """Return the paths of the published files in ``folder``, sorted; none when there is no such folder."""
        ...


def open_storage(root: str | Path) -> Storage:
    """Return the storage for a local path or an ``s3://bucket/prefix`` URI. Nothing is created yet.

    S3 takes its endpoint, region and credentials from the usual ``AWS_*`` variables.

    Raises:
        InvalidInput: A URI of another kind, or S3 without the extra it needs.

    """
    text = str(root)
    if text.startswith("s3://"):
        return _open_s3(text)
    if "://" in text:
        raise InvalidInput(f"cannot keep labels at {text}: expected a local folder or s3://bucket/prefix")
    return LocalStorage(text)


class LocalStorage:
    """A folder on a local (or mounted) disk."""

    def __init__(self, root: str) -> None:
        self.root = root
        self._folder = Path(root)

    def prepare(self, folders: tuple[str, ...]) -> None:
        """Make the folders and publish a probe in each: this finds files in the way and disks without hard links."""
        for folder in folders:
            place = self._folder / folder
            try:
                place.mkdir(parents=True, exist_ok=True)
                with _temporary_file(place) as temporary:
                    probe = temporary.with_suffix(".probe")
                    os.link(temporary, probe)
                    probe.unlink()
            except OSError as error:
                raise InvalidInput(
                    f"cannot write labels to {place}: {error.strerror}; choose another --output"
                ) from None

    def publish(self, path: str, source: Path | bytes) -> bool:
        """Copy beside the target, sync, then link: a link either fails or names a whole file."""
        target = self._folder / path
        if target.exists():
            return False
        with _temporary_file(target.parent) as temporary:
            _write_synced(temporary, source)
            try:
                os.link(temporary, target)
            except FileExistsError:
                return False
        _sync_folder(target.parent)
        return True

    def replace(self, path: str, content: bytes) -> None:
        """Write beside the target, sync, then rename over it."""
        target = self._folder / path
        with _temporary_file(target.parent) as temporary:
            _write_synced(temporary, content)
            temporary.replace(target)
        _sync_folder(target.parent)

    def read(self, path: str) -> bytes:
        """Return the bytes at ``path``."""
        return (self._folder / path).read_bytes()

    def list_files(self, folder: str) -> tuple[str, ...]:
        """Return published files; temporary ones have a leading dot and are not listed."""
        place = self._folder / folder
        if not place.is_dir():
            return ()
        return tuple(sorted(f"{folder}/{file.name}" for file in place.iterdir() if not file.name.startswith(".")))


@contextlib.contextmanager
def _temporary_file(folder: Path) -> Iterator[Path]:
    """Yield a new empty file in ``folder`` that is gone afterwards, unless it was renamed."""
    temporary = folder / f".{secrets.token_hex(8)}.tmp"  # not mkstemp: its mode 0600 would hide labels from colleagues
    temporary.touch(exist_ok=False)
    try:
        yield temporary
    finally:
        temporary.unlink(missing_ok=True)


def _write_synced(target: Path, content: bytes | Path) -> None:
    with target.open("wb") as file:
        if isinstance(content, Path):
            with content.open("rb") as source:
                while chunk := source.read(1 << 20):
                    file.write(chunk)
        else:
            file.write(content)
        file.flush()
        os.fsync(file.fileno())


def _sync_folder(folder: Path) -> None:
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


class ObjectStorage:
    """A prefix of an object store."""

    def __init__(self, root: str, store: Any) -> None:  # an obstore store: its package is optional
        self.root = root
        self._store = store

    def prepare(self, folders: tuple[str, ...]) -> None:
        """List each folder: this finds a wrong bucket, endpoint or key. Folders need not be made."""
        for folder in folders:
            try:
                self.list_files(folder)
            except OSError as error:
                raise InvalidInput(f"cannot write labels to {self.root}: {error}") from None

    def publish(self, path: str, source: Path | bytes) -> bool:
        """Put with "create only if absent", in one part: parts would lose that condition."""
        from obstore.exceptions import AlreadyExistsError

        try:
            with self._one_line_errors(path):
                self._store.put(path, source, mode="create", use_multipart=False)
        except AlreadyExistsError:
            return False
        return True

    def replace(self, path: str, content: bytes) -> None:
        """Put; object stores replace whole objects."""
        with self._one_line_errors(path):
            self._store.put(path, content, use_multipart=False)

    def read(self, path: str) -> bytes:
        """Return the bytes at ``path``."""
        with self._one_line_errors(path):
            return bytes(self._store.get(path).bytes())

    def list_files(self, folder: str) -> tuple[str, ...]:
        """Return the objects under ``folder``."""
        with self._one_line_errors(folder):
            return tuple(sorted(entry["path"] for page in self._store.list(f"{folder}/") for entry in page))

    @contextlib.contextmanager
    def _one_line_errors(self, path: str) -> Iterator[None]:
        from obstore.exceptions import AlreadyExistsError, BaseError

        try:
            yield
        except AlreadyExistsError:
            raise
        except FileNotFoundError:
            raise FileNotFoundError(f"{self.root}/{path}: no such object") from None
        except BaseError as error:
            raise OSError(f"{self.root}/{path}: {_first_line(error)}") from None


def _first_line(error: Exception) -> str:
    """Return the part of an obstore error that is for people, without the server's XML."""
    return str(error).splitlines()[0].partition(": <?xml")[0]


def _open_s3(uri: str) -> ObjectStorage:
    try:
        from obstore.exceptions import BaseError
        from obstore.store import S3Store
    except ImportError:
        raise InvalidInput(f"{uri} needs the S3 extra: pip install motionlabel[s3]") from None
    bucket, _, prefix = uri.removeprefix("s3://").strip("/").partition("/")
    if not bucket:
        raise InvalidInput(f"{uri} names no bucket: expected s3://bucket/prefix")
    try:
        store = S3Store(
            bucket,
            prefix=prefix or None,
            client_options={"allow_http": True},  # a self-hosted endpoint is often plain http
            retry_config={"max_retries": 4, "retry_timeout": timedelta(seconds=30)},
        )
    except BaseError as error:
        raise InvalidInput(f"cannot use {uri}: {_first_line(error)}") from None
    return ObjectStorage(uri.rstrip("/"), store)
