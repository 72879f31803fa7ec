"""The protocol every data set stands behind, and the lookup by name."""

import hashlib
import re
from collections.abc import Callable, Iterator
from importlib import import_module
from pathlib import Path
from typing import Final, Protocol, runtime_checkable

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
    uri: str  # as given, made absolute
    segment_id: str  # see make_segment_id
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


def open_segment(dataset: str, uri: str) -> SegmentReader:
    """Open one segment with the reader called ``dataset``.

    Raises:
        InvalidInput: Unknown data set, or a segment that cannot be read at all.

    """
    if dataset not in READERS:
        raise InvalidInput(f"unknown dataset {dataset!r}: expected one of {', '.join(READERS)}")
    module, function = READERS[dataset].split(":")
    opener: Callable[[str], SegmentReader] = getattr(import_module(module), function)
    return opener(uri)


def make_segment_id(readable_name: str, full_uri: str) -> str:
    """Return a readable name plus a short hash of the full URI, safe in a file name.

    The name alone would collide: buckets repeat their last folder's name.
    """
    safe = re.sub(r"[^A-Za-z0-9_.]+", "-", readable_name).strip("-") or "segment"
    return f"{safe[:80]}-{hashlib.sha256(full_uri.encode()).hexdigest()[:8]}"


def id_of_unopened(uri: str) -> str:
    """Return the id that readers of local folders give, so that a later run with the folder there has the same name."""
    folder = Path(uri).expanduser().resolve()
    return make_segment_id(uri, uri) if ":" in uri else make_segment_id(folder.name, folder.as_uri())


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
