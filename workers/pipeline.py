"""How many of each worker run at once, what each reserves, and why. The only place that decides it.

| worker | Ray | CPUs | processes |
|---|---|---|---|
| StaticRemoval | actor | 1 | one a running segment: prepares its sweeps; while it is ahead, takes any step of it |
| ground, static, vote, plan, fit, finish, link, complete, regroup, write | tasks | 1 | as many as CPUs are left |
| SegmentLabeler | actor | 0 | one a running segment: passes references on, computes nothing |
| Aggregator | actor | 0 | one a job: prepares the folder, writes the manifest |

Whatever computes reserves a CPU. Numbers come from benchmarks/scale.py: see docs/decisions/0010.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final

# What a process reserves, so that a node never starts more of them than it can hold: the libraries take 350 MB, the
# largest batch of fits (``labeling.stages.flow.MAX_BATCH_PAIRS``) less than 150 MB.
PROCESS_MEMORY_BYTES: Final = 512 * 2**20
OBJECT_STORE_BYTES: Final = 2**30  # 3 MB for each of some 70 sweeps of a running segment; Ray spills to disk beyond
MAX_ATTEMPTS: Final = 3  # of one step, within one attempt at its segment
GPU_OF_FIT: Final = 0.125  # share of a GPU that whatever fits nets on one reserves: 2 GB of 16
MAX_TASKS: Final = 64  # of one segment: one StaticRemoval feeds some 30 CPUs
TRACK_BATCHES: Final = 32  # into which the tracks of a segment are cut, at most


@dataclass(frozen=True, slots=True)
class Limits:
    """Bounds of one segment's work in flight."""

    cpus: int  # of the cluster, for this segment
    tasks_in_flight: int  # running, or waiting for a CPU: enough that none waits for us, few enough to cancel fast
    sweeps_ahead: int  # prepared and not yet finished, 2 MB each: more than tasks, that its actor has something to do
    ground_ahead: int  # sweeps whose ground is found before they are needed, 3 MB each


def segments_at_once(num_cpus: int) -> int:
    """Return how many segments to label at once.

    With three CPUs each, a segment's actor is busy preparing four fifths of its time and helps in the rest. Fewer
    segments leave the others waiting for it, more make the last ones of a job end later.
    """
    return max(min(2, num_cpus), num_cpus // 3)


def plan_limits(num_cpus: int, num_segments: int) -> Limits:
    """Return the limits of each of ``num_segments`` that share ``num_cpus``."""
    cpus = max(1, num_cpus // max(1, num_segments))
    tasks = min(3 * cpus, MAX_TASKS)  # more than its share: others may have nothing to do just now
    return Limits(cpus, tasks, sweeps_ahead=tasks + 6, ground_ahead=tasks + 6)


def stays_home(limits: Limits, cpus_of_machine: int) -> bool:
    """Tell whether a segment keeps to one machine, its home: then the loss of another one does not touch it.

    Where segments are few, so that each has a good part of a machine or more, its tasks run wherever a CPU is free.
    """
    return 2 * limits.cpus <= cpus_of_machine


def choose_home(cpus_of_machine: Mapping[str, float], homes: Mapping[str, int]) -> str | None:
    """Return the machine for one more segment: the one with the fewest for its CPUs. None: none has a CPU.

    Args:
        cpus_of_machine: Of each machine that is alive.
        homes: How many segments have their home on a machine.

    """
    able = sorted(machine for machine, cpus in cpus_of_machine.items() if cpus > 0)
    return min(able, key=lambda machine: (homes.get(machine, 0) + 1) / cpus_of_machine[machine], default=None)


def cut_by_cost(costs: Sequence[float], min_cost: float) -> list[list[int]]:
    """Return positions in TRACK_BATCHES batches or less: the most costly first, cheap ones together.

    A batch costs no more than the larger of ``min_cost`` and about twice its share, unless a single one does.
    """
    limit = max(min_cost, 2 * sum(costs) / (TRACK_BATCHES - 1))
    batches: list[list[int]] = []
    filled = limit
    for k in sorted(range(len(costs)), key=lambda k: (-costs[k], k)):
        if not batches or filled + costs[k] > limit:
            batches.append([])
            filled = 0.0
        filled += costs[k]
        batches[-1].append(k)
    return batches
