"""Read a label folder: its manifests, and each segment's tables, checked against them."""

import hashlib
import json
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO, get_args

import pyarrow as pa
import pyarrow.parquet as pq
from pydantic import ValidationError

from labeling.folders.reservations import reserved_identity
from labeling.storage.storage import Storage, open_storage
from schemas.errors import InvalidInput
from schemas.manifest import Manifest, SegmentEntry, Shard
from schemas.reservation import Reserved
from schemas.tables import READABLE_VERSIONS, TABLES

BROKEN_SHARD = "no whole Parquet file (an incomplete copy? delete it and label again)"
_MISSING = "{} is missing, but its manifest lists it: label the segment again"
_COPY_BYTES = 1 << 20
METADATA_PREFIX = "motionlabel."  # of the keys in a shard's schema metadata


@dataclass(frozen=True, slots=True)
class LabelFolder:
    """A label folder as it stood when it was opened."""

    storage: Storage
    manifests: tuple[Manifest, ...]
    entries: Mapping[str, SegmentEntry]  # of each segment that has labels

    @classmethod
    def open(cls, output: str | Path) -> "LabelFolder":
        """Open a local folder or ``s3://`` prefix.

        Raises:
            InvalidInput: No folder, no manifest, or a manifest that is broken or of an unknown version.

        """
        storage = open_storage(output)
        paths = sorted(path for path in storage.list_files("manifests") if path.endswith(".json"))
        manifests = tuple(read_manifest(storage, path) for path in paths)
        if not manifests:
            raise InvalidInput(f"no labels at {output}: expected manifests/*.json, as `motionlabel label` writes them")
        return cls(storage, manifests, _join_entries(storage, manifests))

    @property
    def segment_ids(self) -> tuple[str, ...]:
        """Segments that have labels, sorted."""
        return tuple(sorted(self.entries))

    @property
    def segments_without_labels(self) -> tuple[str, ...]:
        """Segments that failed in every run, sorted."""
        told = {entry.segment_id for manifest in self.manifests for entry in manifest.segments}
        return tuple(sorted(told - set(self.entries)))

    @property
    def recommended_min_score(self) -> float:
        """Score below which labels are more often wrong than right; the strictest of the manifests."""
        return max(manifest.recommended_min_score for manifest in self.manifests)

    def entry(self, segment_id: str) -> SegmentEntry:
        """Return what the manifests say of a segment.

        Raises:
            InvalidInput: The folder has no labels of it.

        """
        if segment_id not in self.entries:
            raise InvalidInput(
                f"{self.storage.root} holds no labels of segment {segment_id}: it has {_some(sorted(self.entries))}"
            )
        return self.entries[segment_id]

    def table(self, name: str, segment_id: str) -> pa.Table | None:
        """Return one table of a segment (see ``schemas.tables``), or None when that table was not written.

        Raises:
            InvalidInput: Unknown table or segment, or a file that is not what the manifest says.

        """
        shard = self.shard(name, segment_id)
        return None if shard is None else read_shard(self._read_checked(shard), self.storage.place(shard.path))

    def row_groups(self, name: str, segment_id: str) -> Iterator[pa.Table]:
        """Yield a table of a segment row group by row group, that of points sweep by sweep; none when it is absent.

        Beside the file, which is compressed, one group at a time is in memory.

        Raises:
            InvalidInput: As ``table``.

        """
        shard = self.shard(name, segment_id)
        if shard is not None:
            file = _open_shard(self._read_checked(shard), self.storage.place(shard.path))
            for number in range(file.num_row_groups):
                yield file.read_row_group(number, use_threads=False)

    def shard(self, name: str, segment_id: str) -> Shard | None:
        """Return the manifest's line on one table of a segment, None when that table was not written.

        Raises:
            InvalidInput: Unknown table or segment.

        """
        if name not in TABLES:
            raise InvalidInput(f"unknown table {name!r}: expected one of {', '.join(TABLES)}")
        return next((shard for shard in self.entry(segment_id).shards if shard.table == name), None)

    def _read_checked(self, shard: Shard) -> bytes:
        place = f"{self.storage.root}/{shard.path}"
        try:
            content = self.storage.read(shard.path)
        except FileNotFoundError:
            raise InvalidInput(_MISSING.format(place)) from None
        _require_same(place, shard, len(content), hashlib.sha256(content).hexdigest())
        return content


def copy_shard(storage: Storage, shard: Shard, file: BinaryIO) -> None:
    """Copy a shard of a label folder into an empty file, piece by piece, and go back to its beginning.

    Raises:
        InvalidInput: It is missing, or not what the manifest says.
        StorageTrouble: Disk or network refused.

    """
    digest, size = hashlib.sha256(), 0
    while size <= shard.bytes:  # one piece more than there should be tells that it has grown
        try:
            piece = storage.read_range(shard.path, size, size + _COPY_BYTES)
        except FileNotFoundError:
            raise InvalidInput(_MISSING.format(storage.place(shard.path))) from None
        if not piece:
            break
        digest.update(piece)
        file.write(piece)
        size += len(piece)
    _require_same(storage.place(shard.path), shard, size, digest.hexdigest())
    file.seek(0)


