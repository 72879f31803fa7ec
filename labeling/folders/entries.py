"""The manifest's entries: what is published of each segment, and what to say of those that have no labels."""

import io
from collections.abc import Sequence

import numpy as np

from labeling.folders.folder import read_shard
from labeling.folders.identity import LABEL_VERSION, LabelSet, code_version, manifest_identity
from labeling.folders.reservations import is_reserved, reserve_older
from labeling.folders.writer import describe_shard
from labeling.storage.storage import Storage
from schemas.config import LabelingConfig
from schemas.manifest import RECOMMENDED_MIN_SCORE, Manifest, SegmentEntry, Shard
from schemas.reservation import RESERVATIONS
from schemas.tables import TABLES, labels, sweeps


def prepare_folder(storage: Storage, config: LabelingConfig) -> None:
    """Make the folders that a run with this config writes, prove that it can, and take note of what stands there.

    Raises:
        InvalidInput: Something stands in the way; the message says what.

    """
    tables = [table for table in TABLES if table != "points" or config.write_points]
    storage.prepare((*tables, RESERVATIONS, "manifests"))
    reserve_older(storage)


def find_published(storage: Storage, label_set: LabelSet, uri: str) -> SegmentEntry | None:
    """Return the entry of a segment whose shards are all published, whoever wrote them; None when one is missing.

    It costs a read a reservation, and a read a shard where all is reserved.

    Raises:
        ShardConflict: Other labels of the segment stand there.

    """
    if not is_reserved(storage, label_set):
        return None
    try:
        shards = [
            describe_shard(table, path, io.BytesIO(storage.read(path)), f"{storage.root}/{path}")
            for table, path in label_set.paths.items()
        ]
    except FileNotFoundError:
        return None
    return describe_segment(storage, label_set.segment_id, uri, tuple(shards))


def describe_segment(storage: Storage, segment_id: str, uri: str, shards: tuple[Shard, ...]) -> SegmentEntry:
    """Return the entry of a segment, counted from its published shards."""
    tables = {
        shard.table: read_shard(storage.read(shard.path), f"{storage.root}/{shard.path}")
        for shard in shards
        if shard.table != "points"
    }
    observations = sweeps.from_table(tables["sweeps"])
    rejected = [observation.reason for observation in observations if observation.is_rejected]
    num_failed_fits = sum(observation.num_failed_fits for observation in observations)
    reasons = [f"{len(rejected)} of {len(observations)} sweeps rejected, the first: {rejected[0]}"] if rejected else []
    if num_failed_fits:
        reasons.append(f"{num_failed_fits} flow fits failed")
    return SegmentEntry(
        segment_id=segment_id,
        uri=uri,
        state="PARTIAL" if reasons else "SUCCEEDED",
        reason="; ".join(reasons),
        num_sweeps=len(observations),
        num_rejected_sweeps=len(rejected),
        num_failed_fits=num_failed_fits,
        num_tracks=len(np.unique(labels.from_table(tables["labels"]).track_id)),
        shards=shards,
    )


def failed_entry(segment_id: str, uri: str, reason: str) -> SegmentEntry:
    """Return the entry of a segment that has no labels."""
    return SegmentEntry(segment_id=segment_id, uri=uri, state="FAILED", reason=reason)


def all_rejected_entry(segment_id: str, uri: str, num_sweeps: int, first_reason: str) -> SegmentEntry:
    """Return the entry of a segment without one usable sweep."""
    return SegmentEntry(
        segment_id=segment_id,
        uri=uri,
        state="FAILED",
        reason=f"all {num_sweeps} sweeps were rejected, the first: {first_reason}",
        num_sweeps=num_sweeps,
        num_rejected_sweeps=num_sweeps,
    )


def make_manifest(dataset: str, segments: Sequence[SegmentEntry], config: LabelingConfig) -> Manifest:
    """Return the manifest of these segments, in this order."""
    return Manifest(
        identity=manifest_identity([segment.segment_id for segment in segments], config),
        dataset=dataset,
        config=config.model_dump(mode="json"),
        config_hash=config.config_hash,
        label_version=LABEL_VERSION,
        code_version=code_version(),
        recommended_min_score=RECOMMENDED_MIN_SCORE,
        segments=tuple(segments),
    )
