import json

import numpy as np
import pytest

START_NS = 1_700_000_000_000_000_000


@pytest.fixture
def read(export):
    """Return a function that exports a folder and returns the results of a task."""

    def run(folder, task="detection", **options):
        document = json.loads((export(folder, "nuscenes", **options) / f"{task}.json").read_text())
        assert document["meta"] == {
            f"use_{name}": name == "lidar" for name in ("camera", "lidar", "radar", "map", "external")
        }
        return document["results"]

    return run


def test_every_sweep_is_a_sample(read, labels):
    tokens = [f"{labels.segment_ids[0]}_{START_NS + index * 100_000_000}" for index in range(3)]
    for task in ("detection", "tracking"):
        results = read(labels, task)
        assert list(results) == tokens
        assert [len(boxes) for boxes in results.values()] == [1, 2, 1]
        assert all(box["sample_token"] == token for token, boxes in results.items() for box in boxes)


def test_the_car_is_where_its_corners_are(read, labels, car):
    for task in ("detection", "tracking"):
        for index, boxes in enumerate(read(labels, task).values()):
            box = next(box for box in boxes if box[f"{task}_name"] == "car")
            width, length, height = box["size"]
            w, x, y, z = box["rotation"]
            assert (x, y) == (0, 0)
            ahead = np.array([w * w - z * z, 2 * w * z])
            left = np.array([-ahead[1], ahead[0]])
            center = np.array(box["translation"])
            corners = car.corners_of(center[:2], ahead, left, length, width)
            for place, (corner_x, corner_y) in car.corners.items():
                # the vehicle looks along y of the world, from (100, 50 + index, 3)
                assert corners[place] == pytest.approx([100 - corner_y, 50 + index + corner_x], abs=1e-5)
            assert center[2] - height / 2 == pytest.approx(3 + car.bottom_z, abs=2e-6)
            assert center[2] + height / 2 == pytest.approx(3 + car.top_z, abs=2e-6)
            ahead_mps, left_mps, _ = car.velocity_ego
            assert box["velocity"] == pytest.approx([-left_mps, ahead_mps], abs=1e-5)


def test_both_tasks_have_their_own_fields(read, labels, car):
    shared = {"sample_token", "translation", "size", "rotation", "velocity"}
    (detection,) = next(iter(read(labels).values()))
    assert set(detection) == shared | {"detection_name", "detection_score", "attribute_name"}
    assert (detection["detection_score"], detection["attribute_name"]) == (pytest.approx(0.9), "vehicle.moving")
    (tracked,) = next(iter(read(labels, "tracking").values()))
    assert set(tracked) == shared | {"tracking_id", "tracking_name", "tracking_score"}
    assert tracked["tracking_id"] == car.track_id


@pytest.mark.parametrize(
    ("box", "speed_mps", "name", "attribute"),
    [
        ([4.5, 1.8, 1.6], 0.0, "car", "vehicle.stopped"),
        ([9.0, 2.5, 3.2], 5.0, "truck", "vehicle.moving"),
        ([0.6, 0.6, 1.7], 1.0, "pedestrian", "pedestrian.moving"),
        ([0.6, 0.6, 1.7], 0.1, "pedestrian", "pedestrian.standing"),
        ([1.7, 0.6, 1.7], 0.1, "bicycle", "cycle.with_rider"),
    ],
)
def test_names_and_attributes_follow_from_size_and_speed(
    read, make_labels, make_driven, box, speed_mps, name, attribute
):
    track = make_driven(sweeps=[0], box_ego=[10, 2, 0.8, *box, 0.0], velocity_ego=np.array([speed_mps, 0, 0]))
    (found,) = next(iter(read(make_labels([track])).values()))
    assert (found["detection_name"], found["attribute_name"]) == (name, attribute)


def test_one_category_for_all(read, labels):
    names = {box["tracking_name"] for boxes in read(labels, "tracking", category="bus").values() for box in boxes}
    assert names == {"bus"}


def test_samples_of_all_segments_are_in_one_file(read, make_labels, make_driven):
    for uri in ("/data/b", "/data/a"):
        folder = make_labels([make_driven()], uri=uri)
    assert [token.rpartition("_")[0] for token in read(folder)] == [folder.segment_ids[0]] * 3 + [
        folder.segment_ids[1]
    ] * 3


def test_of_too_many_boxes_the_best_are_kept(read, make_labels, make_driven):
    tracks = [make_driven(f"{number:04d}", [0], score=0.5 + number / 2000) for number in range(503)]
    results = read(make_labels(tracks), "tracking")
    assert [box["tracking_id"] for box in next(iter(results.values()))] == [f"{number:04d}" for number in range(3, 503)]


def test_no_sweeps_are_no_samples(read, make_labels, make_sweep):
    assert read(make_labels([], sweeps=[make_sweep(0, reason="truncated")])) == {}
