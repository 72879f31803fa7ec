"""One stored file as a Python file object, for libraries that read parts of large files."""

import io

from labeling.storage.storage import Storage


class RangeFile(io.RawIOBase):
    """A file of a storage; each read is one request."""

    def __init__(self, storage: Storage, path: str, size: int) -> None:
        self._storage, self._path, self._size = storage, path, size
        self._position = 0

    def readable(self) -> bool:
        """Return True."""
        return True

    def seekable(self) -> bool:
        """Return True."""
        return True

    def tell(self) -> int:
        """Return where the next read begins."""
        return self._position

    def seek(self, offset: int, whence: int = io.SEEK_SET) -> int:
        """Move to a byte, counted from the start, from here or from the end."""
        start = {io.SEEK_SET: 0, io.SEEK_CUR: self._position, io.SEEK_END: self._size}[whence]
        self._position = max(start + offset, 0)
        return self._position

    def read(self, size: int | None = -1) -> bytes:
        """Return the next ``size`` bytes, all that are left when it is negative or None; fewer at the end."""
        stop = self._size if size is None or size < 0 else min(self._position + size, self._size)
        content = self._storage.read_range(self._path, self._position, stop)
        self._position += len(content)
        return content
