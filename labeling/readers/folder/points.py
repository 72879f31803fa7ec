"""One sweep from the bytes of its file, whatever its format: named columns, then points in the ego frame."""

import io
import zipfile
from collections.abc import Mapping
from typing import Any, Final

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from labeling.geometry.transforms import transform_points
from labeling.readers.files import Columns, decode_columns, require_finite_points
from labeling.readers.folder.description import DEFAULT_COLUMNS, NANOSECONDS, Description
from labeling.readers.folder.pcd import read_pcd
from labeling.readers.folder.ply import read_ply
from labeling.readers.folder.widths import best_width
from schemas.arrays import Float32Array, UInt8Array
from schemas.errors import UnreadableSweep

FORMATS: Final = ("bin", "npy", "npz", "pcd", "ply", "las", "laz", "feather")
MAX_OFFSET_S: Final = 1.0  # of a point from its sweep's stamp; a turn takes a tenth of that
MAX_MEDIAN_RANGE_M: Final = 500.0  # no lidar of a vehicle sees so far
FLOAT_BYTES: Final = 4


def format_of(name: str) -> str | None:
    """Return the known format that a file's name ends with."""
    suffix = name.rpartition(".")[2].lower()
    return suffix if suffix in FORMATS and "." in name else None


def read_columns(content: bytes, name: str, place: str, description: Description) -> Columns:
    """Return the wanted columns of a sweep.

    Raises:
        UnreadableSweep: The file is broken or has other columns.

    """
    kind = format_of(name)
    try:
        if kind == "bin":
            columns = _read_bin(content, description)
        elif kind in ("npy", "npz"):
            columns = _read_numpy(content, kind, description)
        elif kind == "pcd":
            columns = read_pcd(content, description.wanted)
        elif kind == "ply":
            columns = read_ply(content, description.wanted)
        elif kind in ("las", "laz"):
            columns = _read_las(content, description)
        else:
            return decode_columns(content, place, dict.fromkeys(description.wanted, pa.float64()), UnreadableSweep)
    except ValueError as error:
        raise UnreadableSweep(f"{place}: {error}") from None
    missing = [wanted for wanted in description.wanted if wanted not in columns]
    if missing:
        raise UnreadableSweep(f"{place}: no column {', '.join(missing)}: see `coordinates` in motionlabel.yaml")
    return columns


def _read_bin(content: bytes, description: Description) -> Columns:
    names = description.columns or DEFAULT_COLUMNS
    if len(content) % (FLOAT_BYTES * len(names)):
        raise ValueError(
            f"{len(content)} bytes are no rows of {len(names)} float32 ({', '.join(names)}); "
            f"{_fitting_widths(len(content))}"
        )
    table = np.frombuffer(content, dtype="<f4").reshape(-1, len(names))
    if description.columns is None and (width := best_width(table.ravel())) not in (None, len(names)):
        raise ValueError(
            f"looks like rows of {width} float32, not of {len(names)}: name them in motionlabel.yaml, "
            "as `columns: [x, y, z, intensity, ring]`"
        )
    return _named(table, names)