def _require_same(place: str, shard: Shard, num_bytes: int, sha256: str) -> None:
    if num_bytes != shard.bytes:
        raise InvalidInput(
            f"{place} has {num_bytes} bytes, its manifest says {shard.bytes}: "
            "an incomplete copy? Copy it again, or delete it and label again"
        )
    if sha256 != shard.sha256:
        raise InvalidInput(f"{place} was changed after it was written: delete it and label again")


def _join_entries(storage: Storage, manifests: Sequence[Manifest]) -> dict[str, SegmentEntry]:
    """Return what all manifests together say of each segment that has labels."""
    told: dict[str, list[SegmentEntry]] = defaultdict(list)
    for manifest in manifests:
        for entry in manifest.segments:
            if entry.state != "FAILED":
                told[entry.segment_id].append(entry)
    return {segment_id: _join(storage, entries) for segment_id, entries in told.items()}


def _join(storage: Storage, told: Sequence[SegmentEntry]) -> SegmentEntry:
    """Return what several manifests say of one segment: all its shards, whichever run wrote them.

    Manifests stay when labels are deleted and made anew. Of two shards of a table the one counts that the folder is
    reserved for.
    """
    shards = {shard.path: shard for entry in told for shard in entry.shards}
    if len({shard.table for shard in shards.values()}) < len(shards):
        reserved = [reserved_identity(storage, told[0].segment_id, table) for table in get_args(Reserved)]
        names = tuple(f"-{identity}.parquet" for identity in reserved if identity)
        shards = {path: shard for path, shard in shards.items() if path.endswith(names)} or shards
    of_table = {shard.table: shard for shard in shards.values()}
    speaker = next((entry for entry in reversed(told) if of_table.get("labels") in entry.shards), told[-1])
    return speaker.model_copy(update={"shards": tuple(of_table[table] for table in TABLES if table in of_table)})


def read_shard(content: bytes, place: str) -> pa.Table:
    """Return the table in a shard's bytes; ``place`` is its name in messages.

    Raises:
        InvalidInput: Not a shard, or one of an unknown version.

    """
    file = _open_shard(content, place)
    try:
        # Not pq.read_table, and no threads: with torch loaded, reading bytes in Arrow's threads just before the process
        # ends aborts it every other time ("terminate called without an active exception"; pyarrow 26).
        return file.read(use_threads=False)
    except (pa.ArrowException, OSError) as error:
        raise _broken(place, error) from None


def _open_shard(content: bytes, place: str) -> pq.ParquetFile:
    try:
        file = pq.ParquetFile(pa.BufferReader(content))
    except (pa.ArrowException, OSError) as error:
        raise _broken(place, error) from None
    version = (file.schema_arrow.metadata or {}).get(f"{METADATA_PREFIX}schema_version".encode(), b"none").decode()
    _check_version(version, place)
    return file


def _broken(place: str, error: Exception) -> InvalidInput:
    return InvalidInput(f"{place} is {BROKEN_SHARD}: {str(error).splitlines()[0]}")


def read_manifest(storage: Storage, path: str) -> Manifest:
    """Read one manifest.

    Raises:
        InvalidInput: Not a manifest, or one of an unknown version.

    """
    place = f"{storage.root}/{path}"
    try:
        values: Any = json.loads(storage.read(path))
        version = str(values["schema_version"])
    except (ValueError, KeyError, TypeError):
        raise InvalidInput(f"{place} is not a manifest: expected JSON with a schema_version") from None
    _check_version(version, place)
    try:
        return Manifest.model_validate(values)
    except ValidationError as error:
        problem = error.errors()[0]
        raise InvalidInput(
            f"{place} is not a manifest: {'.'.join(map(str, problem['loc']))}: {problem['msg']}"
        ) from None


def publish_manifest(storage: Storage, manifest: Manifest) -> None:
    """Put the manifest in place of an earlier one of its identity, unless that was complete and this one is not."""
    path = f"manifests/{manifest.identity}.json"
    try:
        if read_manifest(storage, path).is_complete and not manifest.is_complete:
            return
    except (FileNotFoundError, InvalidInput):  # none yet, or one that nobody can read
        pass
    storage.replace(path, (manifest.model_dump_json(indent=2) + "\n").encode())


def _check_version(version: str, place: str) -> None:
    if version not in map(str, READABLE_VERSIONS):
        readable = ", ".join(map(str, READABLE_VERSIONS))
        raise InvalidInput(f"{place} has schema version {version}: this motionlabel reads {readable}")


def _some(names: list[str]) -> str:
    return ", ".join(names[:3]) + (f" and {len(names) - 3} more" if len(names) > 3 else "") if names else "none"
