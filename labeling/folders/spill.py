"""Observations of a segment whose points wait on disk until its tracks are known."""

import dataclasses
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from types import TracebackType
from typing import Final

import numpy as np
import pyarrow as pa

from schemas.arrays import Float32Array
from schemas.objects import SweepObservation, SweepPoints
from schemas.tables.columns import FLOW

_PLACE: Final = ("x_m", "y_m", "z_m")
_SCHEMA: Final = pa.schema(
    [
        pa.field("point_index", pa.int32()),
        *(pa.field(name, pa.float32()) for name in _PLACE),  # ego frame
        pa.field("is_dynamic", pa.bool_()),
        pa.field("cluster_id", pa.int32()),
        *(pa.field(name, pa.float32()) for name in FLOW),  # world axes
    ]
)


class ObservationSpill:
    """Takes the observations of a segment one by one, then gives them back in order, one in memory at a time.

    Points go through a temporary file, a batch a sweep, and only where they are to be written; proposals are left out.
    """

    def __init__(self, *, keeps_points: bool) -> None:
        self._keeps_points = keeps_points
        self._observations: list[SweepObservation] = []
        self._batch_of: dict[int, int] = {}  # of those that have points: their place in the file
        self._resources = ExitStack()
        # Without a name: no end leaves it behind.
        self._file = self._resources.enter_context(tempfile.TemporaryFile())  # noqa: SIM115
        self._writer = self._resources.enter_context(pa.ipc.new_file(self._file, _SCHEMA))

    def __enter__(self) -> "ObservationSpill":
        """Return itself: ``with`` closes it."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Close it."""
        self.close()

    def close(self) -> None:
        """Remove the temporary file."""
        self._resources.close()

    def append(self, observation: SweepObservation) -> None:
        """Take the next one."""
        if self._keeps_points and observation.points is not None:
            self._batch_of[len(self._observations)] = len(self._batch_of)
            self._writer.write_batch(_batch_of_points(observation.points))
        self._observations.append(dataclasses.replace(observation, proposals=(), points=None))

    def restore(self) -> Iterator[SweepObservation]:
        """Give all back. None can be taken from here on."""
        self._writer.close()
        self._file.seek(0)
        with pa.ipc.open_file(self._file) as file:
            for number, observation in enumerate(self._observations):
                if number in self._batch_of:
                    points = _points_of_batch(file.get_batch(self._batch_of[number]))
                    yield dataclasses.replace(observation, points=points)
                else:
                    yield observation


def _batch_of_points(points: SweepPoints) -> pa.RecordBatch:
    size, flow = len(points.point_index), points.flow_world_m
    columns = [
        points.point_index,
        *points.points_ego.T,
        points.is_dynamic,
        points.cluster_id,
        *(pa.nulls(size) if flow is None else flow[:, axis] for axis in range(3)),
    ]
    return pa.record_batch([pa.array(c, type=field.type) for c, field in zip(columns, _SCHEMA, strict=True)], _SCHEMA)


def _points_of_batch(batch: pa.RecordBatch) -> SweepPoints:
    def columns(names: Sequence[str]) -> Float32Array:
        return np.stack([batch[name].to_numpy() for name in names], axis=1)

    has_flow = batch[FLOW[0]].null_count == 0
    return SweepPoints(
        columns(_PLACE),
        batch["point_index"].to_numpy(),
        batch["is_dynamic"].to_numpy(zero_copy_only=False),
        batch["cluster_id"].to_numpy(),
        columns(FLOW) if has_flow else None,
    )
