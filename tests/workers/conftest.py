"""One small Ray a session, one small street, and its labels as one process makes them."""

from pathlib import Path

import pytest

from labeling.in_process import label_in_process
from labeling.run import label_segments
from schemas.config import resolve_config

SWEEPS = 8
STREETS = tuple(f"synthetic:street?azimuth_steps=450&beams=16&seed={seed}&sweeps={SWEEPS}" for seed in (1, 2))


@pytest.fixture(scope="session")
def streets():
    return STREETS


@pytest.fixture(scope="session")
def shards():
    """Return a function that reads all shards of a label folder: bytes by path."""

    def read(folder):
        return {path.relative_to(folder).as_posix(): path.read_bytes() for path in Path(folder).rglob("*.parquet")}

    return read


@pytest.fixture(scope="session")
def config():
    return resolve_config(overrides={"flow.iterations": 10, "flow.hidden_units": 16, "write_points": True})


@pytest.fixture(scope="session")
def oracle(config, shards, tmp_path_factory):
    """The shards of STREETS, labelled in this process."""
    output = tmp_path_factory.mktemp("oracle")
    manifest = label_segments("synthetic", STREETS, output, config, label_in_process)
    assert [segment.state for segment in manifest.segments] == ["SUCCEEDED"] * len(STREETS)
    return shards(output)


@pytest.fixture(scope="session")
def cluster():
    """A Ray of two CPUs that this process has joined."""
    from workers.cluster import local_cluster

    with local_cluster(2):
        yield
