import weakref
from dataclasses import fields, is_dataclass, replace

import numpy as np
import pytest

from labeling.evidence.lidars import NUM_SWEEPS as NUM_MEASURED
from labeling.evidence.vehicle import NUM_LOOKS
from labeling.geometry.boxes import iou_3d
from labeling.line import (
    finish_sweep,
    fit_batches,
    label_tracks,
    make_clock,
    observe_sweeps,
    prepare_sweeps,
    vote_and_plan,
)
from labeling.readers.reader import SegmentReader
from labeling.seeds import rng_for
from labeling.stages.nsfp import fit_nets
from labeling.synthetic.rigs import SpinningLidar
from labeling.synthetic.scene import Scene, drive, wall
from labeling.synthetic.shapes import car, walker
from schemas.config import resolve_config
from schemas.errors import InvalidInput, UnreadableSweep

LIDAR = SpinningLidar(num_beams=32, azimuth_steps=540)
FAST = resolve_config("fast")
NARROW = {"static.vote_gaps_s": (0.2, 0.4)}  # a window of a second, so that short segments are longer than it
START_NS = 1_700_000_000_000_000_000


def street(num_sweeps=16, *, is_moving=True, hz=10.0):
    """Return the reader of a street with a wall, two parked cars, a passing car (0) and a walker (1)."""
    movers = (drive(car(), (6, 4.5), 0.0, 8.0), drive(walker(), (9, -6), np.pi / 2, 1.4)) if is_moving else ()
    parked = tuple(drive(car(), (x, -7.5)) for x in (2.0, 14.0))
    return Scene(structures=(wall((-40, 10), (60, 10)),), movers=movers + parked).reader(num_sweeps, hz, LIDAR)


class Spy(SegmentReader):
    """A reader that counts reads and the sweeps that are still held, and breaks on demand."""

    def __init__(self, reader, unreadable=()):
        self.listing = reader.listing
        self._reader, self._unreadable = reader, unreadable
        self.reads, self._alive, self.most_alive = [], [], 0

    def read_sweep(self, index):
        self.reads.append(index)
        if index in self._unreadable:
            raise UnreadableSweep(f"sweep_{index}.bin: truncated")
        sweep = self._reader.read_sweep(index)
        self._alive = [ref for ref in [*self._alive, weakref.ref(sweep.points_ego)] if ref() is not None]
        self.most_alive = max(self.most_alive, len(self._alive))
        return sweep


def values_of(value):
    """Return a record, and all that is in it, in a form that compares equal when all bytes are equal."""
    if is_dataclass(value):
        return tuple((field.name, values_of(getattr(value, field.name))) for field in fields(value))
    if isinstance(value, tuple):
        return tuple(values_of(item) for item in value)
    return (value.dtype.str, value.shape, value.tobytes()) if isinstance(value, np.ndarray) else value


def observe(reader, config=FAST):
    return list(observe_sweeps(reader, config))


def label(observations, config=FAST, segment_id="segment"):
    clock = make_clock(observations)
    return list(label_tracks([o.proposals for o in observations], clock, config, segment_id))


@pytest.fixture(scope="module")
def observed():
    reader = street()
    return reader, observe(reader)


def test_every_sweep_comes_once_and_in_order(observed):
    reader, observations = observed
    assert [o.sweep_index for o in observations] == list(range(16))
    assert [o.timestamp_ns for o in observations] == reader.timestamps_ns.tolist()
    assert not any(o.is_rejected for o in observations)
    for o in observations:
        np.testing.assert_array_equal(o.world_from_ego, reader.world_from_ego(o.sweep_index))
        assert o.num_points == reader.read_sweep(o.sweep_index).num_points
        assert o.num_ground + len(o.points.point_index) == o.num_points
        assert o.num_static == (~o.points.is_dynamic).sum()
        assert (np.diff(o.points.point_index) > 0).all()
        assert o.num_clusters == o.points.cluster_id.max() + 1


def test_only_the_last_sweep_has_no_flow_but_it_has_proposals(observed):
    _, observations = observed
    assert [o.points.flow_world_m is None for o in observations] == [False] * 15 + [True]
    assert all(len(o.proposals) >= 1 for o in observations)


def test_flow_of_the_movers_is_the_truth_and_few_others_move(observed):
    reader, observations = observed
    for o in observations[2:-2]:
        rows = o.points.point_index[o.points.is_dynamic]
        owner = reader.object_index(o.sweep_index)[rows]
        truth = reader.read_point_truth(o.sweep_index).flow_ref_m[rows]
        truth = truth @ reader.world_from_ego(o.sweep_index)[:3, :3].T
        error_m = np.linalg.norm(o.points.flow_world_m[o.points.is_dynamic] - truth, axis=1)
        assert np.median(error_m[owner == 0]) < 0.1
        seen = (reader.object_index(o.sweep_index) == 0).sum()
        assert (owner == 0).sum() > 0.6 * seen  # the rest are wheels, below the margin of the ground
        assert (owner > 1).mean() < 0.1


