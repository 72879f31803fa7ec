"""How well clusters of 2 to 1,024 CPUs are used: the real schedule and limits of the Ray line, in simulated time.

    python benchmarks/scale.py

What is real in it and what is made up: see README.md.
"""

import argparse
import json
import os
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from records import ROOT, describe_run, write_result
from simulated_ray import CPUS_A_MACHINE, LOSS_S, NOTICE_S, Clock, Cluster, Process

from labeling.evaluation.markdown import render_rows
from schemas.errors import WorkerLost
from workers.pipeline import MAX_ATTEMPTS, choose_home, cut_by_cost, plan_limits, segments_at_once, stays_home
from workers.schedule import Kind, Reach, SegmentSchedule, Step

SEED = 14
STAGES = ROOT / "benchmarks/results/stages.json"
SPREAD, SPREAD_OF_MOVERS = 0.2, 0.3  # sigma of lognormal factors of steps, and of segments for what movers cost
STRAGGLERS, STRAGGLING = 0.01, 3.0  # share of the steps of sweeps, and how many times as long they take
SWEEPS_A_TRACK, SPREAD_OF_TRACKS, LONGEST_TRACK = 2, 1.3, 0.15  # the last is a share of all tracks together
JOINED, ADOPTED = 0.15, 0.08  # share of the tracks that are completed again after the first joining and adoption
REACH_SWEEPS, NEAR_SWEEPS = 20, 5  # whose ground static points need, and whose static points a preparation, each way
VOTES_S, TRACKS_S = 0.5, 0.5  # core-seconds of a batch
VIEWS_S, PLAN_S = 0.02, 0.02  # of the mean vote: what a further batch takes, and what the plan takes
LABELER_S = 0.8  # that the process of a SegmentLabeler takes to start, without a CPU
PATIENCE_S = 1.0  # see ``workers.segment_line``
CALL_S = 0.008  # core-seconds that Ray takes for a step, beside it
WRITE_S, POINTS_S = 0.1, 0.006  # of the shards of a segment; of the points of a sweep


@dataclass(frozen=True)
class Scenario:
    num_cpus: int
    num_segments: int
    num_sweeps: int = 200
    has_points: bool = False
    num_jobs: int = 1  # one after the other, of segments of their own: what few segments take is chance


