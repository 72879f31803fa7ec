"""Reservations: a label folder holds one set of labels a segment, whoever writes, in whatever order.

    OUT/reservations/<segment_id>-labels.json    whose labels and sweeps stand there
    OUT/reservations/<segment_id>-points.json    whose points

Whoever is about to publish reserves first, when all shards are written: a run that ends before reserves nothing. The
first to come creates the reservation; whoever has the same identity shares it, whoever has another publishes nothing.
No code takes a reservation away: its owner may only be slow, and no store can make a publication fail because another
file has changed. One without shards is left by a run that died in the instant between, and people delete it.
"""

from typing import Final, get_args

from pydantic import ValidationError

from labeling.folders.identity import LabelSet
from labeling.storage.storage import Storage
from schemas.errors import InvalidInput, ShardConflict, StorageTrouble
from schemas.reservation import RESERVATIONS, Reservation, Reserved, reservation_path
from schemas.tables import SCHEMA_VERSION

_ALL_RESERVED: Final = f"{RESERVATIONS}/complete.json"  # no shard from before there were reservations lacks one
_IDENTITY_DIGITS: Final = 16


def is_reserved(storage: Storage, label_set: LabelSet) -> bool:
    """Tell whether a folder is reserved for these labels; False: for nobody yet. One read a reservation.

    Raises:
        ShardConflict: It is reserved for others.

    """
    found = [_stands(storage, ours) for ours in _reservations_of(label_set)]
    return all(found)


def reserve(storage: Storage, label_set: LabelSet) -> None:
    """Reserve a folder for these labels, or share the reservation that stands.

    Raises:
        ShardConflict: It is reserved for others.
        StorageTrouble: Disk or network refused, or somebody deletes reservations meanwhile.

    """
    if is_reserved(storage, label_set):
        return
    for ours in _reservations_of(label_set):
        if not (storage.publish(ours.path, _content(ours)) or _stands(storage, ours)):
            raise StorageTrouble(f"{storage.root}/{ours.path} was deleted while {label_set.segment_id} was published")


def reserve_older(storage: Storage) -> None:
    """Reserve a folder for the shards that were published in it before there were reservations; once a folder."""
    if _read(storage, _ALL_RESERVED) is not None:
        return
    tables: tuple[Reserved, ...] = get_args(Reserved)
    for table in tables:
        for path in storage.list_files(table):
            name = path.rpartition("/")[2].removesuffix(".parquet")
            segment_id, identity = name[: -_IDENTITY_DIGITS - 1], name[-_IDENTITY_DIGITS:]
            older = Reservation(segment_id=segment_id, table=table, identity=identity)
            storage.publish(older.path, _content(older))
    storage.publish(_ALL_RESERVED, b'{"schema_version": %d}\n' % SCHEMA_VERSION)


def reserved_identity(storage: Storage, segment_id: str, table: Reserved) -> str | None:
    """Return the identity of the set that a folder is reserved for, None for none."""
    theirs = _read_reservation(storage, reservation_path(segment_id, table))
    return None if theirs is None else theirs.identity


def _reservations_of(label_set: LabelSet) -> list[Reservation]:
    tables: tuple[Reserved, ...] = get_args(Reserved)
    return [
        Reservation(
            segment_id=label_set.segment_id,
            table=table,
            identity=label_set.identity(table),
            label_version=label_set.label_version,
            dataset=label_set.dataset,
            content=label_set.content,
            config=label_set.config.deciding(table),
        )
        for table in tables
        if table in label_set.paths
    ]


def _stands(storage: Storage, ours: Reservation) -> bool:
    theirs = _read_reservation(storage, ours.path)
    if theirs is not None and theirs.identity != ours.identity:
        raise _conflict(storage, theirs, ours)
    return theirs is not None


def _conflict(storage: Storage, theirs: Reservation, ours: Reservation) -> ShardConflict:
    root, segment_id, how = storage.root, ours.segment_id, theirs.difference(ours)
    if storage.size(f"{theirs.table}/{segment_id}-{theirs.identity}.parquet") is not None:
        return ShardConflict(
            f"{root} already holds {theirs.table} of {segment_id} made {how}: "
            f"choose another --output, or delete the old labels, {root}/*/{segment_id}-*"
        )
    return ShardConflict(
        f"{root} is reserved for {theirs.table} of {segment_id} made {how}, and holds none so far: another run is "
        f"publishing them, or died there; then delete {root}/{theirs.path}, or choose another --output"
    )


def _read_reservation(storage: Storage, path: str) -> Reservation | None:
    content = _read(storage, path)
    try:
        return None if content is None else Reservation.model_validate_json(content)
    except ValidationError:
        raise InvalidInput(f"{storage.root}/{path} is not a reservation of this or an older motionlabel") from None


def _read(storage: Storage, path: str) -> bytes | None:
    try:
        return storage.read(path)
    except FileNotFoundError:
        return None


def _content(reservation: Reservation) -> bytes:
    return (reservation.model_dump_json(indent=2) + "\n").encode()
