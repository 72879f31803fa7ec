"""The order and the bounds of one segment's work, with plain objects: no Ray."""

import itertools
from collections import Counter

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from schemas.errors import WorkerLost
from workers.pipeline import MAX_ATTEMPTS, Limits, choose_home, plan_limits, segments_at_once, stays_home
from workers.schedule import Kind, Part, Reach, SegmentSchedule, Step, pieces_after_death

NUM_SWEEPS = 30  # of the segment that parts are taken of


def limits(tasks_in_flight=3, sweeps_ahead=4, ground_ahead=2):
    return Limits(1, tasks_in_flight, sweeps_ahead, ground_ahead)


def reach_of(ground=3, static=1):
    def around(reach):
        return lambda sweep: range(max(0, sweep - reach), min(NUM_SWEEPS, sweep + reach + 1))

    return Reach(around(ground), around(static))


def make_schedule(sweeps=range(4), num_regroupings=2, reach=None, **bounds):
    return SegmentSchedule(sweeps, reach or reach_of(), num_regroupings, limits(**bounds))


def deaths_until_settled(size, poison):
    """Run one batch in which clusters of ``poison`` end their worker; return how it was split, how often it died."""
    waiting, done, failed, num_deaths = [Step(0, Kind.FIT, 0, 0, size)], [], [], 0
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
    clusters = sorted(k for piece in done + failed for k in range(piece.start, piece.stop))
    assert clusters == list(range(size))  # each is in one piece


def test_one_poison_cluster_of_a_full_batch_costs_few_workers():
    _, _, num_deaths = deaths_until_settled(64, {37})
    assert num_deaths == 2 + 5 + 2  # the batch twice, its parts once on the way down, the single cluster twice


def test_a_batch_is_tried_whole_again_before_it_is_cut():
    piece = Step(3, Kind.VOTE, 1, 0, 8)
    (again,) = pieces_after_death(piece)
    assert (again.start, again.stop, again.attempt) == (0, 8, 2)
    left, right = pieces_after_death(again)
    assert [(p.start, p.stop, p.is_whole) for p in (left, right)] == [(0, 4, False), (4, 8, False)]


class Segment:
    """Drives a schedule in the order that ``choose`` picks, and checks its bounds and what steps need all the time.

    Args:
        sizes: Sweep, or number of regroupings, and kind -> sizes of the batches that follow.
        is_starved: No task finds a CPU: the actor has to do everything.

    """

    def __init__(self, sweeps, reach, num_regroupings, bounds, sizes, choose, *, is_starved=False):
        self.sweeps, self.reach, self.bounds, self.sizes, self.choose = sweeps, reach, bounds, sizes, choose
        self.schedule = SegmentSchedule(sweeps, reach, num_regroupings, bounds)
        self.is_starved = is_starved
        self.tasks, self.own, self.done = [], [], []

    def run(self, num_deaths=0):
        while not self.schedule.is_done:
            while (step := self.schedule.next_task()) is not None:
                self.check(step)
                self.tasks.append(step)
            if (step := self.schedule.next_own([] if not self.is_starved else self.tasks)) is not None:
                if step not in self.tasks:
                    self.check(step)
                self.own.append(step)
            assert len(self.tasks) <= self.bounds.tasks_in_flight
            running = self.own if self.is_starved else [*self.own, *self.tasks]
            step = running[self.choose(len(running))]  # fails when nothing runs: that would be for ever
            if num_deaths and self.choose(4) == 0:
                num_deaths -= 1
                self.die(step)
            else:
                self.end(step)
        assert not self.tasks or self.is_starved

    def end(self, step):
        if step in self.own:
            self.own.remove(step)
            assert self.schedule.own_ended(step, self.sizes(step))
        else:
            self.tasks.remove(step)
            if not self.schedule.is_wanted(step):  # the actor was faster
                assert not self.schedule.task_ended(step)
                return
            assert self.schedule.task_ended(step, self.sizes(step))
        self.done.append(step)

    def die(self, step):
        if step in self.own:
            self.own.remove(step)
            self.schedule.own_died()
        else:
            self.tasks.remove(step)
            self.schedule.task_died(step)

    def check(self, step):
        assert step not in self.done
        ended = Counter((done.number, done.kind) for done in self.done)

        def has(kind, sweeps):
            return all(ended[sweep, kind] for sweep in sweeps)

        sweep = step.number
        match step.kind:
            case Kind.STATIC:
                assert has(Kind.GROUND, self.reach.ground(sweep))
            case Kind.PREPARE:
                assert has(Kind.STATIC, self.reach.static(sweep))
                ahead = [k for k in self.sweeps if ended[k, Kind.PREPARE] and not ended[k, Kind.FINISH]]
                assert len(ahead) < self.bounds.sweeps_ahead
            case Kind.LINK:
                assert has(Kind.FINISH, self.sweeps)
            case Kind.REGROUP | Kind.WRITE:
                assert has(Kind.LINK if sweep == 1 else Kind.REGROUP, [sweep - 1])


