"""OUT/labels/: one row per (segment, sweep, track)."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from schemas.arrays import BoolArray, Float64Array, Int64Array, read_only, require
from schemas.objects import LabeledTrack
from schemas.tables.columns import BOX, KEY, VELOCITY, VISIBLE_BOX, make_table, read_column, read_matrix, repeat

SCHEMA: Final = pa.schema(
    [
        *KEY,
        pa.field("track_id", pa.string(), nullable=False),
        *(pa.field(name, pa.float64(), nullable=False) for name in BOX[:3]),  # WORLD, geometric centre
        *(pa.field(name, pa.float32(), nullable=False) for name in BOX[3:6]),
        pa.field(BOX[6], pa.float64(), nullable=False),  # world, (-pi, pi]
        *(pa.field(name, pa.float32(), nullable=False) for name in VELOCITY),  # world
        pa.field("score", pa.float32(), nullable=False),  # [0, 1]
        pa.field("num_points", pa.int32(), nullable=False),
        pa.field("box_source", pa.string(), nullable=False),  # observed | interpolated
        *(pa.field(name, pa.float64()) for name in VISIBLE_BOX),  # tight box of the seen points
        pa.field("registration_error_m", pa.float32()),  # null where not registered
    ]
)
OBSERVED: Final = "observed"
INTERPOLATED: Final = "interpolated"


@dataclass(frozen=True, slots=True, eq=False)
class LabelRows:
    """The labels of one segment, one row a sweep and track."""

    sweep_index: Int64Array  # (R,)
    timestamp_ns: Int64Array  # (R,)
    track_id: NDArray[np.str_]  # (R,)
    boxes: Float64Array  # (R, 7) world, see schemas.objects
    velocity_mps: Float64Array  # (R, 3) world
    score: Float64Array  # (R,) in [0, 1]
    num_points: Int64Array  # (R,)
    is_observed: BoolArray  # (R,) False: interpolated
    boxes_visible: Float64Array  # (R, 7) world, NaN where interpolated
    registration_error_m: Float64Array  # (R,) NaN where not registered

    def __post_init__(self) -> None:
        """Check shapes and make all arrays read-only."""
        rows = len(self.sweep_index)
        require("boxes", self.boxes, (rows, 7), np.float64)
        require("boxes_visible", self.boxes_visible, (rows, 7), np.float64)
        require("velocity_mps", self.velocity_mps, (rows, 3), np.float64)
        for name in self.__slots__:
            object.__setattr__(self, name, read_only(getattr(self, name)))

    def __len__(self) -> int:
        """Return the number of rows."""
        return len(self.sweep_index)

    def take(self, rows: BoolArray | Int64Array) -> "LabelRows":
        """Return some of the rows, by mask or by number."""
        return LabelRows(**{name: getattr(self, name)[rows] for name in self.__slots__})

    @classmethod
    def of_tracks(cls, tracks: Sequence[LabeledTrack]) -> "LabelRows":
        """Return the rows of all tracks, by sweep and then by track id."""

        def joined(name: str, dtype: type[np.generic], width: int | None = None) -> Any:
            none = np.empty((0,) if width is None else (0, width), dtype=dtype)
            return np.concatenate([none, *(getattr(track, name) for track in tracks)], dtype=dtype)

        rows = cls(
            sweep_index=joined("sweep_index", np.int64),
            timestamp_ns=joined("timestamp_ns", np.int64),
            track_id=np.array([track.track_id for track in tracks for _ in track.sweep_index], dtype=np.str_),
            boxes=joined("boxes", np.float64, 7),
            velocity_mps=joined("velocity_mps", np.float64, 3),
            score=joined("score", np.float64),
            num_points=joined("num_points", np.int64),
            is_observed=joined("is_observed", np.bool_),
            boxes_visible=joined("boxes_visible", np.float64, 7),
            registration_error_m=joined("registration_error_m", np.float64),
        )
        return rows.take(np.lexsort((rows.track_id, rows.sweep_index)))


def to_table(dataset: str, segment_id: str, rows: LabelRows) -> pa.Table:
    """Return the rows as they are written; sizes, velocities and scores are rounded to float32."""
    is_unseen = np.isnan(rows.boxes_visible).any(axis=1)
    return make_table(
        SCHEMA,
        [
            repeat(dataset, len(rows)),
            repeat(segment_id, len(rows)),
            rows.sweep_index,
            rows.timestamp_ns,
            rows.track_id,
            *rows.boxes.T,
            *rows.velocity_mps.T,
            rows.score,
            rows.num_points,
            np.where(rows.is_observed, OBSERVED, INTERPOLATED),
            *(pa.array(column, mask=is_unseen) for column in rows.boxes_visible.T),
            pa.array(rows.registration_error_m, mask=np.isnan(rows.registration_error_m)),
        ],
    )


def from_table(table: pa.Table) -> LabelRows:
    """Return the rows of one segment's labels table, in its order."""
    return LabelRows(
        sweep_index=read_column(table, "sweep_index", np.int64),
        timestamp_ns=read_column(table, "timestamp_ns", np.int64),
        track_id=read_column(table, "track_id", np.str_),
        boxes=read_matrix(table, BOX),
        velocity_mps=read_matrix(table, VELOCITY),
        score=read_column(table, "score", np.float64),
        num_points=read_column(table, "num_points", np.int64),
        is_observed=read_column(table, "box_source", np.str_) == OBSERVED,
        boxes_visible=read_matrix(table, VISIBLE_BOX),
        registration_error_m=read_column(table, "registration_error_m", np.float64),
    )
