"""Label segments on a Ray of our own on this machine, without a job store: `motionlabel label --workers N`."""

import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, Final

import ray

from labeling.folders.entries import failed_entry
from labeling.readers.reader import SegmentReader
from labeling.run import OnProgress, RunProgress, Stage, label_segments
from labeling.storage.storage import Storage
from schemas.config import LabelingConfig
from schemas.errors import WorkerLost
from schemas.manifest import Manifest, SegmentEntry
from workers.aggregator import Aggregator
from workers.attempts import Attempt
from workers.cluster import cpus_of_machines, local_cluster
from workers.pipeline import MAX_ATTEMPTS, plan_limits, segments_at_once
from workers.processes import CpuMeter
from workers.schedule import Step
from workers.segment_labeler import Assignment, Progress

_TICK_S: Final = 0.3
_Aggregator: Any = Aggregator  # to Ray's types an actor is a plain class


def label_segments_on_ray(
    dataset: str,
    uris: Sequence[str],
    output: str | Path,
    config: LabelingConfig,
    *,
    num_workers: int,
    on_progress: OnProgress = lambda _: None,
) -> tuple[Manifest, float]:
    """Label segments and write a label folder on a Ray of ``num_workers`` CPUs. The shards are the same.

    Returns:
        The manifest, and the core-seconds that all processes together took.

    """
    start_s = time.process_time()
    meter = CpuMeter()

    def start_and_label(
        readers: Sequence[SegmentReader], storage: Storage, config: LabelingConfig, on_progress: OnProgress
    ) -> Iterator[SegmentEntry]:
        if readers:
            with local_cluster(num_workers):
                yield from label_readers(num_workers, readers, storage, config, on_progress)

    def watch(step: RunProgress) -> None:
        meter.read_core_s()
        on_progress(step)

    manifest = label_segments(dataset, uris, output, config, start_and_label, on_progress=watch)
    return manifest, meter.read_core_s() + time.process_time() - start_s


def label_readers(
    num_workers: int,
    readers: Sequence[SegmentReader],
    storage: Storage,
    config: LabelingConfig,
    on_progress: OnProgress,
    *,
    hook: Callable[[Step], None] | None = None,
) -> Iterator[SegmentEntry]:
    """Label segments on the Ray that this process has joined, some at once; yield their entries as they end."""
    aggregator = _Aggregator.remote(readers[0].dataset, storage.root, config)
    num_at_once = min(segments_at_once(num_workers), len(readers))
    limits = plan_limits(num_workers, num_at_once)
    machines = cpus_of_machines()
    waiting = [_Segment(reader, on_progress) for reader in reversed(readers)]
    running: list[tuple[_Segment, Attempt]] = []
    while waiting or running:
        while waiting and len(running) < num_at_once:
            segment = waiting.pop()
            reader = segment.reader
            assignment = Assignment(
                reader.dataset, reader.uri, storage.root, config, limits, hook, listing=reader.listing
            )
            running.append((segment, Attempt(assignment, aggregator, machines)))
        ray.wait([attempt.running for _, attempt in running], timeout=_TICK_S)
        for segment, attempt in list(running):
            segment.tell(attempt.progress())
            if attempt.is_ended:
                running.remove((segment, attempt))
                entry = segment.end(attempt)
                if entry is None:
                    waiting.append(segment)
                else:
                    yield entry


class _Segment:
    """A segment on its way: its attempts, and what was told of it."""

    def __init__(self, reader: SegmentReader, on_progress: OnProgress) -> None:
        self.reader = reader
        self._on_progress = on_progress
        self._num_attempts = 0
        self._last = RunProgress(reader.segment_id, "sweeps", -1, 0)

    def tell(self, progress: Progress) -> None:
        """Pass progress on, each sweep once."""
        for done in range(self._last.sweeps_done + 1, progress.sweeps_done + 1):
            if progress.num_sweeps:
                self._say("sweeps", done, progress.num_sweeps)
        if progress.stage == "tracks" and self._last.stage == "sweeps":
            self._say("tracks", progress.sweeps_done, progress.num_sweeps)

    def end(self, attempt: Attempt) -> SegmentEntry | None:
        """Return the entry, or None when the segment is to be tried again."""
        self._num_attempts += 1
        try:
            entry = attempt.outcome().entry
        except WorkerLost as error:
            if self._num_attempts < MAX_ATTEMPTS:
                return None
            entry = failed_entry(self.reader.segment_id, self.reader.uri, str(error))
        finally:
            attempt.kill()
        self._say("finished", self._last.sweeps_done, self._last.num_sweeps)
        return entry

    def _say(self, stage: Stage, sweeps_done: int, num_sweeps: int) -> None:
        self._last = RunProgress(self.reader.segment_id, stage, sweeps_done, num_sweeps)
        self._on_progress(self._last)
