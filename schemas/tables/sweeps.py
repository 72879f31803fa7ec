"""OUT/sweeps/: one row per sweep."""

from collections.abc import Sequence
from typing import Final

import numpy as np
import pyarrow as pa

from schemas.objects import SweepObservation
from schemas.tables.columns import KEY, make_table, repeat

_COUNTS: Final = ("num_points", "num_ground", "num_static", "num_clusters", "num_failed_fits")
SCHEMA: Final = pa.schema(
    [
        *KEY,
        pa.field("world_from_ego", pa.list_(pa.float64(), 16), nullable=False),  # row-major
        *(pa.field(name, pa.int32(), nullable=False) for name in _COUNTS),
        pa.field("status", pa.string(), nullable=False),  # ok | rejected
        pa.field("reason", pa.string(), nullable=False),  # empty when ok
    ]
)
OK: Final = "ok"
REJECTED: Final = "rejected"


def to_table(dataset: str, segment_id: str, observations: Sequence[SweepObservation]) -> pa.Table:
    """Return what is written of the sweeps, in the order given."""
    poses = [observation.world_from_ego.ravel() for observation in observations]
    return make_table(
        SCHEMA,
        [
            repeat(dataset, len(observations)),
            repeat(segment_id, len(observations)),
            pa.array([observation.sweep_index for observation in observations], pa.int64()),
            pa.array([observation.timestamp_ns for observation in observations], pa.int64()),
            pa.FixedSizeListArray.from_arrays(np.concatenate([np.empty(0), *poses]), 16),
            *(pa.array([getattr(observation, name) for observation in observations], pa.int64()) for name in _COUNTS),
            pa.array([REJECTED if observation.is_rejected else OK for observation in observations], pa.string()),
            pa.array([observation.reason for observation in observations], pa.string()),
        ],
    )


def from_table(table: pa.Table) -> list[SweepObservation]:
    """Return what one segment's sweeps table says of each sweep; proposals and points are not in it."""
    return [
        SweepObservation(
            sweep_index=row["sweep_index"],
            timestamp_ns=row["timestamp_ns"],
            world_from_ego=np.array(row["world_from_ego"]).reshape(4, 4),
            **{name: row[name] for name in _COUNTS},
            reason=row["reason"],
            proposals=(),
            points=None,
        )
        for row in table.to_pylist()
    ]
