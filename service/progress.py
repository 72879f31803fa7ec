"""What a person sees while a run goes on: a progress bar on a terminal, nothing elsewhere."""

import contextlib
from collections.abc import Iterator
from typing import TYPE_CHECKING

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

if TYPE_CHECKING:
    from labeling.run import RunProgress


@contextlib.contextmanager
def progress_bar() -> Iterator[Progress]:
    """Yield a bar on stderr that counts sweeps and is gone when done; silent when stderr is no terminal."""
    console = Console(stderr=True)
    columns = (
        TextColumn("{task.description}", markup=False),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TimeRemainingColumn(),
    )
    with Progress(*columns, console=console, disable=not console.is_terminal, transient=True) as progress:
        yield progress


def count(number: int, noun: str) -> str:
    """Return a number of things, as in ``1 segment`` and ``2 segments``."""
    return f"{number} {noun}" if number == 1 else f"{number} {noun}s"


class RunWatcher:
    """Draws the steps of a labelling run, whose segments may run side by side, and counts what was really labelled."""

    def __init__(self, progress: Progress, num_segments: int) -> None:
        self._progress = progress
        self._task = progress.add_task("", total=None)
        self._num_segments = num_segments
        self._num_ended = 0
        self._running: dict[str, RunProgress] = {}
        self.num_reused_segments = 0
        self.num_new_sweeps = 0

    def __call__(self, step: "RunProgress") -> None:
        """Take one step."""
        self._running[step.segment_id] = step
        if step.stage == "sweeps" and step.sweeps_done > 0:
            self.num_new_sweeps += 1
        if step.stage in ("finished", "already there"):
            self._num_ended += 1
            del self._running[step.segment_id]
        if step.stage == "already there":
            self.num_reused_segments += 1
        doing = " (tracks)" if step.stage == "tracks" else ""
        count = f"[{min(self._num_ended + 1, self._num_segments)}/{self._num_segments}] "
        self._progress.update(
            self._task,
            total=sum(segment.num_sweeps for segment in self._running.values()),
            completed=sum(segment.sweeps_done for segment in self._running.values()),
            description=f"{count}{step.segment_id}{doing}",
        )
