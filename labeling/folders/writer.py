"""Write the tables of one segment and publish them: all that happens to its files, in one place and one process."""

import dataclasses
import hashlib
import io
import logging
import tempfile
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from labeling.folders.folder import BROKEN_SHARD, METADATA_PREFIX
from labeling.folders.identity import LabelSet
from labeling.folders.reservations import reserve
from labeling.geometry.transforms import transform_points
from labeling.stages.attribution import Claim, attribute_points, claims_by_sweep
from labeling.storage.storage import Storage
from schemas.config import AttributionParams
from schemas.errors import InvalidInput
from schemas.manifest import Shard
from schemas.objects import LabeledTrack, SweepObservation, SweepPoints
from schemas.tables import SCHEMAS, Table, labels, points, sweeps
from schemas.tables.labels import LabelRows
from schemas.tables.points import PointRows

_LOGGER = logging.getLogger(__name__)
_VERSIONS = ("label_version", "code_version")


def publish_segment(
    storage: Storage, label_set: LabelSet, observations: Iterable[SweepObservation], tracks: Sequence[LabeledTrack]
) -> tuple[Shard, ...]:
    """Write a segment's shards to a temporary folder, reserve the segment, then publish each, unless another was first.

    The same rows give the same bytes. What another run published under the same identity stays, and is described.

    Args:
        storage: The label folder, prepared.
        label_set: What is made.
        observations: Of all its sweeps, in order, with points when these are to be written. They are gone through once,
            and no more than three are held at a time.
        tracks: Of the whole segment.

    Raises:
        ShardConflict: Labels of the segment stand there, or are about to, that other settings or other code made.
        StorageTrouble: Disk or network refused.

    """
    with tempfile.TemporaryDirectory(prefix="motionlabel-") as folder:
        return publish_files(storage, label_set, _write_tables(Path(folder), label_set, observations, tracks))


def publish_files(storage: Storage, label_set: LabelSet, files: Mapping[Table, Path]) -> tuple[Shard, ...]:
    """Reserve the segment, then publish its files one by one. Whatever ends it, it can be done again.

    Raises:
        ShardConflict: Labels of the segment stand there, or are about to, that other settings or other code made.
        StorageTrouble: Disk or network refused.

    """
    reserve(storage, label_set)
    return tuple(_publish_shard(storage, table, path, files[table]) for table, path in label_set.paths.items())


def describe_shard(table: Table, path: str, file: io.BufferedReader | io.BytesIO, place: str) -> Shard:
    """Return the manifest's line on a shard, read from its bytes; ``place`` is its name in messages.

    Raises:
        InvalidInput: Not a shard.

    """
    content_hash = hashlib.file_digest(file, "sha256").hexdigest()
    size = file.seek(0, io.SEEK_END)
    file.seek(0)
    try:
        footer = pq.read_metadata(file)
    except pa.ArrowException as error:
        raise InvalidInput(f"{place} is {BROKEN_SHARD}: {str(error).splitlines()[0]}") from None
    said = {name: (footer.metadata or {}).get(f"{METADATA_PREFIX}{name}".encode(), b"").decode() for name in _VERSIONS}
    return Shard(
        table=table,
        path=path,
        rows=footer.num_rows,
        bytes=size,
        sha256=content_hash,
        label_version=int(said["label_version"]) if said["label_version"] else None,
        code_version=said["code_version"],
    )


def _publish_shard(storage: Storage, table: Table, path: str, source: Path) -> Shard:
    with source.open("rb") as file:
        ours = describe_shard(table, path, file, str(source))
    if storage.publish(path, source):
        return ours
    theirs = describe_shard(table, path, io.BytesIO(storage.read(path)), f"{storage.root}/{path}")
    if theirs != ours:
        _LOGGER.info("%s was published before, with other bytes: by other code, or another kind of CPU?", path)
    return theirs


def _write_tables(
    folder: Path, label_set: LabelSet, observations: Iterable[SweepObservation], tracks: Sequence[LabeledTrack]
) -> Mapping[Table, Path]:
    """Write all files of a segment, in one pass over its sweeps."""
    key = label_set.dataset, label_set.segment_id
    files = {table: folder / f"{table}.parquet" for table in label_set.paths}

    def parquet(table: Table) -> pq.ParquetWriter:
        metadata = {f"{METADATA_PREFIX}{name}": value for name, value in label_set.metadata(table).items()}
        return pq.ParquetWriter(files[table], SCHEMAS[table].with_metadata(metadata), compression="zstd")

    claims = claims_by_sweep(tracks)
    swept: list[SweepObservation] = []
    with ExitStack() as open_files:
        point_file = open_files.enter_context(parquet("points")) if "points" in files else None
        for observation, gap_s in _with_gaps(observations):
            swept.append(dataclasses.replace(observation, proposals=(), points=None))
            if point_file is not None and observation.points is not None:
                of_sweep = claims.get(observation.sweep_index, ())
                rows = _point_rows(observation, observation.points, gap_s, of_sweep, label_set.config.attribution)
                if len(rows):
                    point_file.write_table(points.to_table(*key, rows))  # a row group a sweep
    with parquet("sweeps") as file:
        file.write_table(sweeps.to_table(*key, swept))
    with parquet("labels") as file:
        file.write_table(labels.to_table(*key, LabelRows.of_tracks(tracks)))
    return files


def _with_gaps(observations: Iterable[SweepObservation]) -> Iterator[tuple[SweepObservation, float]]:
    """Yield each observation with the time to the next usable one, s; zero for the last."""
    waiting: list[SweepObservation] = []
    for observation in observations:
        if not observation.is_rejected:
            for earlier in waiting:
                yield earlier, (observation.timestamp_ns - earlier.timestamp_ns) * 1e-9
            waiting.clear()
        waiting.append(observation)
    for last in waiting:
        yield last, 0.0


def _point_rows(
    observation: SweepObservation,
    found: SweepPoints,
    gap_s: float,
    claims: Sequence[Claim],
    params: AttributionParams,
) -> PointRows:
    """Say of each point whether it moves, and with what."""
    points_world = transform_points(observation.world_from_ego, found.points_ego)
    motion = attribute_points(found, points_world, claims, gap_s, params)
    rows = np.flatnonzero(motion.is_dynamic)
    no_flow = np.full((len(rows), 3), np.nan, dtype=np.float32)
    return PointRows(
        sweep_index=np.full(len(rows), observation.sweep_index),
        timestamp_ns=np.full(len(rows), observation.timestamp_ns),
        point_index=found.point_index[rows],
        flow_world_m=no_flow if motion.flow_world_m is None else motion.flow_world_m[rows],
        cluster_id=found.cluster_id[rows],
        is_in_cluster=found.is_dynamic[rows],
        track_ids=tuple(claim.track_id for claim in claims),
        track=motion.owner[rows],
    )
