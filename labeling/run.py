"""Label whole segments: from their readers to the shards and the manifest of a label folder.

How a segment is labelled is given: in this process (``labeling.in_process``), or by workers.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from labeling.folders.entries import (
    failed_entry,
    find_published,
    make_manifest,
    prepare_folder,
)
from labeling.folders.folder import publish_manifest
from labeling.folders.identity import LabelSet
from labeling.readers.reader import SegmentReader, open_segment, segment_id_of, sweep_range
from labeling.storage import places
from labeling.storage.storage import Storage, open_storage
from schemas.config import LabelingConfig
from schemas.errors import InvalidInput, StorageTrouble
from schemas.manifest import Manifest, SegmentEntry

Stage = Literal["sweeps", "tracks", "finished", "already there"]


@dataclass(frozen=True, slots=True)
class RunProgress:
    """One step of a run, for whoever watches."""

    segment_id: str
    stage: Stage
    sweeps_done: int
    num_sweeps: int


OnProgress = Callable[[RunProgress], None]
LabelReaders = Callable[[Sequence[SegmentReader], Storage, LabelingConfig, OnProgress], Iterator[SegmentEntry]]
"""Labels segments, in any order, and yields the entry of each when it has ended."""


def label_segments(
    dataset: str,
    uris: Sequence[str],
    output: str | Path,
    config: LabelingConfig,
    label_readers: LabelReaders,
    *,
    on_progress: OnProgress = lambda _: None,
) -> Manifest:
    """Label segments and write a label folder.

    A segment that fails leaves the others alone; one whose shards stand already is not labelled again. The manifest is
    brought up to date after each segment, so what is complete stays readable whatever ends the run.

    Raises:
        InvalidInput: No segment can be opened, one is given twice, or nothing can be written at the output.
        StorageTrouble: The disk or the network refused; what is published stays.
        ShardConflict: The output holds labels of one of the segments from other settings or other code.

    """
    storage = open_storage(output)
    config = config.with_places(lambda place: places.canonical(places.absolute(place)))
    readers, entries = _open_all(dataset, uris, config)
    segment_ids = sorted([*readers, *entries])
    prepare_folder(storage, config)

    def make() -> Manifest:
        return make_manifest(dataset, [entries[segment_id] for segment_id in segment_ids], config)

    try:
        for segment_id, reader in readers.items():
            published = find_published(storage, LabelSet.of(reader, config), reader.uri)
            entries[segment_id] = published or failed_entry(segment_id, reader.uri, "not labelled yet")
            if published is not None:
                on_progress(RunProgress(segment_id, "already there", 0, published.num_sweeps))
        publish_manifest(storage, make())
        missing = [reader for segment_id, reader in sorted(readers.items()) if not entries[segment_id].shards]
        for entry in label_readers(missing, storage, config, on_progress):
            entries[entry.segment_id] = entry
            publish_manifest(storage, make())
    except (OSError, StorageTrouble) as error:
        raise StorageTrouble(f"disk or network trouble: {error}; run it again to go on") from error
    return make()


def _open_all(
    dataset: str, uris: Sequence[str], config: LabelingConfig
) -> tuple[dict[str, SegmentReader], dict[str, SegmentEntry]]:
    """Return readers by segment id, and entries of the segments that have none."""
    readers: dict[str, SegmentReader] = {}
    entries: dict[str, SegmentEntry] = {}
    spellings: dict[str, str] = {}  # by segment id
    for uri in uris:
        segment_id = segment_id_of(dataset, uri)
        if segment_id in spellings:
            raise InvalidInput(f"{uri} and {spellings[segment_id]} are one segment: give it once")
        spellings[segment_id] = uri
        try:
            reader = open_segment(dataset, uri, config.flow.external_folder)
            sweep_range(reader, config)
        except InvalidInput as error:
            entries[segment_id] = failed_entry(segment_id, uri, str(error))
        else:
            readers[segment_id] = reader
    if not readers:
        reasons = [entry.reason for entry in entries.values()] or ["no segment is given"]
        raise InvalidInput(reasons[0] + (f" (and {len(reasons) - 1} more such segments)" if len(reasons) > 1 else ""))
    return readers, entries
