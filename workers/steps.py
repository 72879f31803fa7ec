"""What processes do, a step at a time: each function takes what earlier steps gave, and computes on one thread.

The first value of each is what the segment's labeler has to know; the others stay in Ray's object store. Ray repeats no
step: attempts are counted in ``workers.schedule``.
"""

import dataclasses
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

import ray
from ray import ObjectRef

from schemas.config import LabelingConfig
from schemas.listing import SegmentListing
from schemas.manifest import SegmentEntry
from schemas.objects import LabeledTrack, Proposal, SweepObservation, Track
from workers.pipeline import PROCESS_MEMORY_BYTES, TRACK_BATCHES, cut_by_cost
from workers.schedule import Kind, Part, Step

if TYPE_CHECKING:
    from labeling.evidence.places import GroundedSweep
    from labeling.folders.identity import LabelSet
    from labeling.line import SweepWork
    from labeling.readers.reader import SegmentReader
    from labeling.stages.flow import FlowPlan, Vote
    from labeling.stages.nsfp import FitResult
    from labeling.window import SweepWindow
    from schemas.frames import MotionMask

MAX_OPENED: Final = 8  # segments that a process keeps open
MIN_TRACK_BATCH: Final = 32  # views, each counted by the points that are registered: a second or less

Place = tuple[int, int]
"""Of a track: the batch that it was completed in, and its position there."""


@dataclass(frozen=True, slots=True)
class Segment:
    """What every step of a segment knows."""

    listing: SegmentListing
    output: str
    config: LabelingConfig
    hook: Callable[[Step], None] | None = None  # called before each step, where it is taken: tests let processes die


@dataclass(frozen=True, slots=True)
class Neighbors:
    """What others have found about the sweeps that a step looks at."""

    read: range  # sweeps that somebody has read or could not read
    rejected: Mapping[int, str]  # of them: those that cannot be used, and why
    grounded: "Mapping[int, ObjectRef[GroundedSweep]]"
    motion: "Mapping[int, ObjectRef[MotionMask]]"


def find_ground(window: "SweepWindow", step: Step) -> "tuple[str, GroundedSweep | None]":
    """Read a sweep and find its ground; or say why it cannot be used."""
    from schemas.errors import UnreadableSweep

    try:
        return "", window.grounded(step.number)
    except UnreadableSweep as error:
        return str(error), None


def find_static(window: "SweepWindow", step: Step, neighbors: Neighbors) -> "tuple[None, MotionMask | None]":
    """Find which points of a sweep stand still; None: it cannot be used."""
    _tell(window, neighbors)
    return None, None if step.number in neighbors.rejected else window.motion(step.number)


def prepare(
    window: "SweepWindow", step: Step, neighbors: Neighbors, config: LabelingConfig
) -> "tuple[tuple[int, ...], SweepWork | SweepObservation]":
    """Prepare a sweep; return how many clusters each of its batches asks."""
    from labeling.line import prepare_sweep

    _tell(window, neighbors)
    work = prepare_sweep(window, step.number, config)
    sizes = () if isinstance(work, SweepObservation) else tuple(len(batch) for batch in work.vote_batches)
    return sizes, work


def _tell(window: "SweepWindow", neighbors: Neighbors) -> None:
    window.tell_usable(neighbors.read, neighbors.rejected)
    for sweep, grounded in neighbors.grounded.items():
        if window.lacks_ground(sweep):
            window.take_ground(sweep, ray.get(grounded))
    for sweep, motion in neighbors.motion.items():
        if window.lacks_motion(sweep):
            window.take_motion(sweep, ray.get(motion))


def vote(segment: Segment, step: Step, work: "SweepWork") -> "tuple[None, Vote]":
    """Ask some clusters of a sweep for their motion."""
    from labeling.line import vote_sweep

    return None, vote_sweep(work, work.vote_batches[step.batch][step.start : step.stop], segment.config)


def plan(
    segment: Segment, _: Step, parts: Sequence[Part], work: "SweepWork | SweepObservation", *votes: "Vote"
) -> "tuple[tuple[int, ...], FlowPlan | None]":
    """Cut the fits of a sweep; return how many each batch has. ``votes`` are of the parts that are not lost."""
    from labeling.line import fit_batches, plan_sweep
    from labeling.stages.flow import Vote

    if isinstance(work, SweepObservation):
        return (), None
    lost = [step for step, is_lost in parts if is_lost]
    unasked = [Vote(work.vote_batches[step.batch][step.start : step.stop], None) for step in lost]
    found = plan_sweep(work, [*votes, *unasked], segment.config)
    return tuple(len(batch) for batch in fit_batches(found)), found


