import numpy as np
import pytest

from labeling.geometry.meshes import SensorMesh
from schemas.lidars import Beams, Lidar

ORIGIN = np.array([1.0, 2.0, 1.5])
AZIMUTHS = np.deg2rad(np.arange(-20, 20, 0.5))
ELEVATIONS = np.deg2rad(np.arange(-12, 8, 2.0))
LIDAR = Lidar((1.0, 2.0, 1.5), np.deg2rad(0.5), np.deg2rad(2.0), 0.0)


def mesh_of(points, lidar_of_point=None):
    return SensorMesh(points, Beams((LIDAR, LIDAR), lidar_of(points) if lidar_of_point is None else lidar_of_point))


def lidar_of(points, number=0):
    return np.full(len(points), number, dtype=np.uint8)


def heights(mesh, points, number=0):
    return mesh.heights(points, lidar_of(points, number))


def see_plane(point, normal, azimuths=AZIMUTHS, origin=ORIGIN):
    """Return where beams from the origin meet a plane, row by row."""
    azimuth, elevation = (grid.ravel() for grid in np.meshgrid(azimuths, ELEVATIONS))
    rays = np.stack([np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)], 1)
    range_m = ((np.asarray(point) - origin) @ normal) / (rays @ normal)
    return (origin + rays * range_m[:, None]).astype(np.float32)


@pytest.mark.parametrize(
    "normal", [(1, 0, 0), (0.8, 0, 0.6), (0.7, 0.7, 0.14)], ids=["facing", "windscreen", "turned away"]
)
def test_heights_are_distances_from_the_surface_wherever_its_beams_are(normal):
    normal = np.array(normal) / np.linalg.norm(normal)
    mesh = mesh_of(see_plane((8, 0, 0), normal))
    between = see_plane((8, 0, 0), normal, azimuths=AZIMUTHS[2:-2] + 0.003)[80:-80]
    for height in (0.0, 0.2, -0.4):
        found, heights_m = heights(mesh, between + height * normal)
        is_met = found.any(axis=1)
        assert is_met.mean() > 0.8  # some leave the beams' field, or lie over an edge that is too long
        sign = np.sign(found[is_met] @ normal)
        np.testing.assert_allclose(heights_m[is_met] * sign, height, atol=1e-3)
        np.testing.assert_allclose(found[is_met] * sign[:, None], np.tile(normal, (is_met.sum(), 1)), atol=1e-3)


def test_a_surface_straight_behind_is_not_cut():
    behind = see_plane((-8, 0, 0), (1, 0, 0), azimuths=AZIMUTHS + np.pi)
    normal, heights_m = heights(mesh_of(behind), behind[100:-100] - np.float32([0.1, 0, 0]))
    assert normal.any(axis=1).mean() > 0.9
    np.testing.assert_allclose(np.abs(heights_m[normal.any(axis=1)]), 0.1, atol=1e-3)


def test_what_stands_behind_another_thing_is_not_joined_with_it():
    near = see_plane((5, 0, 0), (1, 0, 0), azimuths=AZIMUTHS[:40])
    far = see_plane((9, 0, 0), (1, 0, 0), azimuths=AZIMUTHS[40:])
    mesh = mesh_of(np.concatenate([near, far]))
    edge = (AZIMUTHS[39] + AZIMUTHS[40]) / 2
    between = see_plane((7, 0, 0), (1, 0, 0), azimuths=np.array([edge]))
    assert not heights(mesh, between)[0].any()


def test_each_lidar_meets_surfaces_of_its_own_only():
    points = see_plane((8, 0, 0), (1, 0, 0))
    first, second = np.zeros(len(points), dtype=np.uint8), np.ones(len(points), dtype=np.uint8)
    both = mesh_of(np.concatenate([points, points - np.float32([1, 0, 0])]), np.concatenate([first, second]))
    inner = slice(100, -100)
    for lidar, expected in ((first, 0.0), (second, 1.0)):
        normal, heights_m = both.heights(points[inner], lidar[inner])
        is_met = normal.any(axis=1)
        assert is_met.mean() > 0.9
        np.testing.assert_allclose(np.abs(heights_m[is_met]), expected, atol=1e-3)


def test_no_surface_bridges_two_lidars():
    """A person as wide as two lidars' triangles are long: the right edge of one is near the left edge of the other."""
    person = see_plane((8, 0, 0), (1, 0, 0), azimuths=AZIMUTHS[10:16])
    lidar = np.repeat([0, 1], len(person)).astype(np.uint8)
    both = mesh_of(np.concatenate([person, person]), lidar)
    beside = person + np.float32([0, 0.6, 0])
    assert not both.heights(beside, np.zeros(len(person), dtype=np.uint8))[0].any()
    assert not both.heights(person - np.float32([0, 0.6, 0]), np.ones(len(person), dtype=np.uint8))[0].any()


@pytest.mark.parametrize("num_points", [0, 1, 2, 3, 50])
def test_a_row_or_a_few_points_have_no_surface(num_points):
    row = np.linspace([5, -1, 1], [5, 1, 1], num_points).astype(np.float32)
    normal, heights_m = heights(mesh_of(row), row + np.float32([0.1, 0, 0]))
    assert not normal.any()
    assert not heights_m.any()


def test_equal_points_have_no_surface():
    same = np.ones((5000, 3), dtype=np.float32)
    assert not heights(mesh_of(same), same)[0].any()


def test_points_of_no_direction_met_have_none():
    mesh = mesh_of(see_plane((8, 0, 0), (1, 0, 0)))
    assert not heights(mesh, np.float32([[-8, 0, 0], [8, 30, 0], [8, 0, 30]]))[0].any()
    assert heights(mesh, np.empty((0, 3), dtype=np.float32))[0].shape == (0, 3)
