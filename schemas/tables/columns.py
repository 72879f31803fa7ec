"""Columns that tables share, and arrays to columns and back."""

from collections.abc import Iterable, Sequence
from typing import Any, Final

import numpy as np
import pyarrow as pa

from schemas.arrays import Float64Array

KEY: Final = (
    pa.field("dataset", pa.string(), nullable=False),
    pa.field("segment_id", pa.string(), nullable=False),
    pa.field("sweep_index", pa.int32(), nullable=False),
    pa.field("timestamp_ns", pa.int64(), nullable=False),
)
BOX: Final = (*(f"center_{axis}_m" for axis in "xyz"), "length_m", "width_m", "height_m", "yaw_rad")
VISIBLE_BOX: Final = tuple(f"visible_{name}" for name in BOX)
VELOCITY: Final = tuple(f"velocity_{axis}_mps" for axis in "xyz")
FLOW: Final = tuple(f"flow_{axis}_m" for axis in "xyz")


def make_table(schema: pa.Schema, columns: Iterable[Any]) -> pa.Table:  # arrays, Arrow's or numpy's, or lists
    """Return a table of these columns, in the schema's order and types; floats are rounded to what a column holds."""
    arrays = [pa.array(column).cast(field.type, safe=False) for column, field in zip(columns, schema, strict=True)]
    return pa.table(arrays, schema=schema)


def repeat(value: str, size: int) -> pa.Array:
    """Return a column that says the same in each row."""
    return pa.repeat(pa.scalar(value, pa.string()), size)


def read_column(table: pa.Table, name: str, dtype: type[np.generic]) -> Any:  # an array of that dtype
    """Return one column as an array; nulls of a column of floats are NaN."""
    return table[name].to_numpy().astype(dtype, copy=False)


def read_matrix(table: pa.Table, names: Sequence[str]) -> Float64Array:
    """Return (R, len(names)); nulls are NaN."""
    return np.stack([read_column(table, name, np.float64) for name in names], axis=1)
