"""Is the cluster well: asked once, looked at again, without Ray."""

import os
import stat
from pathlib import Path
from types import SimpleNamespace

import pytest

from workers import cluster
from workers.cluster import ClusterLost, HealthProbe


@pytest.fixture
def ray_of(monkeypatch):
    """Return a function that plays a Ray that has answered, or not, on the test's clock."""
    clock = SimpleNamespace(now_s=0.0)
    monkeypatch.setattr(cluster, "time", SimpleNamespace(monotonic=lambda: clock.now_s))
    monkeypatch.setattr(cluster, "_code_version", SimpleNamespace(remote=lambda: "asked"))

    def play(answer=None):
        monkeypatch.setattr(cluster.ray, "wait", lambda refs, timeout: (refs if answer else [], []))
        monkeypatch.setattr(cluster.ray, "get", answer or (lambda _: None))
        return clock

    return play


def look_for(probe, clock, seconds):
    for _ in range(int(4 * seconds)):
        clock.now_s += 0.25
        if probe.is_answered():
            return True
    return False


def test_an_answer_is_seen_when_it_is_there(ray_of):
    clock = ray_of()
    probe = HealthProbe()
    assert not look_for(probe, clock, 20)
    ray_of(lambda ref: "1.0")
    assert look_for(probe, clock, 1)


def test_a_cluster_that_does_not_answer_in_time_is_lost(ray_of):
    clock = ray_of()
    probe = HealthProbe()
    assert not look_for(probe, clock, 29)
    with pytest.raises(ClusterLost, match="has run nothing for us within 30 s"):
        look_for(probe, clock, 2)


def test_a_cluster_that_answers_with_its_own_death_is_lost_at_once(ray_of):
    def die(_):
        raise cluster.ray.exceptions.RaySystemError("the raylet died\nand so on")

    clock = ray_of(die)
    with pytest.raises(ClusterLost, match=r"^the Ray cluster is gone: .*the raylet died$"):
        look_for(HealthProbe(), clock, 1)


def test_time_that_we_slept_through_proves_nothing(ray_of):
    clock = ray_of()
    probe = HealthProbe()
    assert not look_for(probe, clock, 1)
    clock.now_s += 3600
    assert not probe.is_answered()
    assert not look_for(probe, clock, 20)


def test_the_folder_of_a_local_ray_is_open_to_nobody_else_and_its_sockets_fit(monkeypatch):
    seen = {}

    def init(**options):
        place = Path(options["_temp_dir"])
        place.mkdir()
        place.chmod(0o777)  # as Ray does
        seen["folder"], seen["modes"] = place, [stat.S_IMODE(part.stat().st_mode) for part in place.parents]
        seen["TMPDIR"] = os.environ["TMPDIR"]

    monkeypatch.setattr(cluster.ray, "init", init)
    monkeypatch.setattr(cluster.ray, "shutdown", lambda: None)
    with cluster.local_cluster(1):
        assert seen["folder"].is_dir()
    assert seen["modes"][0] == 0o700
    assert str(seen["folder"].parent) == seen["TMPDIR"]
    assert not seen["folder"].parent.exists()
    session = "session_2026-11-28_05-14-17_123456_4194304"  # Ray's name for a run
    shorter = 7 - len(str(os.getpid()))  # than the longest pid
    assert len(os.fsencode(seen["folder"] / session / "sockets/plasma_store")) + shorter <= 107
