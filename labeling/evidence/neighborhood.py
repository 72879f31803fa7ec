"""Which sweeps look at which. It follows from time stamps and from which sweeps can be read, and from nothing else."""

from collections.abc import Callable, Iterable

import numpy as np

from labeling.geometry.times import bridged_s, median_period_s, seconds_between
from schemas.arrays import BoolArray, Float64Array, Int64Array
from schemas.config import FlowParams, StaticParams

VOTE_REACH = 1.1  # times the longest wanted gap: what votes stands no farther away
REACHED_PERIODS = 1.6  # of a sweep to the next, where sweeps are rare: more is a silence
FAR_GAP_TOLERANCE = 0.2  # share by which the gap to a far sweep may differ from the wanted one


class Neighborhood:
    """The neighbours of each sweep of a segment.

    Whether a candidate can be read is asked before anything is chosen, so that a part of a segment, a chunk of it, or a
    process that begins in its middle chooses as whoever goes through the whole.
    """

    def __init__(
        self,
        timestamps_ns: Int64Array,  # (T,) ascending
        static: StaticParams,
        flow: FlowParams,
        is_usable: Callable[[int], bool] = lambda _: True,  # asked of candidates only, the likeliest first
    ) -> None:
        self._timestamps_ns, self._static, self._flow = timestamps_ns, static, flow
        self._is_usable = is_usable
        self._silence_s = bridged_s(flow.max_gap_s, median_period_s(timestamps_ns), REACHED_PERIODS)

    def voters(self, index: int) -> list[int]:
        """Return the sweeps that say which points of sweep ``index`` stand still, ascending.

        For ``chamfer`` the sweeps just before; for ``visibility`` the one nearest to each wanted gap on either side.
        """
        if self._static.method == "none":
            return []
        if self._static.method == "chamfer":
            return sorted(self._first(range(index - 1, -1, -1), self._static.num_chamfer_sweeps))
        gaps_s = self._static.vote_gaps_s
        wanted_s = [sign * gap_s for sign in (-1, 1) for gap_s in gaps_s]
        return self._nearest(index, wanted_s, lambda _, gap_s: np.abs(gap_s) <= VOTE_REACH * max(gaps_s))

    def flow(self, index: int) -> list[int]:
        """Return the sweeps that flow looks at, the one that it is fitted to first; none: none is in reach.

        On either side those nearest to the wanted gaps, each for one of them: where sweeps are rarer, the next ones.
        """
        if self._flow.method == "none":
            return []
        later, earlier = self._supporters(index, 1), self._supporters(index, -1)
        primary, secondary = (later, earlier) if later else (earlier, later)
        return [*primary, *secondary] if self._looks_around else primary[:1]

    def following(self, index: int) -> int | None:
        """Return the next sweep that can be read, to which displacements are written; None: before a silence."""
        gap_s = self._gaps_s(index)
        later = np.flatnonzero((gap_s > 0) & (gap_s <= self._silence_s))
        return next(iter(self._first(later.tolist(), 1)), None)

    def far(self, index: int) -> list[int]:
        """Return the sweeps that what seems slow is looked at in besides: those nearest to the wanted gaps."""
        if not self._looks_around or not self._flow.has("far_look"):
            return []
        wanted_s = [sign * gap_s for gap_s in self._flow.slow_gaps_s for sign in (1, -1)]
        return self._nearest(
            index, wanted_s, lambda wanted_s, gap_s: np.abs(gap_s - wanted_s) <= FAR_GAP_TOLERANCE * np.abs(wanted_s)
        )

    def _supporters(self, index: int, sign: int) -> list[int]:
        """Return the usable sweeps nearest to the wanted gaps after (+1) or before (-1) a sweep, each for one gap."""
        gap_s = sign * self._gaps_s(index)
        found: list[int] = []
        for wanted_s in self._flow.support_gaps_s:
            candidates = np.flatnonzero((gap_s > 0) & (gap_s <= (self._flow.max_gap_s if found else self._silence_s)))
            by_distance = candidates[np.argsort(np.abs(gap_s[candidates] - wanted_s), kind="stable")]
            found += self._first([k for k in by_distance.tolist() if k not in found], 1)
        return sorted(found, key=lambda k: float(gap_s[k]))

    def oldest(self, index: int) -> int:
        """Return the earliest sweep that sweep ``index``, or one that it looks at, looks at."""
        looked_at = [index, *self.flow(index), *self.far(index)]
        return min([*looked_at, *(voter for k in looked_at for voter in self.voters(k))])

    def voter_range(self, index: int) -> range:
        """Return the sweeps that the voters of sweep ``index`` are chosen from, and itself, whatever can be read."""
        if self._static.method == "none":
            return range(index, index + 1)
        if self._static.method == "chamfer":
            return range(max(0, index - self._static.num_chamfer_sweeps), index + 1)
        return self._range(index, VOTE_REACH * max(self._static.vote_gaps_s))

    def target_range(self, index: int) -> range:
        """Return the sweeps that flow's and far targets of sweep ``index`` are chosen from, and itself."""
        if self._flow.method == "none":
            return range(index, index + 1)
        far_s = (1 + FAR_GAP_TOLERANCE) * max(self._flow.slow_gaps_s, default=0.0)
        return self._range(index, max(self._silence_s, far_s if self._looks_around else 0.0))

    def _range(self, index: int, reach_s: float) -> range:
        is_near = np.flatnonzero(np.abs(self._gaps_s(index)) <= reach_s)
        return range(int(is_near[0]), int(is_near[-1]) + 1)

    @property
    def _looks_around(self) -> bool:
        return self._flow.method in ("nsfp++", "rigid")

    def _gaps_s(self, index: int) -> Float64Array:
        return seconds_between(self._timestamps_ns, int(self._timestamps_ns[index]))

    def _first(self, candidates: Iterable[int], number: int) -> list[int]:
        """Return the first usable ones."""
        found: list[int] = []
        for k in candidates:
            if len(found) == number:
                break
            if self._is_usable(k):
                found.append(k)
        return found

    def _nearest(
        self, index: int, wanted_s: list[float], is_in_reach: Callable[[float, Float64Array], BoolArray]
    ) -> list[int]:
        """Return, ascending, the usable sweep nearest to each wanted gap, of those in its reach."""
        gap_s = self._gaps_s(index)
        found = set()
        for wanted in wanted_s:
            by_distance = np.argsort(np.abs(gap_s - wanted), kind="stable")
            is_candidate = is_in_reach(wanted, gap_s) & (gap_s != 0)
            found.update(self._first(by_distance[is_candidate[by_distance]].tolist(), 1))
        return sorted(found)