@st.composite
def segments(draw):
    start = draw(st.integers(0, 5))
    sweeps = range(start, draw(st.integers(start + 1, NUM_SWEEPS)))
    reach = reach_of(draw(st.integers(0, 6)), draw(st.integers(0, 3)))
    bounds = limits(draw(st.integers(1, 6)), draw(st.integers(1, 8)), draw(st.integers(0, 5)))
    batches = draw(st.lists(st.lists(st.integers(1, 4), max_size=3), min_size=1, max_size=5))
    followed = (Kind.PREPARE, Kind.PLAN, Kind.LINK, Kind.REGROUP)

    def sizes(step):
        return batches[(step.number + step.kind) % len(batches)] if step.kind in followed else ()

    return Segment(sweeps, reach, draw(st.integers(0, 4)), bounds, sizes, lambda n: draw(st.integers(0, n - 1)))


@settings(max_examples=50)
@given(segment=segments(), is_starved=st.booleans())
def test_every_step_is_taken_once_and_when_what_it_needs_is_there(segment, is_starved):
    segment.is_starved = is_starved
    segment.run()
    taken = Counter(segment.done)
    assert set(taken.values()) == {1}
    kinds = Counter(step.kind for step in segment.done)
    for kind in (Kind.PREPARE, Kind.PLAN, Kind.FINISH):
        assert [step.number for step in sorted(segment.done) if step.kind == kind] == list(segment.sweeps)
    assert kinds[Kind.LINK] == kinds[Kind.WRITE] == 1
    for after, kind in ((Kind.PREPARE, Kind.VOTE), (Kind.PLAN, Kind.FIT), (Kind.LINK, Kind.COMPLETE)):
        assert kinds[kind] >= sum(len(segment.sizes(step)) for step in segment.done if step.kind == after)


@settings(max_examples=50)
@given(segment=segments())
def test_a_few_deaths_change_nothing_in_the_end(segment):
    segment.run(num_deaths=MAX_ATTEMPTS - 1)
    for kind in (Kind.PREPARE, Kind.FINISH):
        assert {step.number for step in segment.done if step.kind == kind} == set(segment.sweeps)
    assert segment.schedule.has_all_sweeps


def take_until(schedule, kind, *, sizes=(2, 1)):
    """Take steps by the actor alone until one of ``kind`` is next, and return that."""
    while (step := schedule.next_own()) is not None and step.kind != kind:
        schedule.own_ended(step, sizes if step.kind in (Kind.PREPARE, Kind.PLAN) else ())
    return step


def test_steps_of_early_sweeps_go_first():
    schedule = make_schedule(tasks_in_flight=10)
    for _ in range(2):
        schedule.own_ended(take_until(schedule, Kind.PREPARE), (2, 1))
    steps = list(itertools.takewhile(lambda step: step.kind == Kind.VOTE, iter(schedule.next_task, None)))
    assert [(step.number, step.batch) for step in steps] == [(0, 0), (0, 1), (1, 0), (1, 1)]


def test_tasks_take_late_steps_before_early_ones():
    schedule = make_schedule()
    schedule.own_ended(take_until(schedule, Kind.PREPARE), (3,))
    assert schedule.next_task().kind == Kind.VOTE
    assert schedule.next_task().kind in (Kind.STATIC, Kind.GROUND)


def test_an_actor_that_is_ahead_helps_and_takes_over_only_what_waits():
    schedule = make_schedule(sweeps=range(2), tasks_in_flight=2, sweeps_ahead=1)
    schedule.own_ended(take_until(schedule, Kind.PREPARE), (1, 1, 1))
    waiting, running = schedule.next_task(), schedule.next_task()
    schedule.task_begins(running)
    helped = schedule.next_own([running, waiting])
    assert (helped.kind, helped.batch) == (Kind.VOTE, 2)
    schedule.own_ended(helped)
    while (step := schedule.next_own()) is not None:  # what is read and judged ahead
        schedule.own_ended(step)
    assert schedule.next_own([running, waiting]) == waiting
    assert schedule.own_ended(waiting)
    assert not schedule.is_wanted(waiting)
    assert schedule.next_own([running, waiting]) is None
    assert schedule.next_task() is None  # both still wait in some queue
    assert not schedule.task_ended(waiting)  # it began after all, and is late
    assert schedule.task_ended(running)
    assert schedule.next_task() == Step(0, Kind.PLAN)


