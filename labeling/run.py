"""Label whole segments in this process: from their readers to the shards and the manifest of a label folder."""

import dataclasses
import io
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final, Literal

import numpy as np
import pyarrow.compute as pc
import threadpoolctl
import torch

from labeling.readers.reader import SegmentReader, make_segment_id, open_segment
from labeling.shards.folder import METADATA_PREFIX, publish_manifest, read_shard
from labeling.shards.identity import code_version, make_identity, shard_paths
from labeling.shards.storage import Storage, open_storage
from labeling.shards.writer import SegmentShardWriter, describe_shard
from labeling.stages.pipeline import label_tracks, make_clock, observe_sweeps, sweep_range
from schemas.config import LabelingConfig
from schemas.errors import InvalidInput, LabelingError, ShardConflict
from schemas.manifest import Manifest, SegmentEntry, Shard
from schemas.objects import SweepObservation
from schemas.shards import TABLES

RECOMMENDED_MIN_SCORE: Final = 0.5
_IDENTITY_DIGITS: Final = 16


@dataclass(frozen=True, slots=True)
class RunProgress:
    """One step of a run, for whoever watches."""

    segment_id: str
    stage: Literal["sweeps", "tracks", "finished", "already there"]
    sweeps_done: int
    num_sweeps: int


def label_segments(
    dataset: str,
    uris: Sequence[str],
    output: str | Path,
    config: LabelingConfig,
    *,
    on_progress: Callable[[RunProgress], None] = lambda _: None,
) -> Manifest:
    """Label segments, one after the other, and write a label folder.

    A segment that fails leaves the others alone; one whose shards stand already is not labelled again. The manifest is
    brought up to date after each segment, so what is complete stays readable whatever ends the run.

    Raises:
        InvalidInput: No segment can be opened, one is given twice, or the output cannot be written.
        ShardConflict: The output holds labels of one of the segments from other settings or other code.

    """
    _use_one_thread()
    storage = open_storage(output)
    readers, entries = _open_all(dataset, uris, config)
    segment_ids = sorted([*readers, *entries])
    published = {path for table in TABLES for path in _listed(storage, table)}
    _refuse_conflicts(storage, published, segment_ids, config)
    storage.prepare((*TABLES, "manifests") if config.write_points else ("labels", "sweeps", "manifests"))

    def publish() -> None:
        segments = tuple(entries[segment_id] for segment_id in segment_ids)
        publish_manifest(storage, _manifest(dataset, segments, config))

    try:
        for segment_id, reader in readers.items():
            if published.issuperset(shard_paths(segment_id, config).values()):
                entries[segment_id] = _describe_published(storage, reader, config)
                on_progress(RunProgress(segment_id, "already there", 0, entries[segment_id].num_sweeps))
            else:
                entries[segment_id] = _failed(segment_id, reader.uri, "not labelled yet")
        publish()
        for segment_id, reader in sorted(readers.items()):
            if not entries[segment_id].shards:
                entries[segment_id] = _label_or_fail(reader, storage, config, on_progress)
                publish()
    except OSError as error:
        raise InvalidInput(f"disk or network trouble while writing {output}: {error}; run it again to go on") from error
    return _manifest(dataset, tuple(entries[segment_id] for segment_id in segment_ids), config)


def _use_one_thread() -> None:
    """Keep this process to one core: small batches run many times slower on more threads (benchmarks/README.md)."""
    torch.set_num_threads(1)
    threadpoolctl.threadpool_limits(1)


def _open_all(
    dataset: str, uris: Sequence[str], config: LabelingConfig
) -> tuple[dict[str, SegmentReader], dict[str, SegmentEntry]]:
    """Return readers by segment id, and entries of the segments that have none."""
    readers: dict[str, SegmentReader] = {}
    entries: dict[str, SegmentEntry] = {}
    for uri in uris:
        try:
            reader = open_segment(dataset, uri)
            sweep_range(reader, config)
        except InvalidInput as error:
            segment_id = _id_of_unopened(uri)
            entry = _failed(segment_id, uri, str(error))
            is_repeated = segment_id in entries
            entries[segment_id] = entry
        else:
            is_repeated = reader.segment_id in readers
            readers[reader.segment_id] = reader
        if is_repeated:
            raise InvalidInput(f"segment {uri} is given twice")
    if not readers:
        reasons = [entry.reason for entry in entries.values()] or ["no segment is given"]
        raise InvalidInput(reasons[0] + (f" (and {len(reasons) - 1} more such segments)" if len(reasons) > 1 else ""))
    return readers, entries


