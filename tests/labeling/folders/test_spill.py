import tempfile

import numpy as np
import pytest

from labeling.folders.spill import ObservationSpill
from schemas.objects import SweepObservation, SweepPoints


def same(ours, theirs, record):
    for name in record.__slots__:
        if name not in ("points", "proposals"):
            np.testing.assert_array_equal(getattr(ours, name), getattr(theirs, name), err_msg=name)
    return True


def test_observations_come_back_in_order_with_their_points(make_observation):
    observations = [
        make_observation(0, [4, 7]),
        make_observation(1, reason="broken"),
        make_observation(2),
        make_observation(3, [1], has_flow=False),
    ]
    with ObservationSpill(keeps_points=True) as spill:
        for observation in observations:
            spill.append(observation)
        for ours, theirs in zip(observations, spill.restore(), strict=True):
            assert same(ours, theirs, SweepObservation)
            assert (ours.points is None) == (theirs.points is None)
            assert ours.points is None or same(ours.points, theirs.points, SweepPoints)


def test_points_that_nobody_wants_are_left_out(make_observation):
    with ObservationSpill(keeps_points=False) as spill:
        spill.append(make_observation(0, [4, 7]))
        assert [observation.points for observation in spill.restore()] == [None]


@pytest.mark.parametrize("is_restored", [True, False])
def test_nothing_stays_on_the_disk(make_observation, tmp_path, monkeypatch, is_restored):
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    with ObservationSpill(keeps_points=True) as spill:
        spill.append(make_observation(0, [4, 7]))
        assert not list(tmp_path.iterdir())  # whatever ends the process
        if is_restored:
            assert len(list(spill.restore())) == 1
    assert not list(tmp_path.iterdir())
