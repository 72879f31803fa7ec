"""The label folder's tables: Arrow schemas, ``to_table`` and ``from_table``, a file each.

OUT/labels/   one row per (segment, sweep, track)
OUT/sweeps/   one row per sweep
OUT/points/   one row per point called neither ground nor static (only when asked)

Columns may be added; a change of meaning needs a new version.
"""

from typing import Final, Literal, get_args

import pyarrow as pa

from schemas.tables import labels, points, sweeps

SCHEMA_VERSION: Final = 1
READABLE_VERSIONS: Final = (1,)

Table = Literal["labels", "sweeps", "points"]
TABLES: Final[tuple[Table, ...]] = get_args(Table)
SCHEMAS: Final[dict[Table, pa.Schema]] = {
    "labels": labels.SCHEMA,
    "sweeps": sweeps.SCHEMA,
    "points": points.SCHEMA,
}
