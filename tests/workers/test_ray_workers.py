"""What is asked of Ray is looked at, not waited for: without Ray, which may keep its answer to itself."""

import threading
import time

import pytest
import ray

from workers import cluster
from workers.ray_workers import RayWorkers


@pytest.fixture
def answer(monkeypatch):
    """Have the cluster say what its machines are: at once when it is first asked, then only when it is told to."""
    machines, gate = [{"a": 2.0}], threading.Event()

    def ask():
        ask.num_calls += 1
        if len(machines) > 1:
            assert gate.wait(60)
        if isinstance(machines[-1], Exception):
            raise machines[-1]
        return machines[-1]

    ask.num_calls = 0
    monkeypatch.setattr(cluster, "cpus_of_machines", ask)
    return machines, gate, ask


def test_a_cluster_that_keeps_silent_is_as_it_was_and_not_waited_for(answer):
    machines, gate, _ = answer
    workers = RayWorkers()
    machines.append({"a": 2.0, "b": 6.0})
    assert [workers.num_cpus() for _ in range(3)] == [2, 2, 2]
    gate.set()
    while workers.num_cpus() != 8:  # until the test's time limit
        time.sleep(0.01)


def test_a_cluster_that_answers_with_an_error_is_as_it_was(answer):
    machines, gate, ask = answer
    workers = RayWorkers()
    machines.append(ray.exceptions.RaySystemError("no GCS"))
    gate.set()
    before = ask.num_calls
    while ask.num_calls < before + 3:  # it is asked again after each answer, also after an error
        assert workers.num_cpus() == 2
        time.sleep(0.01)
