"""The whole line in one process, without Ray: the documentation of the method and the oracle of the distributed run.

reader -> ground -> static -> decomposition -> flow -> proposals | tracking -> registration -> refinement
            (per sweep, within a sliding window: observe_sweeps)      (over the segment: label_tracks)
"""

from collections.abc import Iterable, Iterator

from labeling.readers.reader import SegmentReader
from schemas.config import LabelingConfig
from schemas.objects import LabeledTrack, SweepObservation


def observe_sweeps(reader: SegmentReader, config: LabelingConfig) -> Iterator[SweepObservation]:
    """Yield what each sweep of ``config.sweeps`` shows, in order, holding no more than a window of sweeps.

    Every sweep of the range is yielded once: one that cannot be used comes as rejected, with its reason.

    Raises:
        InvalidInput: ``config.sweeps`` lies outside the segment.

    """
    raise NotImplementedError


def label_tracks(
    observations: Iterable[SweepObservation], config: LabelingConfig, segment_id: str
) -> list[LabeledTrack]:
    """Link, complete and refine the proposals of a segment into labelled tracks, ordered by first sweep."""
    raise NotImplementedError
