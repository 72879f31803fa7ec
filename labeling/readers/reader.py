"""The protocol every data set stands behind, and the lookup by name."""

import hashlib
import re
from collections.abc import Iterator
from importlib import import_module
from typing import Any, Final, NamedTuple, Protocol, runtime_checkable

from labeling.storage import places
from labeling.storage.storage import open_storage
from labeling.synthetic.options import read_options
from schemas.arrays import Float64Array, Int64Array
from schemas.config import LabelingConfig
from schemas.errors import InvalidInput
from schemas.frames import Annotations, PointTruth, Sweep
from schemas.lidars import Lidar
from schemas.listing import SegmentListing


class DataSet(NamedTuple):
    """Who reads the segments of a data set, and how they are recognised.

    The module has two functions. ``list_segment(uri)`` looks what a segment holds, by its canonical name, and returns a
    ``SegmentListing``; ``read_segment(listing)`` opens what was listed and looks no more. Where a folder holds several
    segments, ``segments_in(storage, folder)`` yields their paths.
    """

    module: str
    layout: str = ""  # the folder that gives a segment away, or a folder of several
    holds_several: bool = False  # what has the layout is no segment itself: ``segments_in`` tells those it holds


READERS: Final[dict[str, DataSet]] = {
    "av2": DataSet("labeling.readers.argoverse2", "sensors/lidar"),
    "kitti_raw": DataSet("labeling.readers.kitti_raw", "velodyne_points/data"),
    "wod": DataSet("labeling.readers.waymo", "lidar_calibration", holds_several=True),
    "nuscenes": DataSet("labeling.readers.nuscenes", "samples/LIDAR_TOP", holds_several=True),
    "folder": DataSet("labeling.readers.folder.segment"),
    "synthetic": DataSet("labeling.readers.synthetic"),
}


@runtime_checkable
class SegmentReader(Protocol):
    """One recorded log, drive, context or scene: points are read one sweep at a time.

    A reader inherits from this, holds its listing and reads sweeps; annotations and truth only where there are some.
    """

    listing: SegmentListing

    @property
    def dataset(self) -> str:
        """The name of its data set in ``READERS``."""
        return self.listing.dataset

    @property
    def uri(self) -> str:
        """The segment's canonical name."""
        return self.listing.uri

    @property
    def segment_id(self) -> str:
        """The id that follows from the name, see ``segment_id_of``."""
        return self.listing.segment_id

    @property
    def timestamps_ns(self) -> Int64Array:
        """(T,) time stamps of the sweeps, strictly ascending; T >= 1."""
        return self.listing.timestamps_ns

    @property
    def lidars(self) -> tuple[Lidar, ...] | None:
        """What its lidars are, one record a number in ``Sweep.lidar_of_point``; None: that is measured."""
        return None

    def read_sweep(self, index: int) -> Sweep:
        """Read sweep ``index``.

        Raises:
            UnreadableSweep: The file is missing, truncated, not of its format, empty, holds a number that is not
                finite, or its pose is missing. The message is one line that names the file.
            StorageTrouble: The disk or the network refused, which says nothing about the sweep.

        """
        ...

    def read_annotations(self, index: int) -> Annotations | None:
        """Return the cuboids of sweep ``index``, or None when this sweep (or data set) has none."""
        return None

    def read_point_truth(self, index: int) -> PointTruth | None:
        """Return point-wise truth of sweep ``index``, or None when there is none."""
        return None


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
    return id_of_canonical(dataset, name)


def id_of_canonical(dataset: str, name: str) -> str:
    """Return the id of a segment by its canonical name, without a look at the disk: a dead mount would not answer.

    What is no such name, in the store of a former version, has an id of its own.
    """
    try:
        if dataset == "synthetic":
            return make_segment_id(read_options(name).name, name)
        return make_segment_id(places.split(name)[1], places.as_uri(name))
    except (InvalidInput, ValueError):  # the latter: a path that is not absolute
        return make_segment_id(name, name)


def open_segment(dataset: str, uri: str, flow_folder: str | None = None) -> SegmentReader:
    """Look what a segment holds, and open it with the reader called ``dataset``. Paths may be relative.

    Args:
        dataset: A name of ``READERS``.
        uri: The segment, in any spelling.
        flow_folder: Where its flow is read from (``flow.external_folder``); None: it is estimated.

    Raises:
        InvalidInput: Unknown data set, or a segment that cannot be read at all.

    """
    name = canonical_segment(dataset, places.absolute(uri))
    listing: SegmentListing = _module(dataset).list_segment(name)
    if flow_folder is not None:
        from labeling.readers.external_flow import list_external_flow  # it imports what is here

        listing = list_external_flow(flow_folder, listing)
    return _read(listing)


def reopen(listing: SegmentListing) -> SegmentReader:
    """Open a segment that was listed before, here or elsewhere: nothing is listed again.

    Raises:
        InvalidInput: What every sweep needs, such as poses, is gone or broken, or not what it was.

    """
    for place, digest in listing.common:
        if digest_of(place) != digest:
            raise InvalidInput(f"{place} has changed since {listing.uri} was listed: label the segment once more")
    return _read(listing)


def _read(listing: SegmentListing) -> SegmentReader:
    reader: SegmentReader = _module(listing.dataset).read_segment(listing)
    return reader


def digest_of(place: str) -> str:
    """Return the SHA-256 of a small file's content, nothing when there is no such file."""
    folder, name = places.split(place)
    try:
        return hashlib.sha256(open_storage(folder).read(name)).hexdigest()
    except FileNotFoundError:
        return ""


def _module(dataset: str) -> Any:  # a reader's module, see DataSet
    return import_module(READERS[dataset].module)


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