def test_movers_become_tracks_with_boxes_near_the_truth(observed):
    reader, observations = observed
    tracks = label(observations)
    truth_of = [[reader.box_at(i, o.timestamp_ns * 1e-9 - START_NS * 1e-9) for o in observations] for i in (0, 1)]
    found = []
    for track in tracks:
        nearest = [np.linalg.norm(np.array(t)[track.sweep_index, :2] - track.boxes[:, :2], axis=1) for t in truth_of]
        found.append(int(np.argmin([distance.mean() for distance in nearest])))
        assert min(distance.mean() for distance in nearest) < 1.0
    assert found.count(0) == 1
    vehicle = tracks[found.index(0)]
    boxes = np.stack([reader.box_at(0, (stamp - START_NS) * 1e-9) for stamp in vehicle.timestamp_ns])
    assert len(vehicle.sweep_index) >= 14
    assert np.median(np.diag(iou_3d(vehicle.boxes, boxes))) > 0.6
    assert np.median(vehicle.velocity_mps[:, 0]) == pytest.approx(8.0, abs=0.3)


def test_two_runs_are_equal_to_the_last_byte(observed):
    _, observations = observed
    again = observe(street())
    assert [values_of(o) for o in again] == [values_of(o) for o in observations]
    first, second = label(observations), label(again)
    assert [t.track_id for t in first] == [t.track_id for t in second]
    assert [t.boxes.tobytes() for t in first] == [t.boxes.tobytes() for t in second]


def test_nets_too_are_equal_to_the_last_byte():
    config = resolve_config("default", {"flow.iterations": 5, "sweeps": (6, 9)})
    assert [values_of(o) for o in observe(street(), config)] == [values_of(o) for o in observe(street(), config)]


@pytest.mark.parametrize("part", [(0, 3), (6, 10), (15, 16)])
def test_a_part_is_labelled_as_in_the_whole(observed, part):
    _, observations = observed
    config = resolve_config("fast", {"sweeps": part})
    assert [values_of(o) for o in observe(street(), config)] == [values_of(o) for o in observations[slice(*part)]]


def test_a_part_is_labelled_as_in_the_whole_beside_unreadable_sweeps():
    """Whoever comes from far has met the bad sweeps by votes; whoever starts beside them has not."""
    unreadable = (7, 8, 9, 10)
    whole = observe(Spy(street(), unreadable))
    for part in ((6, 7), (11, 12)):
        found = observe(Spy(street(), unreadable), resolve_config("fast", {"sweeps": part}))
        assert [values_of(o) for o in found] == [values_of(o) for o in whole[slice(*part)]]
    assert whole[6].points.flow_world_m is not None  # 0.5 s to sweep 11, within the reach of flow


def test_a_part_around_an_unreadable_sweep_is_labelled_as_in_the_whole():
    """Whether a neighbour can be read is known before it is chosen, wherever a process begins."""
    whole = observe(Spy(street(28), (13,)))
    part = observe(Spy(street(28), (13,)), resolve_config("fast", {"sweeps": (11, 16)}))
    assert [values_of(o) for o in part] == [values_of(o) for o in whole[11:16]]


def test_ranges_outside_the_segment_are_refused():
    for sweeps in ((0, 17), (5, 5)):
        with pytest.raises(InvalidInput, match="sweeps 0:16"):
            observe(street(), resolve_config("fast", {"sweeps": sweeps}))


def test_a_rejected_sweep_leaves_its_neighbours_working(observed):
    observations = observe(Spy(street(), unreadable=(6,)))
    assert [o.sweep_index for o in observations] == list(range(16))
    assert [o.is_rejected for o in observations] == [k == 6 for k in range(16)]
    rejected = observations[6]
    assert rejected.reason == "sweep_6.bin: truncated"
    assert rejected.timestamp_ns == observed[0].timestamps_ns[6]
    assert (rejected.num_points, rejected.points, rejected.proposals) == (0, None, ())
    before = observations[5]
    assert before.points.flow_world_m is not None
    speeds = [proposal.velocity_mps[0] for proposal in before.proposals]
    assert max(speeds) == pytest.approx(8.0, abs=0.5)  # over 0.2 s, to the sweep after the bad one
    tracks = label(observations)
    assert all(6 not in track.sweep_index for track in tracks)
    assert max(len(track.sweep_index) for track in tracks) >= 14


@pytest.mark.parametrize("unreadable", [(0,), (15,), (0, 1, 14, 15), tuple(range(16))])
def test_bad_sweeps_at_the_ends_or_everywhere_are_no_error(unreadable):
    observations = observe(Spy(street(), unreadable))
    assert [o.is_rejected for o in observations] == [k in unreadable for k in range(16)]
    used = [o for o in observations if not o.is_rejected]
    assert [o.points.flow_world_m is None for o in used] == [False] * (len(used) - 1) + [True] * min(1, len(used))
    label(observations)


