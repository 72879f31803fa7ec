"""What backfills have asked for: one numbered record a batch, beside the labels, on which any number of runs agree.

A record is put before its batch is submitted: create-only, whole, and with the ``client_job_id`` that its job will
have. So a run may be killed at any moment: a segment stands in one record or in none, and submitting a record once more
gives the job that is there. A batch whose segments are all labelled gets a mark, and is never submitted again. See
docs/decisions/0011-a-ledger-beside-the-labels.md.
"""

import hashlib
import json
import secrets
import sqlite3
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

from pydantic import BaseModel, ConfigDict, ValidationError

from labeling.storage.storage import Storage
from schemas.errors import InvalidInput

FOLDER: Final = "backfill"
_NOT_OF_LABELS: Final = ("priority",)  # whoever asks for the same labels, sooner or later, goes by the same records


class Record(BaseModel):
    """One batch, as it stands in its file."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    shard: str  # of the run that found the segments, as "2/4"; empty: it found all
    request: dict[str, Any]  # the body of the job

    @property
    def segments(self) -> list[str]:
        """What is to be labelled."""
        return list(self.request["segments"])


@dataclass(frozen=True)
class Batch:
    """A record and its number."""

    number: int
    record: Record


class Ledger:
    """The records of all runs that ask for the same of each segment, below one place.

    What was asked for is kept in a temporary database while the run lasts: memory does not grow with it.
    """

    def __init__(self, storage: Storage, template: Mapping[str, Any], shard: str = "") -> None:
        """Take what each job asks for, its segments left out; ``shard`` as in ``Record``. Nothing is read yet."""
        labels = {name: value for name, value in template.items() if name not in _NOT_OF_LABELS}
        identity = hashlib.sha256(json.dumps(labels, sort_keys=True).encode()).hexdigest()[:16]
        self._storage = storage
        self._folder = f"{FOLDER}/{identity}"
        self._template = template
        self._shard = shard
        self._next = 0  # number of the first record that is not known
        self._done = {path for path in storage.list_files(self._folder) if path.endswith(".done")}
        self._segments = sqlite3.connect("")  # a file that is gone when it is closed
        self._segments.execute("CREATE TABLE asked (name TEXT PRIMARY KEY, is_ours INTEGER) WITHOUT ROWID")
        self.num_done = 0  # segments that were labelled in earlier runs

    def close(self) -> None:
        """Forget what was read."""
        self._segments.close()

    def __contains__(self, segment: str) -> bool:
        """Return whether a segment was asked for, by whomever."""
        return self._is_ours(segment) is not None

    def is_new(self, segment: str) -> bool:
        """Return whether a segment was not asked for when this run began."""
        return self._is_ours(segment) in (None, True)

    def prepare(self) -> None:
        """Prove that records can be put.

        Raises:
            InvalidInput: They cannot.

        """
        try:
            self._storage.prepare((self._folder,))
        except InvalidInput as error:
            raise InvalidInput(f"{error}, or a --ledger where this command may write") from None

    def read_new(self) -> list[Batch]:
        """Read the records that were put since the last look, and return those that this run has to see through.

        These are the ones of its own shard, or all where it has none. Done ones are left out.

        Raises:
            InvalidInput: A file that is no record.

        """
        batches = []
        while (record := self._read(self._next)) is not None:
            self._learn(record.segments, is_ours=False)
            if self._path(self._next, "done") in self._done:
                self.num_done += len(record.segments)
            elif self._shard in ("", record.shard):
                batches.append(Batch(self._next, record))
            self._next += 1
        return batches

    def claim(self, segments: Sequence[str]) -> list[Batch]:
        """Put a record of those segments that nobody has asked for yet.

        Returns:
            What is to be submitted now: the new batch, if any is left for it, behind those that other runs have put
            meanwhile. Whoever reads a record submits it, for whoever put it may be dead.

        """
        batches: list[Batch] = []
        while fresh := [segment for segment in dict.fromkeys(segments) if segment not in self]:
            job = f"backfill-{secrets.token_hex(8)}"
            record = Record(shard=self._shard, request={**self._template, "segments": fresh, "client_job_id": job})
            if self._storage.publish(self._path(self._next, "json"), record.model_dump_json().encode()):
                self._learn(fresh, is_ours=True)
                self._next += 1
                return [*batches, Batch(self._next - 1, record)]
            batches += self.read_new()
        return batches

    def mark_done(self, batch: Batch) -> None:
        """Note that all segments of a batch are labelled."""
        self._storage.publish(self._path(batch.number, "done"), b"")

    def _read(self, number: int) -> Record | None:
        path = self._path(number, "json")
        try:
            return Record.model_validate_json(self._storage.read(path))
        except FileNotFoundError:
            return None
        except ValidationError:
            raise InvalidInput(f"{self._storage.place(path)} is no record of a backfill: was it changed?") from None

    def _path(self, number: int, kind: str) -> str:
        return f"{self._folder}/{number:08d}.{kind}"

    def _is_ours(self, segment: str) -> bool | None:
        row = self._segments.execute("SELECT is_ours FROM asked WHERE name = ?", (segment,)).fetchone()
        return None if row is None else bool(row[0])

    def _learn(self, segments: Iterable[str], *, is_ours: bool) -> None:
        with self._segments:
            self._segments.executemany(
                "INSERT OR IGNORE INTO asked VALUES (?, ?)", ((segment, is_ours) for segment in segments)
            )
