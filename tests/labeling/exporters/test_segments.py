import numpy as np
import pytest

from labeling.exporters.output import ExportFolder
from labeling.exporters.segments import SegmentLabels, read_segment
from labeling.folders.folder import LabelFolder
from schemas.errors import InvalidInput


def test_boxes_come_sweep_by_sweep_in_the_frame_of_the_vehicle(labels, car, walker):
    segment = read_segment(labels, labels.segment_ids[0], 0.5)
    assert (segment.dataset, len(segment.rows)) == ("av2", 4)
    assert [sweep.rows.track_id.tolist() for sweep in segment] == [
        [car.track_id],
        [car.track_id, walker.track_id],
        [car.track_id],
    ]
    for sweep in segment:
        np.testing.assert_allclose(sweep.boxes_ego[0], car.box_ego, atol=1e-6)
    assert segment.timestamps_ns.tolist() == [1_700_000_000_000_000_000 + i * 100_000_000 for i in (0, 1, 1, 2)]
    np.testing.assert_array_equal(segment.boxes_ego[1:3], segment.sweeps[1].boxes_ego)
    assert segment.track_numbers == {car.track_id: 0, walker.track_id: 1}


def test_roll_and_pitch_move_centers_only(make_labels, make_driven, make_sweep, car):
    """A vehicle whose nose points down by 0.1 rad sees what lies ahead of it higher, and upright all the same."""
    cos, sin = np.cos(0.1), np.sin(0.1)
    world_from_ego = np.array([[cos, 0, sin, 0], [0, 1, 0, 0], [-sin, 0, cos, 0], [0, 0, 0, 1.0]])
    track = make_driven(sweeps=[0], box_ego=[20.0, 0, 0, 4.5, 1.8, 1.6, 0.3], poses=[np.eye(4)])
    folder = make_labels([track], sweeps=[make_sweep(0, world_from_ego=world_from_ego)])
    (box,) = read_segment(folder, folder.segment_ids[0], 0.0).boxes_ego
    np.testing.assert_allclose(box, [20 * cos, 0, 20 * sin, 4.5, 1.8, 1.6, 0.3], atol=1e-6)


def test_points_of_other_sweeps_are_one_line(make_labels, make_sweep):
    sweeps = [make_sweep(index, moving=[1], points_ego=np.zeros((2, 3))) for index in range(2)]
    folder = make_labels([], sweeps=sweeps, with_points=True)
    whole = read_segment(folder, folder.segment_ids[0], 0.0)
    less = SegmentLabels(folder, whole.segment_id, whole.dataset, whole.sweeps[:1], whole.rows)
    with pytest.raises(InvalidInput, match=r"has points of other sweeps than its table of sweeps: label it again"):
        list(less.with_points())


def test_points_are_read_as_they_are_written(make_labels, make_sweep, export, monkeypatch):
    """However many sweeps there are, points of at most two of them are in memory."""
    sweeps = [make_sweep(index, moving=[1], points_ego=np.zeros((2, 3))) for index in range(4)]
    folder = make_labels([], sweeps=sweeps, with_points=True)
    steps, row_groups = [], LabelFolder.row_groups

    def read(self, *key):
        for group in row_groups(self, *key):
            steps.append("read")
            yield group

    monkeypatch.setattr(LabelFolder, "row_groups", read)
    monkeypatch.setattr(ExportFolder, "put", lambda *_: steps.append("put"))
    export(folder, "semantickitti")
    assert steps == ["read", *["read", "put"] * 3, "put"]
