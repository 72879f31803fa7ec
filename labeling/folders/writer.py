"""Write the three tables of one segment, a sweep at a time, and publish them when they are whole."""

import dataclasses
import hashlib
import io
import json
import logging
import tempfile
from collections.abc import Iterable, Sequence
from contextlib import ExitStack
from pathlib import Path
from types import TracebackType

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from labeling.folders.folder import METADATA_PREFIX
from labeling.folders.identity import code_version, shard_paths
from labeling.geometry.transforms import transform_points
from labeling.stages.attribution import Claim, PointMotion, attribute_points, claims_by_sweep
from labeling.storage.storage import Storage
from schemas.arrays import Float32Array
from schemas.config import LabelingConfig
from schemas.manifest import Shard
from schemas.objects import LabeledTrack, SweepObservation, SweepPoints
from schemas.tables import SCHEMA_VERSION, SCHEMAS, Table, labels, points, sweeps
from schemas.tables.labels import LabelRows
from schemas.tables.points import PointRows

_LOGGER = logging.getLogger(__name__)
_SPILLED = pa.schema(  # what is known of a point before its segment is tracked
    [
        pa.field("point_index", pa.int32()),
        *(pa.field(f"{axis}_m", pa.float32()) for axis in "xyz"),  # ego frame
        pa.field("is_dynamic", pa.bool_()),
        pa.field("cluster_id", pa.int32()),
        *(pa.field(f"flow_{axis}_m", pa.float32()) for axis in "xyz"),  # world axes
    ]
)


