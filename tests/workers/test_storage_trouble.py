"""Disk or network trouble is no fault of a segment: another attempt may succeed. No Ray is started."""

import pytest

from schemas.errors import InvalidInput, StorageTrouble, WorkerLost
from workers.pipeline import plan_limits
from workers.segment_labeler import Assignment, SegmentLabeler


@pytest.fixture
def run(config, monkeypatch):
    """Return a function that runs a labeler whose segment cannot be opened."""

    def open_and_fail(error):
        def broken(*_):
            raise error

        monkeypatch.setattr("workers.segment_labeler.open_segment", broken)
        assignment = Assignment("av2", "/data/log", "/data/out", config, plan_limits(2, 1))
        return SegmentLabeler.__ray_metadata__.modified_class(assignment, None).run()

    return open_and_fail


def test_trouble_asks_for_another_attempt(run):
    with pytest.raises(WorkerLost, match="disk or network trouble: s3://bucket/log: connection refused"):
        run(StorageTrouble("s3://bucket/log: connection refused"))


def test_wrong_input_does_not(run):
    outcome = run(InvalidInput("/data/log: no such folder"))
    assert (outcome.failure.error, outcome.entry.state) == ("InvalidInput", "FAILED")