def fit(segment: Segment, step: Step, plan: "FlowPlan") -> "tuple[None, list[FitResult]]":
    """Fit some nets of a sweep."""
    from labeling.stages.nsfp import fit_nets

    return None, fit_nets(plan.batches[step.batch][step.start : step.stop], segment.config.flow)


def finish(
    segment: Segment,
    _: Step,
    parts: Sequence[Part],
    work: "SweepWork | SweepObservation",
    plan: "FlowPlan | None",
    *fits: "list[FitResult]",
) -> tuple[SweepObservation, SweepObservation, tuple[Proposal, ...]]:
    """Say what a sweep shows. ``fits`` are of the parts that are not lost.

    Returns:
        The observation without points and proposals; the same with the points, when they are to be written; proposals.

    """
    from labeling.line import finish_sweep, fit_batches
    from labeling.stages.nsfp import failed_fit

    if isinstance(work, SweepObservation):
        return work, work, ()
    batches = fit_batches(plan)
    results: list[list[FitResult]] = [[] for _ in batches]
    found = iter(fits)
    for step, is_lost in parts:
        problems = batches[step.batch][step.start : step.stop]
        results[step.batch] += [failed_fit(problem) for problem in problems] if is_lost else next(found)
    observation = finish_sweep(work, plan, results, segment.config)
    with_points = dataclasses.replace(observation, proposals=())
    bare = dataclasses.replace(with_points, points=None)
    return bare, with_points if segment.config.write_points else bare, observation.proposals


def link(
    segment: Segment, _: Step, observations: Sequence[SweepObservation], *proposals: tuple[Proposal, ...]
) -> tuple[Any, ...]:
    """Link the proposals of all sweeps, one tuple a sweep, into tracks; see ``_in_batches``."""
    from labeling.line import link_tracks, make_clock

    tracks = link_tracks(proposals, make_clock(observations), segment.config, segment.listing.segment_id)
    return _in_batches(tracks, [], 0, segment.config)


def complete(
    segment: Segment, _: Step, observations: Sequence[SweepObservation], tracks: Sequence[Track]
) -> tuple[None, list[LabeledTrack]]:
    """Find the whole objects of some tracks."""
    from labeling.line import complete_track, make_clock

    clock = make_clock(observations)
    return None, [complete_track(track, clock, segment.config) for track in tracks]


def regroup(
    segment: Segment,
    step: Step,
    places: Sequence[Place],
    num_batches: int,
    *batches: Any,  # tracks of each batch, then what each batch was completed to, then the proposals of all sweeps
) -> tuple[Any, ...]:
    """Put tracks together, or strays to them; see ``_in_batches``."""
    from labeling.line import regroup_tracks

    kind = segment.config.joining.regroupings[step.number - 1]
    tracks, labeled = ([batches[shift + b][k] for b, k in places] for shift in (0, num_batches))
    proposals = batches[2 * num_batches :]
    found = regroup_tracks(kind, tracks, labeled, proposals, segment.config, segment.listing.segment_id)
    return _in_batches(found, places, num_batches, segment.config)


def _in_batches(
    found: Sequence[Track | int], places: Sequence[Place], num_batches: int, config: LabelingConfig
) -> tuple[Any, ...]:
    """Cut new tracks into batches of about equal cost, the longest first. Batches follow from the tracks alone.

    Returns:
        (place of each track, size of each new batch); then TRACK_BATCHES lists of new tracks, the last ones empty.

    """
    max_points = config.registration.max_source_points
    new = [k for k, track in enumerate(found) if not isinstance(track, int)]
    costs = [_num_registered(found[k], max_points) for k in new]
    batches = [[new[k] for k in batch] for batch in cut_by_cost(costs, MIN_TRACK_BATCH * max_points)]
    place_of = {k: (num_batches + b, p) for b, batch in enumerate(batches) for p, k in enumerate(batch)}
    new_places = tuple(places[t] if isinstance(t, int) else place_of[k] for k, t in enumerate(found))
    tracks = [[found[k] for k in batch] for batch in batches]
    return (new_places, tuple(map(len, batches))), *tracks, *([] for _ in range(TRACK_BATCHES - len(batches)))


