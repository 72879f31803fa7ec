"""What the steps of one segment gave: references to it, and which of them each step takes."""

from collections.abc import Iterable, Sequence
from typing import Any, TypeAlias

import ray
from ray import ObjectRef

from labeling.evidence.neighborhood import Neighborhood
from labeling.folders.identity import LabelSet
from labeling.readers.reader import SegmentReader
from schemas.manifest import SegmentEntry
from schemas.objects import SweepObservation
from workers.schedule import Kind, SegmentSchedule, Step
from workers.steps import Neighbors, Place

Ref: TypeAlias = ObjectRef[Any]


class Results:
    """What the steps of a segment gave so far, as far as it is still needed, and which of it each step takes."""

    def __init__(self, reader: SegmentReader, sweeps: range, label_set: LabelSet) -> None:
        config = label_set.config
        self.neighborhood = Neighborhood(
            reader.timestamps_ns, config.static, config.flow, lambda sweep: sweep not in self._rejected
        )
        self._label_set, self._sweeps, self._writes_points = label_set, sweeps, config.write_points
        self._rejected: dict[int, str] = {}
        self._ground: dict[int, Ref] = {}
        self._motion: dict[int, Ref] = {}
        self._of_sweep: dict[int, dict[Step, Ref]] = {}  # work, votes, plan and fits of those that are not finished
        self._observations: dict[int, SweepObservation] = {}  # without points and proposals
        self._all_observations: Ref | None = None
        self._rows: dict[int, Ref] = {}  # observations with their points
        self._proposals: dict[int, Ref] = {}
        self._places: Sequence[Place] = ()
        self._first_batch: list[int] = []  # of the tracks that linking, and each regrouping, made
        self._tracks: list[Ref] = []  # of each batch
        self._labeled: dict[int, Ref] = {}
        self.entry: SegmentEntry | None = None

    def reason_to_reject_all(self) -> str:
        """Return why the first sweep cannot be used when none can be; else nothing."""
        observations = [self._observations[sweep] for sweep in self._sweeps]
        return observations[0].reason if all(observation.is_rejected for observation in observations) else ""

    def inputs(self, step: Step, schedule: SegmentSchedule) -> tuple[Any, ...]:
        """Return what the function of a step takes."""
        sweep, near = step.number, self.neighborhood
        match step.kind:
            case Kind.GROUND:
                return ()
            case Kind.STATIC:
                return (self._neighbors(schedule, [sweep, *near.voters(sweep)], []),)
            case Kind.PREPARE:
                looked_at = [sweep, *near.flow(sweep), *near.far(sweep)]
                return (self._neighbors(schedule, looked_at, looked_at),)
            case Kind.VOTE:
                return (self._work(sweep),)
            case Kind.PLAN:
                return self._of_parts(schedule, sweep, Kind.VOTE, self._work(sweep))
            case Kind.FIT:
                return (self._of_sweep[sweep][Step(sweep, Kind.PLAN)],)
            case Kind.FINISH:
                plan = self._of_sweep[sweep][Step(sweep, Kind.PLAN)]
                return self._of_parts(schedule, sweep, Kind.FIT, self._work(sweep), plan)
            case Kind.LINK:
                return self._observed(), *(self._proposals[sweep] for sweep in self._sweeps)
            case Kind.COMPLETE:
                return self._observed(), self._tracks[self._first_batch[step.number] + step.batch]
            case Kind.REGROUP:
                proposals = (self._proposals[sweep] for sweep in self._sweeps)
                return self._places, len(self._tracks), *self._tracks, *self._all_labeled(), *proposals
            case Kind.WRITE:
                rows = [self._rows[sweep] for sweep in self._sweeps] if self._writes_points else []
                return self._label_set, self._places, self._observed(), rows, *self._all_labeled()

    def take(self, step: Step, value: Any, results: Sequence[Ref], schedule: SegmentSchedule) -> None:
        """Keep what a step gave, and drop what nobody needs any more."""
        sweep = step.number
        match step.kind:
            case Kind.GROUND if value:
                self._rejected[sweep] = value
            case Kind.GROUND:
                (self._ground[sweep],) = results
            case Kind.STATIC:
                (self._motion[sweep],) = results
            case Kind.FINISH:
                del self._of_sweep[sweep]
                self._observations[sweep] = value
                self._rows[sweep], self._proposals[sweep] = results
            case Kind.LINK | Kind.REGROUP:
                self._places, sizes = value
                self._first_batch.append(len(self._tracks))
                self._tracks += results[: len(sizes)]
            case Kind.COMPLETE:
                (self._labeled[self._first_batch[step.number] + step.batch],) = results
            case Kind.WRITE:
                self.entry = value
            case _:
                (self._of_sweep.setdefault(sweep, {})[step],) = results
        if step.kind == Kind.PREPARE:
            for kept in (self._ground, self._motion):
                for old in [k for k in kept if k < schedule.first_needed]:
                    del kept[old]

    def _neighbors(self, schedule: SegmentSchedule, grounded: Iterable[int], motion: Iterable[int]) -> Neighbors:
        rejected = {k: reason for k, reason in self._rejected.items() if k in schedule.known}
        return Neighbors(
            schedule.known,
            rejected,
            {k: self._ground[k] for k in grounded if k in self._ground},
            {k: self._motion[k] for k in motion if k in self._motion and k not in rejected},
        )

    def _work(self, sweep: int) -> Ref:
        return self._of_sweep[sweep][Step(sweep, Kind.PREPARE)]

    def _of_parts(self, schedule: SegmentSchedule, sweep: int, kind: Kind, *before: Ref) -> tuple[Any, ...]:
        parts = schedule.parts(sweep, kind)
        return parts, *before, *(self._of_sweep[sweep][part.step] for part in parts if not part.is_lost)

    def _observed(self) -> Ref:
        if self._all_observations is None:
            self._all_observations = ray.put([self._observations[sweep] for sweep in self._sweeps])
        return self._all_observations

    def _all_labeled(self) -> list[Ref]:
        return [self._labeled[batch] for batch in range(len(self._tracks))]
