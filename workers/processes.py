"""Processes below this one, or of one session. A process is known by its id and its start: ids are used again."""

import contextlib
import os
import time
from collections.abc import Iterable
from typing import Final

import psutil

_KILL_S: Final = 5.0
_GONE: Final = (psutil.STATUS_ZOMBIE, psutil.STATUS_DEAD)  # they run no more, whether their parent has heard or not


def descendants() -> set[psutil.Process]:
    """Return the processes below this one."""
    return set(psutil.Process().children(recursive=True))


def session_members(session: int) -> set[psutil.Process]:
    """Return the living processes of a session, which is named by the id of its first process."""
    members = set()
    for pid in psutil.pids():
        with contextlib.suppress(ProcessLookupError, psutil.NoSuchProcess):  # it ended while we looked
            if os.getsid(pid) == session:
                members.add(psutil.Process(pid))
    return set(filter(is_alive, members))


def is_alive(process: psutil.Process) -> bool:
    """Return whether this very process still runs."""
    try:
        return process.is_running() and process.status() not in _GONE
    except psutil.NoSuchProcess:
        return False


def wait_for_end(processes: Iterable[psutil.Process], patience_s: float) -> set[psutil.Process]:
    """Wait until processes have ended, and return those that have not in time."""
    deadline_s = time.monotonic() + patience_s
    alive = set(filter(is_alive, processes))
    while alive and time.monotonic() < deadline_s:
        time.sleep(0.05)
        alive = set(filter(is_alive, alive))
    return alive


def kill_session(session: int) -> None:
    """Kill every process of a session, until none is left that could start another; for 5 s at most."""
    deadline_s = time.monotonic() + _KILL_S
    while (members := session_members(session)) and time.monotonic() < deadline_s:
        kill(members)
        time.sleep(0.01)


def kill(processes: Iterable[psutil.Process]) -> None:
    """Kill processes, none of their heirs: one that has ended is left alone, whoever has its id now."""
    for process in processes:
        with contextlib.suppress(psutil.NoSuchProcess):
            process.kill()


class CpuMeter:
    """Adds up the CPU time of all processes below this one. Ray's processes end unseen: read it often."""

    def __init__(self) -> None:
        self._core_s: dict[psutil.Process, float] = {}

    def read_core_s(self) -> float:
        """Return the core-seconds so far, user and system, as far as they were seen."""
        for process in descendants():
            with contextlib.suppress(psutil.NoSuchProcess):
                times = process.cpu_times()
                self._core_s[process] = times.user + times.system
        return sum(self._core_s.values())
