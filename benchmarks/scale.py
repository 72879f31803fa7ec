"""How well clusters of 2 to 1,024 CPUs are used: the real schedule and limits of the Ray line, in simulated time.

    python benchmarks/scale.py

What is real in it and what is made up: see README.md.
"""

import argparse
import json
import os
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from records import ROOT, describe_run, write_result
from simulated_ray import LOSS_S, NOTICE_S, Clock, Cluster, Process

from labeling.evaluation.markdown import render_rows
from schemas.errors import WorkerLost
from workers.pipeline import MAX_ATTEMPTS, plan_limits, segments_at_once
from workers.schedule import SegmentSchedule

SEED = 14
STAGES = ROOT / "benchmarks/results/stages.json"
SPREAD, SPREAD_OF_MOVERS = 0.2, 0.3  # sigma of lognormal factors of steps, and of segments for what movers cost
STRAGGLERS, STRAGGLING = 0.01, 3.0  # share of the steps of sweeps, and how many times as long they take
SWEEPS_A_TRACK, SPREAD_OF_TRACKS, LONGEST_TRACK = 2, 1.3, 0.15  # the last is a share of all tracks together
JOINED, ADOPTED = 0.15, 0.08  # share of the tracks that are completed again after the first joining and adoption
REACH_SWEEPS, NEAR_SWEEPS = 25, 5  # that a sweep's preparation reads, and whose static points it needs, on either side
LABELER_S = 0.8  # that the process of a SegmentLabeler takes to start, without a CPU
CALL_S = 0.008  # core-seconds that Ray takes for a step, beside it
BEGIN_S, ADD_SWEEP_S, PUBLISH_S = 0.005, 0.001, 0.1  # what the aggregator does for a segment without points
POINTS_S = 0.006  # core-seconds to write the points of a sweep


@dataclass(frozen=True)
class Scenario:
    num_cpus: int
    num_segments: int
    num_sweeps: int = 200
    has_points: bool = False


SCENARIOS = (
    Scenario(1, 2),
    Scenario(2, 2),
    Scenario(16, 3),
    Scenario(16, 3, 600),
    Scenario(16, 100),
    Scenario(128, 1000),
    Scenario(128, 1000, has_points=True),
    Scenario(1024, 10_000),
)


class Work:
    """Core-seconds of each step of one segment, drawn about the shares that benchmarks/stages.py measured."""

    def __init__(self, number: int, scenario: Scenario, mean_s: dict[str, float]) -> None:
        num_sweeps = scenario.num_sweeps
        rng = np.random.default_rng([SEED, number])
        of_points, of_movers = (rng.lognormal(-(s**2) / 2, s) for s in (SPREAD, SPREAD_OF_MOVERS))

        def draw(step: str, factor: float) -> list[float]:
            spread = rng.lognormal(-(SPREAD**2) / 2, SPREAD, num_sweeps)
            is_straggler = rng.random(num_sweeps) < STRAGGLERS
            return list(mean_s[step] * factor * spread * np.where(is_straggler, STRAGGLING, 1.0))

        self.ground, self.static, self.prepare = (draw(step, of_points) for step in ("ground", "static", "prepare"))
        self.vote, self.fit, self.finish = (draw(step, of_movers) for step in ("vote", "fit", "finish"))
        self.link, self.join, self.adopt = (mean_s[step] * num_sweeps for step in ("link", "join", "adopt"))
        self.tracks = _draw_tracks(rng, num_sweeps, mean_s["complete"] * of_movers * num_sweeps)
        of_sweeps = (self.ground, self.static, self.prepare, self.vote, self.fit, self.finish)
        self.of_tracks = self.link + self.join + self.adopt + sum(map(sum, self.tracks))
        self.write = PUBLISH_S + (POINTS_S * num_sweeps if scenario.has_points else 0.0)
        self.total = sum(map(sum, of_sweeps)) + self.of_tracks + self.write


