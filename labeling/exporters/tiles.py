"""A point cloud of any size, thinned to one point a voxel, that waits on disk in tiles."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from schemas.arrays import Float64Array

TILE_M: Final = 32.0
PENDING_ROWS: Final = 1 << 18  # that a tile takes before equal voxels are merged, or as many as it has voxels
_ROW: Final = np.dtype([("cell", "<i8", 3), ("offset", "<f4", 3), ("count", "<i4")])

Rows = NDArray[Any]  # of _ROW: a voxel, the mean of its points from its corner, m, and their number


class VoxelTiles:
    """Takes clouds one by one and gives back the mean of the points of each voxel; one tile at a time is in memory.

    Equal voxels of a tile are merged once they may be many, so that a vehicle that stands fills no disk.
    """

    def __init__(self, folder: Path, voxel_m: float) -> None:
        self._folder, self._voxel_m = folder, voxel_m
        self._cells_of_tile = max(1, round(TILE_M / voxel_m))
        self._num_merged: dict[tuple[int, int], int] = {}  # rows of each tile after the last merge
        self._num_pending: dict[tuple[int, int], int] = {}  # and since

    def add(self, points: Float64Array) -> None:
        """Take (N, 3) points, m."""
        rows = np.empty(len(points), dtype=_ROW)
        rows["cell"] = np.floor(points / self._voxel_m)
        rows["offset"], rows["count"] = points - rows["cell"] * self._voxel_m, 1
        rows = _merge(rows)
        tiles, tile_of_row = np.unique(rows["cell"][:, :2] // self._cells_of_tile, axis=0, return_inverse=True)
        for number, (x, y) in enumerate(tiles.tolist()):
            self._append((x, y), rows[tile_of_row == number])

    def count_voxels(self) -> int:
        """Merge what is left to merge, and return how many points there are in all."""
        for tile in self._num_merged:
            self._merge_tile(tile)
        return sum(self._num_merged.values())

    def means(self) -> Iterator[Float64Array]:
        """Yield the (V, 3) points of tile after tile, each sorted by voxel."""
        for tile in sorted(self._num_merged):
            self._merge_tile(tile)
            rows = np.fromfile(self._path(tile), dtype=_ROW)
            yield rows["cell"] * self._voxel_m + rows["offset"]

    def _append(self, tile: tuple[int, int], rows: Rows) -> None:
        with self._path(tile).open("ab") as file:
            file.write(rows.tobytes())
        num_merged = self._num_merged.setdefault(tile, 0)
        self._num_pending[tile] = self._num_pending.get(tile, 0) + len(rows)
        if self._num_pending[tile] > max(PENDING_ROWS, num_merged):
            self._merge_tile(tile)

    def _merge_tile(self, tile: tuple[int, int]) -> None:
        if self._num_pending.pop(tile, 0):
            rows = _merge(np.fromfile(self._path(tile), dtype=_ROW))
            rows.tofile(self._path(tile))
            self._num_merged[tile] = len(rows)

    def _path(self, tile: tuple[int, int]) -> Path:
        return self._folder / "{}_{}".format(*tile)


def _merge(rows: Rows) -> Rows:
    """Return a row a voxel, sorted by voxel."""
    if len(rows) == 0:
        return rows
    rows = rows[np.lexsort(rows["cell"].T[::-1])]
    starts = np.flatnonzero(np.append(True, (rows["cell"][1:] != rows["cell"][:-1]).any(axis=1)))
    weighted = rows["offset"].astype(np.float64) * rows["count"][:, None]
    merged = rows[starts]
    merged["count"] = np.add.reduceat(rows["count"], starts)
    merged["offset"] = np.add.reduceat(weighted, starts) / merged["count"][:, None]
    return merged
