"""Tasks on one sweep: fit a batch of nets, and turn the fitted flow into proposals.

A task computes with one thread on one CPU. Ray does not retry it: attempts are counted in ``workers.schedule``.
"""

import dataclasses
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

import numpy as np
import ray

from schemas.config import LabelingConfig
from schemas.objects import LabeledTrack, Proposal, SweepObservation
from workers.pipeline import TASK_MEMORY_BYTES
from workers.schedule import FitPart, FitPiece

if TYPE_CHECKING:
    from labeling.line import SweepWork
    from labeling.stages.nsfp import FitProblem, FitResult
    from schemas.config import FlowParams

FitFunction = Callable[[Sequence["FitProblem"], "FlowParams"], "list[FitResult]"]


@ray.remote(num_cpus=1, memory=TASK_MEMORY_BYTES, max_retries=0, num_returns=2)
def fit_batch(
    work: "SweepWork", piece: FitPiece, config: LabelingConfig, fit: FitFunction | None
) -> "tuple[None, list[FitResult]]":
    """Fit some of a sweep's nets; ``fit`` is ``fit_nets`` unless a test puts another in its place.

    The first of the two values tells that the second is there, without fetching it.
    """
    from labeling.stages.nsfp import fit_nets
    from labeling.threads import use_one_thread

    use_one_thread()
    assert work.plan is not None  # a piece was cut from it
    return None, (fit or fit_nets)(work.plan.batches[piece.batch][piece.start : piece.stop], config.flow)


@ray.remote(num_cpus=1, memory=TASK_MEMORY_BYTES, max_retries=0, num_returns=3)
def finish(
    work: "SweepWork | SweepObservation",
    parts: Sequence[FitPart[int]],
    config: LabelingConfig,
    *results: "list[FitResult]",
) -> tuple[SweepObservation, SweepObservation, tuple[Proposal, ...]]:
    """Say what a sweep shows, once its nets are fitted.

    Args:
        work: The sweep; or what is to be said of it, when it was rejected.
        parts: In order, together all its fits; ``result`` is a position in ``results``.
        config: All parameters.
        results: Of ``fit_batch``.

    Returns:
        The observation without points and proposals; the same with the points, when they are to be written; proposals.

    """
    from labeling.line import finish_sweep
    from labeling.stages.nsfp import FitResult
    from labeling.threads import use_one_thread

    if isinstance(work, SweepObservation):
        return work, work, ()
    use_one_thread()
    batches = work.plan.batches if work.plan else ()
    fits: list[list[FitResult]] = [[] for _ in batches]
    for part in parts:
        piece = part.piece
        if part.result is None:
            size = len(batches[piece.batch][piece.start].points)
            fits[piece.batch].append(FitResult(np.zeros((size, 3), dtype=np.float32), 0, np.nan, is_finite=False))
        else:
            fits[piece.batch].extend(results[part.result])
    observation = finish_sweep(work, fits, config)
    with_points = dataclasses.replace(observation, proposals=())
    bare = dataclasses.replace(with_points, points=None)
    return bare, with_points if config.write_points else bare, observation.proposals


@ray.remote(num_cpus=1, memory=TASK_MEMORY_BYTES, max_retries=0, num_returns=2)
def track_segment(
    observations: Sequence[SweepObservation], config: LabelingConfig, segment_id: str, *proposals: tuple[Proposal, ...]
) -> tuple[None, list[LabeledTrack]]:
    """Link the proposals of all sweeps, one tuple an observation, into labelled tracks. See ``fit_batch``."""
    from labeling.line import label_tracks, make_clock
    from labeling.threads import use_one_thread

    use_one_thread()
    return None, label_tracks(proposals, make_clock(observations), config, segment_id)
