"""What one segment does next: which sweep is prepared, which fits run, what a death changes. No Ray, no clock.

A sweep goes through: preparing -> fits (several pieces at once) -> finishing -> writing, the last in order.
"""

import heapq
from collections import Counter, deque
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Generic, TypeVar

from schemas.errors import WorkerLost
from workers.pipeline import MAX_ATTEMPTS, Limits

ResultT = TypeVar("ResultT")


@dataclass(frozen=True, slots=True, order=True)
class FitPiece:
    """Fits ``start:stop`` of one batch of one sweep. A whole batch, until its worker died with it twice."""

    sweep: int
    batch: int
    start: int
    stop: int
    is_whole: bool = True
    attempt: int = 1


def pieces_after_death(piece: FitPiece) -> tuple[FitPiece, ...]:
    """Return what to try after a worker died with ``piece``; nothing when the one fit left in it is to blame.

    A batch and a single fit are tried twice, for the death may not have been theirs; parts in between once, for
    halving a good one costs little.
    """
    size = piece.stop - piece.start
    if piece.attempt == 1 and (piece.is_whole or size == 1):
        return (replace(piece, attempt=2),)
    if size == 1:
        return ()
    middle = piece.start + size // 2
    part = replace(piece, is_whole=False, attempt=1)
    return replace(part, stop=middle), replace(part, start=middle)


@dataclass(frozen=True, slots=True)
class FitPart(Generic[ResultT]):
    """A piece that is done; ``result`` is None when its one fit ended every worker that tried it."""

    piece: FitPiece
    result: ResultT | None


@dataclass(slots=True)
class _Sweep(Generic[ResultT]):
    num_open: int  # pieces
    parts: list[FitPart[ResultT]]


class SegmentSchedule(Generic[ResultT]):
    """Keeps the order and the bounds of one segment's work. Results pass through unseen."""

    def __init__(self, sweeps: range, limits: Limits) -> None:
        self._sweeps, self._limits = sweeps, limits
        size = limits.chunk_sweeps or len(sweeps)
        self._chunks = deque(sweeps[k : k + size] for k in range(0, len(sweeps), size))
        self._rest: list[range] = [range(0)] * limits.streams  # of each stream's chunk
        self._is_busy = [False] * limits.streams
        self._attempts: Counter[tuple[str, int]] = Counter()
        self._waiting: list[FitPiece] = []
        self._num_fits = 0
        self._open: dict[int, _Sweep[ResultT]] = {}
        self._finishable: list[int] = []
        self._unwritten: set[int] = set()  # finished, and their turn has not come
        self._next_to_write = sweeps.start
        self.num_written = 0

    @property
    def is_done(self) -> bool:
        """True when every sweep is written."""
        return self.num_written == len(self._sweeps)

    def next_to_prepare(self, stream: int) -> range | None:
        """Return the rest of the stream's chunk, whose first sweep is to be prepared now; None: nothing, or not yet."""
        if self._is_busy[stream]:
            return None
        if not self._rest[stream] and self._chunks:
            self._rest[stream] = self._chunks.popleft()
        rest = self._rest[stream]
        if not rest or rest.start - self._oldest >= self._limits.sweeps_ahead:
            return None
        self._is_busy[stream] = True
        return rest

    def prepared(self, stream: int, batch_sizes: Sequence[int]) -> None:
        """Note a prepared sweep and the fits it wants."""
        sweep = self._rest[stream].start
        self._rest[stream] = self._rest[stream][1:]
        self._is_busy[stream] = False
        for batch, size in enumerate(batch_sizes):
            heapq.heappush(self._waiting, FitPiece(sweep, batch, 0, size))
        self._open[sweep] = _Sweep(len(batch_sizes), [])
        if not batch_sizes:
            heapq.heappush(self._finishable, sweep)

    def preparing_died(self, stream: int) -> None:
        """Let the stream begin again at the same sweep.

        Raises:
            WorkerLost: That was the last attempt.

        """
        self._is_busy[stream] = False
        self._count_death("preparing", self._rest[stream].start)

    def next_fit(self) -> FitPiece | None:
        """Return a piece to start now, of the earliest sweep; None: nothing, or enough are in flight."""
        if not self._waiting or self._num_fits >= self._limits.fits_in_flight:
            return None
        self._num_fits += 1
        return heapq.heappop(self._waiting)

    def fitted(self, piece: FitPiece, result: ResultT) -> None:
        """Note the result of a piece."""
        self._num_fits -= 1
        self._close(piece.sweep, FitPart(piece, result))

    def fit_died(self, piece: FitPiece) -> None:
        """Try again, in halves if need be; a fit that ends every worker counts as failed."""
        self._num_fits -= 1
        pieces = pieces_after_death(piece)
        for again in pieces:
            heapq.heappush(self._waiting, again)
        self._open[piece.sweep].num_open += len(pieces)
        self._close(piece.sweep, None if pieces else FitPart(piece, None))

    def next_to_finish(self) -> tuple[int, list[FitPart[ResultT]]] | None:
        """Return a sweep whose fits are all done, with their parts in order; None when there is none."""
        if not self._finishable:
            return None
        sweep = heapq.heappop(self._finishable)
        return sweep, sorted(self._open[sweep].parts, key=lambda part: part.piece)

    def finishing_died(self, sweep: int) -> None:
        """Let the sweep be finished again.

        Raises:
            WorkerLost: That was the last attempt.

        """
        self._count_death("finishing", sweep)
        heapq.heappush(self._finishable, sweep)

    def finished(self, sweep: int) -> list[int]:
        """Note a finished sweep; return the sweeps whose turn to be written has come, in order."""
        del self._open[sweep]
        self._unwritten.add(sweep)
        turn = []
        while self._next_to_write in self._unwritten:
            self._unwritten.remove(self._next_to_write)
            turn.append(self._next_to_write)
            self._next_to_write += 1
        return turn

    def written(self) -> None:
        """Note that one more sweep is written."""
        self.num_written += 1

    @property
    def _oldest(self) -> int:
        return self._sweeps.start + self.num_written

    def _close(self, sweep: int, part: FitPart[ResultT] | None) -> None:
        state = self._open[sweep]
        state.num_open -= 1
        if part:
            state.parts.append(part)
        if not state.num_open:
            heapq.heappush(self._finishable, sweep)

    def _count_death(self, doing: str, sweep: int) -> None:
        self._attempts[doing, sweep] += 1
        if self._attempts[doing, sweep] == MAX_ATTEMPTS:
            raise WorkerLost(
                f"{MAX_ATTEMPTS} workers in a row died {doing} sweep {sweep}: out of memory, or a fault in a library?"
            )
