"""One small Ray a session, small logs, and their labels as one process makes them."""

from itertools import cycle, islice
from pathlib import Path

import numpy as np
import pytest

from labeling.in_process import label_in_process
from labeling.run import label_segments
from schemas.config import resolve_config

SWEEPS = 6
LONG_SWEEPS = 300
TRUCK_X_M, TRUCK_MPS = -12.0, 6.0


@pytest.fixture(scope="session")
def write_road(write_av2, tmp_path_factory):
    """Return a function that writes a log of a road, a wall, a truck that is a batch of fits for three, and cars."""

    def write(name, num_sweeps, seed):
        rng = np.random.default_rng(seed)
        road = np.column_stack([rng.uniform(-30, 30, (1500, 2)), rng.normal(0, 0.01, 1500)])
        wall = np.column_stack([rng.uniform(-30, 30, 400), np.full(400, 16.0), rng.uniform(0, 3, 400)])
        truck = rng.uniform([-6, -1.2, 0.3], [6, 1.2, 3], (1100, 3))
        movers = [(truck - [truck[:, 0].mean(), 0, 0], TRUCK_X_M, -12.0, TRUCK_MPS)]
        movers += [(rng.uniform([-2, -1, 0.3], [2, 1, 1.6], (80, 3)), -9.0 * k, 4.0 * k - 8, 4.0 + k) for k in range(6)]

        def capture(time_s):
            moved = [np.add(points, (x + speed * time_s, y, 0)) for points, x, y, speed in movers]
            return np.concatenate([road, wall, *moved])

        times_s = np.arange(num_sweeps) / 10
        captures = [capture(time_s) for time_s in times_s[:SWEEPS]]
        folder = tmp_path_factory.mktemp("logs", numbered=True) / name
        return str(write_av2(folder, times_s, islice(cycle(captures), num_sweeps)))

    return write


@pytest.fixture(scope="session")
def logs(write_road):
    """Two short logs."""
    return [write_road(f"log{seed}", SWEEPS, seed) for seed in (1, 2)]


@pytest.fixture(scope="session")
def long_log(write_road):
    """A log that takes a minute: nothing waits for its end."""
    return write_road("long", LONG_SWEEPS, 3)


@pytest.fixture(scope="session")
def shards():
    """Return a function that reads all shards of a label folder: bytes by path."""

    def read(folder):
        return {path.relative_to(folder).as_posix(): path.read_bytes() for path in Path(folder).rglob("*.parquet")}

    return read


@pytest.fixture(scope="session")
def overrides():
    """What makes sweeps cheap and labels sensible at so few of them; batches hold all points of the truck.

    Every mover gets a net, also where one velocity would do: the fits are what dies.
    """
    votes = {"static.vote_gaps_s": [0.1, 0.2]}
    nets = {"flow.iterations": 3, "flow.hidden_units": 16, "flow.max_points": 1200}
    return {**votes, **nets, "flow.without": "sparse_nets"}


@pytest.fixture(scope="session")
def config(overrides):
    return resolve_config(overrides={**overrides, "write_points": True})


@pytest.fixture(scope="session")
def oracle(config, logs, shards, tmp_path_factory):
    """The shards of the short logs, labelled in this process."""
    output = tmp_path_factory.mktemp("oracle")
    manifest = label_segments("av2", logs, output, config, label_in_process)
    assert [segment.state for segment in manifest.segments] == ["SUCCEEDED"] * len(logs)
    assert all(segment.num_tracks > 3 for segment in manifest.segments)
    return shards(output)


@pytest.fixture(scope="session")
def cluster():
    """A Ray of two CPUs that this process has joined."""
    from workers.cluster import local_cluster

    with local_cluster(2):
        yield
