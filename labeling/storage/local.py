"""A folder on a local (or mounted) disk. Why it is not obstore's: docs/decisions/0009-a-local-store-of-our-own.md."""

import contextlib
import errno
import os
import secrets
from collections.abc import Iterator
from datetime import UTC, datetime
from pathlib import Path
from typing import Final

from labeling.storage.storage import Storage
from schemas.errors import InvalidInput, StorageTrouble

_ABSENT: Final = (FileNotFoundError, NotADirectoryError, IsADirectoryError)
# What another output folder mends; a full or broken disk may be mended where it is.
_WRONG_PLACE: Final = (
    errno.EACCES, errno.EPERM, errno.EROFS, errno.EEXIST, errno.ENOTDIR, errno.ENAMETOOLONG, errno.ELOOP,
)  # fmt: skip
_CHUNK_BYTES: Final = 1 << 20


class LocalStorage(Storage):
    """A folder on a disk behind the Storage protocol."""

    def __init__(self, root: str) -> None:
        self.root = root
        self._folder = Path(root)

    def list_files(self, folder: str = "") -> Iterator[str]:
        """Yield files; a link that leads nowhere is one too: reading it fails, and says so."""
        return (path for path, is_folder in self._entries(folder) if not is_folder)

    def list_folders(self, folder: str = "") -> Iterator[str]:
        """Yield folders, and links to such."""
        return (path for path, is_folder in self._entries(folder) if is_folder)

    def has_folder(self, folder: str = "") -> bool:
        """Return whether there is such a folder."""
        with _trouble(self._folder / folder):
            return (self._folder / folder).is_dir()

    def last_modified(self, folder: str) -> datetime | None:
        """Return the latest time stamp of a file; a link that leads nowhere has none."""
        newest_s = None
        for path in self.list_files(folder):
            with contextlib.suppress(FileNotFoundError), _trouble(self._folder / path):
                stamp_s = (self._folder / path).stat().st_mtime
                newest_s = stamp_s if newest_s is None else max(newest_s, stamp_s)
        return None if newest_s is None else datetime.fromtimestamp(newest_s, UTC)

    def size(self, path: str) -> int | None:
        """Return the bytes of a file, None when there is none."""
        try:
            with _trouble(self._folder / path), (self._folder / path).open("rb") as file:
                return file.seek(0, os.SEEK_END)
        except FileNotFoundError:
            return None

    def read(self, path: str) -> bytes:
        """Return the content of a file."""
        with _trouble(self._folder / path):
            return (self._folder / path).read_bytes()

    def read_range(self, path: str, start: int, stop: int) -> bytes:
        """Return a slice of a file."""
        with _trouble(self._folder / path), (self._folder / path).open("rb") as file:
            file.seek(start)
            return file.read(max(stop - start, 0))

    def publish(self, path: str, content: bytes | Path) -> bool:
        """Copy beside the target, sync, then link: a link either fails or names a whole file."""
        target = self._folder / path
        with _trouble(target):
            if target.exists():
                return False
            with _temporary_file(target.parent) as temporary:
                _write_synced(temporary, content)
                try:
                    os.link(temporary, target)
                except FileExistsError:
                    return False
            _sync_folder(target.parent)
        return True

    def replace(self, path: str, content: bytes) -> None:
        """Write beside the target, sync, then rename over it."""
        target = self._folder / path
        with _trouble(target):
            with _temporary_file(target.parent) as temporary:
                _write_synced(temporary, content)
                temporary.replace(target)
            _sync_folder(target.parent)

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
                if error.errno in _WRONG_PLACE:
                    raise InvalidInput(
                        f"cannot write labels to {place}: {error.strerror}; choose another --output"
                    ) from None
                raise StorageTrouble(f"{place}: {error.strerror}") from None

    def _entries(self, folder: str) -> Iterator[tuple[str, bool]]:
        """Yield path and whether it is a folder."""
        place = self._folder / folder
        try:
            with _trouble(place), os.scandir(place) as entries:
                for entry in entries:
                    if not entry.name.startswith("."):
                        yield f"{folder}/{entry.name}".lstrip("/"), entry.is_dir()
        except FileNotFoundError:
            return


@contextlib.contextmanager
def _trouble(place: Path) -> Iterator[None]:
    """Turn what the system refuses into a FileNotFoundError or a StorageTrouble of one line."""
    try:
        yield
    except _ABSENT:
        raise FileNotFoundError(f"{place}: no such file") from None
    except OSError as error:
        raise StorageTrouble(f"{place}: {error.strerror}") from None


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
                while chunk := source.read(_CHUNK_BYTES):
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
