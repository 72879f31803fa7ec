"""The label folder's tables, as Arrow schemas. Columns may be added; a change of meaning needs a new version.

OUT/labels/   one row per (segment, sweep, track)
OUT/sweeps/   one row per sweep
OUT/points/   one row per point called neither ground nor static (only when asked)
OUT/manifests/<identity>.json
"""

from typing import Final

import pyarrow as pa

SCHEMA_VERSION: Final = 1
READABLE_VERSIONS: Final = (1,)

TABLES: Final = ("labels", "sweeps", "points")

_KEY = [
    pa.field("dataset", pa.string(), nullable=False),
    pa.field("segment_id", pa.string(), nullable=False),
    pa.field("sweep_index", pa.int32(), nullable=False),
    pa.field("timestamp_ns", pa.int64(), nullable=False),
]

LABELS: Final = pa.schema(
    [
        *_KEY,
        pa.field("track_id", pa.string(), nullable=False),
        *(pa.field(f"center_{axis}_m", pa.float64(), nullable=False) for axis in "xyz"),  # WORLD, geometric centre
        *(pa.field(f"{size}_m", pa.float32(), nullable=False) for size in ("length", "width", "height")),
        pa.field("yaw_rad", pa.float64(), nullable=False),  # world, (-pi, pi]
        *(pa.field(f"velocity_{axis}_mps", pa.float32(), nullable=False) for axis in "xyz"),  # world
        pa.field("score", pa.float32(), nullable=False),  # [0, 1]
        pa.field("num_points", pa.int32(), nullable=False),
        pa.field("box_source", pa.string(), nullable=False),  # observed | interpolated
        *(pa.field(f"visible_center_{axis}_m", pa.float64()) for axis in "xyz"),  # tight box of the seen points
        *(pa.field(f"visible_{size}_m", pa.float64()) for size in ("length", "width", "height")),
        pa.field("visible_yaw_rad", pa.float64()),
        pa.field("registration_error_m", pa.float32()),  # null where not registered
    ]
)

SWEEPS: Final = pa.schema(
    [
        *_KEY,
        pa.field("world_from_ego", pa.list_(pa.float64(), 16), nullable=False),  # row-major
        pa.field("num_points", pa.int32(), nullable=False),
        pa.field("num_ground", pa.int32(), nullable=False),
        pa.field("num_static", pa.int32(), nullable=False),
        pa.field("num_clusters", pa.int32(), nullable=False),
        pa.field("num_failed_fits", pa.int32(), nullable=False),
        pa.field("status", pa.string(), nullable=False),  # ok | rejected
        pa.field("reason", pa.string(), nullable=False),  # empty when ok
    ]
)

POINTS: Final = pa.schema(
    [
        *_KEY,
        pa.field("point_index", pa.int32(), nullable=False),  # row in the source sweep, before any filter
        *(pa.field(f"flow_{axis}_m", pa.float32()) for axis in "xyz"),  # WORLD axes, to the next sweep, null at the end
        pa.field("cluster_id", pa.int32()),  # null for a point that its object's track brought back
        pa.field("track_id", pa.string()),  # null when none
    ]
)

SCHEMAS: Final = {"labels": LABELS, "sweeps": SWEEPS, "points": POINTS}

BOX_SOURCES: Final = ("observed", "interpolated")
