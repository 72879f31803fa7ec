"""What the readers of folders share: layouts, feather columns, and the checks on what was read."""

from collections.abc import Mapping
from itertools import islice
from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray
from pyarrow import ipc

from labeling.geometry.transforms import rotation_from_quaternion, wrap_angle
from labeling.readers.reader import READERS
from labeling.storage import places
from labeling.storage.storage import Storage, open_storage
from schemas.arrays import Float64Array, FloatArray
from schemas.errors import InvalidInput, LabelingError, UnreadableSweep
from schemas.frames import Annotations

Columns = dict[str, NDArray[Any]]  # the caller knows each column's dtype: it asked for it

QUATERNION = ("qw", "qx", "qy", "qz")
TRANSLATION = ("tx_m", "ty_m", "tz_m")
_SIZES = ("length_m", "width_m", "height_m")
POSE_TYPES: Mapping[str, pa.DataType] = dict.fromkeys((*QUATERNION, *TRANSLATION), pa.float64())
CUBOID_TYPES: Mapping[str, pa.DataType] = {
    "track_uuid": pa.string(),
    "category": pa.string(),
    **dict.fromkeys(_SIZES, pa.float64()),
    **POSE_TYPES,
}

_PEEK = 20  # folders that are looked into for a hint


def open_folder(uri: str, dataset: str) -> Storage:
    """Return the storage of one ``dataset`` segment, by its canonical name.

    Raises:
        InvalidInput: No such folder, a file, or a folder that is not laid out like this data set.

    """
    storage, layout = open_storage(uri), READERS[dataset].layout
    if storage.has_folder(layout):
        return storage
    if storage.has_folder():
        raise InvalidInput(f"{uri}: no folder {layout}/ as dataset {dataset} has{likely_cause(storage)}")
    parent, name = places.split(uri)
    if name and open_storage(parent).size(name) is not None:
        raise InvalidInput(f"{uri}: is a file, expected the folder of one {dataset} segment")
    raise InvalidInput(f"{uri}: no such folder")


def likely_cause(storage: Storage) -> str:
    """Return what a folder that is not laid out as expected may be, to end a message with."""
    layouts = {dataset: reader.layout for dataset, reader in READERS.items() if reader.layout}
    for dataset, layout in layouts.items():
        if storage.has_folder(layout):
            return f"; it looks like dataset {dataset}"
    for folder in islice(storage.list_folders(), _PEEK):
        for dataset, layout in layouts.items():
            if storage.has_folder(f"{folder}/{layout}"):
                return f"; it holds segments of dataset {dataset}: pass one of them, as {folder}"
    return "; pass the folder of one segment"


def read_file(storage: Storage, path: str, error: type[LabelingError], hint: str = "") -> bytes:
    """Return the content of a file; raise ``error`` with ``hint`` when there is none."""
    try:
        return storage.read(path)
    except FileNotFoundError:
        raise error(f"{storage.place(path)}: no such file{hint}") from None


def read_columns(
    storage: Storage,
    path: str,
    types: Mapping[str, pa.DataType],
    error: type[LabelingError],
    optional: Mapping[str, pa.DataType] | None = None,
) -> Columns:
    """Return named columns of a feather file, as ``decode_columns``.

    The file is read whole, in one request where it lies in a bucket; no other column is decoded.

    Raises:
        error: The file is missing, or as ``decode_columns``.

    """
    return decode_columns(read_file(storage, path, error), storage.place(path), types, error, optional)


def decode_columns(
    content: bytes,
    place: str,
    types: Mapping[str, pa.DataType],
    error: type[LabelingError],
    optional: Mapping[str, pa.DataType | None] | None = None,
) -> Columns:
    """Return named columns of a feather file's content, cast to the types asked for: they vary between releases.

    One without a type stays as it is. Columns of ``optional`` are left out where the file has none.

    Raises:
        error: It is not feather or truncated, or a column is missing, of another kind or has gaps.

    """
    try:
        names = ipc.open_file(pa.BufferReader(content)).schema.names
        wanted = {name: kind for name, kind in {**types, **(optional or {})}.items() if name in names}
        options = ipc.IpcReadOptions(included_fields=[names.index(name) for name in wanted], use_threads=False)
        table = ipc.open_file(pa.BufferReader(content), options=options).read_all()
    except (pa.ArrowException, OSError) as problem:
        raise error(f"{place}: not a readable feather file, truncated? ({_first_line(problem)})") from None
    missing = [name for name in types if name not in names]
    if missing:
        raise error(f"{place}: no column {', '.join(missing)}; it has {', '.join(names)}")
    columns: Columns = {}
    for name, kind in wanted.items():
        column = table.column(name)
        if column.null_count:
            raise error(f"{place}: column {name} is empty in {column.null_count} of {len(column)} rows")
        try:
            columns[name] = (column if kind is None else column.cast(kind)).to_numpy()
        except pa.ArrowException:  # whose words quote what is in the file
            raise error(f"{place}: column {name} is not {kind}") from None
    return columns


def require_finite_points(points: FloatArray, place: str) -> None:
    """Raise UnreadableSweep unless there are points and every coordinate is a finite number."""
    if not len(points):
        raise UnreadableSweep(f"{place}: no points in the sweep")
    num_bad = int((~np.isfinite(points).all(axis=1)).sum())
    if num_bad:
        raise UnreadableSweep(f"{place}: {num_bad} of {len(points)} points hold NaN or infinity")


def transforms_of(columns: Columns) -> Float64Array:
    """Return (B, 4, 4) from columns qw ... tz_m; a row without a direction (all zero) comes out as NaN."""
    transforms = np.tile(np.eye(4), (len(columns["qw"]), 1, 1))
    with np.errstate(invalid="ignore"):
        transforms[:, :3, :3] = rotation_from_quaternion(*(columns[name] for name in QUATERNION))
    transforms[:, :3, 3] = np.stack([columns[name] for name in TRANSLATION], axis=1)
    return transforms


def read_cuboids(storage: Storage, path: str, key: str) -> Columns | None:
    """Return the cuboid columns of an annotation file beside int64 column ``key``, None when there is no file.

    Raises:
        InvalidInput: The file is there but unreadable, or holds boxes that are none.

    """
    if storage.size(path) is None:
        return None
    columns = read_columns(storage, path, {key: pa.int64(), **CUBOID_TYPES}, InvalidInput)
    sizes = np.stack([columns[name] for name in _SIZES])
    is_bad = ~np.isfinite(transforms_of(columns)).all(axis=(1, 2)) | ~((sizes > 0) & np.isfinite(sizes)).all(axis=0)
    if is_bad.any():
        place, row = storage.place(path), int(is_bad.argmax())
        raise InvalidInput(f"{place}: row {row}: a box needs finite numbers, a rotation and sizes above zero")
    return columns


def cuboids_of(columns: Columns, rows: NDArray[np.bool_]) -> Annotations:
    """Return the annotations in ``rows`` of cuboid columns; of a rotation only the yaw is kept."""
    chosen = {name: columns[name][rows] for name in CUBOID_TYPES}
    transforms = transforms_of(chosen)
    yaw = wrap_angle(np.arctan2(transforms[:, 1, 0], transforms[:, 0, 0]))
    sizes = [chosen[name] for name in _SIZES]
    return Annotations(
        track_ids=tuple(chosen["track_uuid"].tolist()),
        categories=tuple(chosen["category"].tolist()),
        boxes_ego=np.column_stack([transforms[:, :3, 3], *sizes, yaw]),
    )


def _first_line(problem: BaseException) -> str:
    return (str(problem) or type(problem).__name__).splitlines()[0]
