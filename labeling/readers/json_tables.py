"""Tables as JSON lists of flat records, up to gigabytes: records are found by a token and read alone."""

import hashlib
import re
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final, TypeVar

from pydantic import BaseModel, ConfigDict, ValidationError

from labeling.storage.storage import Storage
from schemas.errors import InvalidInput, LabelingError, UnreadableSweep

_CHUNK_BYTES: Final = 8 << 20
_MAX_RECORD_BYTES: Final = 1 << 20
_RECORD: Final = re.compile(rb"\{[^{}]*\}")  # no table that is searched nests objects, or has braces in its texts
_BETWEEN: Final = b" \t\r\n,["


class Record(BaseModel):
    """A row of a table: what is read of it."""

    model_config = ConfigDict(frozen=True, allow_inf_nan=False)


RecordT = TypeVar("RecordT", bound=Record)


@dataclass(frozen=True, slots=True)
class Span:
    """Where a record stands, and the digest of what stood there."""

    path: str
    start: int
    stop: int
    digest: str

    @classmethod
    def parse(cls, name: str) -> "Span":
        """Return what ``str`` made a name of."""
        path, _, place = name.rpartition("#")
        start, stop, digest = place.split("-")
        return cls(path, int(start), int(stop), digest)

    def __str__(self) -> str:
        """Return a name for listings."""
        return f"{self.path}#{self.start}-{self.stop}-{self.digest}"

    def read(self, storage: Storage, model: type[RecordT], error: type[LabelingError] = UnreadableSweep) -> RecordT:
        """Read the record again, by a request for its bytes alone; raise ``error`` if it is another one now."""
        place = f"{storage.place(self.path)}: byte {self.start}"
        try:
            content = storage.read_range(self.path, self.start, self.stop)
        except FileNotFoundError:
            raise error(f"{storage.place(self.path)}: no such file") from None
        if _digest(content) != self.digest:
            raise error(f"{place}: the record has changed since the scene was listed")
        return parse_record(model, content, place, error)


def find_records(
    storage: Storage, path: str, model: type[RecordT], field: str, wanted: set[str]
) -> Iterator[tuple[Span, RecordT]]:
    """Yield the records whose ``field`` is one of ``wanted``, in the order of the table, a chunk in memory at a time.

    Raises:
        InvalidInput: No such table, it ends within a record, or a record that is found is not as the schema has it.

    """
    place, size = storage.place(path), storage.size(path)
    if size is None:
        raise InvalidInput(f"{place}: no such file")
    key, tokens = re.compile(rb'"%s"\s*:\s*"([^"]*)"' % field.encode()), {token.encode() for token in wanted}
    rest, start = b"", 0  # of the file, what is not read to the end of a record yet, and where it begins
    for position in range(0, size, _CHUNK_BYTES):
        rest += storage.read_range(path, position, min(position + _CHUNK_BYTES, size))
        stop = 0
        for record in _RECORD.finditer(rest):
            stop = record.end()
            found = key.search(rest, record.start(), stop)
            if found and found[1] in tokens:
                span = Span(path, start + record.start(), start + stop, _digest(record[0]))
                yield span, parse_record(model, record[0], f"{place}: byte {span.start}", InvalidInput)
        rest, start = rest[stop:], start + stop
        if len(rest) > _MAX_RECORD_BYTES:
            break
    if rest.strip(_BETWEEN) != b"]":
        raise InvalidInput(f"{place}: byte {start}: expected a list of flat records, truncated?")


def parse_record(model: type[RecordT], content: bytes, place: str, error: type[LabelingError]) -> RecordT:
    """Return a record, or raise ``error`` with what is wrong with it."""
    try:
        return model.model_validate_json(content)
    except ValidationError as problem:
        first = problem.errors()[0]
        where = ".".join(map(str, first["loc"])) or "record"
        raise error(f"{place}: {where}: {first['msg']}") from None


def _digest(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()[:16]
