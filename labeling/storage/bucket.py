"""A prefix of an S3 bucket, through obstore."""

import contextlib
import re
from collections.abc import Callable, Iterator
from datetime import datetime, timedelta
from pathlib import Path
from typing import Any, Final

from labeling.storage import places
from labeling.storage.storage import Storage
from schemas.errors import InvalidInput, StorageTrouble

RETRY: Final[Any] = {"max_retries": 4, "retry_timeout": timedelta(seconds=30)}
_QUICK: Final[Any] = {"max_retries": 1, "retry_timeout": timedelta(seconds=3)}
_CLIENT: Final[Any] = {"allow_http": True}  # a self-hosted endpoint is often plain http
_PAGE_KEYS: Final = 1000  # S3's own: more would be several requests
_QUICK_CLIENT: Final[Any] = {**_CLIENT, "connect_timeout": "2s", "timeout": "4s"}


class ObjectStorage(Storage):
    """A prefix of an object store behind the Storage protocol. Folders are what the parts of keys make of them."""

    def __init__(self, root: str, store: Any) -> None:  # an obstore store: its package is optional
        self.root = root
        self._store = store

    def __reduce__(self) -> tuple[Callable[[str], "ObjectStorage"], tuple[str]]:
        """Open the place anew elsewhere: credentials do not travel."""
        return open_bucket, (self.root,)

    def list_files(self, folder: str = "") -> Iterator[str]:
        """Yield the objects whose keys have one more part."""
        return (entry["path"] for entry in self._files(folder))

    def list_folders(self, folder: str = "") -> Iterator[str]:
        """Yield what keys with more parts have in common: they come sorted, so those of one folder are neighbours.

        What else a folder holds that fills a page is leapt over, and never asked for.
        """
        depth = folder.count("/") + 1 if folder else 0
        last, after = None, None
        while True:
            for page in self._pages(folder, after):
                inner = [_parent_at(depth, entry["path"]) for entry in page]
                for name in inner:
                    if name is not None and name != last:
                        last = name
                        if not name.rpartition("/")[2].startswith("."):
                            yield name
                if len(page) == _PAGE_KEYS and inner[0] is not None and inner[0] == inner[-1]:
                    after = f"{inner[0]}0"  # the character behind "/"
                    break
            else:
                return

    def has_folder(self, folder: str = "") -> bool:
        """Return whether any key begins so."""
        return any(True for _ in self._pages(folder))

    def last_modified(self, folder: str) -> datetime | None:
        """Return the latest time stamp in the listing."""
        return max((entry["last_modified"] for entry in self._files(folder)), default=None)

    def size(self, path: str) -> int | None:
        """Return the bytes of an object, None when there is none."""
        try:
            with self._one_line_errors(path):
                return int(self._store.head(path)["size"])
        except FileNotFoundError:
            return None

    def read(self, path: str) -> bytes:
        """Return the content of an object."""
        with self._one_line_errors(path):
            return bytes(self._store.get(path).bytes())

    def read_range(self, path: str, start: int, stop: int) -> bytes:
        """Ask for a range."""
        from obstore.exceptions import BaseError

        if start >= stop:
            return b""
        with self._one_line_errors(path):
            try:
                return bytes(self._store.get_range(path, start=start, end=stop))
            except BaseError as error:
                if "InvalidRange" in str(error):  # it begins behind the end
                    return b""
                raise

    def publish(self, path: str, content: bytes | Path) -> bool:
        """Put with "create only if absent", in one part: parts would lose that condition."""
        from obstore.exceptions import AlreadyExistsError

        try:
            with self._one_line_errors(path):
                self._store.put(path, content, mode="create", use_multipart=False)
        except AlreadyExistsError:
            return False
        return True

    def replace(self, path: str, content: bytes) -> None:
        """Put; object stores replace whole objects."""
        with self._one_line_errors(path):
            self._store.put(path, content, use_multipart=False)

    def prepare(self, folders: tuple[str, ...]) -> None:
        """List each folder: this finds a wrong bucket, endpoint or key. Folders need not be made."""
        for folder in folders:
            self.has_folder(folder)

    def _files(self, folder: str) -> Iterator[Any]:
        """Yield what is said of each object directly in a folder."""
        for page in self._pages(folder):
            for entry in page:
                name = entry["path"].removeprefix(f"{folder}/")
                if "/" not in name and not name.startswith("."):
                    yield entry

    def _pages(self, folder: str, after: str | None = None) -> Iterator[list[Any]]:
        """Yield what is said of all objects below a folder, sorted by key, a request at a time."""
        prefix = f"{folder}/" if folder else ""
        with self._one_line_errors(folder):
            for page in self._store.list(prefix, offset=after, chunk_size=_PAGE_KEYS):
                # An object that stands for the folder itself is none in it.
                if entries := [entry for entry in page if entry["path"].startswith(prefix)]:
                    yield entries

    @contextlib.contextmanager
    def _one_line_errors(self, path: str) -> Iterator[None]:
        from obstore.exceptions import AlreadyExistsError, BaseError

        place = self.place(path)
        try:
            yield
        except AlreadyExistsError:
            raise
        except (FileNotFoundError, BaseError) as error:
            if "NoSuchBucket" in str(error):
                raise InvalidInput(f"{place}: no such bucket") from None
            if isinstance(error, FileNotFoundError):
                raise FileNotFoundError(f"{place}: no such object") from None
            raise StorageTrouble(f"{place}: {_first_line(error)}") from None


def _parent_at(depth: int, path: str) -> str | None:
    """Return the folder of ``depth`` + 1 parts that an object lies in, None when it has no more parts."""
    parts = path.split("/", depth + 1)
    return "/".join(parts[:-1]) if len(parts) == depth + 2 else None


def _first_line(error: Exception) -> str:
    """Return the part of an obstore error that is for people, without the server's XML."""
    return str(error).splitlines()[0].partition(": <?xml")[0]


def require_access(place: str) -> None:
    """Look whether what lies below a canonical ``s3://bucket/prefix`` can be listed. Takes seconds at most.

    Raises:
        InvalidInput: There is no such bucket, it does not let us in, or the extra is missing.
        StorageTrouble: It cannot be reached now.

    """
    storage = _open(place, _QUICK, _QUICK_CLIENT)
    try:
        storage.has_folder()
    except StorageTrouble as error:
        if re.search(r"status code: 40[13]\b", str(error)):  # of a listing, obstore says so in words only
            raise InvalidInput(f"{place}: the bucket does not let this service in: see its AWS_* variables") from None
        raise


def open_bucket(place: str) -> ObjectStorage:
    """Return the storage of a canonical ``s3://bucket/prefix``; see ``open_storage``."""
    return _open(place, RETRY, _CLIENT)


def _open(place: str, retry: Any, client_options: Any) -> ObjectStorage:
    try:
        from obstore.exceptions import BaseError
        from obstore.store import S3Store
    except ImportError:
        raise InvalidInput(f"{place} needs the S3 extra: pip install motionlabel[s3]") from None
    bucket, _, prefix = place.removeprefix(places.S3).partition("/")
    try:
        store = S3Store(
            bucket,
            prefix=prefix or None,
            client_options=client_options,
            retry_config=retry,
        )
    except BaseError as error:
        raise InvalidInput(f"cannot use {place}: {_first_line(error)}") from None
    return ObjectStorage(place, store)
