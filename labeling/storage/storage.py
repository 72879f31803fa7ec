"""Files below one place, on a disk or in a bucket, behind one protocol: what is read and what is written.

A file is complete or absent: readers never see half of one. ``publish`` is create-only: the first complete writer wins
and writing again is a no-op. Paths are relative to the place, with ``/`` between their parts. Names that begin with a
dot are temporary, and never listed.

All methods raise ``StorageTrouble``, with a message of one line, for whatever the disk or the network refuses: it says
nothing about the data. What is absent is a ``FileNotFoundError`` where it was to be read.
"""

from collections.abc import Iterator
from datetime import datetime
from pathlib import Path
from typing import Protocol

from labeling.storage import places


class Storage(Protocol):
    """The files below one place. It can be pickled: whoever gets it opens the place anew."""

    root: str  # a canonical place

    def place(self, path: str) -> str:
        """Return the canonical name of a path, for people."""
        return places.join(self.root, path) if path else self.root

    def list_files(self, folder: str = "") -> Iterator[str]:
        """Yield the paths of the files directly in ``folder``, in no certain order; none when there is no such folder.

        Lazily: the memory it takes does not grow with their number.
        """
        ...

    def list_folders(self, folder: str = "") -> Iterator[str]:
        """Yield the paths of the folders directly in ``folder``, as lazily and in as little order."""
        ...

    def has_folder(self, folder: str = "") -> bool:
        """Return whether there is such a folder; a bucket has it when it holds a file."""
        ...

    def last_modified(self, folder: str) -> datetime | None:
        """Return when the newest of the files directly in ``folder`` was written; None when there is no file."""
        ...

    def size(self, path: str) -> int | None:
        """Return the bytes of the file at ``path``, None when there is none."""
        ...

    def read(self, path: str) -> bytes:
        """Return the content of the file at ``path``; raise FileNotFoundError when there is none."""
        ...

    def read_range(self, path: str, start: int, stop: int) -> bytes:
        """Return bytes ``start`` to ``stop`` of a file, as a slice of its content: fewer where it ends before."""
        ...

    def publish(self, path: str, content: bytes | Path) -> bool:
        """Put bytes, or what a local file holds, at ``path``; return False when something is there: it stays."""
        ...

    def replace(self, path: str, content: bytes) -> None:
        """Put ``content`` at ``path`` in one step, whatever was there."""
        ...

    def prepare(self, folders: tuple[str, ...]) -> None:
        """Make the folders and prove that files can be published in them, before any work is done.

        Raises:
            InvalidInput: Nothing can be written at this place; the message says why.

        """
        ...


def open_storage(place: str | Path) -> Storage:
    """Return the storage of a place: a path, which may be relative, or a URI. Nothing is created yet.

    S3 takes its endpoint, region and credentials from the usual ``AWS_*`` variables.

    Raises:
        InvalidInput: No place, or S3 without the extra it needs.

    """
    root = places.canonical(places.absolute(str(place)))
    if root.startswith(places.S3):
        from labeling.storage.bucket import open_bucket

        return open_bucket(root)
    from labeling.storage.local import LocalStorage

    return LocalStorage(root)
