"""What makes labels the same labels: their segments, the configuration and the code that made them."""

import functools
import hashlib
import json
from collections.abc import Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Final

from schemas.config import LabelingConfig
from schemas.tables import TABLES

_ROOT: Final = Path(__file__).resolve().parents[2]
_WITHOUT_SAY = ("labeling/evaluation/", "labeling/pictures.py")  # code that reads labels and cannot change them


@functools.cache
def code_version() -> str:
    """Return the package version plus a digest of the source that decides labels: changed code, other identity."""
    digest = hashlib.sha256()
    for file in sorted(file for room in ("schemas", "labeling") for file in (_ROOT / room).rglob("*.py")):
        name = file.relative_to(_ROOT).as_posix()
        if not name.startswith(_WITHOUT_SAY):
            digest.update(f"{name}\0".encode() + file.read_bytes() + b"\0")
    return f"{version('motionlabel')}+{digest.hexdigest()[:12]}"


def make_identity(segment_ids: Sequence[str], config: LabelingConfig) -> str:
    """Return 16 hex digits that name the labels of these segments, whatever their order."""
    content = [sorted(segment_ids), config.config_hash, code_version()]
    return hashlib.sha256(json.dumps(content).encode()).hexdigest()[:16]


def shard_paths(segment_id: str, config: LabelingConfig) -> dict[str, str]:
    """Return the path of each table's shard that a complete segment has, in the order of publishing."""
    identity = make_identity([segment_id], config)
    tables = [table for table in TABLES if table != "points" or config.write_points]
    return {table: f"{table}/{segment_id}-{identity}.parquet" for table in tables}
