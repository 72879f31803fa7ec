"""Flow from a file beside each sweep: an oracle's, a trained network's, anybody's."""

from pathlib import Path

import numpy as np
import pyarrow as pa
from pyarrow import feather

from schemas.arrays import Float32Array
from schemas.errors import UnreadableSweep

COLUMNS = ("flow_x_m", "flow_y_m", "flow_z_m")


def read_external_flow(folder: str, segment_id: str, timestamp_ns: int, num_points: int) -> Float32Array:
    """Read FOLDER/<segment_id>/<timestamp_ns>.feather: one row a point of the sweep, in its order.

    Returns:
        (num_points, 3) m: displacement to the next sweep in the ego axes of this one, ego motion removed.

    Raises:
        UnreadableSweep: The file is missing, not Feather, of another length, or holds a number that is not finite.

    """
    path = Path(folder) / segment_id / f"{timestamp_ns}.feather"
    try:
        table = feather.read_table(path, columns=list(COLUMNS))
    except FileNotFoundError:
        raise UnreadableSweep(f"no external flow at {path}: expected one file a sweep") from None
    except (pa.ArrowException, OSError, ValueError) as error:
        reason = str(error).partition("\n")[0]
        raise UnreadableSweep(f"{path} is not a Feather file with {', '.join(COLUMNS)}: {reason}") from None
    if len(table) != num_points:
        raise UnreadableSweep(f"{path} has {len(table)} rows, its sweep {num_points} points: made for another sweep?")
    flow = np.stack([table[name].to_numpy().astype(np.float32) for name in COLUMNS], axis=1)
    if not np.isfinite(flow).all():
        raise UnreadableSweep(f"{path} holds {int((~np.isfinite(flow)).any(axis=1).sum())} rows that are not finite")
    return flow