def _id_of_unopened(uri: str) -> str:
    """Return the id that readers of local folders give, so that a later run with the folder there has the same name."""
    folder = Path(uri).expanduser().resolve()
    return make_segment_id(uri, uri) if ":" in uri else make_segment_id(folder.name, folder.as_uri())


def _failed(segment_id: str, uri: str, reason: str) -> SegmentEntry:
    return SegmentEntry(segment_id=segment_id, uri=uri, state="FAILED", reason=reason)


def _listed(storage: Storage, folder: str) -> tuple[str, ...]:
    try:
        return storage.list_files(folder)
    except OSError as error:
        raise InvalidInput(f"cannot read {storage.root}: {error}") from None


def _refuse_conflicts(
    storage: Storage, published: Iterable[str], segment_ids: Sequence[str], config: LabelingConfig
) -> None:
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


def _label_or_fail(
    reader: SegmentReader, storage: Storage, config: LabelingConfig, on_progress: Callable[[RunProgress], None]
) -> SegmentEntry:
    num_sweeps = len(sweep_range(reader, config))
    observations: list[SweepObservation] = []
    try:
        with SegmentShardWriter(storage, reader.dataset, reader.segment_id, config) as writer:
            on_progress(RunProgress(reader.segment_id, "sweeps", 0, num_sweeps))
            for observation in observe_sweeps(reader, config):
                writer.add_sweep(observation)
                observations.append(_without_points(observation))
                on_progress(RunProgress(reader.segment_id, "sweeps", len(observations), num_sweeps))
            if all(observation.is_rejected for observation in observations):
                reason = f"all {num_sweeps} sweeps were rejected, the first: {observations[0].reason}"
                entry = _failed(reader.segment_id, reader.uri, reason)
                rejected = {"num_sweeps": num_sweeps, "num_rejected_sweeps": num_sweeps}
                return entry.model_copy(update=rejected)
            on_progress(RunProgress(reader.segment_id, "tracks", num_sweeps, num_sweeps))
            proposals = [observation.proposals for observation in observations]
            writer.add_tracks(label_tracks(proposals, make_clock(observations), config, reader.segment_id))
            shards = writer.publish()
    except LabelingError as error:
        return _failed(reader.segment_id, reader.uri, str(error))
    finally:
        on_progress(RunProgress(reader.segment_id, "finished", len(observations), num_sweeps))
    return _describe(storage, reader, shards)


def _without_points(observation: SweepObservation) -> SweepObservation:
    """Drop what only the points table needs: tracking looks at the proposals."""
    none = np.empty(0, dtype=np.int32)
    return dataclasses.replace(observation, point_index=none, cluster_id=none, flow_world_m=None)


def _describe_published(storage: Storage, reader: SegmentReader, config: LabelingConfig) -> SegmentEntry:
    shards = tuple(
        describe_shard(table, path, io.BytesIO(storage.read(path)))
        for table, path in shard_paths(reader.segment_id, config).items()
    )
    return _describe(storage, reader, shards)


def _describe(storage: Storage, reader: SegmentReader, shards: tuple[Shard, ...]) -> SegmentEntry:
    """Return the manifest's entry, counted from the published shards, whoever wrote them."""
    paths = {shard.table: shard.path for shard in shards}
    sweeps = read_shard(storage.read(paths["sweeps"]), f"{storage.root}/{paths['sweeps']}")
    labels = read_shard(storage.read(paths["labels"]), f"{storage.root}/{paths['labels']}")
    rejected = sweeps.filter(pc.field("status") == "rejected")["reason"].to_pylist()
    num_failed_fits = pc.sum(sweeps["num_failed_fits"]).as_py()
    reasons = [f"{len(rejected)} of {len(sweeps)} sweeps rejected, the first: {rejected[0]}"] if rejected else []
    if num_failed_fits:
        reasons.append(f"{num_failed_fits} flow fits failed")
    return SegmentEntry(
        segment_id=reader.segment_id,
        uri=reader.uri,
        state="PARTIAL" if reasons else "SUCCEEDED",
        reason="; ".join(reasons),
        num_sweeps=len(sweeps),
        num_rejected_sweeps=len(rejected),
        num_failed_fits=num_failed_fits,
        num_tracks=pc.count_distinct(labels["track_id"]).as_py(),
        shards=shards,
    )


def _manifest(dataset: str, segments: tuple[SegmentEntry, ...], config: LabelingConfig) -> Manifest:
    return Manifest(
        identity=make_identity([segment.segment_id for segment in segments], config),
        dataset=dataset,
        config=config.model_dump(mode="json"),
        config_hash=config.config_hash,
        code_version=code_version(),
        recommended_min_score=RECOMMENDED_MIN_SCORE,
        segments=segments,
    )
