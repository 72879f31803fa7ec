"""What static removal prepares is what the labeler listed, whatever comes and goes meanwhile. No Ray is started."""

import shutil
from pathlib import Path

import pytest

from labeling.readers.reader import open_segment
from schemas.objects import SweepObservation
from workers.schedule import Kind, Step
from workers.static_removal import StaticRemoval
from workers.steps import Neighbors, Segment

NUM_SWEEPS = 5


@pytest.fixture
def log(write_road, tmp_path):
    return Path(shutil.copytree(write_road("copied", NUM_SWEEPS, 4), tmp_path / "log"))


@pytest.fixture
def prepare(config):
    """Return a function that prepares all sweeps of a listing, as the actor does, and returns the works."""

    def run(listing):
        actor = StaticRemoval.__ray_metadata__.modified_class(Segment(listing, "out", config))
        nothing = Neighbors(range(0), {}, {}, {})
        sweeps = range(len(listing.timestamps_ns))
        return [actor.take(0, Step(sweep, Kind.PREPARE), nothing)[1] for sweep in sweeps]

    return run


def test_a_sweep_that_is_gone_is_rejected_with_its_reason_and_no_other(log, prepare):
    listing = open_segment("av2", str(log)).listing
    (log / listing.names[-1]).unlink()
    *works, last = prepare(listing)
    assert [work.dynamic.timestamp_ns for work in works] == listing.timestamps_ns[:-1].tolist()
    assert isinstance(last, SweepObservation)
    assert last.reason == f"{log / listing.names[-1]}: no such file"
    assert last.timestamp_ns == listing.timestamps_ns[-1]


def test_a_sweep_that_comes_later_is_not_seen(log, prepare):
    names = open_segment("av2", str(log)).listing.names
    late = (log / names[1]).rename(log / "late")
    listing = open_segment("av2", str(log)).listing
    expected = [work.dynamic for work in prepare(listing)]
    late.rename(log / names[1])
    found = [work.dynamic for work in prepare(listing)]
    assert [dynamic.timestamp_ns for dynamic in found] == listing.timestamps_ns.tolist()
    assert [dynamic.points_ego.tobytes() for dynamic in found] == [dynamic.points_ego.tobytes() for dynamic in expected]
