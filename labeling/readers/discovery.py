"""Find the segments of a data set below a place: a folder on a disk, or a prefix of a bucket.

What marks a segment is the data set's own rule, ``DataSet.layout``: it is a folder that has this one in it, or one of
those that the data set's reader finds in such a folder. Segments may lie at any depth, and none is looked for inside of
another. The memory that it takes grows with their depth alone.
"""

import hashlib
from collections.abc import Callable, Iterator
from datetime import datetime
from importlib import import_module

from labeling.readers.reader import READERS, DataSet, id_of_canonical, require_dataset
from labeling.storage import places
from labeling.storage.storage import Storage, open_storage
from schemas.errors import InvalidInput


def find_segments(
    dataset: str, place: str, on_unusable: Callable[[str], None], since: datetime | None = None
) -> Iterator[str]:
    """Yield the canonical names of the segments at and below a place, as they are found, in no certain order.

    One that several links lead to may come several times.

    Args:
        dataset: A name of ``READERS``.
        place: Where to look, in any spelling.
        on_unusable: Is told, in one line, of each folder whose name no place can have.
        since: Only segments that had a sweep written at this time or later.

    Raises:
        InvalidInput: Unknown data set, one whose segments lie nowhere, ``since`` of one whose segments have no folder
            of their own, or no such folder. At once; while segments are taken, only StorageTrouble is raised.

    """
    rule = describe_segments(dataset)
    if since is not None and READERS[dataset].holds_several:
        raise InvalidInput(f"{rule}: when each was written is not known")
    storage = open_storage(place)
    if not storage.has_folder():
        raise InvalidInput(f"{storage.root}: no such folder, or nothing in it; {rule}")
    return _walk(storage, "", READERS[dataset], (), on_unusable, since)


def describe_segments(dataset: str) -> str:
    """Say what a segment of a data set looks like.

    Raises:
        InvalidInput: Unknown data set, or one whose segments lie nowhere.

    """
    require_dataset(dataset)
    layout = READERS[dataset].layout
    if not layout:
        raise InvalidInput(f"segments of dataset {dataset} lie in no folder: name them to `motionlabel submit`")
    if READERS[dataset].holds_several:
        return f"segments of dataset {dataset} lie below a folder that has {layout}/ in it"
    return f"a segment of dataset {dataset} is a folder that has {layout}/ in it"


def shard_of(dataset: str, segment: str, num_shards: int) -> int:
    """Return which of ``num_shards`` shares a segment belongs to, from 0 on; it follows from its id alone."""
    digest = hashlib.sha256(id_of_canonical(dataset, segment).encode()).digest()
    return int.from_bytes(digest[:8], "big") % num_shards


def _walk(
    storage: Storage,
    folder: str,
    data_set: DataSet,
    above: tuple[str, ...],
    on_unusable: Callable[[str], None],
    since: datetime | None,
) -> Iterator[str]:
    name = next(_named(storage, folder, on_unusable), None)
    if name is None or name in above:  # the latter: a link that leads back
        return
    sweeps = f"{folder}/{data_set.layout}".lstrip("/")
    if not storage.has_folder(sweeps):
        for inner in storage.list_folders(folder):
            yield from _walk(storage, inner, data_set, (*above, name), on_unusable, since)
    elif data_set.holds_several:
        for segment in import_module(data_set.module).segments_in(storage, folder):
            yield from _named(storage, segment, on_unusable)
    elif since is None or ((newest := storage.last_modified(sweeps)) is not None and newest >= since):
        yield name


def _named(storage: Storage, path: str, on_unusable: Callable[[str], None]) -> Iterator[str]:
    """Yield the canonical name of what lies there, or nothing and tell why."""
    try:
        name = places.canonical(storage.place(path))
        name.encode()
    except (InvalidInput, UnicodeEncodeError) as problem:
        on_unusable(f"{storage.place(path)!r} is left out with all that it holds: {problem}")
        return
    yield name
