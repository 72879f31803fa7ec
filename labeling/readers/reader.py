"""The protocol every data set stands behind, and the lookup by name."""

import hashlib
import re
from collections.abc import Callable, Iterator
from importlib import import_module
from typing import Final, Protocol, runtime_checkable

from labeling.storage import places
from labeling.synthetic.options import read_options
from schemas.arrays import Float64Array, Int64Array
from schemas.config import LabelingConfig
from schemas.errors import InvalidInput
from schemas.frames import Annotations, PointTruth, Sweep

READERS: Final[dict[str, str]] = {
    "av2": "labeling.readers.argoverse2:open_segment",
    "kitti_raw": "labeling.readers.kitti_raw:open_segment",
    "synthetic": "labeling.readers.synthetic:open_segment",
}


@runtime_checkable
class SegmentReader(Protocol):
    """One recorded log, drive, context or scene. Opening it lists sweeps; points are read one sweep at a time."""

    dataset: str
    uri: str  # see canonical_segment
    segment_id: str  # see segment_id_of
    timestamps_ns: Int64Array  # (T,) strictly ascending; T >= 1

    def read_sweep(self, index: int) -> Sweep:
        """Read sweep ``index``.

        Raises:
            UnreadableSweep: The file is missing, truncated, not of its format, empty, holds a number that is not
                finite, or its pose is missing. The message is one line that names the file.

        """
        ...

    def read_annotations(self, index: int) -> Annotations | None:
        """Return the cuboids of sweep ``index``, or None when this sweep (or data set) has none."""
        ...

    def read_point_truth(self, index: int) -> PointTruth | None:
        """Return point-wise truth of sweep ``index``, or None when there is none."""
        ...


@runtime_checkable
class AnnotatedBetweenSweeps(Protocol):
    """A segment whose annotations also stand at instants without a sweep. Who moves is known more surely with them."""

    def read_annotations_between(self) -> Iterator[tuple[int, Float64Array, Annotations]]:
        """Yield time stamp, world_from_ego (4, 4) and cuboids of each annotated instant with a pose but no sweep."""
        ...


def require_dataset(dataset: str) -> None:
    """Raise InvalidInput when no reader has this name."""
    if dataset not in READERS:
        raise InvalidInput(f"unknown dataset {dataset!r}: expected one of {', '.join(READERS)}")


def canonical_segment(dataset: str, uri: str) -> str:
    """Return the one name of a segment, without opening it: a canonical place, or ``synthetic:`` with sorted options.

    Raises:
        InvalidInput: Unknown data set, or what cannot be the name of one of its segments.

    """
    require_dataset(dataset)
    return read_options(uri).uri if dataset == "synthetic" else places.canonical(uri)


def segment_id_of(dataset: str, uri: str) -> str:
    """Return the id of a segment, which follows from its name alone: whether it can be opened makes no difference."""
    try:
        name = canonical_segment(dataset, places.absolute(uri))
    except InvalidInput:
        return make_segment_id(uri, uri)
    if dataset == "synthetic":
        return make_segment_id(read_options(name).name, name)
    return make_segment_id(places.split(name)[1], places.as_uri(name))


def open_segment(dataset: str, uri: str) -> SegmentReader:
    """Open one segment with the reader called ``dataset``. A path may be relative to the current folder.

    Raises:
        InvalidInput: Unknown data set, or a segment that cannot be read at all.

    """
    name = canonical_segment(dataset, places.absolute(uri))
    module, function = READERS[dataset].split(":")
    opener: Callable[[str], SegmentReader] = getattr(import_module(module), function)
    return opener(name)


def make_segment_id(readable_name: str, full_uri: str) -> str:
    """Return a readable name plus a short hash of the full URI, safe in a file name.

    The name alone would collide: buckets repeat their last folder's name.
    """
    safe = re.sub(r"[^A-Za-z0-9_.]+", "-", readable_name).strip("-") or "segment"
    return f"{safe[:80]}-{hashlib.sha256(full_uri.encode()).hexdigest()[:8]}"


def sweep_range(reader: SegmentReader, config: LabelingConfig) -> range:
    """Return the sweep indices to label.

    Raises:
        InvalidInput: The range is empty or lies outside the segment.

    """
    num_sweeps = len(reader.timestamps_ns)
    start, stop = config.sweeps or (0, num_sweeps)
    if not 0 <= start < stop <= num_sweeps:
        raise InvalidInput(f"sweeps {start}:{stop} lie outside {reader.uri}, which has sweeps 0:{num_sweeps}")
    return range(start, stop)


def content_digest(reader: SegmentReader) -> str:
    """Return 16 hex digits of what was listed of a segment when it was opened: other sweeps, another digest."""
    return hashlib.sha256(reader.timestamps_ns.tobytes()).hexdigest()[:16]