def _num_registered(track: Track | int, max_points: int) -> int:
    assert isinstance(track, Track)
    return sum(min(len(proposal.points_world), max_points) for proposal in track.proposals)


def write(
    segment: Segment,
    _: Step,
    label_set: "LabelSet",
    places: Sequence[Place],
    observations: Sequence[SweepObservation],
    rows: Sequence[ObjectRef[SweepObservation]],  # the same with their points; none when these are not written
    *labeled: Sequence[LabeledTrack],  # of each batch
) -> tuple[SegmentEntry]:
    """Say of each point what it belongs to, write the shards, and publish them. One sweep's points are held at a time.

    Raises:
        ShardConflict: Labels of other settings or other code are in the way.

    """
    from labeling.folders.entries import describe_segment
    from labeling.folders.writer import publish_segment
    from labeling.line import finish_tracks
    from labeling.storage.storage import open_storage

    def with_points() -> Iterator[SweepObservation]:
        for ref in rows:
            yield ray.get(ref)

    storage = open_storage(segment.output)
    tracks = finish_tracks([labeled[b][k] for b, k in places], segment.config)
    shards = publish_segment(storage, label_set, with_points() if rows else observations, tracks)
    return (describe_segment(storage, segment.listing.segment_id, segment.listing.uri, shards),)


_LATE: Final[Mapping[Kind, Callable[..., tuple[Any, ...]]]] = {
    Kind.VOTE: vote,
    Kind.PLAN: plan,
    Kind.FIT: fit,
    Kind.FINISH: finish,
    Kind.LINK: link,
    Kind.COMPLETE: complete,
    Kind.REGROUP: regroup,
    Kind.WRITE: write,
}
NUM_RETURNS: Final[Mapping[Kind, int]] = {
    **dict.fromkeys(Kind, 2),
    Kind.FINISH: 3,
    Kind.LINK: 1 + TRACK_BATCHES,
    Kind.REGROUP: 1 + TRACK_BATCHES,
    Kind.WRITE: 1,
}


def make_window(segment: Segment) -> "SweepWindow":
    """Return a window on a segment, for the steps that look at several sweeps."""
    from labeling.window import SweepWindow

    return SweepWindow(_open(segment.listing), segment.config)


def take_step(segment: Segment, step: Step, *inputs: Any, window: "SweepWindow | None" = None) -> Any:
    """Take a step in this process.

    Args:
        segment: What it is a step of.
        step: Which.
        inputs: What its function takes besides.
        window: That this process keeps, for the first kinds of steps; None: it has none.

    Returns:
        NUM_RETURNS values.

    """
    from labeling.threads import use_one_thread

    if segment.hook is not None:
        segment.hook(step)
    use_one_thread()
    match step.kind:
        case Kind.GROUND:
            values: tuple[Any, ...] = find_ground(window or make_window(segment), step)
        case Kind.STATIC:
            values = find_static(window or make_window(segment), step, *inputs)
        case Kind.PREPARE:
            values = prepare(window or make_window(segment), step, inputs[0], segment.config)
        case _:
            values = _LATE[step.kind](segment, step, *inputs)
    return values if len(values) > 1 else values[0]


@ray.remote(num_cpus=1, memory=PROCESS_MEMORY_BYTES, max_retries=0)
def task(labeler: Any, segment: Segment, step: Step, *inputs: Any) -> Any:
    """Tell the labeler that its task has begun, and take the step, unless that was done meanwhile: then give nothing.

    A task is never interrupted for this: it might be in the middle of an import, and no module can be imported after
    half of it was. It waits as a Future does, not by ``ray.get``, which would lend its CPU to another task.
    """
    if labeler.task_begins.remote(step).future().result():
        return take_step(segment, step, *inputs)
    num_returns = NUM_RETURNS[step.kind]
    return (None,) * num_returns if num_returns > 1 else None


_OPENED: Final[dict[tuple[str, str], "SegmentReader"]] = {}


def _open(listing: SegmentListing) -> "SegmentReader":
    """Open a segment once for all the steps that a process takes of it."""
    from labeling.readers.reader import reopen

    key = listing.uri, listing.digest
    if key not in _OPENED:
        while len(_OPENED) >= MAX_OPENED:
            del _OPENED[next(iter(_OPENED))]
        _OPENED[key] = reopen(listing)
    return _OPENED[key]
