"""Flow from a file beside each sweep: an oracle's, a trained network's, anybody's.

The files of a segment are listed when it is opened, with what is in them: they decide its labels as its sweeps do.
"""

import dataclasses
import hashlib

import numpy as np
import pyarrow as pa

from labeling.readers.files import decode_columns
from labeling.storage.storage import open_storage
from schemas.arrays import Float32Array
from schemas.errors import InvalidInput, UnreadableSweep
from schemas.listing import ExternalFlow, SegmentListing

COLUMNS = ("flow_x_m", "flow_y_m", "flow_z_m")


def list_external_flow(folder: str, listing: SegmentListing) -> SegmentListing:
    """Return the listing with the files FOLDER/<segment_id>/<timestamp_ns>.feather of its sweeps. Each is read once.

    Raises:
        InvalidInput: No place, or no file for any of the sweeps.

    """
    storage, digests = open_storage(folder), {}
    found = set(storage.list_files(listing.segment_id))
    for timestamp_ns in listing.timestamps_ns:
        path = f"{listing.segment_id}/{_name(timestamp_ns)}"
        if path in found:
            digests[_name(timestamp_ns)] = hashlib.sha256(storage.read(path)).hexdigest()
    place = storage.place(listing.segment_id)
    if not digests:
        raise InvalidInput(f"no external flow of any sweep: expected files {place}/{{timestamp_ns}}.feather")
    return dataclasses.replace(listing, flow=ExternalFlow(place, tuple(digests.items())))


def read_external_flow(listing: SegmentListing, timestamp_ns: int, num_points: int) -> Float32Array:
    """Read the flow of one sweep: one row a point, in its order.

    Returns:
        (num_points, 3) m: displacement to the next sweep in the ego axes of this one, ego motion removed.

    Raises:
        InvalidInput: The segment was opened without external flow.
        UnreadableSweep: The file was not listed or has changed since, is not Feather, of another length, or holds a
            number that is not finite.

    """
    if listing.flow is None:
        raise InvalidInput(f"{listing.uri} was opened without external flow")
    storage, name = open_storage(listing.flow.folder), _name(timestamp_ns)
    place, digests = storage.place(name), dict(listing.flow.digests)
    try:
        content = storage.read(name) if name in digests else None
    except FileNotFoundError:
        content = None
    if content is None:
        raise UnreadableSweep(f"no external flow at {place}: expected one file a sweep, there before labelling begins")
    if hashlib.sha256(content).hexdigest() != digests[name]:
        raise UnreadableSweep(f"{place} has changed since labelling began")
    columns = decode_columns(content, place, dict.fromkeys(COLUMNS, pa.float32()), UnreadableSweep)
    flow: Float32Array = np.stack([columns[name] for name in COLUMNS], axis=1)
    if len(flow) != num_points:
        raise UnreadableSweep(f"{place} has {len(flow)} rows, its sweep {num_points} points: made for another sweep?")
    if not np.isfinite(flow).all():
        raise UnreadableSweep(f"{place} holds {int((~np.isfinite(flow)).any(axis=1).sum())} rows that are not finite")
    return flow


def _name(timestamp_ns: int) -> str:
    return f"{timestamp_ns}.feather"
