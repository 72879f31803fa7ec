"""Actor: writes the shards of one job's segments, each once and whole, and the job's manifest."""

from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field

import ray

from labeling.folders.entries import (
    describe_published,
    describe_segment,
    list_published,
    make_manifest,
    prepare_folder,
    refuse_conflicts,
)
from labeling.folders.folder import publish_manifest
from labeling.folders.identity import shard_paths
from labeling.folders.writer import SegmentShardWriter
from labeling.storage.storage import open_storage
from schemas.config import LabelingConfig
from schemas.errors import WorkerLost
from schemas.manifest import SegmentEntry
from schemas.objects import LabeledTrack, SweepObservation


@dataclass(slots=True)
class _OpenSegment:
    attempt: str
    writer: SegmentShardWriter
    resources: ExitStack = field(default_factory=ExitStack)


@ray.remote(num_cpus=0, max_restarts=-1)
class Aggregator:
    """One a job. It holds a writer for each segment that runs; points wait on its disk, see ``SegmentShardWriter``.

    When it dies it comes back empty: attempts that were under way find their writer gone and end; others follow.
    """

    def __init__(self, dataset: str, output: str, config: LabelingConfig) -> None:
        self._dataset, self._config = dataset, config
        self._storage = open_storage(output)
        self._published: set[str] | None = None  # listed once, for a folder may hold a million segments
        self._open: dict[str, _OpenSegment] = {}

    def begin(self, segment_id: str, uri: str, attempt: str) -> SegmentEntry | None:
        """Take a segment in, or return its entry when all its shards are published. An earlier attempt is forgotten.

        Raises:
            InvalidInput: The output cannot be written or read.
            ShardConflict: Labels of other settings or other code are in the way.

        """
        if self._published is None:
            prepare_folder(self._storage, self._config)
            self._published = list_published(self._storage)
        published = {path for path in self._published if f"/{segment_id}-" in path}
        refuse_conflicts(self._storage, published, [segment_id], self._config)
        if published.issuperset(shard_paths(segment_id, self._config).values()):
            return describe_published(self._storage, segment_id, uri, self._config)
        if segment_id in self._open:
            self.forget(segment_id, self._open[segment_id].attempt)
        writer = SegmentShardWriter(self._storage, self._dataset, segment_id, self._config)
        self._open[segment_id] = _OpenSegment(attempt, writer)
        self._open[segment_id].resources.enter_context(writer)
        return None

    def add_sweep(self, segment_id: str, attempt: str, observation: SweepObservation) -> None:
        """Take the next sweep of a segment."""
        self._writer(segment_id, attempt).add_sweep(observation)

    def publish(self, segment_id: str, uri: str, attempt: str, tracks: Sequence[LabeledTrack]) -> SegmentEntry:
        """Write and publish the shards of a segment whose sweeps are all in."""
        writer = self._writer(segment_id, attempt)
        writer.add_tracks(tracks)
        shards = writer.publish()
        self.forget(segment_id, attempt)
        return describe_segment(self._storage, segment_id, uri, shards)

    def forget(self, segment_id: str, attempt: str) -> None:
        """Drop what an attempt left that did not publish."""
        held = self._open.get(segment_id)
        if held and held.attempt == attempt:
            self._open.pop(segment_id).resources.close()

    def close(self) -> None:
        """Drop what all attempts left."""
        for segment_id in list(self._open):
            self._open.pop(segment_id).resources.close()

    def publish_manifest(self, entries: Sequence[SegmentEntry]) -> None:
        """Put the job's manifest in place, its segments sorted by id."""
        ordered = sorted(entries, key=lambda entry: entry.segment_id)
        publish_manifest(self._storage, make_manifest(self._dataset, ordered, self._config))

    def _writer(self, segment_id: str, attempt: str) -> SegmentShardWriter:
        held = self._open.get(segment_id)
        if held is None or held.attempt != attempt:
            raise WorkerLost(f"attempt {attempt} at {segment_id} is over: another has begun, or its writer was lost")
        return held.writer
