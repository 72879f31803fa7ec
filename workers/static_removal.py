"""Actor: a segment's own process. It holds the window of sweeps in which static points are found."""

from typing import TYPE_CHECKING, Any

import ray

from workers.pipeline import PROCESS_MEMORY_BYTES
from workers.schedule import Kind, Step
from workers.steps import Segment, make_window, take_step

if TYPE_CHECKING:
    from labeling.window import SweepWindow


@ray.remote(num_cpus=1, memory=PROCESS_MEMORY_BYTES, max_restarts=0)
class StaticRemoval:
    """Finds ground and static points, sweep after sweep, and prepares each; while it is ahead, it takes any other step.

    Any call may be the first, so that a new actor goes on where another died. Its window only saves fetching again what
    it has found or fetched before.
    """

    def __init__(self, segment: Segment) -> None:
        self._segment = segment
        self._window: SweepWindow | None = None

    def wake(self) -> None:
        """Load what steps need: it takes seconds."""
        import labeling.line  # noqa: F401

    def take(self, first_needed: int, step: Step, *inputs: Any) -> Any:
        """Take a step, see ``workers.steps.take_step``; sweeps before the first that is needed are forgotten."""
        if step.kind > Kind.PREPARE:
            return take_step(self._segment, step, *inputs)
        self._window = self._window or make_window(self._segment)
        self._window.forget_before(first_needed)
        return take_step(self._segment, step, *inputs, window=self._window)