def _fitting_widths(num_bytes: int) -> str:
    if num_bytes % FLOAT_BYTES:
        return "nor any float32: truncated, or of another type?"
    fitting = [str(width) for width in range(3, 11) if num_bytes // FLOAT_BYTES % width == 0]
    return f"rows of {' or '.join(fitting)} would fit: say `columns` in motionlabel.yaml" if fitting else "truncated?"


def _read_numpy(content: bytes, kind: str, description: Description) -> Columns:
    try:
        if kind == "npy":
            return _columns_of(np.lib.format.read_array(io.BytesIO(content), allow_pickle=False), description)
        with np.load(io.BytesIO(content), allow_pickle=False) as arrays:
            if set(description.wanted) <= set(arrays.files):
                return {name: arrays[name].ravel() for name in description.wanted}
            tables = {name: arrays[name] for name in arrays.files if name.lower() not in _NO_POINTS}
    except (zipfile.BadZipFile, EOFError, OSError, KeyError):
        raise ValueError(f"no readable .{kind}, truncated?") from None
    except ValueError as error:
        if "allow_pickle" in str(error):
            raise ValueError("holds pickled Python objects, which are never loaded: save an array of numbers") from None
        raise
    tables = {name: table for name, table in tables.items() if table.ndim == 2 or table.dtype.names}
    if len(tables) != 1:
        found = ", ".join(arrays.files) or "none"
        raise ValueError(f"expected arrays {', '.join(description.wanted)}, or one of rows; it has {found}")
    return _columns_of(next(iter(tables.values())), description)


def _columns_of(table: NDArray[Any], description: Description) -> Columns:
    if table.dtype.names:
        return {name: table[name].ravel() for name in description.wanted if name in table.dtype.names}
    if table.ndim != 2 or table.dtype.kind not in "fiu":
        raise ValueError(f"an array of shape {table.shape} and type {table.dtype}, expected rows of numbers")
    names = description.columns or DEFAULT_COLUMNS[: table.shape[1]]
    if table.shape[1] < len(names) or (description.columns and table.shape[1] != len(names)) or table.shape[1] < 3:
        raise ValueError(f"rows of {table.shape[1]} numbers, expected {len(names)}: {', '.join(names)}")
    return _named(table, names)


def _named(table: NDArray[Any], names: tuple[str, ...]) -> Columns:
    return {name: table[:, column] for column, name in enumerate(names)}


def _read_las(content: bytes, description: Description) -> Columns:
    try:
        import laspy
    except ImportError:
        raise ValueError("needs an extra: pip install motionlabel[las]") from None
    try:
        cloud = laspy.read(io.BytesIO(content))
        known = {"x", "y", "z", *cloud.point_format.dimension_names}
        return {name: np.asarray(cloud[name]) for name in description.wanted if name in known}
    except (laspy.errors.LaspyException, RuntimeError, EOFError, IndexError) as error:
        raise ValueError(f"no readable .las or .laz, truncated? ({' '.join(str(error).split())})") from None


def points_ego_of(columns: Mapping[str, NDArray[Any]], description: Description, place: str) -> Float32Array:
    """Return (N, 3) points in the ego frame at the sweep's stamp, m; raise UnreadableSweep for what can be none."""
    raw = np.stack([columns[name] for name in description.coordinates], axis=1).astype(np.float64)
    require_finite_points(raw, place)
    points = transform_points(description.ego_from_points, raw)
    range_m = float(np.median(np.abs(points - description.sensor.ego_from_sensor[:3, 3]).max(axis=1)))
    if range_m > MAX_MEDIAN_RANGE_M:
        raise UnreadableSweep(
            f"{place}: half of the points lie more than {range_m:.3g} m away: other `units`, other `columns`, "
            "or points in the frame of a map?"
        )
    return points.astype(np.float32)


def capture_offsets_of(
    columns: Mapping[str, NDArray[Any]], description: Description, timestamp_ns: int, place: str
) -> Float32Array:
    """Return (N,) s from the sweep's stamp to the capture of each point; zeros where no column tells."""
    time = description.time
    if time is None:
        return np.zeros(len(columns[description.coordinates[0]]), dtype=np.float32)
    column = columns[time.column]
    offset_s: NDArray[Any]
    scale, start = NANOSECONDS[time.unit], timestamp_ns if time.since == "epoch" else 0
    if column.dtype.kind == "f":
        offset_s = (column.astype(np.float64) - start / scale) * (scale * 1e-9)
    else:  # exactly: nanoseconds since 1970 are no float64
        offset_s = (column.astype(np.int64) - start // scale) * (scale * 1e-9)
    worst_s = float(np.abs(offset_s).max(initial=0.0)) if np.isfinite(offset_s).all() else np.inf
    if worst_s > MAX_OFFSET_S:
        raise UnreadableSweep(
            f"{place}: column {time.column} puts a point {worst_s:.3g} s from its sweep's stamp: another `unit`, or "
            f"`since: {'stamp' if time.since == 'epoch' else 'epoch'}`?"
        )
    return offset_s.astype(np.float32)


def lidar_of_point(columns: Mapping[str, NDArray[Any]], description: Description, place: str) -> UInt8Array:
    """Return (N,) numbers of lidars."""
    num_lidars = len(description.origins)
    if description.lidar is None:
        return np.zeros(len(columns[description.coordinates[0]]), dtype=np.uint8)
    column = columns[description.lidar.column]
    number = np.floor_divide(column.astype(np.float64), description.lidar.lasers)
    is_known = (number >= 0) & (number < num_lidars)
    if not is_known.all():
        worst = column[~is_known][0]
        raise UnreadableSweep(
            f"{place}: column {description.lidar.column} holds {worst:g}: motionlabel.yaml has {num_lidars} `origins`, "
            f"with {description.lidar.lasers} lasers each"
        )
    return number.astype(np.uint8)


_NO_POINTS: Final = ("pose", "timestamp", "time", "intensity", "calib")
