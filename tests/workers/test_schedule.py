"""The order and the bounds of one segment's work, with plain objects: no Ray."""

import itertools

import pytest
from hypothesis import given
from hypothesis import strategies as st

from schemas.errors import WorkerLost
from workers.pipeline import MAX_ATTEMPTS, Limits, plan_limits, segments_at_once
from workers.schedule import FitPiece, SegmentSchedule, pieces_after_death


def limits(streams=1, chunk_sweeps=None, sweeps_ahead=4, fits_in_flight=3):
    return Limits(streams, chunk_sweeps, sweeps_ahead, fits_in_flight)


def deaths_until_settled(size, poison):
    """Run one batch in which fits of ``poison`` end their worker; return how it was split and how often it died."""
    waiting, done, failed, num_deaths = [FitPiece(0, 0, 0, size)], [], [], 0
    while waiting:
        piece = waiting.pop()
        if poison.isdisjoint(range(piece.start, piece.stop)):
            done.append(piece)
            continue
        num_deaths += 1
        again = pieces_after_death(piece)
        waiting.extend(again)
        if not again:
            failed.append(piece)
    return done, failed, num_deaths


@given(st.data())
def test_halving_finds_just_the_poison(data):
    size = data.draw(st.integers(1, 64))
    poison = data.draw(st.sets(st.integers(0, size - 1), max_size=3))
    done, failed, _ = deaths_until_settled(size, poison)
    assert {piece.start for piece in failed} == poison
    fits = sorted(k for piece in done + failed for k in range(piece.start, piece.stop))
    assert fits == list(range(size))  # each fit is in one piece


def test_one_poison_cluster_of_a_full_batch_costs_few_workers():
    _, _, num_deaths = deaths_until_settled(64, {37})
    assert num_deaths == 2 + 5 + 2  # the batch twice, its parts once on the way down, the single fit twice


def test_a_batch_is_tried_whole_again_before_it_is_cut():
    piece = FitPiece(3, 1, 0, 8)
    (again,) = pieces_after_death(piece)
    assert (again.start, again.stop, again.attempt) == (0, 8, 2)
    left, right = pieces_after_death(again)
    assert [(p.start, p.stop, p.is_whole) for p in (left, right)] == [(0, 4, False), (4, 8, False)]


class Segment:
    """Drives a schedule in the order that ``choose`` picks, and checks its bounds at every step."""

    def __init__(self, sweeps, bounds, batch_sizes, choose):
        self.sweeps, self.bounds, self.batch_sizes, self.choose = sweeps, bounds, batch_sizes, choose
        self.schedule = SegmentSchedule(sweeps, bounds)
        self.prepared, self.written, self.parts = [], [], {}

    def run(self):
        waiting = []
        while not self.schedule.is_done:
            while finishable := self.schedule.next_to_finish():
                waiting.append(("finish", *finishable))
            while piece := self.schedule.next_fit():
                waiting.append(("fit", piece))
            for stream in range(self.bounds.streams):
                if rest := self.schedule.next_to_prepare(stream):
                    waiting.append(("prepare", stream, rest))
            assert sum(item[0] == "fit" for item in waiting) <= self.bounds.fits_in_flight
            assert len(self.prepared) - len(self.written) <= self.bounds.sweeps_ahead
            self.end(*waiting.pop(self.choose(len(waiting))))

    def end(self, kind, *item):
        if kind == "prepare":
            stream, rest = item
            self.prepared.append(rest.start)
            self.schedule.prepared(stream, self.batch_sizes(rest.start))
        elif kind == "fit":
            (piece,) = item
            self.schedule.fitted(piece, f"result of {piece}")
        else:
            sweep, parts = item
            self.parts[sweep] = parts
            for turn in self.schedule.finished(sweep):
                self.written.append(turn)
                self.schedule.written()


@given(st.data())
def test_every_sweep_is_prepared_once_and_written_in_order(data):
    sweeps = range(data.draw(st.integers(0, 5)), data.draw(st.integers(6, 40)))
    streams = data.draw(st.integers(1, 3))
    chunk = data.draw(st.integers(1, 8)) if streams > 1 else None
    bounds = limits(streams, chunk, sweeps_ahead=data.draw(st.integers(1, 12)))
    sizes = data.draw(st.lists(st.lists(st.integers(1, 4), max_size=3), min_size=1, max_size=5))
    segment = Segment(
        sweeps, bounds, lambda sweep: sizes[sweep % len(sizes)], lambda n: data.draw(st.integers(0, n - 1))
    )
    segment.run()
    assert sorted(segment.prepared) == list(sweeps)
    assert segment.written == list(sweeps)
    for sweep, parts in segment.parts.items():
        assert [(part.piece.batch, part.piece.stop) for part in parts] == list(enumerate(sizes[sweep % len(sizes)]))


def test_fits_of_early_sweeps_go_first():
    schedule = SegmentSchedule(range(4), limits(fits_in_flight=10))
    for _ in range(2):
        schedule.next_to_prepare(0)
        schedule.prepared(0, [2, 1])
    pieces = list(iter(schedule.next_fit, None))
    assert [(piece.sweep, piece.batch) for piece in pieces] == [(0, 0), (0, 1), (1, 0), (1, 1)]


def test_a_poison_fit_leaves_the_rest_of_its_batch_alone():
    schedule = SegmentSchedule(range(1), limits())
    schedule.next_to_prepare(0)
    schedule.prepared(0, [4])
    while piece := schedule.next_fit():
        if piece.start <= 2 < piece.stop:
            schedule.fit_died(piece)
        else:
            schedule.fitted(piece, "flow")
    _, parts = schedule.next_to_finish()
    assert [(part.piece.start, part.piece.stop, part.result) for part in parts] == [
        (0, 2, "flow"),
        (2, 3, None),
        (3, 4, "flow"),
    ]


def test_a_stream_whose_worker_died_begins_at_the_same_sweep_and_not_for_ever():
    schedule = SegmentSchedule(range(3, 9), limits())
    assert schedule.next_to_prepare(0) == range(3, 9)
    schedule.prepared(0, [])
    for _ in range(MAX_ATTEMPTS - 1):
        assert schedule.next_to_prepare(0) == range(4, 9)
        schedule.preparing_died(0)
    assert schedule.next_to_prepare(0) == range(4, 9)
    with pytest.raises(WorkerLost, match="preparing sweep 4"):
        schedule.preparing_died(0)


def test_a_sweep_whose_worker_died_is_finished_again_and_not_for_ever():
    schedule = SegmentSchedule(range(1), limits())
    schedule.next_to_prepare(0)
    schedule.prepared(0, [])
    for _ in range(MAX_ATTEMPTS - 1):
        assert schedule.next_to_finish() == (0, [])
        schedule.finishing_died(0)
    schedule.next_to_finish()
    with pytest.raises(WorkerLost, match="finishing sweep 0"):
        schedule.finishing_died(0)


@pytest.mark.parametrize(("num_cpus", "num_segments"), list(itertools.product([1, 2, 8, 64], [1, 2, 20])))
def test_limits_let_every_stream_work_and_keep_every_cpu_busy(num_cpus, num_segments):
    bounds = plan_limits(num_cpus, num_segments)
    assert bounds.fits_in_flight * num_segments >= num_cpus
    assert (bounds.chunk_sweeps is None) == (bounds.streams == 1)
    assert bounds.sweeps_ahead >= bounds.streams * (bounds.chunk_sweeps or 1)
    assert segments_at_once(num_cpus) >= 1
