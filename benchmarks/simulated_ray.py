"""A Ray cluster in simulated time: machines with CPUs, processes that wait for one, compute and die. For scale.py."""

import heapq
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial

import numpy as np

CPUS_A_MACHINE = 16
LOSS_S = 600.0  # between losses of a machine, where there are several
NOTICE_S = 15.0  # until Ray says so
AWAY_S = 120.0  # until another takes its place
START_S = 3.0  # core-seconds of a process that imports our libraries

Action = Callable[[], None]


class Clock:
    """Simulated time, and what happens when."""

    def __init__(self) -> None:
        self.now_s = 0.0
        self._events: list[tuple[float, int, Action]] = []
        self._number = 0

    def at(self, time_s: float, action: Action) -> None:
        self._number += 1
        heapq.heappush(self._events, (time_s, self._number, action))

    def run(self, is_over: Callable[[], bool]) -> None:
        while not is_over():
            self.now_s, _, action = heapq.heappop(self._events)
            action()


@dataclass(slots=True, eq=False)
class Process:
    """A process of a task, for its one computation, or of an actor, for all of them."""

    home: int  # the machine it is to run on by preference
    num_cpus: int
    is_actor: bool
    on_start: "Callable[[Process], None]"
    on_death: Action
    machine: "Machine | None" = None  # None: it waits for a CPU
    is_over: bool = False
    debt_s: float = 0.0  # what starting it still takes
    _on_end: Action | None = None  # of what it computes now

    def compute(self, core_s: float, on_end: Action) -> None:
        assert self.machine is not None
        assert self._on_end is None
        self._on_end = on_end
        self.machine.compute(self, core_s + self.debt_s)
        self.debt_s = 0.0

    def take_end(self) -> Action:
        on_end, self._on_end = self._on_end, None
        assert on_end is not None
        return on_end

    @property
    def is_computing(self) -> bool:
        return self._on_end is not None


class Machine:
    """Cores, shared evenly by the processes that compute on them, whether they reserved a CPU or not."""

    def __init__(self, clock: Clock, number: int, cores: int) -> None:
        self._clock, self.number, self.cores = clock, number, cores
        self.free_cpus = self.idle_processes = cores  # Ray starts as many ahead, and keeps them
        self.is_lost = False
        self.processes: set[Process] = set()
        self._computing: list[tuple[float, int, Process]] = []
        self._num_computing = self._number = 0
        self._each_s = self._until_s = 0.0  # core-seconds that each process has had, and until when

    def compute(self, process: Process, core_s: float) -> None:
        self._advance(+1)
        self._number += 1
        heapq.heappush(self._computing, (self._each_s + core_s, self._number, process))
        self._plan()

    def stop(self, process: Process) -> None:
        self.processes.discard(process)
        if process.is_computing:
            self._advance(-1)
            self._plan()

    @property
    def _pace(self) -> float:
        return min(1.0, self.cores / self._num_computing)

    def _advance(self, change: int) -> None:
        if self._num_computing:
            self._each_s += (self._clock.now_s - self._until_s) * self._pace
        self._until_s = self._clock.now_s
        self._num_computing += change

    def _plan(self) -> None:
        """Plan the next end, as things stand now."""
        while self._computing and self._computing[0][2].is_over:
            heapq.heappop(self._computing)
        self._number += 1
        if self._computing:
            wait_s = max(0.0, self._computing[0][0] - self._each_s) / self._pace
            self._clock.at(self._clock.now_s + wait_s, partial(self._end_next, self._number))

    def _end_next(self, number: int) -> None:
        if number == self._number:  # else something changed meanwhile
            self._advance(-1)
            on_end = heapq.heappop(self._computing)[2].take_end()
            self._plan()
            on_end()


