"""DIR/SEGMENT.parquet of ``motionlabel merge``: one row per (sweep, object), whoever labelled it."""

from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import pyarrow as pa

from schemas.arrays import Float64Array, Int64Array, read_only, require
from schemas.tables.columns import BOX, KEY, VELOCITY, make_table, repeat
from schemas.tables.labels import INTERPOLATED, OBSERVED, LabelRows

HUMAN: Final = "human"
AUTO: Final = "auto"
SCHEMA: Final = pa.schema(
    [
        *KEY,
        pa.field("track_id", pa.string(), nullable=False),  # unique together with provenance
        pa.field("provenance", pa.string(), nullable=False),  # human | auto
        pa.field("category", pa.string()),  # the data set's; null: auto
        *(pa.field(name, pa.float64(), nullable=False) for name in BOX[:3]),  # WORLD, geometric centre
        *(pa.field(name, pa.float32(), nullable=False) for name in BOX[3:6]),
        pa.field(BOX[6], pa.float64(), nullable=False),  # world, (-pi, pi]
        *(pa.field(name, pa.float32()) for name in VELOCITY),  # world; null: human
        pa.field("score", pa.float32(), nullable=False),  # [0, 1]; 1: human
        pa.field("num_points", pa.int32()),  # null: human
        pa.field("box_source", pa.string()),  # observed | interpolated; null: human
        pa.field("human_overlap", pa.float32()),  # [0, 1]; null: human, and where the sweep has no annotations
    ]
)


@dataclass(frozen=True, slots=True, eq=False)
class HumanRows:
    """Annotated boxes of one segment."""

    sweep_index: Int64Array  # (R,)
    timestamp_ns: Int64Array  # (R,) of the sweep
    track_ids: tuple[str, ...]  # R
    categories: tuple[str, ...]  # R
    boxes: Float64Array  # (R, 7) world

    def __post_init__(self) -> None:
        """Check shapes and make all arrays read-only."""
        require("boxes", self.boxes, (len(self.track_ids), 7), np.float64)
        for name in ("sweep_index", "timestamp_ns", "boxes"):
            object.__setattr__(self, name, read_only(getattr(self, name)))

    def __len__(self) -> int:
        """Return the number of rows."""
        return len(self.track_ids)


def to_table(
    dataset: str,
    segment_id: str,
    human: HumanRows,
    auto: LabelRows,
    auto_overlap: Float64Array,  # (A,) of each auto row with people's boxes; NaN where nobody looked
) -> pa.Table:
    """Return both as they are written, by sweep, people's first, then by track id."""
    size = len(human) + len(auto)

    def joined(name: str) -> Any:  # an array
        return np.concatenate([getattr(human, name), getattr(auto, name)])

    def only_auto(values: Any) -> pa.Array:  # values of an array or a list
        return pa.concat_arrays([pa.nulls(len(human), (column := pa.array(values)).type), column])

    table = make_table(
        SCHEMA,
        [
            repeat(dataset, size),
            repeat(segment_id, size),
            joined("sweep_index"),
            joined("timestamp_ns"),
            [*human.track_ids, *auto.track_id.tolist()],
            [HUMAN] * len(human) + [AUTO] * len(auto),
            pa.array([*human.categories, *[None] * len(auto)], pa.string()),
            *joined("boxes").T,
            *map(only_auto, auto.velocity_mps.T),
            np.concatenate([np.ones(len(human)), auto.score]),
            only_auto(auto.num_points),
            only_auto(np.where(auto.is_observed, OBSERVED, INTERPOLATED)),
            only_auto(pa.array(auto_overlap, mask=np.isnan(auto_overlap))),
        ],
    )
    is_auto = np.arange(size) >= len(human)
    return table.take(np.lexsort((table["track_id"].to_numpy(), is_auto, joined("sweep_index"))))
