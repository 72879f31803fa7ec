"""What a command costs: core-seconds and memory of all its processes."""

import subprocess
import threading
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import psutil

_TICK_S = 0.25  # a process loses at most the end of its life: less than this


@dataclass(frozen=True, slots=True)
class Usage:
    """Of one command and all that it started."""

    core_s: float  # user + system
    wall_s: float
    peak_pss_mb: float  # summed over processes, shared pages counted once
    num_processes: int


def run_measured(command: Sequence[str | Path], environment: Mapping[str, str] | None = None) -> Usage:
    """Run a command to its end and add up what its processes took.

    Raises:
        subprocess.CalledProcessError: It failed; its output is in the exception.

    """
    start_s = time.monotonic()
    process = subprocess.Popen(
        [str(part) for part in command], stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, env=environment
    )
    meter = _Meter(process.pid)
    thread = threading.Thread(target=meter.run, daemon=True)
    thread.start()
    output, _ = process.communicate()
    meter.stop.set()
    thread.join()
    if process.returncode:
        raise subprocess.CalledProcessError(process.returncode, process.args, output)
    return Usage(sum(meter.core_s.values()), time.monotonic() - start_s, meter.peak_pss_bytes / 1e6, len(meter.core_s))


class _Meter:
    """Looks at a process and its descendants until stopped; what ended keeps the time it was last seen with."""

    def __init__(self, pid: int) -> None:
        self.stop = threading.Event()
        self.core_s: dict[tuple[int, float], float] = {}  # (pid, start) -> user + system
        self.peak_pss_bytes = 0
        self._root = psutil.Process(pid)
        self._known: dict[tuple[int, float], psutil.Process] = {}

    def run(self) -> None:
        tick = 0
        while not self.stop.is_set():
            self._look(has_memory=tick % 8 == 0)
            tick += 1
            self.stop.wait(_TICK_S)

    def _look(self, *, has_memory: bool) -> None:
        try:
            for process in [self._root, *self._root.children(recursive=True)]:
                self._known[process.pid, process.create_time()] = process  # orphans stay known
        except psutil.NoSuchProcess:
            pass  # the root has ended between two looks
        pss_bytes = 0
        for key, process in list(self._known.items()):
            try:
                times = process.cpu_times()
                self.core_s[key] = times.user + times.system
                pss_bytes += process.memory_full_info().pss if has_memory else 0
            except (psutil.NoSuchProcess, psutil.AccessDenied):
                del self._known[key]
        self.peak_pss_bytes = max(self.peak_pss_bytes, pss_bytes)