@dataclass(slots=True)
class Cluster:
    """Machines, and the processes that wait for a CPU: for one of their home, or of any machine that has none waiting.

    Every LOSS_S a machine is lost, with all that runs there.
    """

    clock: Clock
    num_cpus: int
    rng: np.random.Generator
    on_loss: Callable[[int], None]  # told of each machine that is gone, NOTICE_S later
    num_losses: int = 0
    machines: list[Machine] = field(init=False)
    _waiting: list[deque[Process]] = field(init=False)  # by home
    _oldest: deque[Process] = field(default_factory=deque)
    _present: int = field(init=False)
    _num_free: int = field(init=False)
    _counted_s: float = 0.0
    _cpu_s: float = 0.0

    def __post_init__(self) -> None:
        size = min(self.num_cpus, CPUS_A_MACHINE)
        self.machines = [Machine(self.clock, k, size) for k in range(self.num_cpus // size)]
        self._waiting = [deque() for _ in self.machines]
        self._present = self._num_free = self.num_cpus
        if len(self.machines) > 1:
            self.clock.at(LOSS_S, self._lose_one)

    def cpu_s(self) -> float:
        """Return the CPU-seconds that were there so far."""
        self._cpu_s += self._present * (self.clock.now_s - self._counted_s)
        self._counted_s = self.clock.now_s
        return self._cpu_s

    def start(
        self,
        home: int,
        on_start: Callable[[Process], None],
        on_death: Action,
        *,
        is_actor: bool = False,
        num_cpus: int = 1,
    ) -> Process:
        process = Process(home, num_cpus, is_actor, on_start, on_death)
        machine = self.machines[home]
        if machine.free_cpus < num_cpus <= self._num_free:
            machine = max(self.machines, key=lambda m: m.free_cpus)
        if machine.free_cpus >= num_cpus and not machine.is_lost:
            self._place(process, machine)
        else:
            self._waiting[home].append(process)
            self._oldest.append(process)
        return process

    def end(self, process: Process) -> None:
        """End a process, whether it computes, rests or waits."""
        if process.is_over:
            return
        process.is_over = True
        machine = process.machine
        if machine is None or machine.is_lost:
            return
        machine.stop(process)
        machine.free_cpus += process.num_cpus
        self._num_free += process.num_cpus
        if not process.is_actor:  # it stays for the next task
            machine.idle_processes = min(machine.idle_processes + 1, machine.cores)
        self._fill(machine)

    def _place(self, process: Process, machine: Machine) -> None:
        machine.free_cpus -= process.num_cpus
        self._num_free -= process.num_cpus
        if machine.idle_processes:
            machine.idle_processes -= 1
        else:
            process.debt_s = START_S
        process.machine = machine
        machine.processes.add(process)
        process.on_start(process)

    def _fill(self, machine: Machine) -> None:
        for queue in (self._waiting[machine.number], self._oldest):
            while queue and machine.free_cpus:
                process = queue.popleft()
                if process.machine is None and not process.is_over:
                    self._place(process, machine)

    def _lose_one(self) -> None:
        self.clock.at(self.clock.now_s + LOSS_S, self._lose_one)
        machine = self.machines[int(self.rng.integers(len(self.machines)))]
        self.cpu_s()
        self._present -= machine.cores
        self._num_free -= machine.free_cpus
        self.num_losses += 1
        machine.is_lost, machine.free_cpus = True, 0
        lost = list(machine.processes)
        for process in lost:
            process.is_over = True
            machine.stop(process)
        self.clock.at(self.clock.now_s + NOTICE_S, partial(self._notice, machine.number, lost))
        self.clock.at(self.clock.now_s + AWAY_S, partial(self._replace, machine))

    def _notice(self, machine: int, lost: list[Process]) -> None:
        for process in lost:
            process.on_death()
        self.on_loss(machine)

    def _replace(self, machine: Machine) -> None:
        self.cpu_s()
        self._present += machine.cores
        self._num_free += machine.cores
        machine.is_lost, machine.free_cpus, machine.idle_processes = False, machine.cores, 0
        self._fill(machine)
