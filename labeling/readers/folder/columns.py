"""One sweep from the bytes of its file, whatever its format: named columns."""

import io
import tokenize
import zipfile
import zlib
from collections.abc import Sequence
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from labeling.readers.files import Columns, decode_columns
from labeling.readers.folder.description import DEFAULT_COLUMNS, Description
from labeling.readers.folder.las import read_las
from labeling.readers.folder.pcd import read_pcd
from labeling.readers.folder.ply import read_ply
from labeling.readers.folder.widths import best_width
from schemas.errors import UnreadableSweep

FORMATS: Final = ("bin", "npy", "npz", "pcd", "ply", "las", "laz", "feather")
FLOAT_BYTES: Final = 4
_BROKEN_NUMPY: Final = (zipfile.BadZipFile, zlib.error, tokenize.TokenError, EOFError, OSError, KeyError)


def format_of(name: str) -> str | None:
    """Return the known format that a file's name ends with."""
    suffix = name.rpartition(".")[2].lower()
    return suffix if suffix in FORMATS and "." in name else None


def read_columns(content: bytes, name: str, place: str, description: Description) -> Columns:
    """Return the wanted columns of a sweep, one number a point in each.

    Raises:
        UnreadableSweep: The file is broken or has other columns.

    """
    try:
        columns = columns_there(content, name, description.wanted, description.columns)
    except ValueError as error:
        raise UnreadableSweep(f"{place}: {error}") from None
    missing = [wanted for wanted in description.wanted if wanted not in columns]
    if missing:
        raise UnreadableSweep(f"{place}: no column {', '.join(missing)}: say which in motionlabel.yaml")
    odd = [name for name, column in columns.items() if column.dtype.kind not in "fiu" or column.ndim != 1]
    if odd:
        raise UnreadableSweep(f"{place}: column {odd[0]} does not hold one number a point")
    if len({len(column) for column in columns.values()}) > 1:
        raise UnreadableSweep(f"{place}: columns of different lengths")
    return columns


def columns_there(content: bytes, name: str, wanted: Sequence[str], names: Sequence[str] | None = None) -> Columns:
    """Return those of the wanted columns that a file has.

    Args:
        content: The whole file.
        name: Its name, which tells its format.
        wanted: Names of columns.
        names: Of all columns in a row, for formats that name none; None: x, y, z and intensity.

    Raises:
        ValueError: The file is broken; in words for people.

    """
    kind = format_of(name)
    if kind == "bin":
        return _read_bin(content, names)
    if kind == "npy":
        return _read_npy(content, wanted, names)
    if kind == "npz":
        return _read_npz(content, wanted, names)
    if kind == "pcd":
        return read_pcd(content, wanted)
    if kind == "ply":
        return read_ply(content, wanted)
    if kind in ("las", "laz"):
        return read_las(content, wanted)
    return decode_columns(content, "feather", {}, _Unreadable, dict.fromkeys(wanted))


class _Unreadable(UnreadableSweep, ValueError):
    """What decode_columns is to raise here."""


def _read_bin(content: bytes, names: Sequence[str] | None) -> Columns:
    expected = names or DEFAULT_COLUMNS
    if len(content) % (FLOAT_BYTES * len(expected)):
        raise ValueError(
            f"{len(content)} bytes are no rows of {len(expected)} float32 ({', '.join(expected)}); "
            f"{_fitting_widths(len(content))}"
        )
    table = np.frombuffer(content, dtype="<f4").reshape(-1, len(expected))
    if names is None and (width := best_width(table.ravel())) not in (None, len(expected)):
        raise ValueError(
            f"looks like rows of {width} float32, not of {len(expected)}: name them in motionlabel.yaml, "
            "as `columns: [x, y, z, intensity, ring]`"
        )
    return _named(table, expected)


