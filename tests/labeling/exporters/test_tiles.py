import numpy as np
import pytest

from labeling.exporters.tiles import VoxelTiles
from labeling.geometry.voxels import group_by_voxel


@pytest.fixture
def clouds():
    rng = np.random.default_rng(0)
    return [rng.uniform(-50, 50, (size, 3)) for size in (4000, 0, 3000, 1)]


@pytest.mark.parametrize("pending_rows", [0, 1 << 18])
@pytest.mark.parametrize("voxel_m", [0.7, 4.0, 90.0])
def test_means_are_those_of_all_clouds_together(tmp_path, monkeypatch, clouds, pending_rows, voxel_m):
    monkeypatch.setattr("labeling.exporters.tiles.PENDING_ROWS", pending_rows)
    tiles = VoxelTiles(tmp_path, voxel_m)
    for cloud in clouds:
        tiles.add(cloud)
    points = np.concatenate(clouds)
    groups = group_by_voxel(points, voxel_m)
    totals = np.stack([np.bincount(groups.voxel_of_point, column) for column in points.T], axis=1)
    expected = totals / groups.num_points[:, None]
    assert tiles.count_voxels() == len(expected)
    found = np.concatenate(list(tiles.means()))
    np.testing.assert_allclose(found[np.lexsort(found.T)], expected[np.lexsort(expected.T)], atol=1e-5)


def test_what_falls_into_the_same_voxels_again_takes_no_more_room(tmp_path, monkeypatch, clouds):
    monkeypatch.setattr("labeling.exporters.tiles.PENDING_ROWS", 100)
    tiles = VoxelTiles(tmp_path, 4.0)
    sizes = []
    for _ in range(12):
        tiles.add(clouds[0])
        sizes.append(sum(path.stat().st_size for path in tmp_path.iterdir()))
    assert max(sizes[3:]) <= 3 * sizes[0]


def test_a_tile_holds_what_lies_in_it(tmp_path, clouds):
    tiles = VoxelTiles(tmp_path, 1.0)
    tiles.add(clouds[0])
    for points in tiles.means():
        assert len(np.unique(np.floor(points[:, :2] / 32.0), axis=0)) == 1


def test_no_points_are_no_voxels(tmp_path):
    tiles = VoxelTiles(tmp_path, 0.1)
    tiles.add(np.empty((0, 3)))
    assert tiles.count_voxels() == 0
    assert list(tiles.means()) == []
