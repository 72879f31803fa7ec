"""What makes labels the same labels: the segment, what was read of it, the parameters, and the label version."""

import functools
import hashlib
import json
from collections.abc import Sequence
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Final

from labeling.readers.reader import SegmentReader
from schemas.config import LabelingConfig
from schemas.tables import SCHEMA_VERSION, TABLES, Table

LABEL_VERSION: Final = 3
"""One more with each change that makes other labels of the same input; docs/decisions/0002 says how."""

_ROOT: Final = Path(__file__).resolve().parents[2]
_WITHOUT_SAY = ("labeling/evaluation/", "labeling/pictures.py")  # code that reads labels and cannot change them


@dataclass(frozen=True, slots=True)
class LabelSet:
    """The labels of one segment as one config makes them: which shards a label folder gets, and what they are called.

    Tables that the same values decide share an identity: ``labels`` and ``sweeps`` one, ``points`` another.
    """

    dataset: str
    segment_id: str
    content: str  # digest of what is read of the segment
    config: LabelingConfig
    label_version: int = LABEL_VERSION

    @classmethod
    def of(cls, reader: SegmentReader, config: LabelingConfig) -> "LabelSet":
        """Return what this config makes of an opened segment."""
        return cls(reader.dataset, reader.segment_id, reader.listing.digest, config, LABEL_VERSION)

    def identity(self, table: Table) -> str:
        """Return 16 hex digits that follow from all that decides the table, and from nothing else."""
        return _digest(self.dataset, self.segment_id, self.content, self.config.deciding(table), self.label_version)

    @property
    def paths(self) -> dict[Table, str]:
        """Path of each shard of the whole set, in the order of publishing."""
        tables = [table for table in TABLES if table != "points" or self.config.write_points]
        return {table: f"{table}/{self.segment_id}-{self.identity(table)}.parquet" for table in tables}

    def metadata(self, table: Table) -> dict[str, str]:
        """Return what a shard says of itself."""
        return {
            "schema_version": str(SCHEMA_VERSION),
            "label_version": str(self.label_version),
            "code_version": code_version(),
            "content": self.content,
            "config": json.dumps(self.config.deciding(table), sort_keys=True),
            "frame": "world",
        }


def manifest_identity(segment_ids: Sequence[str], config: LabelingConfig) -> str:
    """Return 16 hex digits that name a run by what was asked of it: segments, whatever their order, and config."""
    return _digest(sorted(segment_ids), config.config_hash, LABEL_VERSION)


def _digest(*parts: object) -> str:
    return hashlib.sha256(json.dumps(parts, sort_keys=True).encode()).hexdigest()[:16]


@functools.cache
def code_version() -> str:
    """Return the package version plus a digest of the source that labels follow from. It decides nothing.

    It tells whoever looks into a label folder which code made it; what decides is ``LABEL_VERSION``.
    """
    digest = hashlib.sha256()
    for file in sorted(file for room in ("schemas", "labeling") for file in (_ROOT / room).rglob("*.py")):
        name = file.relative_to(_ROOT).as_posix()
        if not name.startswith(_WITHOUT_SAY):
            digest.update(f"{name}\0".encode() + file.read_bytes() + b"\0")
    return f"{version('motionlabel')}+{digest.hexdigest()[:12]}"
