"""Processes are found, counted and ended: on children of this test."""

import subprocess
import sys

import psutil
import pytest

from workers.processes import CpuMeter, descendants, is_alive, kill, kill_session, session_members, wait_for_end

# A child and its child, which ignores everything but SIGKILL and works; both say that they are there.
FAMILY = """
import subprocess, sys
child = subprocess.Popen([sys.executable, "-c", '''
import signal, sys
for number in (signal.SIGTERM, signal.SIGINT, signal.SIGHUP):
    signal.signal(number, signal.SIG_IGN)
print("grandchild", flush=True)
while True:
    pass
'''])
child.wait()
"""


@pytest.fixture
def family():
    """A child in a session of its own, and its child."""
    process = subprocess.Popen([sys.executable, "-c", FAMILY], stdout=subprocess.PIPE, start_new_session=True)
    assert process.stdout.readline() == b"grandchild\n"
    yield process
    kill_session(process.pid)
    process.wait()
    process.stdout.close()


def test_all_generations_are_found_and_counted(family):
    meter = CpuMeter()
    found = descendants()
    assert family.pid in {process.pid for process in found}
    assert {process.pid for process in found} >= {process.pid for process in session_members(family.pid)}
    (grandchild,) = psutil.Process(family.pid).children()
    assert grandchild in found
    before_s = meter.read_core_s()
    while meter.read_core_s() <= before_s:  # until the test's time limit
        pass
    kill_session(family.pid)
    family.wait()
    counted_s = meter.read_core_s()
    assert counted_s > before_s  # what has ended still counts
    assert meter.read_core_s() == counted_s
    assert session_members(family.pid) == set()


def test_what_does_not_end_in_time_is_named_and_killed(family):
    (grandchild,) = psutil.Process(family.pid).children()
    grandchild.terminate()
    assert wait_for_end([grandchild], patience_s=0.1) == {grandchild}
    kill([grandchild])
    assert wait_for_end([grandchild], patience_s=60) == set()


def test_the_dead_do_not_run_even_unburied(family):
    process = psutil.Process(family.pid)
    process.kill()
    while process.status() != psutil.STATUS_ZOMBIE:  # nobody has waited for it yet
        pass
    assert not is_alive(process)
    family.wait()
    assert not is_alive(process)
