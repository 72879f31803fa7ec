import json

import numpy as np
import pytest

from labeling.geometry.transforms import rotation_from_quaternion


@pytest.fixture
def read(export):
    """Return a function that exports a folder of one segment and returns what stands below "openlabel"."""

    def run(folder, **options):
        (path,) = export(folder, "openlabel", **options).rglob("*.json")
        assert path.name == f"{folder.segment_ids[0]}.json"
        document = json.loads(path.read_text())
        assert list(document) == ["openlabel"]
        return document["openlabel"]

    return run


def cuboids_of(document, track_id):
    for frame in document["frames"].values():
        if track_id in frame["objects"]:
            (cuboid,) = frame["objects"][track_id]["object_data"]["cuboid"]
            yield frame, cuboid


def test_the_document_names_its_version_frames_and_coordinate_systems(read, labels):
    document = read(labels)
    assert document["metadata"]["schema_version"] == "1.0.0"
    systems = document["coordinate_systems"]
    assert {name: (system["parent"], system["children"]) for name, system in systems.items()} == {
        "world": ("", ["vehicle-iso8855"]),
        "vehicle-iso8855": ("world", []),
    }
    assert document["frame_intervals"] == [{"frame_start": 0, "frame_end": 2}]
    assert list(document["frames"]) == ["0", "1", "2"]


def test_the_car_is_where_its_corners_are(read, labels, car):
    found = list(cuboids_of(read(labels), car.track_id))
    assert len(found) == 3
    for _, cuboid in found:
        assert cuboid["coordinate_system"] == "vehicle-iso8855"
        x, y, z, qx, qy, qz, qw, length, width, height = cuboid["val"]
        assert (qx, qy) == (0, 0)
        ahead = np.array([qw * qw - qz * qz, 2 * qw * qz])
        left = np.array([-ahead[1], ahead[0]])
        corners = car.corners_of([x, y], ahead, left, length, width)
        for place, corner in car.corners.items():
            assert corners[place] == pytest.approx(corner, abs=1e-5)
        assert (z - height / 2, z + height / 2) == pytest.approx((car.bottom_z, car.top_z), abs=2e-6)


def test_a_pose_carries_the_car_to_the_world(read, labels, car):
    for index, (frame, cuboid) in enumerate(cuboids_of(read(labels), car.track_id)):
        transform = frame["frame_properties"]["transforms"]["vehicle-iso8855_to_world"]
        assert (transform["src"], transform["dst"]) == ("vehicle-iso8855", "world")
        pose = transform["transform_src_to_dst"]
        x, y, z, w = (np.array([part]) for part in pose["quaternion"])
        center = rotation_from_quaternion(w, x, y, z)[0] @ cuboid["val"][:3] + pose["translation"]
        # the vehicle looks along y of the world from (100, 50 + index, 3): 10 m ahead, 2 m to the left of it
        assert center == pytest.approx([98.0, 60.0 + index, 3.8], abs=3e-6)


def test_what_is_known_of_a_box_stands_beside_it(read, labels, car):
    frame, cuboid = next(cuboids_of(read(labels), car.track_id))
    kinds = cuboid["attributes"]
    assert {entry["name"]: entry["val"] for entries in kinds.values() for entry in entries} == {
        "score": pytest.approx(0.9),
        "num_points": car.num_points,
        "box_source": "observed",
        "velocity_mps": pytest.approx(car.velocity_ego),
    }
    assert frame["frame_properties"]["timestamp"] == 1_700_000_000.0


def test_objects_say_in_which_frames_they_are(read, make_labels, make_driven, make_sweep, car):
    sweeps = [make_sweep(index) if index != 2 else make_sweep(2, reason="truncated") for index in range(6)]
    document = read(make_labels([make_driven(sweeps=[1, 3, 4])], sweeps=sweeps))
    assert document["objects"] == {
        car.track_id: {
            "name": "car 0",
            "type": "car",
            "frame_intervals": [{"frame_start": 1, "frame_end": 1}, {"frame_start": 3, "frame_end": 4}],
        }
    }
    assert document["frame_intervals"] == [{"frame_start": 0, "frame_end": 1}, {"frame_start": 3, "frame_end": 5}]
    assert list(document["frames"]) == ["0", "1", "3", "4", "5"]


def test_types_follow_from_sizes_or_are_given(read, labels):
    def types(**options):
        return [known["type"] for known in read(labels, **options)["objects"].values()]

    assert types() == ["car", "pedestrian"]
    assert types(output="other", category="mover") == ["mover", "mover"]