def _fitting_widths(num_bytes: int) -> str:
    if num_bytes % FLOAT_BYTES:
        return "nor any float32: truncated, or of another type?"
    fitting = [str(width) for width in range(3, 11) if num_bytes // FLOAT_BYTES % width == 0]
    return f"rows of {' or '.join(fitting)} would fit: say `columns` in motionlabel.yaml" if fitting else "truncated?"


def bare_rows(content: bytes, name: str) -> NDArray[Any] | None:
    """Return (N, C) rows of a file that names no columns, of the likely width where it has none; None: it names them.

    Raises:
        ValueError: The file is broken, or no width fits; in words for people.

    """
    kind = format_of(name)
    if kind == "bin":
        if len(content) % FLOAT_BYTES:
            raise ValueError(f"{len(content)} bytes are no float32: truncated, or of another type?")
        numbers = np.frombuffer(content, dtype="<f4")
        width = best_width(numbers)
        if width is None:
            raise ValueError(f"{len(numbers)} float32 tell no width of rows: say `columns` yourself")
        return numbers.reshape(-1, width)
    if kind not in ("npy", "npz"):
        return None
    table = _load_npy(content) if kind == "npy" else _only_table(_load_npz(content))
    return None if table is None or table.dtype.names or table.ndim != 2 else table


def _read_npy(content: bytes, wanted: Sequence[str], names: Sequence[str] | None) -> Columns:
    return _columns_of(_load_npy(content), wanted, names)


def _load_npy(content: bytes) -> NDArray[Any]:
    try:
        array: NDArray[Any] = np.lib.format.read_array(io.BytesIO(content), allow_pickle=False)
    except (*_BROKEN_NUMPY, ValueError) as error:
        raise _no_array(error) from None
    return array


def _read_npz(content: bytes, wanted: Sequence[str], names: Sequence[str] | None) -> Columns:
    arrays = _load_npz(content)
    columns = {name: array for name, array in arrays.items() if name in wanted and array.ndim == 1}
    table = _only_table(arrays)
    return columns if columns or table is None else _columns_of(table, wanted, names)


def _load_npz(content: bytes) -> dict[str, NDArray[Any]]:
    if not zipfile.is_zipfile(io.BytesIO(content)):  # np.load would take it for something else
        raise ValueError("no readable array of NumPy, truncated?")
    try:
        with np.load(io.BytesIO(content), allow_pickle=False) as arrays:
            return {name: arrays[name] for name in arrays.files}
    except (*_BROKEN_NUMPY, ValueError) as error:
        raise _no_array(error) from None


def _only_table(arrays: dict[str, NDArray[Any]]) -> NDArray[Any] | None:
    """Return the array of rows; None when arrays are columns. Poses may be beside it."""
    tables = [a for a in arrays.values() if a.dtype.names or (a.ndim == 2 and a.shape not in ((3, 4), (4, 4)))]
    if not tables and any(array.ndim == 1 for array in arrays.values()):
        return None
    if len(tables) != 1:
        raise ValueError(f"expected one array of rows, or arrays x, y, z; it has {', '.join(arrays) or 'none'}")
    return tables[0]


def _no_array(error: Exception) -> ValueError:
    if "allow_pickle" in str(error):
        return ValueError("holds pickled Python objects, which are never loaded: save an array of numbers")
    return ValueError("no readable array of NumPy, truncated?")


def _columns_of(table: NDArray[Any], wanted: Sequence[str], names: Sequence[str] | None) -> Columns:
    if table.dtype.names:
        return {name: table[name].ravel() for name in wanted if name in table.dtype.names}
    if table.ndim != 2 or table.shape[1] < 3:
        raise ValueError(f"an array of shape {table.shape}, expected rows of 3 numbers or more")
    if names is not None and table.shape[1] != len(names):
        raise ValueError(f"rows of {table.shape[1]} numbers, expected {len(names)}: {', '.join(names)}")
    return _named(table, names or DEFAULT_COLUMNS[: table.shape[1]])


def _named(table: NDArray[Any], names: Sequence[str]) -> Columns:
    return {name: table[:, column] for column, name in enumerate(names)}
