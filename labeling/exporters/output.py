"""The folder that an export goes to, local or in a bucket."""

import contextlib
import io
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO, Final

from labeling.storage.storage import open_storage
from schemas.errors import ShardConflict

_CHUNK_BYTES: Final = 8 << 20


class ExportFolder:
    """Takes whole files, and counts them. A file that is there is kept when it is the same, and refused when not."""

    def __init__(self, place: str | Path) -> None:
        self._storage = open_storage(place)
        self._prepared: set[str] = set()
        self.num_written = 0
        self.num_kept = 0

    def put(self, path: str, content: bytes | Path) -> None:
        """Put bytes, or what a local file holds, at ``path``, below the folder.

        Raises:
            InvalidInput: Nothing can be written there.
            ShardConflict: Something else is there.
            StorageTrouble: Disk or network refused.

        """
        parent = path.rpartition("/")[0]
        if parent not in self._prepared:
            self._storage.prepare((parent,))
            self._prepared.add(parent)
        if self._storage.publish(path, content):
            self.num_written += 1
        elif self._holds(path, content):
            self.num_kept += 1
        else:
            raise ShardConflict(
                f"{self._storage.place(path)} is there with other content, of other labels, options or versions: "
                "delete it, or choose another --output"
            )

    @contextlib.contextmanager
    def writing(self, path: str) -> Iterator[BinaryIO]:
        """Yield a temporary file to write; when all went well, it is put at ``path``."""
        with tempfile.TemporaryDirectory(prefix="motionlabel-") as folder:
            temporary = Path(folder) / "content"
            with temporary.open("wb") as file:
                yield file
            self.put(path, temporary)

    def _holds(self, path: str, content: bytes | Path) -> bool:
        with content.open("rb") if isinstance(content, Path) else io.BytesIO(content) as ours:
            size = ours.seek(0, io.SEEK_END)
            ours.seek(0)
            return self._storage.size(path) == size and all(
                self._storage.read_range(path, start, start + _CHUNK_BYTES) == ours.read(_CHUNK_BYTES)
                for start in range(0, size, _CHUNK_BYTES)
            )
