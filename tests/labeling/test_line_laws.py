"""Laws of the line up to the proposals: what about the input, or its cutting, may change and the answer must not."""

from dataclasses import replace

import numpy as np
import pytest

from labeling.geometry.transforms import rotate_vectors, transform_points, yaw_translation
from labeling.line import SweepWork, finish_sweep, fit_batches, observe_sweeps, prepare_sweeps, vote_and_plan
from labeling.readers.reader import SegmentReader
from labeling.stages.nsfp import fit_nets
from labeling.synthetic.rigs import SpinningLidar
from labeling.synthetic.scene import Scene, drive, wall
from labeling.synthetic.shapes import block, car, walker
from schemas.config import resolve_config

NUM_SWEEPS = 8
NARROW = {"static.vote_gaps_s": (0.2, 0.4)}  # a window of a second, so that short segments are longer than it
CONFIG = resolve_config("default", {**NARROW, "flow.iterations": 3})
PART = resolve_config("fast", {**NARROW, "sweeps": (4, 6)})


class Street(SegmentReader):
    """A reader of a street with two movers, a parked car and a wall; ``change`` makes another sweep of each."""

    def __init__(self, change=None, ego_mps=0.0):
        movers = (drive(car(), (6, 4.5), 0.0, 8.0), drive(walker(), (9, -6), np.pi / 2, 1.4), drive(car(), (2, -7.5)))
        ego = drive(block(), speed_mps=ego_mps).path
        scene = Scene(structures=(wall((-40, 10), (60, 10)),), movers=movers, ego=ego)
        self._reader = scene.reader(NUM_SWEEPS, lidar=SpinningLidar(num_beams=32, azimuth_steps=540))
        self.listing = self._reader.listing
        self._change = change or (lambda sweep: sweep)

    def read_sweep(self, index):
        return self._change(self._reader.read_sweep(index))


def bytes_of(observation):
    points = observation.points
    flow = None if points.flow_world_m is None else points.flow_world_m.tobytes()
    proposals = [(p.points_world.tobytes(), p.velocity_mps.tobytes()) for p in observation.proposals]
    return points.point_index.tobytes(), points.cluster_id.tobytes(), flow, proposals


@pytest.fixture(scope="module")
def whole():
    return list(observe_sweeps(Street(), CONFIG))


@pytest.mark.parametrize("seed", range(2))
def test_any_cut_gives_the_bytes_of_the_whole(whole, seed):
    """Ranges in any order, each by a reader of its own, each fit in a batch of its sweep: as the workers do it."""
    rng = np.random.default_rng(seed)
    bounds = [0, *np.sort(rng.choice(np.arange(1, NUM_SWEEPS), 2, replace=False)), NUM_SWEEPS]
    ranges = [range(int(bounds[k]), int(bounds[k + 1])) for k in range(3)]
    found = {}
    for k in rng.permutation(3):
        for work in prepare_sweeps(Street(), CONFIG, ranges[k]):
            assert isinstance(work, SweepWork)
            plan = vote_and_plan(work, CONFIG)
            fits = [fit_nets(batch, CONFIG.flow) for batch in fit_batches(plan)]
            found[work.dynamic.sweep_index] = finish_sweep(work, plan, fits, CONFIG)
    assert sum(len(o.proposals) for o in whole) >= 2 * NUM_SWEEPS
    assert [bytes_of(found[k]) for k in range(NUM_SWEEPS)] == [bytes_of(o) for o in whole]


@pytest.mark.parametrize("ego_mps", [0.0, 4.0])
def test_moving_the_whole_world_turns_the_flow_and_carries_the_proposals(ego_mps):
    """To city coordinates, whose float32 numbers are centimetres apart: no stage computes with them."""
    there_from_here = yaw_translation(0.7, np.array([200_000.0, -100_000.0, 300.0]))

    def move(sweep):
        return replace(sweep, world_from_ego=there_from_here @ sweep.world_from_ego)

    plain, moved = observe_sweeps(Street(None, ego_mps), PART), observe_sweeps(Street(move, ego_mps), PART)
    for here, there in zip(plain, moved, strict=True):
        np.testing.assert_array_equal(there.points.point_index, here.points.point_index)
        flow = rotate_vectors(there_from_here, here.points.flow_world_m)
        np.testing.assert_allclose(there.points.flow_world_m, flow, atol=1e-4)
        assert len(here.proposals) >= 2
        for mine, theirs in zip(here.proposals, there.proposals, strict=True):
            points = transform_points(there_from_here, mine.points_world)
            np.testing.assert_allclose(theirs.points_world, points, atol=1e-4)


def test_permuting_the_points_of_each_sweep_permutes_the_flow():
    """The vote samples each cluster by row: other rows of it, two centimetres of displacement."""

    def order_of(sweep_index, num_points):
        return np.random.default_rng(sweep_index).permutation(num_points)

    def shuffle(sweep):
        order = order_of(sweep.index, sweep.num_points)
        names = ("points_ego", "capture_offset_s", "lidar_of_point")
        return replace(sweep, **{name: getattr(sweep, name)[order] for name in names})

    for plain, shuffled in zip(observe_sweeps(Street(), PART), observe_sweeps(Street(shuffle), PART), strict=True):
        ours, others = plain.points.only_dynamic(), shuffled.points.only_dynamic()
        source_row = order_of(plain.sweep_index, plain.num_points)[others.point_index]
        both, mine, theirs = np.intersect1d(ours.point_index, source_row, return_indices=True)
        assert len(both) > 0.99 * max(len(ours.point_index), len(source_row), 100)
        np.testing.assert_allclose(others.flow_world_m[theirs], ours.flow_world_m[mine], atol=0.02)
        assert len(shuffled.proposals) == len(plain.proposals)


def test_a_sweep_without_a_point_is_no_error_and_its_neighbours_find_the_movers():
    def empty(sweep):
        if sweep.index != 5:
            return sweep
        none = np.empty(0, np.float32)
        return replace(
            sweep, points_ego=none.reshape(0, 3), capture_offset_s=none, lidar_of_point=none.astype(np.uint8)
        )

    config = resolve_config("fast", {**NARROW, "sweeps": (4, 7)})
    before, nothing, after = observe_sweeps(Street(empty), config)
    assert not nothing.is_rejected
    assert (nothing.num_points, nothing.num_clusters, nothing.proposals) == (0, 0, ())
    assert nothing.points.flow_world_m.shape == (0, 3)
    for observation in (before, after):
        car_mps, walker_mps = (proposal.velocity_mps[:2] for proposal in observation.proposals[:2])
        np.testing.assert_allclose(car_mps, [8, 0], atol=0.5)
        np.testing.assert_allclose(walker_mps, [0, 1.4], atol=0.5)
