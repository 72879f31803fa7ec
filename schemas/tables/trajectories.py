"""DIR/SEGMENT.parquet of ``motionlabel trajectories``: one row per (track, anchor), a list of T steps in each cell.

Steps are in the frame that the object has at the anchor: origin in its centre there, x along its heading, z up.
"""

from dataclasses import dataclass

import numpy as np
import pyarrow as pa

from schemas.arrays import BoolArray, Float64Array, Int64Array, read_only, require
from schemas.tables.columns import BOX, VELOCITY, make_table, repeat

_FLOATS = (*BOX[:3], BOX[6], *VELOCITY, "score")
_MASKS = ("is_valid", "is_observed")


def make_schema(num_steps: int) -> pa.Schema:
    """Return the schema for windows of ``num_steps`` steps."""
    return pa.schema(
        [
            pa.field("dataset", pa.string(), nullable=False),
            pa.field("segment_id", pa.string(), nullable=False),
            pa.field("track_id", pa.string(), nullable=False),
            pa.field("anchor_timestamp_ns", pa.int64(), nullable=False),
            *(pa.field(f"anchor_{name}", pa.float64(), nullable=False) for name in (*BOX[:3], BOX[6])),  # WORLD
            *(pa.field(name, pa.float32(), nullable=False) for name in BOX[3:6]),
            pa.field("num_valid_history", pa.int32(), nullable=False),  # steps before the anchor
            pa.field("num_valid_future", pa.int32(), nullable=False),  # and after it
            *(pa.field(name, pa.list_(pa.bool_(), num_steps), nullable=False) for name in _MASKS),
            *(pa.field(name, pa.list_(pa.float32(), num_steps), nullable=False) for name in _FLOATS),  # AGENT
        ]
    )


@dataclass(frozen=True, slots=True, eq=False)
class TrajectoryRows:
    """Windows of one track: A anchors with T steps around each. Agent frame unless it says world, zero if unknown."""

    track_id: str
    size_m: Float64Array  # (3,) length, width, height
    num_history: int  # steps before the anchor, which is itself a step
    anchor_timestamp_ns: Int64Array  # (A,)
    anchor_center_m: Float64Array  # (A, 3) world
    anchor_yaw_rad: Float64Array  # (A,) world
    is_valid: BoolArray  # (A, T)
    is_observed: BoolArray  # (A, T) False where a box that rests on no points has a say
    center_m: Float64Array  # (A, T, 3)
    yaw_rad: Float64Array  # (A, T)
    velocity_mps: Float64Array  # (A, T, 3)
    score: Float64Array  # (A, T)

    def __post_init__(self) -> None:
        """Check shapes and make all arrays read-only."""
        shape = self.is_valid.shape
        require("anchor_center_m", self.anchor_center_m, (shape[0], 3), np.float64)
        require("center_m", self.center_m, (*shape, 3), np.float64)
        require("velocity_mps", self.velocity_mps, (*shape, 3), np.float64)
        for name in self.__slots__:
            value = getattr(self, name)
            if isinstance(value, np.ndarray):
                object.__setattr__(self, name, read_only(value))

    def __len__(self) -> int:
        """Return the number of windows."""
        return len(self.anchor_timestamp_ns)


def to_table(dataset: str, segment_id: str, rows: TrajectoryRows) -> pa.Table:
    """Return the rows as they are written; steps, sizes and scores are rounded to float32."""
    size, num_steps = rows.is_valid.shape
    after = rows.num_history + 1
    steps = [rows.is_valid, rows.is_observed]
    floats = [*np.moveaxis(rows.center_m, 2, 0), rows.yaw_rad, *np.moveaxis(rows.velocity_mps, 2, 0), rows.score]
    steps += [values.astype(np.float32) for values in floats]
    return make_table(
        make_schema(num_steps),
        [
            repeat(dataset, size),
            repeat(segment_id, size),
            repeat(rows.track_id, size),
            rows.anchor_timestamp_ns,
            *rows.anchor_center_m.T,
            rows.anchor_yaw_rad,
            *np.tile(rows.size_m[:, None], size),
            rows.is_valid[:, : rows.num_history].sum(axis=1),
            rows.is_valid[:, after:].sum(axis=1),
            *(pa.FixedSizeListArray.from_arrays(pa.array(values.ravel()), num_steps) for values in steps),
        ],
    )
