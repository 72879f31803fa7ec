"""What a dispatcher has others do, on the Ray that its process has joined. Nothing in here waits for Ray."""

from collections.abc import Collection, Sequence
from typing import Any, Final

import ray
from ray import ObjectRef
from ray import exceptions as rex

from schemas.api.jobs import Failure
from schemas.config import LabelingConfig
from schemas.errors import WorkerLost
from schemas.manifest import SegmentEntry
from workers import cluster
from workers.aggregator import Aggregator
from workers.attempts import Attempt
from workers.background import in_background
from workers.jobs.claims import Claim, FinishedJob
from workers.pipeline import Limits
from workers.segment_labeler import Assignment

_Aggregator: Final[Any] = Aggregator  # to Ray's types an actor is a plain class


class Publication:
    """A job's manifest on its way."""

    def __init__(self, written: ObjectRef[Any]) -> None:
        self._written = written

    @property
    def is_ended(self) -> bool:
        """True when ``outcome`` has something to say."""
        return bool(ray.wait([self._written], timeout=0)[0])

    def outcome(self) -> Failure | None:
        """Return why an ended publication failed, None when it did not.

        Raises:
            WorkerLost: Whoever was to write it died.

        """
        try:
            ray.get(self._written)
        except rex.RayTaskError as error:
            cause = error.cause
            return Failure(error=type(cause).__name__, message=f"the manifest was not published: {cause}")
        except rex.RayError as error:
            raise WorkerLost(f"whoever publishes the manifest died: {str(error).splitlines()[0]}") from None
        return None


class RayWorkers:
    """Starts attempts and publications, and keeps one aggregator for each job at work."""

    def __init__(self) -> None:
        self._machines = cluster.cpus_of_machines()
        self._asked = in_background(cluster.cpus_of_machines)
        self._aggregators: dict[str, Any] = {}  # by job

    def num_cpus(self) -> int:
        """Return how many CPUs the cluster had when it was last heard of, and ask again."""
        if self._asked.done():
            if self._asked.exception() is None:
                self._machines = self._asked.result()
            self._asked = in_background(cluster.cpus_of_machines)
        return int(sum(self._machines.values()))

    def probe(self) -> cluster.HealthProbe:
        """Ask whether the cluster is well."""
        return cluster.HealthProbe()

    def start(self, claim: Claim, config: LabelingConfig, limits: Limits) -> Attempt:
        """Start an attempt at a claimed segment."""
        assignment = Assignment(claim.dataset, claim.uri, claim.output_uri, config, limits)
        return Attempt(assignment, self._aggregator(claim, config), self._machines)

    def publish(self, job: FinishedJob, config: LabelingConfig, entries: Sequence[SegmentEntry]) -> Publication:
        """Start publishing a job's manifest."""
        return Publication(self._aggregator(job, config).publish_manifest.remote(entries))

    def keep(self, job_ids: Collection[str]) -> None:
        """Let go of the aggregators of all other jobs: each ends when nobody holds it."""
        for job_id in self._aggregators.keys() - job_ids:
            del self._aggregators[job_id]

    def _aggregator(self, job: Claim | FinishedJob, config: LabelingConfig) -> Any:
        if job.job_id not in self._aggregators:
            self._aggregators[job.job_id] = _Aggregator.remote(job.dataset, job.output_uri, config)
        return self._aggregators[job.job_id]
