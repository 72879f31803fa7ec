"""How many of each worker run at once, what each reserves, and why. The only place that decides it.

| worker | Ray | CPUs | processes |
|---|---|---|---|
| StaticRemoval | actor | 0 | ``streams`` a running segment: a third of the work, held back by ``sweeps_ahead`` |
| fit_batch, finish, track_segment | tasks | 1 | as many as the cluster has CPUs: the rest of the work |
| SegmentLabeler | actor | 0 | one a running segment: passes references on, computes nothing |
| Aggregator | actor | 0 | one a job: writes files |

StaticRemoval reserves no CPU, since it would hold it while it waits for the fits, and on one CPU for ever.
"""

from dataclasses import dataclass
from typing import Final

# Tasks reserve memory, so that a node never starts more of them than it can hold: the libraries take 350 MB, the
# largest batch (``labeling.stages.flow.MAX_BATCH_PAIRS``) less than 150 MB.
TASK_MEMORY_BYTES: Final = 512 * 2**20
OBJECT_STORE_BYTES: Final = 2**30  # proposals of running segments: 0.5 MB a sweep; Ray spills to disk beyond
MAX_ATTEMPTS: Final = 3  # of one sweep's preparation, one sweep's end, one segment's tracking, within one claim
CHUNK_SWEEPS: Final = 40  # of one stream among several: each chunk reads 25 sweeps again on either side
_CPUS_A_STREAM: Final = 3  # fits take twice the time of all that comes before them


@dataclass(frozen=True, slots=True)
class Limits:
    """Bounds of one segment's work in flight."""

    streams: int  # StaticRemoval actors
    chunk_sweeps: int | None  # sweeps that one of them prepares in a row; None: all there are, no sweep is read twice
    sweeps_ahead: int  # prepared and not yet written: 1-2 MB each
    fits_in_flight: int  # running or waiting for a CPU: enough that no CPU waits for us, few enough to cancel fast


def segments_at_once(num_cpus: int) -> int:
    """Return how many segments to label at once: two keep the CPUs busy while one is tracked or just begins."""
    return max(2, num_cpus // _CPUS_A_STREAM)


def plan_limits(num_cpus: int, num_segments: int) -> Limits:
    """Return the limits of each of ``num_segments`` that share ``num_cpus``.

    One stream a segment costs least. Only a segment that has many CPUs to itself is cut into chunks.
    """
    cpus = max(1, num_cpus // max(1, num_segments))
    streams = max(1, cpus // _CPUS_A_STREAM)
    chunk_sweeps = CHUNK_SWEEPS if streams > 1 else None
    return Limits(
        streams, chunk_sweeps, sweeps_ahead=(streams * CHUNK_SWEEPS if chunk_sweeps else 8), fits_in_flight=2 * cpus
    )
