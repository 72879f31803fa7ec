import dataclasses

import numpy as np
import pytest

from schemas.errors import InvalidInput
from schemas.frames import Annotations, GroundMask, Sweep


def make_sweep(**changes):
    fields = {
        "index": 3,
        "timestamp_ns": 1_000_000_000,
        "points_ego": np.zeros((5, 3), np.float32),
        "capture_offset_s": np.zeros(5, np.float32),
        "world_from_ego": np.eye(4),
        "sensor_origins_ego": np.zeros((1, 3), np.float32),
        "lidar_of_point": np.zeros(5, np.uint8),
    }
    return Sweep(**{**fields, **changes})


def make_annotations(**changes):
    fields = {"track_ids": ("a", "b"), "categories": ("CAR", "BUS"), "boxes_ego": np.ones((2, 7))}
    return Annotations(**{**fields, **changes})


@pytest.mark.parametrize(
    ("changes", "name"),
    [
        pytest.param({"points_ego": np.zeros((5, 3))}, "points_ego", id="points-in-float64"),
        pytest.param({"points_ego": np.zeros((5, 4), np.float32)}, "points_ego", id="points-with-intensity"),
        pytest.param({"capture_offset_s": np.zeros(4, np.float32)}, "capture_offset_s", id="one-offset-short"),
        pytest.param({"world_from_ego": np.eye(4, dtype=np.float32)}, "world_from_ego", id="pose-in-float32"),
        pytest.param({"world_from_ego": np.eye(3)}, "world_from_ego", id="pose-without-translation"),
        pytest.param({"lidar_of_point": np.zeros(4, np.uint8)}, "lidar_of_point", id="one-lidar-short"),
        pytest.param({"lidar_of_point": np.zeros(5)}, "lidar_of_point", id="lidars-as-floats"),
        pytest.param({"sensor_origins_ego": np.zeros(3, np.float32)}, "sensor_origins_ego", id="one-bare-origin"),
    ],
)
def test_a_sweep_refuses_what_does_not_fit_by_name(changes, name):
    with pytest.raises(InvalidInput, match=f"^{name} must be"):
        make_sweep(**changes)


def test_a_sweep_refuses_points_of_a_lidar_that_it_does_not_know():
    with pytest.raises(InvalidInput, match="names lidar 1: sensor_origins_ego has 1 rows"):
        make_sweep(lidar_of_point=np.array([0, 0, 1, 0, 0], np.uint8))


def test_a_sweep_refuses_writes_to_fields_and_arrays():
    sweep = make_sweep()
    with pytest.raises(dataclasses.FrozenInstanceError):
        sweep.index = 4
    for name in ("points_ego", "capture_offset_s", "world_from_ego", "sensor_origins_ego", "lidar_of_point"):
        with pytest.raises(ValueError, match="read-only"):
            getattr(sweep, name)[0] = 1


def test_an_empty_sweep_is_legal_and_counts_no_points():
    none = np.zeros(0, np.float32)
    empty = make_sweep(points_ego=none.reshape(0, 3), capture_offset_s=none, lidar_of_point=none.astype(np.uint8))
    assert empty.num_points == 0
    assert make_sweep().num_points == 5


def test_a_ground_mask_has_one_height_a_point():
    mask = GroundMask(is_ground=np.array([True, False]), height_m=np.zeros(2, np.float32))
    assert not mask.is_ground.flags.writeable
    assert not mask.height_m.flags.writeable
    with pytest.raises(InvalidInput, match="height_m"):
        GroundMask(is_ground=np.array([True, False]), height_m=np.zeros(3, np.float32))


@pytest.mark.parametrize(
    "changes",
    [{"track_ids": ("a",)}, {"categories": ()}, {"boxes_ego": np.ones((3, 7))}, {"boxes_ego": np.ones((2, 8))}],
    ids=["ids", "categories", "boxes", "columns"],
)
def test_annotations_refuse_unequal_lengths_and_other_boxes(changes):
    with pytest.raises(InvalidInput):
        make_annotations(**changes)


def test_annotations_may_be_empty_and_are_read_only():
    assert len(make_annotations(track_ids=(), categories=(), boxes_ego=np.zeros((0, 7))).boxes_ego) == 0
    with pytest.raises(ValueError, match="read-only"):
        make_annotations().boxes_ego[0, 0] = 2
