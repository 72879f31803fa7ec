"""OUT/points/: one row per point called neither ground nor static (only when asked)."""

from dataclasses import dataclass
from typing import Final

import numpy as np
import pyarrow as pa

from schemas.arrays import BoolArray, Float32Array, Int32Array, Int64Array, read_only, require
from schemas.tables.columns import FLOW, KEY, make_table, read_column, read_matrix, repeat

SCHEMA: Final = pa.schema(
    [
        *KEY,
        pa.field("point_index", pa.int32(), nullable=False),  # row in the source sweep, before any filter
        *(pa.field(name, pa.float32()) for name in FLOW),  # WORLD axes, to the next sweep, null at the end
        pa.field("cluster_id", pa.int32()),  # null for a point that its object's track brought back
        pa.field("track_id", pa.string()),  # null when none
    ]
)


@dataclass(frozen=True, slots=True, eq=False)
class PointRows:
    """Points of one segment that are called neither ground nor static."""

    sweep_index: Int64Array  # (P,)
    timestamp_ns: Int64Array  # (P,) of the sweep
    point_index: Int32Array  # (P,) rows in the source sweep
    flow_world_m: Float32Array  # (P, 3) world axes, to the next sweep; NaN where there is none
    cluster_id: Int32Array  # (P,) without meaning where not is_in_cluster
    is_in_cluster: BoolArray  # (P,)
    track_ids: tuple[str, ...]
    track: Int64Array  # (P,) position in track_ids; -1: of no track

    def __post_init__(self) -> None:
        """Check shapes and make all arrays read-only."""
        rows = len(self.point_index)
        require("flow_world_m", self.flow_world_m, (rows, 3), np.float32)
        require("is_in_cluster", self.is_in_cluster, (rows,), np.bool_)
        for name in self.__slots__:
            if name != "track_ids":
                object.__setattr__(self, name, read_only(getattr(self, name)))

    def __len__(self) -> int:
        """Return the number of rows."""
        return len(self.point_index)


def to_table(dataset: str, segment_id: str, rows: PointRows) -> pa.Table:
    """Return the rows as they are written."""
    has_no_flow = np.isnan(rows.flow_world_m).any(axis=1)
    return make_table(
        SCHEMA,
        [
            repeat(dataset, len(rows)),
            repeat(segment_id, len(rows)),
            rows.sweep_index,
            rows.timestamp_ns,
            rows.point_index,
            *(pa.array(column, mask=has_no_flow) for column in rows.flow_world_m.T),
            pa.array(rows.cluster_id, mask=~rows.is_in_cluster),
            pa.array(rows.track_ids, pa.string()).take(pa.array(rows.track, mask=rows.track < 0)),
        ],
    )


def from_table(table: pa.Table) -> PointRows:
    """Return the rows of one segment's points table, in its order."""
    cluster_id = table["cluster_id"]
    tracks = table["track_id"].combine_chunks().dictionary_encode()
    return PointRows(
        sweep_index=read_column(table, "sweep_index", np.int64),
        timestamp_ns=read_column(table, "timestamp_ns", np.int64),
        point_index=read_column(table, "point_index", np.int32),
        flow_world_m=read_matrix(table, FLOW).astype(np.float32),
        cluster_id=cluster_id.fill_null(0).to_numpy(),
        is_in_cluster=cluster_id.is_valid().to_numpy(),
        track_ids=tuple(tracks.dictionary.to_pylist()),
        track=tracks.indices.fill_null(-1).to_numpy().astype(np.int64),
    )
