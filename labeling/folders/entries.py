"""The manifest's entries: what is published of each segment, and what to say of those that have no labels."""

import io
from collections.abc import Iterable, Sequence
from typing import Final

import pyarrow.compute as pc

from labeling.folders.folder import METADATA_PREFIX, read_shard
from labeling.folders.identity import code_version, make_identity, shard_paths
from labeling.folders.writer import describe_shard
from labeling.storage.storage import Storage
from schemas.config import LabelingConfig
from schemas.errors import InvalidInput, ShardConflict
from schemas.manifest import Manifest, SegmentEntry, Shard
from schemas.tables import TABLES

RECOMMENDED_MIN_SCORE: Final = 0.5
_IDENTITY_DIGITS: Final = 16


def prepare_folder(storage: Storage, config: LabelingConfig) -> None:
    """Make the folders that a run with this config writes, and prove that it can.

    Raises:
        InvalidInput: Something stands in the way; the message says what.

    """
    storage.prepare((*TABLES, "manifests") if config.write_points else ("labels", "sweeps", "manifests"))


def list_published(storage: Storage) -> set[str]:
    """Return the paths of all shards of a label folder.

    Raises:
        InvalidInput: The folder cannot be read.

    """
    try:
        return {path for table in TABLES for path in storage.list_files(table)}
    except OSError as error:
        raise InvalidInput(f"cannot read {storage.root}: {error}") from None


def refuse_conflicts(
    storage: Storage, published: Iterable[str], segment_ids: Iterable[str], config: LabelingConfig
) -> None:
    """Raise ShardConflict when labels of one of the segments stand there that other settings or other code made."""
    ours = {segment_id: make_identity([segment_id], config) for segment_id in segment_ids}
    for path in sorted(published):
        name = path.rpartition("/")[2].removesuffix(".parquet")
        segment_id, theirs = name[: -_IDENTITY_DIGITS - 1], name[-_IDENTITY_DIGITS:]
        if ours.get(segment_id, theirs) != theirs:
            metadata = read_shard(storage.read(path), f"{storage.root}/{path}").schema.metadata
            is_same_code = metadata[f"{METADATA_PREFIX}code_version".encode()].decode() == code_version()
            raise ShardConflict(
                f"{storage.root} already holds labels of {segment_id} made with other "
                f"{'settings' if is_same_code else 'code'} (identity {theirs}, this run has {ours[segment_id]}): "
                "choose another --output, or delete the old labels"
            )


def describe_published(storage: Storage, segment_id: str, uri: str, config: LabelingConfig) -> SegmentEntry:
    """Return the entry of a segment whose shards are all published, whoever wrote them."""
    shards = tuple(
        describe_shard(table, path, io.BytesIO(storage.read(path)))
        for table, path in shard_paths(segment_id, config).items()
    )
    return describe_segment(storage, segment_id, uri, shards)


def describe_segment(storage: Storage, segment_id: str, uri: str, shards: tuple[Shard, ...]) -> SegmentEntry:
    """Return the entry of a segment, counted from its published shards."""
    paths = {shard.table: shard.path for shard in shards}
    sweeps = read_shard(storage.read(paths["sweeps"]), f"{storage.root}/{paths['sweeps']}")
    labels = read_shard(storage.read(paths["labels"]), f"{storage.root}/{paths['labels']}")
    rejected = sweeps.filter(pc.field("status") == "rejected")["reason"].to_pylist()
    num_failed_fits = pc.sum(sweeps["num_failed_fits"]).as_py()
    reasons = [f"{len(rejected)} of {len(sweeps)} sweeps rejected, the first: {rejected[0]}"] if rejected else []
    if num_failed_fits:
        reasons.append(f"{num_failed_fits} flow fits failed")
    return SegmentEntry(
        segment_id=segment_id,
        uri=uri,
        state="PARTIAL" if reasons else "SUCCEEDED",
        reason="; ".join(reasons),
        num_sweeps=len(sweeps),
        num_rejected_sweeps=len(rejected),
        num_failed_fits=num_failed_fits,
        num_tracks=pc.count_distinct(labels["track_id"]).as_py(),
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
        identity=make_identity([segment.segment_id for segment in segments], config),
        dataset=dataset,
        config=config.model_dump(mode="json"),
        config_hash=config.config_hash,
        code_version=code_version(),
        recommended_min_score=RECOMMENDED_MIN_SCORE,
        segments=tuple(segments),
    )
