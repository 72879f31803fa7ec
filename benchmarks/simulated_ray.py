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

    def after(self, delay_s: float, action: Action) -> None:
        self._number += 1
        heapq.heappush(self._events, (self.now_s + delay_s, self._number, action))

    def run(self, is_over: Callable[[], bool]) -> None:
        while not is_over():
            self.now_s, _, action = heapq.heappop(self._events)
            action()


@dataclass(slots=True, eq=False)
class Process:
    """A process of a task, for its one computation, or of an actor, for all of them. It has a CPU to itself."""

    home: int  # the machine it is to run on
    is_bound: bool  # to it; else only by preference
    is_actor: bool
    on_start: "Callable[[Process], None]"
    on_death: Action
    machine: "Machine | None" = None  # None: it waits for a CPU
    is_over: bool = False
    debt_s: float = 0.0  # what starting it still takes


@dataclass(slots=True, eq=False)
class Machine:
    number: int
    num_cpus: int
    free_cpus: int
    idle_processes: int  # Ray starts as many ahead as there are CPUs, and keeps them
    is_lost: bool = False
    processes: set[Process] = field(default_factory=set)
    waiting: deque[Process] = field(default_factory=deque)


class Cluster:
    """Machines, and the processes that wait for a CPU of theirs.

    Every LOSS_S a machine is lost, with all that runs there.
    """

    def __init__(self, clock: Clock, num_cpus: int, rng: np.random.Generator, on_loss: Callable[[int], None]) -> None:
        self._clock, self._rng = clock, rng
        self._on_loss = on_loss  # told of each machine that is gone, NOTICE_S later
        size = min(num_cpus, CPUS_A_MACHINE)
        self.machines = [Machine(k, size, size, size) for k in range(num_cpus // size)]
        self._oldest: deque[Process] = deque()  # of those that may run anywhere
        self.num_losses = 0
        self._present = self._num_free = num_cpus
        self._counted_s = self._cpu_s = 0.0
        if len(self.machines) > 1:
            clock.after(LOSS_S, self._lose_one)

    def cpu_s(self) -> float:
        """Return the CPU-seconds that were there so far."""
        self._cpu_s += self._present * (self._clock.now_s - self._counted_s)
        self._counted_s = self._clock.now_s
        return self._cpu_s

    def start(
        self,
        home: int,
        on_start: Callable[[Process], None],
        on_death: Action,
        *,
        is_bound: bool,
        is_actor: bool = False,
    ) -> Process:
        process = Process(home, is_bound, is_actor, on_start, on_death)
        machine = self.machines[home]
        if not machine.free_cpus and not is_bound and self._num_free:
            machine = max(self.machines, key=lambda m: m.free_cpus)
        if machine.free_cpus:
            self._place(process, machine)
        else:
            self.machines[home].waiting.append(process)
            if not is_bound:
                self._oldest.append(process)
        return process

    def compute(self, process: Process, core_s: float, on_end: Action) -> None:
        def end() -> None:
            if not process.is_over:
                on_end()

        self._clock.after(core_s + process.debt_s, end)
        process.debt_s = 0.0

    def end(self, process: Process) -> None:
        """End a process, whether it computes, rests or waits."""
        if process.is_over:
            return
        process.is_over = True
        machine = process.machine
        if machine is None:
            return
        machine.processes.discard(process)
        machine.free_cpus += 1
        self._num_free += 1
        if not process.is_actor:  # it stays for the next task
            machine.idle_processes = min(machine.idle_processes + 1, machine.num_cpus)
        self._fill(machine)

    def _place(self, process: Process, machine: Machine) -> None:
        machine.free_cpus -= 1
        self._num_free -= 1
        if machine.idle_processes:
            machine.idle_processes -= 1
        else:
            process.debt_s = START_S
        process.machine = machine
        machine.processes.add(process)
        process.on_start(process)

    def _fill(self, machine: Machine) -> None:
        for queue in (machine.waiting, self._oldest):
            while queue and machine.free_cpus:
                process = queue.popleft()
                if process.machine is None and not process.is_over:
                    self._place(process, machine)

    def _lose_one(self) -> None:
        self._clock.after(LOSS_S, self._lose_one)
        machine = self.machines[int(self._rng.integers(len(self.machines)))]
        self.cpu_s()
        self._present -= machine.num_cpus
        self._num_free -= machine.free_cpus
        self.num_losses += 1
        machine.is_lost, machine.free_cpus = True, 0
        lost = list(machine.processes)
        machine.processes.clear()
        for process in lost:
            process.is_over = True
        self._clock.after(NOTICE_S, partial(self._notice, machine.number, lost))
        self._clock.after(AWAY_S, partial(self._replace, machine))

    def _notice(self, machine: int, lost: list[Process]) -> None:
        for process in lost:
            process.on_death()
        self._on_loss(machine)

    def _replace(self, machine: Machine) -> None:
        self.cpu_s()
        self._present += machine.num_cpus
        self._num_free += machine.num_cpus
        machine.is_lost, machine.free_cpus, machine.idle_processes = False, machine.num_cpus, 0
        self._fill(machine)
