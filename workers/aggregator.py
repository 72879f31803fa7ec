"""Actor: writes the shards of one job's segments, each once and whole, and the job's manifest."""

from collections.abc import Sequence
from dataclasses import dataclass

import ray

from labeling.folders.entries import (
    describe_segment,
    find_published,
    make_manifest,
    prepare_folder,
)
from labeling.folders.folder import publish_manifest
from labeling.folders.identity import LabelSet
from labeling.folders.spill import ObservationSpill
from labeling.folders.writer import publish_segment
from labeling.storage.storage import open_storage
from schemas.config import LabelingConfig
from schemas.errors import WorkerLost
from schemas.manifest import SegmentEntry
from schemas.objects import LabeledTrack, SweepObservation


@dataclass(slots=True)
class _OpenSegment:
    attempt: str
    label_set: LabelSet
    spill: ObservationSpill


@ray.remote(num_cpus=0, max_restarts=-1)
class Aggregator:
    """One a job. It holds what the sweeps of running segments show; points wait on its disk, see ``ObservationSpill``.

    When it dies it comes back empty: attempts that were under way find their sweeps gone and end; others follow.
    """

    def __init__(self, dataset: str, output: str, config: LabelingConfig) -> None:
        self._dataset, self._config = dataset, config
        self._storage = open_storage(output)
        self._is_prepared = False
        self._open: dict[str, _OpenSegment] = {}

    def begin(self, label_set: LabelSet, uri: str, attempt: str) -> SegmentEntry | None:
        """Take a segment in, or return its entry when all its shards are published. An earlier attempt is forgotten.

        Raises:
            InvalidInput: The output cannot be written or read.
            ShardConflict: Labels of other settings or other code are in the way.

        """
        if not self._is_prepared:
            prepare_folder(self._storage, self._config)
            self._is_prepared = True
        published = find_published(self._storage, label_set, uri)
        if published is not None:
            return published
        segment_id = label_set.segment_id
        if segment_id in self._open:
            self.forget(segment_id, self._open[segment_id].attempt)
        spill = ObservationSpill(keeps_points=self._config.write_points)
        self._open[segment_id] = _OpenSegment(attempt, label_set, spill)
        return None

    def add_sweep(self, segment_id: str, attempt: str, observation: SweepObservation) -> None:
        """Take the next sweep of a segment."""
        self._held(segment_id, attempt).spill.append(observation)

    def publish(self, segment_id: str, uri: str, attempt: str, tracks: Sequence[LabeledTrack]) -> SegmentEntry:
        """Write and publish the shards of a segment whose sweeps are all in."""
        held = self._held(segment_id, attempt)
        shards = publish_segment(self._storage, held.label_set, held.spill.restore(), tracks)
        self.forget(segment_id, attempt)
        return describe_segment(self._storage, segment_id, uri, shards)

    def forget(self, segment_id: str, attempt: str) -> None:
        """Drop what an attempt left that did not publish."""
        held = self._open.get(segment_id)
        if held and held.attempt == attempt:
            self._open.pop(segment_id).spill.close()

    def close(self) -> None:
        """Drop what all attempts left."""
        for segment_id in list(self._open):
            self._open.pop(segment_id).spill.close()

    def publish_manifest(self, entries: Sequence[SegmentEntry]) -> None:
        """Put the job's manifest in place, its segments sorted by id."""
        ordered = sorted(entries, key=lambda entry: entry.segment_id)
        publish_manifest(self._storage, make_manifest(self._dataset, ordered, self._config))

    def _held(self, segment_id: str, attempt: str) -> _OpenSegment:
        held = self._open.get(segment_id)
        if held is None or held.attempt != attempt:
            raise WorkerLost(f"attempt {attempt} at {segment_id} is over: another has begun, or its sweeps were lost")
        return held
