"""What the readers of local folders share: paths, feather columns, and the checks on what was read."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray
from pyarrow import feather

from labeling.geometry.transforms import rotation_from_quaternion, wrap_angle
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

_LAYOUTS = {"av2": "sensors/lidar", "kitti_raw": "velodyne_points/data"}  # the folder that gives a data set away


def require_folder(folder: Path, dataset: str) -> None:
    """Raise unless a folder is one ``dataset`` segment.

    Raises:
        InvalidInput: No such folder, a file, or a folder that is not laid out like this data set.

    """
    if not folder.exists():
        raise InvalidInput(f"{folder}: no such folder")
    if not folder.is_dir():
        raise InvalidInput(f"{folder}: is a file, expected the folder of one {dataset} segment")
    if not (folder / _LAYOUTS[dataset]).is_dir():
        raise InvalidInput(f"{folder}: no folder {_LAYOUTS[dataset]}/ as dataset {dataset} has{_likely_cause(folder)}")


def _likely_cause(folder: Path) -> str:
    for dataset, inner in _LAYOUTS.items():
        if (folder / inner).is_dir():
            return f"; it looks like dataset {dataset}"
    for dataset, inner in _LAYOUTS.items():
        below = next((path for path in sorted(folder.iterdir()) if (path / inner).is_dir()), None)
        if below is not None:
            return f"; it holds segments of dataset {dataset}: pass one of them, as {below.name}"
    return "; pass the folder of one segment"


def read_columns(
    path: Path,
    types: Mapping[str, pa.DataType],
    error: type[LabelingError],
    optional: Mapping[str, pa.DataType] | None = None,
) -> Columns:
    """Return named columns of a feather file, cast to the types asked for: types on disk vary between releases.

    Columns of ``optional`` are left out where the file has none.

    Raises:
        error: The file is missing, not feather, truncated, or a column is missing, of another kind or has gaps.

    """
    if not path.is_file():
        raise error(f"{path}: no such file")
    try:
        table = feather.read_table(path)
    except (pa.ArrowException, OSError) as problem:
        raise error(f"{path}: not a readable feather file, truncated? ({_first_line(problem)})") from None
    missing = [name for name in types if name not in table.column_names]
    if missing:
        raise error(f"{path}: no column {', '.join(missing)}; it has {', '.join(table.column_names)}")
    wanted = {**types, **{name: kind for name, kind in (optional or {}).items() if name in table.column_names}}
    columns: Columns = {}
    for name, kind in wanted.items():
        column = table.column(name)
        if column.null_count:
            raise error(f"{path}: column {name} is empty in {column.null_count} of {len(column)} rows")
        try:
            columns[name] = column.cast(kind).to_numpy()
        except pa.ArrowException as problem:
            raise error(f"{path}: column {name} is not {kind} ({_first_line(problem)})") from None
    return columns


def require_finite_points(points: FloatArray, path: Path) -> None:
    """Raise UnreadableSweep unless there are points and every coordinate is a finite number."""
    if not len(points):
        raise UnreadableSweep(f"{path}: no points in the sweep")
    num_bad = int((~np.isfinite(points).all(axis=1)).sum())
    if num_bad:
        raise UnreadableSweep(f"{path}: {num_bad} of {len(points)} points hold NaN or infinity")


def transforms_of(columns: Columns) -> Float64Array:
    """Return (B, 4, 4) from columns qw ... tz_m; a row without a direction (all zero) comes out as NaN."""
    transforms = np.tile(np.eye(4), (len(columns["qw"]), 1, 1))
    with np.errstate(invalid="ignore"):
        transforms[:, :3, :3] = rotation_from_quaternion(*(columns[name] for name in QUATERNION))
    transforms[:, :3, 3] = np.stack([columns[name] for name in TRANSLATION], axis=1)
    return transforms


def read_cuboids(path: Path, key: str) -> Columns | None:
    """Return the cuboid columns of an annotation file beside int64 column ``key``, None when there is no file.

    Raises:
        InvalidInput: The file is there but unreadable, or holds boxes that are none.

    """
    if not path.is_file():
        return None
    columns = read_columns(path, {key: pa.int64(), **CUBOID_TYPES}, InvalidInput)
    sizes = np.stack([columns[name] for name in _SIZES])
    is_bad = ~np.isfinite(transforms_of(columns)).all(axis=(1, 2)) | ~((sizes > 0) & np.isfinite(sizes)).all(axis=0)
    if is_bad.any():
        row = int(is_bad.argmax())
        raise InvalidInput(f"{path}: row {row}: a box needs finite numbers, a rotation and sizes above zero")
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
