"""Actor: prepares the label folder of one job, and puts the job's manifest in place."""

from collections.abc import Sequence

import ray

from labeling.folders.entries import make_manifest, prepare_folder
from labeling.folders.folder import publish_manifest
from labeling.storage.storage import open_storage
from schemas.config import LabelingConfig
from schemas.manifest import SegmentEntry


@ray.remote(num_cpus=0, max_restarts=-1, max_task_retries=-1)
class Aggregator:
    """One a job. Its segments are written by tasks of their own; it holds nothing that would be lost with it."""

    def __init__(self, dataset: str, output: str, config: LabelingConfig) -> None:
        self._dataset, self._config = dataset, config
        self._storage = open_storage(output)
        self._is_prepared = False

    def prepare(self) -> None:
        """Make the folders that shards go to, once.

        Raises:
            InvalidInput: The output cannot be written or read.

        """
        if not self._is_prepared:
            prepare_folder(self._storage, self._config)
            self._is_prepared = True

    def publish_manifest(self, entries: Sequence[SegmentEntry]) -> None:
        """Put the job's manifest in place, its segments sorted by id."""
        ordered = sorted(entries, key=lambda entry: entry.segment_id)
        publish_manifest(self._storage, make_manifest(self._dataset, ordered, self._config))