def _draw_tracks(rng: np.random.Generator, num_sweeps: int, total_s: float) -> list[list[float]]:
    """Return what tracks are completed: after linking, and those that each joining and adoption changed."""
    num_tracks = max(1, num_sweeps // SWEEPS_A_TRACK)
    cost = np.sort(rng.lognormal(0, SPREAD_OF_TRACKS, num_tracks))[::-1]
    cost = np.minimum(cost, LONGEST_TRACK * cost.sum())
    joined = rng.choice(num_tracks, max(1, int(JOINED * num_tracks)), replace=False, p=cost**0.5 / (cost**0.5).sum())
    adopted = rng.choice(num_tracks, max(1, int(ADOPTED * num_tracks)), replace=False)
    last = rng.choice(num_tracks, 1)
    rounds = [cost, cost[np.sort(joined)], cost[np.sort(adopted)], np.empty(0), cost[last]]
    scale = total_s / sum(map(np.sum, rounds))
    return [list(scale * costs) for costs in rounds]


def read_means() -> dict[str, float]:
    """Return the core-seconds of each step a sweep."""
    cost = json.loads(STAGES.read_text())["core_s_per_sweep"]
    return {
        "ground": cost["reading"] + cost["ground"] + cost["range image"],
        "static": cost["static"] + cost["static: trees"] + cost["static: nearest"] + cost["rays"] / 2,
        "prepare": cost["rays"] / 2 + cost["decomposition"],
        "vote": cost["flow: vote"] + cost["flow: plan"],
        "fit": cost["flow: nets"],
        "finish": cost["proposals"] + cost["all else"] / 2,
        "link": cost["tracking"],
        "complete": cost["registration"] + cost["refinement"],
        "join": cost["joining"],
        "adopt": cost["adoption"],
    }


class Aggregator:
    """An actor of one job that does one thing after the other, on no CPU of its own."""

    def __init__(self, clock: Clock) -> None:
        self._clock = clock
        self._free_s = 0.0

    def call(self, core_s: float, on_end: Callable[[], None]) -> None:
        self._free_s = max(self._free_s, self._clock.now_s) + core_s
        self._clock.at(self._free_s, on_end)


class Labeler:
    """Leads one segment, as ``workers.segment_labeler`` does."""

    def __init__(self, service: "Service", number: int, attempt: int) -> None:
        self.number, self.attempt = number, attempt
        self._service, self._cluster = service, service.cluster
        self._num_sweeps = service.scenario.num_sweeps
        self._work = Work(number, service.scenario, service.mean_s)
        self._schedule: SegmentSchedule[None] = SegmentSchedule(range(self._num_sweeps), service.limits)
        self._home = service.any_machine()
        self._used = {self._home}  # machines that have something of this segment
        self._is_robbed = False  # something of it was lost; seen when it is asked for
        self._streams: list[Process | None] = [None] * service.limits.streams
        self._read = [range(0)] * service.limits.streams  # sweeps that each stream's window reaches
        self._judged = [range(0)] * service.limits.streams
        self._processes: set[Process] = set()
        self.is_over = False
        self._at(LABELER_S, lambda: service.aggregator.call(BEGIN_S, self._if_alive(self._submit)))

    def lose(self, machine: int) -> None:
        if machine == self._home:
            self._fail()
        self._is_robbed |= machine in self._used

    def _submit(self) -> None:
        while (finishable := self._schedule.next_to_finish()) is not None:
            sweep, _ = finishable
            self._start_task(
                self._work.finish[sweep],
                partial(self._on_finished, sweep),
                partial(self._schedule.finishing_died, sweep),
            )
        while (piece := self._schedule.next_fit()) is not None:
            self._start_task(
                self._work.fit[piece.sweep],
                partial(self._schedule.fitted, piece, None),
                partial(self._schedule.fit_died, piece),
            )
        for stream in range(len(self._streams)):
            if (sweeps := self._schedule.next_to_prepare(stream)) is not None:
                self._prepare(stream, sweeps.start)

    def _start_task(self, core_s: float, on_end: Callable[[], None], on_death: Callable[[], None]) -> None:
        def end() -> None:
            self._cluster.end(process)
            self._processes.discard(process)
            on_end()
            self._submit()

        def start(process: Process) -> None:
            self._touch(process)
            process.compute(core_s + CALL_S, self._if_alive(end))

        process = self._cluster.start(self._home, start, self._on_death(on_death))
        self._processes.add(process)

    def _prepare(self, stream: int, sweep: int) -> None:
        reach, near = (
            range(max(0, sweep - k), min(self._num_sweeps, sweep + k + 1)) for k in (REACH_SWEEPS, NEAR_SWEEPS)
        )
        work = self._work
        core_s = sum(work.ground[k] for k in reach if k not in self._read[stream])
        core_s += sum(work.static[k] for k in near if k not in self._judged[stream])
        core_s += work.prepare[sweep] + work.vote[sweep] + CALL_S
        self._read[stream], self._judged[stream] = reach, near

        def end() -> None:
            self._schedule.prepared(stream, [1])
            self._submit()

        def compute(process: Process) -> None:
            self._touch(process)
            process.compute(core_s, self._if_alive(end))

        def die() -> None:
            self._streams[stream] = None
            self._read[stream] = self._judged[stream] = range(0)
            self._schedule.preparing_died(stream)

        process = self._streams[stream]
        if process is None:
            home = self._service.any_machine()
            process = self._cluster.start(home, compute, self._on_death(die), is_actor=True, num_cpus=0)
            self._streams[stream] = process
        else:
            compute(process)

    def _on_finished(self, sweep: int) -> None:
        for _ in self._schedule.finished(sweep):
            self._service.aggregator.call(ADD_SWEEP_S, self._if_alive(self._on_written))

    def _on_written(self) -> None:
        self._schedule.written()
        if self._schedule.is_done:
            publish = partial(self._service.aggregator.call, self._work.write, self._if_alive(self._end))
            self._start_task(self._work.of_tracks, publish, self._fail)
        else:
            self._submit()

    def _touch(self, process: Process) -> None:
        if self._is_robbed:
            self._at(0.0, self._fail)
        elif process.machine is not None:
            self._used.add(process.machine.number)

    def _at(self, delay_s: float, action: Callable[[], None]) -> None:
        clock = self._service.clock
        clock.at(clock.now_s + delay_s, self._if_alive(action))

    def _if_alive(self, action: Callable[[], None]) -> Callable[[], None]:
        return lambda: None if self.is_over else action()

    def _on_death(self, action: Callable[[], None]) -> Callable[[], None]:
        def act() -> None:
            try:
                action()
            except WorkerLost:
                self._fail()
            else:
                self._submit()

        return self._if_alive(act)

    def _end(self) -> None:
        self._close()
        self._service.take_end(self, self._work.total)

    def _fail(self) -> None:
        self._close()
        self._service.take_failure(self)

    def _close(self) -> None:
        self.is_over = True
        for process in (*self._processes, *(stream for stream in self._streams if stream)):
            self._cluster.end(process)


@dataclass
class Service:
    """Keeps as many segments at work as the limits allow, as the drivers do."""

    scenario: Scenario
    mean_s: dict[str, float]
    useful_s: float = 0.0
    num_ended: int = 0
    num_repeated: int = 0
    num_crashed: int = 0
    _running: set[Labeler] = field(default_factory=set)

    def __post_init__(self) -> None:
        scenario = self.scenario
        self.clock = Clock()
        self._rng = np.random.default_rng(SEED)
        self.cluster = Cluster(self.clock, scenario.num_cpus, self._rng, self._on_loss)
        self.aggregator = Aggregator(self.clock)
        self.num_at_once = min(segments_at_once(scenario.num_cpus), scenario.num_segments)
        self.limits = plan_limits(scenario.num_cpus, self.num_at_once)
        self._waiting = [(number, 1) for number in reversed(range(scenario.num_segments))]
        for _ in range(self.num_at_once):
            self._start_next()

    def any_machine(self) -> int:
        """Return a machine for a process without a CPU: Ray takes any."""
        alive = [machine.number for machine in self.cluster.machines if not machine.is_lost]
        return int(self._rng.choice(alive))

    def take_end(self, labeler: Labeler, useful_s: float) -> None:
        self.useful_s += useful_s
        self.num_ended += 1
        self._replace(labeler)

    def take_failure(self, labeler: Labeler) -> None:
        if labeler.attempt < MAX_ATTEMPTS:
            self._waiting.append((labeler.number, labeler.attempt + 1))
            self.num_repeated += 1
        else:
            self.num_crashed += 1
        self._replace(labeler)

    def _replace(self, labeler: Labeler) -> None:
        self._running.remove(labeler)
        self._start_next()

    def _start_next(self) -> None:
        if self._waiting:
            self._running.add(Labeler(self, *self._waiting.pop()))

    def _on_loss(self, machine: int) -> None:
        for labeler in list(self._running):
            labeler.lose(machine)

    def run(self) -> dict[str, Any]:
        self.clock.run(lambda: self.num_ended + self.num_crashed == self.scenario.num_segments)
        return {
            "cpus": self.scenario.num_cpus,
            "segments": self.scenario.num_segments,
            "sweeps_a_segment": self.scenario.num_sweeps,
            "has_points": self.scenario.has_points,
            "segments_at_once": self.num_at_once,
            "utilisation": round(self.useful_s / self.cluster.cpu_s(), 3),
            "simulated_s": round(self.clock.now_s),
            "machines_lost": self.cluster.num_losses,
            "attempts_repeated": self.num_repeated,
            "segments_crashed": self.num_crashed,
        }


def main() -> None:
    options = read_options()
    load_average = os.getloadavg()[0]
    mean_s = read_means()
    rows = []
    for scenario in SCENARIOS:
        if scenario.num_segments <= options.max_segments:
            rows.append(Service(scenario, mean_s).run())
    run = describe_run(load_average, libraries=("numpy",), packages=("workers", "benchmarks"))
    result = {**run, "mean_core_s_per_sweep": mean_s, "machine_lost_every_s": LOSS_S, "noticed_after_s": NOTICE_S}
    write_result({**result, "runs": rows}, options.output)
    print(table(rows))


def read_options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--max-segments", type=int, default=10_000, metavar="N", help="leave out scenarios with more")
    parser.add_argument("--output", type=Path, default=ROOT / "benchmarks/results/scale.json")
    return parser.parse_args()


def table(rows: list[dict[str, Any]]) -> str:
    return render_rows("Utilisation", " | ".join(rows[0]), [tuple(map(str, row.values())) for row in rows])


if __name__ == "__main__":
    main()
