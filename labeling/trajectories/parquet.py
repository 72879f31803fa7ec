"""SEGMENT.parquet: windows around anchors, each in the frame that its object has there."""

from collections.abc import Iterable

import pyarrow as pa
import pyarrow.parquet as pq

from labeling.exporters.output import ExportFolder
from labeling.folders.folder import METADATA_PREFIX
from labeling.trajectories.trajectories import SegmentTracks
from labeling.trajectories.windows import Horizon, cut_windows
from schemas.tables import SCHEMA_VERSION
from schemas.tables.trajectories import make_schema, to_table


def write(segments: Iterable[SegmentTracks], output: ExportFolder, horizon: Horizon) -> int:
    """Write a file a segment and a row group a track, which is all that is in memory; see ``TrajectoryWriter``."""
    num_windows = 0
    for segment in segments:
        labels = segment.labels
        schema = _schema(horizon, segment.max_gap_s)
        with (
            output.writing(f"{labels.segment_id}.parquet") as file,
            pq.ParquetWriter(file, schema, compression="zstd") as parquet,
        ):
            for rows in segment.tracks:
                windows = cut_windows(rows, segment.start_ns, horizon, segment.max_gap_s)
                num_windows += len(windows)
                if len(windows):
                    table = to_table(labels.dataset, labels.segment_id, windows)
                    parquet.write_table(table.replace_schema_metadata(schema.metadata))
    return num_windows


def _schema(horizon: Horizon, max_gap_s: float) -> pa.Schema:
    """Return the table's schema; its metadata says at which times the steps are."""
    said = {
        "schema_version": SCHEMA_VERSION,
        "hz": f"{horizon.hz:g}",
        "num_history": horizon.num_history,
        "num_future": horizon.num_future,
        "max_gap_s": f"{max_gap_s:g}",
    }
    metadata = {f"{METADATA_PREFIX}{name}": str(value) for name, value in said.items()}
    return make_schema(len(horizon.offsets_ns)).with_metadata(metadata)