class SegmentShardWriter:
    """Collects one segment's rows; nothing is visible in the label folder before ``publish``.

    Points wait on disk, a batch a sweep, until tracking has named their tracks, so memory does not grow with them.
    The same rows give the same bytes.
    """

    def __init__(self, storage: Storage, dataset: str, segment_id: str, config: LabelingConfig) -> None:
        self._storage = storage
        self._dataset = dataset
        self._segment_id = segment_id
        self._paths = shard_paths(segment_id, config)
        self._metadata = {
            f"{METADATA_PREFIX}{key}": value
            for key, value in {
                "schema_version": str(SCHEMA_VERSION),
                "code_version": code_version(),
                "config": json.dumps(config.model_dump(mode="json"), sort_keys=True),
                "frame": "world",
            }.items()
        }
        self._params = config.attribution
        self._sweeps: list[SweepObservation] = []
        self._spilled: list[int] = []  # which of them have points in the spill
        self._tracks: list[LabeledTrack] = []
        self._resources = ExitStack()

    def __enter__(self) -> "SegmentShardWriter":
        """Open the temporary files."""
        self._folder = Path(self._resources.enter_context(tempfile.TemporaryDirectory(prefix="motionlabel-")))
        self._spill = self._resources.enter_context(pa.ipc.new_file(str(self._folder / "spill.arrow"), _SPILLED))
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Remove the temporary files."""
        self._resources.close()

    def add_sweep(self, observation: SweepObservation) -> None:
        """Take the next sweep, in order."""
        self._sweeps.append(dataclasses.replace(observation, proposals=(), points=None))
        if "points" in self._paths and observation.points is not None:
            self._spilled.append(len(self._sweeps) - 1)
            self._spill.write_batch(_spilled_batch(observation.points))

    def add_tracks(self, tracks: Iterable[LabeledTrack]) -> None:
        """Take all tracks of the segment, once all sweeps are in."""
        self._tracks.extend(tracks)

    def publish(self) -> tuple[Shard, ...]:
        """Write the final files and publish each, unless another run was first: then what it published is described.

        Raises:
            OSError: Disk or network refused.

        """
        self._spill.close()
        write = {"labels": self._write_labels, "sweeps": self._write_sweeps, "points": self._write_points}
        for table in self._paths:
            write[table](self._folder / f"{table}.parquet")
        return tuple(self._publish_one(table, path) for table, path in self._paths.items())

    def _publish_one(self, table: str, path: str) -> Shard:
        source = self._folder / f"{table}.parquet"
        with source.open("rb") as file:
            ours = describe_shard(table, path, file)
        if self._storage.publish(path, source):
            return ours
        theirs = describe_shard(table, path, io.BytesIO(self._storage.read(path)))
        if theirs != ours:
            _LOGGER.info("%s was published before, with other bytes: another kind of CPU?", path)
        return theirs

    def _parquet(self, table: Table, path: Path) -> pq.ParquetWriter:
        return pq.ParquetWriter(path, SCHEMAS[table].with_metadata(self._metadata), compression="zstd")

    def _write_sweeps(self, path: Path) -> None:
        with self._parquet("sweeps", path) as file:
            file.write_table(sweeps.to_table(self._dataset, self._segment_id, self._sweeps))

    def _write_labels(self, path: Path) -> None:
        with self._parquet("labels", path) as file:
            file.write_table(labels.to_table(self._dataset, self._segment_id, LabelRows.of_tracks(self._tracks)))

    def _write_points(self, path: Path) -> None:
        """Second pass: say of each point what it belongs to, one row group a sweep."""
        claims = claims_by_sweep(self._tracks)
        with self._parquet("points", path) as file, pa.ipc.open_file(str(self._folder / "spill.arrow")) as spill:
            for number, sweep in enumerate(self._spilled):
                found = _points_of(spill.get_batch(number))
                of_sweep = claims.get(self._sweeps[sweep].sweep_index, ())
                motion = self._attribute(sweep, found, of_sweep)
                if motion.is_dynamic.any():
                    rows = _point_rows(self._sweeps[sweep], found, motion, of_sweep)
                    file.write_table(points.to_table(self._dataset, self._segment_id, rows))

    def _attribute(self, sweep: int, found: SweepPoints, claims: Sequence[Claim]) -> PointMotion:
        observation = self._sweeps[sweep]
        later = (other.timestamp_ns for other in self._sweeps[sweep + 1 :] if not other.is_rejected)
        gap_s = (next(later, observation.timestamp_ns) - observation.timestamp_ns) * 1e-9
        points_world = transform_points(observation.world_from_ego, found.points_ego)
        return attribute_points(found, points_world, claims, gap_s, self._params)


def _point_rows(
    observation: SweepObservation, found: SweepPoints, motion: PointMotion, claims: Sequence[Claim]
) -> PointRows:
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


def describe_shard(table: str, path: str, file: io.BufferedReader | io.BytesIO) -> Shard:
    """Return the manifest's line on a shard, read from its bytes."""
    content_hash = hashlib.file_digest(file, "sha256").hexdigest()
    size = file.seek(0, io.SEEK_END)
    file.seek(0)
    return Shard(
        table=table,
        path=path,
        rows=pq.read_metadata(file).num_rows,
        bytes=size,
        sha256=content_hash,
    )


def _spilled_batch(points: SweepPoints) -> pa.RecordBatch:
    size, flow = len(points.point_index), points.flow_world_m
    columns = [
        points.point_index,
        *points.points_ego.T,
        points.is_dynamic,
        points.cluster_id,
        *(pa.nulls(size) if flow is None else flow[:, axis] for axis in range(3)),
    ]
    return pa.record_batch([pa.array(c, type=field.type) for c, field in zip(columns, _SPILLED, strict=True)], _SPILLED)


def _points_of(batch: pa.RecordBatch) -> SweepPoints:
    def columns(names: Sequence[str]) -> Float32Array:
        return np.stack([batch[name].to_numpy() for name in names], axis=1)

    has_flow = batch["flow_x_m"].null_count == 0
    return SweepPoints(
        columns(["x_m", "y_m", "z_m"]),
        batch["point_index"].to_numpy(),
        batch["is_dynamic"].to_numpy(zero_copy_only=False),
        batch["cluster_id"].to_numpy(),
        columns(["flow_x_m", "flow_y_m", "flow_z_m"]) if has_flow else None,
    )
