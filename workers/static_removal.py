"""Actor: ground, static points, clusters and voted motion of sweep after sweep, up to the fits."""

from typing import TYPE_CHECKING

import ray

from schemas.config import LabelingConfig
from schemas.listing import SegmentListing
from schemas.objects import SweepObservation

if TYPE_CHECKING:
    from collections.abc import Iterator

    from labeling.line import SweepWork


@ray.remote(num_cpus=0, max_restarts=0)
class StaticRemoval:
    """Prepares sweeps of one segment, holding one window of them. It reads the segment itself: no sweep travels to it.

    Any call may be the first, so that a new actor goes on where another died.
    """

    def __init__(self, listing: SegmentListing, config: LabelingConfig) -> None:
        self._listing, self._config = listing, config
        self._next: int | None = None
        self._works: Iterator[SweepWork | SweepObservation] = iter(())

    @ray.method(num_returns=2)
    def prepare(self, sweeps: range) -> "tuple[tuple[int, ...], SweepWork | SweepObservation]":
        """Prepare the first of ``sweeps``; the rest is what is going to be asked for next.

        Returns:
            Sizes of the batches to fit; and the work, or the observation of a rejected sweep.

        """
        # PyTorch takes seconds to load: only in the processes that compute.
        from labeling.line import prepare_sweeps
        from labeling.readers.reader import reopen
        from labeling.threads import use_one_thread

        if sweeps.start != self._next:
            use_one_thread()
            self._works = prepare_sweeps(reopen(self._listing), self._config, sweeps)
        self._next = None  # until this sweep is done: after an exception the generator is of no more use
        work = next(self._works)
        self._next = sweeps.start + 1
        plan = None if isinstance(work, SweepObservation) else work.plan
        return tuple(len(batch) for batch in plan.batches) if plan else (), work
