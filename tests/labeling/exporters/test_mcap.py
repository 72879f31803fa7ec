import sys

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory

from labeling.geometry.transforms import rotation_from_quaternion
from schemas.errors import InvalidInput

START_NS, STEP_NS = 1_700_000_000_000_000_000, 100_000_000


@pytest.fixture
def read(export):
    """Return a function that exports a folder of one segment and returns times and messages by topic."""

    def run(folder, **options):
        (path,) = export(folder, "mcap", **options).iterdir()
        assert path.name == f"{folder.segment_ids[0]}.mcap"
        found = {}
        with path.open("rb") as file:
            reader = make_reader(file, validate_crcs=True, decoder_factories=[DecoderFactory()])
            for schema, channel, message, decoded in reader.iter_decoded_messages():
                assert schema.encoding == channel.message_encoding == "protobuf"
                assert message.log_time == message.publish_time
                found.setdefault((channel.topic, schema.name), []).append((message.log_time, decoded))
        return found

    return run


def turned(quaternion, vector):
    parts = (np.array([getattr(quaternion, part)]) for part in "wxyz")
    return rotation_from_quaternion(*parts)[0] @ vector


def xyz(vector):
    return np.array([vector.x, vector.y, vector.z])


def test_every_sweep_has_a_message_on_every_topic(read, label_recorded):
    found = read(label_recorded())
    assert set(found) == {
        ("/tf", "foxglove.FrameTransform"),
        ("/labels/boxes", "foxglove.SceneUpdate"),
        ("/labels/moving_points", "foxglove.PointCloud"),
    }
    for messages in found.values():
        assert [time for time, _ in messages] == [START_NS + index * STEP_NS for index in range(3)]


def test_the_car_is_where_its_corners_are(read, labels, car):
    found = read(labels)
    for index, ((_, pose), (_, update)) in enumerate(
        zip(found["/tf", "foxglove.FrameTransform"], found["/labels/boxes", "foxglove.SceneUpdate"], strict=True)
    ):
        assert (pose.parent_frame_id, pose.child_frame_id) == ("world", "ego")
        entity = next(entity for entity in update.entities if entity.id == car.track_id)
        assert entity.frame_id == "world"
        (cube,) = entity.cubes
        for (end, side), corner in car.corners.items():
            for z, top in ((car.bottom_z, -1), (car.top_z, 1)):
                signs = [1 if end == "front" else -1, 1 if side == "left" else -1, top]
                at = xyz(cube.pose.position) + turned(cube.pose.orientation, signs * xyz(cube.size) / 2)
                expected = xyz(pose.translation) + turned(pose.rotation, np.array([*corner, z]))
                assert at == pytest.approx(expected, abs=1e-5)
        assert xyz(pose.translation) == pytest.approx([100.0, 50.0 + index, 3.0])
        assert turned(pose.rotation, np.array([1.0, 0, 0])) == pytest.approx([0, 1, 0], abs=1e-9)


def test_boxes_of_the_last_sweep_go_when_new_ones_come(read, labels, car, walker):
    updates = [update for _, update in read(labels)["/labels/boxes", "foxglove.SceneUpdate"]]
    assert [[entity.id for entity in update.entities] for update in updates] == [
        [car.track_id],
        [car.track_id, walker.track_id],
        [car.track_id],
    ]
    for index, update in enumerate(updates):
        (deletion,) = update.deletions
        assert deletion.type == deletion.ALL
        assert deletion.timestamp.ToNanoseconds() == START_NS + index * STEP_NS


def test_a_box_tells_of_itself(read, labels, car):
    _, update = read(labels)["/labels/boxes", "foxglove.SceneUpdate"][0]
    (entity,) = update.entities
    assert {pair.key: pair.value for pair in entity.metadata} == {
        "kind": "car",
        "score": "0.900",
        "speed_mps": "8.06",
        "num_points": "321",
        "box_source": "observed",
    }
    assert entity.texts[0].text == "0 car 8.1 m/s"
    assert entity.arrows[0].pose == entity.cubes[0].pose


def test_points_that_move_are_those_of_the_recording(read, label_recorded, car):
    _, cloud = read(label_recorded())["/labels/moving_points", "foxglove.PointCloud"][0]
    assert [(field.name, field.offset, field.type) for field in cloud.fields] == [
        ("x", 0, cloud.fields[0].FLOAT32),
        ("y", 4, cloud.fields[0].FLOAT32),
        ("z", 8, cloud.fields[0].FLOAT32),
        ("track", 12, cloud.fields[0].INT32),
    ]
    assert (cloud.frame_id, cloud.point_stride) == ("ego", 16)
    points = np.frombuffer(cloud.data, dtype=[("xyz", "<f4", 3), ("track", "<i4")])
    np.testing.assert_allclose(points["xyz"] - car.center, [[0, 0.2, 0.1], [0.3, 0, 0], [-0.4, 0.1, 0.3]], atol=1e-6)
    assert points["track"].tolist() == [0, 0, 0]


def test_labels_without_points_have_boxes_and_poses(read, labels):
    assert {topic for topic, _ in read(labels)} == {"/tf", "/labels/boxes"}


def test_the_missing_extra_is_one_line(labels, export, monkeypatch):
    monkeypatch.delitem(sys.modules, "labeling.exporters.mcap", raising=False)
    monkeypatch.setitem(sys.modules, "mcap_protobuf.writer", None)
    with pytest.raises(InvalidInput, match=r"format mcap needs an extra .*: pip install 'motionlabel\[mcap\]'"):
        export(labels, "mcap")
