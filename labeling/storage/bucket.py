"""A prefix of an S3 bucket, through obstore."""

import contextlib
import re
from collections.abc import Callable, Iterator
from datetime import timedelta
from itertools import groupby
from pathlib import Path
from typing import Any, Final

from labeling.storage import places
from labeling.storage.storage import Storage
from schemas.errors import InvalidInput, StorageTrouble

RETRY: Final[Any] = {"max_retries": 4, "retry_timeout": timedelta(seconds=30)}
_QUICK: Final[Any] = {"max_retries": 1, "retry_timeout": timedelta(seconds=3)}
_CLIENT: Final[Any] = {"allow_http": True}  # a self-hosted endpoint is often plain http
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
        for path in self._keys(folder):
            name = path.removeprefix(f"{folder}/")
            if "/" not in name and not name.startswith("."):
                yield path

    def list_folders(self, folder: str = "") -> Iterator[str]:
        """Yield what keys with more parts have in common: they come sorted, so those of one folder are neighbours."""
        depth = folder.count("/") + 1 if folder else 0
        inner = (path.split("/")[: depth + 1] for path in self._keys(folder) if path.count("/") > depth)
        return ("/".join(parts) for parts, _ in groupby(inner) if not parts[-1].startswith("."))

    def has_folder(self, folder: str = "") -> bool:
        """Return whether any key begins so."""
        return any(True for _ in self._keys(folder))

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

    def _keys(self, folder: str) -> Iterator[str]:
        """Yield all keys below a folder, sorted, a page at a time."""
        prefix = f"{folder}/" if folder else ""
        with self._one_line_errors(folder):
            for page in self._store.list(prefix):
                for entry in page:
                    if entry["path"].startswith(prefix):  # an object that stands for the folder itself does not
                        yield entry["path"]

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