SCENARIOS = (
    Scenario(1, 2, num_jobs=20),
    Scenario(2, 2, num_jobs=20),
    Scenario(16, 3, num_jobs=20),
    Scenario(16, 3, 600, num_jobs=20),
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
            costs: list[float] = (mean_s[step] * factor * spread * np.where(is_straggler, STRAGGLING, 1.0)).tolist()
            return costs

        ground, static, prepare = (draw(step, of_points) for step in ("ground", "static", "prepare"))
        vote, fit, finish = (draw(step, of_movers) for step in ("vote", "fit", "finish"))
        tracks = _draw_tracks(rng, num_sweeps, mean_s["complete"] * of_movers * num_sweeps)
        regroup = [mean_s[step] / 2 * num_sweeps for step in ("join", "adopt", "join", "adopt")]
        link, write = mean_s["link"] * num_sweeps, WRITE_S + (POINTS_S * num_sweeps if scenario.has_points else 0.0)
        self.num_regroupings = len(regroup)
        self.total = sum(map(sum, (ground, static, prepare, vote, fit, finish, regroup, *tracks))) + link + write
        self._num_votes = [1 + int(cost // VOTES_S) for cost in vote]
        self._batches = [[sum(costs[k] for k in batch) for batch in cut_by_cost(costs, TRACKS_S)] for costs in tracks]
        self._of_step = {
            Kind.GROUND: ground,
            Kind.STATIC: static,
            Kind.PREPARE: prepare,
            Kind.VOTE: [(cost - PLAN_S) / num + VIEWS_S for cost, num in zip(vote, self._num_votes, strict=True)],
            Kind.PLAN: [PLAN_S] * num_sweeps,
            Kind.FIT: fit,
            Kind.FINISH: finish,
            Kind.LINK: [link],
            Kind.REGROUP: [0.0, *regroup],
            Kind.WRITE: [write] * (len(regroup) + 2),
        }

    def core_s(self, step: Step) -> float:
        if step.kind == Kind.COMPLETE:
            return self._batches[step.number][step.batch]
        return self._of_step[step.kind][step.number]

    def sizes(self, step: Step) -> list[int]:
        """Return the sizes of the batches that follow a step."""
        match step.kind:
            case Kind.PREPARE:
                return [10] * self._num_votes[step.number]
            case Kind.PLAN:
                return [5]
            case Kind.LINK | Kind.REGROUP:
                return [1] * len(self._batches[step.number])
        return []


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
    return [(scale * costs).tolist() for costs in rounds]


def read_means() -> dict[str, float]:
    """Return the core-seconds of each step a sweep."""
    measured = json.loads(STAGES.read_text())
    log = measured["log"] if isinstance(measured["log"], dict) else measured  # before there was a street beside the log
    cost = log["core_s_per_sweep"]
    return {
        "ground": cost["reading"] + cost["ground"] + cost["range image"],
        "static": cost["static"] + cost["static: trees"] + cost["static: nearest"] + cost["rays"] / 2,
        "prepare": cost["rays"] / 2 + cost["decomposition"] + cost["all else"] / 2,
        "vote": cost["flow: vote"] + cost["flow: plan"],
        "fit": cost["flow: nets"],
        "finish": cost["proposals"] + cost["all else"] / 2,
        "link": cost["tracking"],
        "complete": cost["registration"] + cost["refinement"],
        "join": cost["joining"],
        "adopt": cost["adoption"],
    }


class Labeler:
    """Leads one segment, as ``workers.segment_line`` does."""

    def __init__(self, service: "Service", number: int, attempt: int, home: int) -> None:
        self.number, self.attempt, self.home = number, attempt, home
        self._service, self._cluster = service, service.cluster
        self._work = Work(number, service.scenario, service.mean_s)
        sweeps = range(service.scenario.num_sweeps)
        self._schedule = SegmentSchedule(sweeps, service.reach, self._work.num_regroupings, service.limits)
        self._tasks: dict[Step, tuple[Process, float]] = {}  # and when it was given
        self._actor: Process | None = None
        self._is_awake = self._is_looking = False
        self._used = {home}  # machines that have something of this segment
        self.is_over = False
        self.call_s = 0.0
        service.clock.after(LABELER_S, self._start_steps)

    def lose(self, machine: int) -> None:
        if machine in self._used:
            self._fail()

    def _start_steps(self) -> None:
        if self.is_over:
            return
        schedule, now_s = self._schedule, self._service.clock.now_s
        if self._actor is None:
            self._actor = self._start(self._wake, self._on_actor_death, is_actor=True)
        if self._is_awake:
            overdue = [step for step, (_, since_s) in self._tasks.items() if now_s - since_s >= PATIENCE_S]
            if (step := schedule.next_own(overdue)) is not None:
                self._compute(self._actor, step, partial(self._on_own_end, step))
        while (step := schedule.next_task()) is not None:
            process = self._start(partial(self._begin_task, step), partial(self._on_task_death, step))
            if not process.is_over:
                self._tasks[step] = process, now_s
        if not self._is_looking and any(process.machine is None for process, _ in self._tasks.values()):
            self._is_looking = True
            self._service.clock.after(PATIENCE_S, self._look)

    def _look(self) -> None:
        self._is_looking = False
        self._start_steps()

    def _start(self, on_start: Callable[[Process], None], on_death: Callable[[], None], **options: bool) -> Process:
        return self._cluster.start(self.home, on_start, on_death, is_bound=self._service.stays_home, **options)

    def _wake(self, process: Process) -> None:
        def on_end() -> None:
            self._is_awake = True
            self._start_steps()

        self._touch(process)
        self._cluster.compute(process, 0.0, on_end)

    def _begin_task(self, step: Step, process: Process) -> None:
        self._touch(process)
        self._tasks[step] = process, self._service.clock.now_s
        self._schedule.task_begins(step)
        self._compute(process, step, partial(self._on_task_end, step, process))

    def _compute(self, process: Process, step: Step, on_end: Callable[[], None]) -> None:
        self.call_s += CALL_S
        self._cluster.compute(process, self._work.core_s(step) + CALL_S, on_end)

    def _on_task_end(self, step: Step, process: Process) -> None:
        self._tasks.pop(step, None)
        self._schedule.task_ended(step, self._work.sizes(step))
        self._cluster.end(process)
        self._go_on()

    def _on_own_end(self, step: Step) -> None:
        self._schedule.own_ended(step, self._work.sizes(step))
        if step in self._tasks:
            self._cluster.end(self._tasks.pop(step)[0])
        self._go_on()

    def _on_task_death(self, step: Step) -> None:
        if not self.is_over:
            self._tasks.pop(step, None)
            self._repeat(partial(self._schedule.task_died, step))

    def _on_actor_death(self) -> None:
        if not self.is_over:
            self._actor, self._is_awake = None, False
            self._repeat(self._schedule.own_died)

    def _repeat(self, note_death: Callable[[], None]) -> None:
        try:
            note_death()
        except WorkerLost:
            self._fail()
        self._start_steps()

    def _go_on(self) -> None:
        if self._schedule.is_done:
            self._close()
            self._service.take_end(self, self._work.total)
        else:
            self._start_steps()

    def _touch(self, process: Process) -> None:
        if process.machine is not None:
            self._used.add(process.machine.number)

    def _fail(self) -> None:
        if not self.is_over:
            self._close()
            self._service.take_failure(self)

    def _close(self) -> None:
        self.is_over = True
        for process, _ in list(self._tasks.values()):
            self._cluster.end(process)
        if self._actor is not None:
            self._cluster.end(self._actor)


def reach_of(num_sweeps: int) -> Reach:
    """Return what a sweep's steps need of others."""

    def around(each_way: int) -> list[range]:
        return [range(max(0, k - each_way), min(num_sweeps, k + each_way + 1)) for k in range(num_sweeps)]

    return Reach(around(REACH_SWEEPS).__getitem__, around(NEAR_SWEEPS).__getitem__)


class Service:
    """Keeps as many segments at work as the limits allow, as the drivers do."""

    def __init__(self, scenario: Scenario, mean_s: dict[str, float], *, first_segment: int) -> None:
        self.scenario, self.mean_s = scenario, mean_s
        self.reach = reach_of(scenario.num_sweeps)
        self.clock = Clock()
        self.cluster = Cluster(self.clock, scenario.num_cpus, np.random.default_rng(SEED), self._on_loss)
        self.num_at_once = min(segments_at_once(scenario.num_cpus), scenario.num_segments)
        self.limits = plan_limits(scenario.num_cpus, self.num_at_once)
        self.stays_home = stays_home(self.limits, min(scenario.num_cpus, CPUS_A_MACHINE))
        self.useful_s = self.call_s = 0.0
        self.num_ended = self.num_repeated = self.num_crashed = 0
        self._running: set[Labeler] = set()
        self._homes: Counter[str] = Counter()
        self._waiting = [
            (number, 1) for number in reversed(range(first_segment, first_segment + scenario.num_segments))
        ]
        for _ in range(self.num_at_once):
            self._start_next()

    def take_end(self, labeler: Labeler, useful_s: float) -> None:
        self.useful_s += useful_s
        self.call_s += labeler.call_s
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
        self._homes[str(labeler.home)] -= 1
        self._start_next()

    def _start_next(self) -> None:
        if self._waiting:
            cpus = {str(machine.number): machine.num_cpus for machine in self.cluster.machines if not machine.is_lost}
            home = choose_home(cpus, self._homes)
            assert home is not None  # there are always some
            self._homes[home] += 1
            self._running.add(Labeler(self, *self._waiting.pop(), int(home)))

    def _on_loss(self, machine: int) -> None:
        for labeler in list(self._running):
            labeler.lose(machine)

    def run(self) -> None:
        self.clock.run(lambda: self.num_ended + self.num_crashed == self.scenario.num_segments)


def simulate(scenario: Scenario, mean_s: dict[str, float]) -> dict[str, Any]:
    """Return how well the jobs of a scenario use their cluster."""
    jobs = []
    for number in range(scenario.num_jobs):
        jobs.append(Service(scenario, mean_s, first_segment=number * scenario.num_segments))
        jobs[-1].run()
    cpu_s = [job.cluster.cpu_s() for job in jobs]
    used = [(job.useful_s + job.call_s) / job_cpu_s for job, job_cpu_s in zip(jobs, cpu_s, strict=True)]
    return {
        "cpus": scenario.num_cpus,
        "segments": scenario.num_segments,
        "sweeps_a_segment": scenario.num_sweeps,
        "has_points": scenario.has_points,
        "jobs": scenario.num_jobs,
        "segments_at_once": jobs[0].num_at_once,
        "utilisation": round(float(np.mean(used)), 3),
        "in_process_share": round(sum(job.useful_s for job in jobs) / sum(cpu_s), 3),
        "simulated_s": round(float(np.mean([job.clock.now_s for job in jobs]))),
        "machines_lost": sum(job.cluster.num_losses for job in jobs),
        "attempts_repeated": sum(job.num_repeated for job in jobs),
        "segments_crashed": sum(job.num_crashed for job in jobs),
    }


def main() -> None:
    options = read_options()
    load_average = os.getloadavg()[0]
    mean_s = read_means()
    rows = []
    for scenario in SCENARIOS:
        if scenario.num_segments <= options.max_segments:
            rows.append(simulate(scenario, mean_s))
    before = json.loads(options.output.read_text())["before"] if options.output.exists() else []
    run = describe_run(load_average, libraries=("numpy",), packages=("workers", "benchmarks"))
    result = {**run, "mean_core_s_per_sweep": mean_s, "machine_lost_every_s": LOSS_S, "noticed_after_s": NOTICE_S}
    write_result({**result, "before": before, "runs": rows}, options.output)
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