@pytest.mark.parametrize("dies_first", ["task", "actor"])
def test_of_two_that_take_a_step_one_may_die(dies_first):
    schedule = make_schedule(sweeps=range(1), tasks_in_flight=1)
    schedule.own_ended(take_until(schedule, Kind.PREPARE), (1,))
    step = schedule.next_task()
    assert schedule.next_own([step]) == step
    if dies_first == "task":
        schedule.task_died(step)
        assert schedule.next_task() is None
        assert schedule.own_ended(step)
    else:
        schedule.own_died()
        assert schedule.next_own() is None
        assert schedule.task_ended(step)
    assert schedule.next_task() == Step(0, Kind.PLAN)


@pytest.mark.parametrize("kind", [Kind.VOTE, Kind.FIT])
def test_a_poison_cluster_leaves_the_rest_of_its_batch_alone(kind):
    schedule = make_schedule(sweeps=range(1))
    step = take_until(schedule, kind, sizes=(4,))
    while step is not None and step.kind == kind:
        if step.start <= 2 < step.stop:
            schedule.own_died()
        else:
            schedule.own_ended(step)
        step = schedule.next_own()
    assert step.kind == (Kind.PLAN if kind == Kind.VOTE else Kind.FINISH)
    parts = [(part.step.start, part.step.stop, part.is_lost) for part in schedule.parts(0, kind)]
    assert parts == [(0, 2, False), (2, 3, True), (3, 4, False)]
    assert all(isinstance(part, Part) for part in schedule.parts(0, kind))


@pytest.mark.parametrize("kind", [kind for kind in Kind if kind not in (Kind.VOTE, Kind.FIT)])
def test_a_step_whose_worker_died_is_taken_again_and_not_for_ever(kind):
    schedule = make_schedule(sweeps=range(3, 9), num_regroupings=1)
    followed = (Kind.PREPARE, Kind.PLAN, Kind.LINK)

    def next_step():
        while (step := schedule.next_own()).kind != kind:
            schedule.own_ended(step, (1,) if step.kind in followed else ())
        return step

    first = next_step()
    for _ in range(MAX_ATTEMPTS - 1):
        schedule.own_died()
        assert next_step() == first
    with pytest.raises(WorkerLost, match=f"died in step {kind.name.lower()} {first.number}:"):
        schedule.own_died()


def test_what_is_still_needed_of_early_sweeps_is_known():
    schedule = make_schedule(sweeps=range(10, 20), reach=reach_of(ground=4, static=2))
    assert schedule.first_needed == 4
    assert schedule.known == range(4, 4)
    schedule.own_ended(take_until(schedule, Kind.PREPARE))
    assert schedule.first_needed == 5
    assert schedule.known.stop >= 10 + 4 + 2 + 1


CLUSTERS = pytest.mark.parametrize(("num_cpus", "num_segments"), list(itertools.product([1, 2, 8, 64], [1, 2, 20])))


@CLUSTERS
def test_limits_keep_every_cpu_busy_and_leave_actors_something_to_help_with(num_cpus, num_segments):
    bounds = plan_limits(num_cpus, num_segments)
    assert (bounds.tasks_in_flight + 1) * num_segments >= num_cpus
    assert bounds.sweeps_ahead > bounds.tasks_in_flight
    assert 1 <= segments_at_once(num_cpus) <= num_cpus


def test_a_segment_stays_home_unless_it_has_a_machine_to_itself():
    assert stays_home(plan_limits(1024, segments_at_once(1024)), 16)
    assert stays_home(plan_limits(16, 3), 16)
    assert not stays_home(plan_limits(1024, 10), 16)
    assert not stays_home(plan_limits(16, 1), 16)


def test_homes_are_shared_out_by_cpus():
    homes = Counter()
    for _ in range(30):
        homes[choose_home({"small": 8, "large": 16, "head": 0}, homes)] += 1
    assert homes == {"small": 10, "large": 20}
    assert choose_home({"head": 0}, {}) is None