def test_each_sweep_is_read_once_beside_looks_at_the_vehicle_and_the_lidars_and_few_are_held():
    spy = Spy(street(40), unreadable=(20,))
    observe(spy, resolve_config("fast", NARROW))
    assert set(spy.reads) == set(range(40))
    assert spy.reads.count(20) == 1
    assert len(spy.reads) <= 40 + 17 + NUM_LOOKS + NUM_MEASURED  # candidates, and one beside each; for any length
    assert spy.most_alive <= 20  # 0.44 s of votes around the sweeps 0.5 s away, on either side, and this one


def test_the_paper_looks_at_no_vehicle_and_reads_twice_only_what_the_lidars_are_measured_by():
    spy = Spy(street(40), unreadable=(20,))
    observe(spy, resolve_config("fast", {**NARROW, "static.method": "chamfer"}))
    assert sorted(spy.reads) == sorted([*range(NUM_MEASURED), *range(40)])


def test_a_lonely_sweep_has_neither_static_points_nor_flow():
    (only,) = observe(street(1))
    assert only.num_static == 0
    assert only.points.flow_world_m is None
    assert only.proposals == ()
    assert label([only]) == []


def test_two_sweeps_are_enough_for_flow():
    first, last = observe(street(2))
    assert first.points.flow_world_m is not None
    assert any(
        np.linalg.norm(p.velocity_mps[:2] - [8, 0]) < 1 for p in first.proposals
    )  # a tenth of a second is no look
    assert last.points.flow_world_m is None


def test_where_nothing_moves_there_are_no_tracks():
    observations = observe(street(is_moving=False))
    assert sum(len(o.proposals) for o in observations) <= 2  # a stray here and there must not last
    assert label(observations) == []


def test_twenty_sweeps_a_second_give_the_same_speeds():
    tracks = label(observe(street(24, hz=20.0)))
    assert max(np.median(track.velocity_mps[:, 0]) for track in tracks) == pytest.approx(8.0, abs=0.4)


def test_without_flow_what_is_not_static_is_tracked_by_its_place():
    config = resolve_config("default", {"flow.method": "none"})
    observations = observe(street(), config)
    assert all(o.proposals for o in observations)  # of the last sweep too: it needs no next one
    tracks = label(observations, config)
    assert max(np.median(track.velocity_mps[:, 0]) for track in tracks) == pytest.approx(8.0, abs=0.5)


def test_a_long_gap_has_no_flow_across_it():
    class Gapped(Spy):
        def __init__(self, reader):
            super().__init__(reader)
            stamps = reader.timestamps_ns + np.where(np.arange(16) >= 8, 5_000_000_000, 0)
            self.listing = replace(reader.listing, timestamps_ns=stamps)

        def read_sweep(self, index):
            sweep = super().read_sweep(index)
            values = {field.name: getattr(sweep, field.name) for field in fields(sweep)}
            return type(sweep)(**{**values, "timestamp_ns": int(self.timestamps_ns[index])})

    observations = observe(Gapped(street()))
    assert [o.points.flow_world_m is None for o in observations] == [k in (7, 15) for k in range(16)]
    assert observations[7].proposals  # by the sweep before
    for track in label(observations):
        is_fast = np.median(np.linalg.norm(track.velocity_mps, axis=1)) > 3
        assert not is_fast or not {7, 8} <= set(track.sweep_index.tolist())  # a walker may have paused


def test_work_done_in_halves_and_in_any_order_is_the_same(observed):
    """What the distributed run does: plans in ranges, fits anywhere, results put together."""
    config = resolve_config("default", {"flow.iterations": 4})
    reader = street()
    expected = {o.sweep_index: o for o in observe(reader, config.model_copy(update={"sweeps": (4, 8)}))}
    for indices in (range(6, 8), range(4, 6)):
        for work in prepare_sweeps(street(), config, indices):
            plan = vote_and_plan(work, config)
            fits = [fit_nets(batch, config.flow) for batch in fit_batches(plan)]
            done = finish_sweep(work, plan, fits, config)
            assert values_of(done) == values_of(expected[done.sweep_index])


def test_random_numbers_follow_from_the_key_alone():
    draws = {
        rng_for(config, segment_id, stamp, *key).integers(0, 2**62)
        for config in (FAST, resolve_config("fast", {"seed": 1}))
        for segment_id in ("a", "b")
        for stamp in (1, 2)
        for key in ((0,), (1, 0), (1, 1))
    }
    assert len(draws) == 24
    assert rng_for(FAST, "a", 1, 1, 0).random() == rng_for(FAST, "a", 1, 1, 0).random()


def test_the_clock_knows_the_usable_sweeps():
    observations = observe(Spy(street(6), unreadable=(2,)))
    clock = make_clock(observations)
    assert clock.sweep_index.tolist() == [0, 1, 3, 4, 5]
    assert make_clock([]).sweep_index.shape == (0,)
