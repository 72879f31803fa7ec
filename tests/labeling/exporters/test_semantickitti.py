import numpy as np
import pytest

from labeling.exporters.exporter import export_labels
from schemas.errors import InvalidInput

STATIC, MOVING = 9, 251


@pytest.fixture
def read(export):
    """Return a function that exports a folder and returns the labels of the only segment's sweeps by file name."""

    def run(folder, **options):
        sequence = export(folder, "semantickitti", **options) / "sequences" / folder.segment_ids[0] / "labels"
        return {path.name: np.fromfile(path, dtype="<u4") for path in sorted(sequence.iterdir())}

    return run


@pytest.fixture
def moving(make_labels, make_sweep, make_driven, car):
    """Two sweeps of 12 points: 3 and 4 lie on the car, 6 on the lorry that is hardly there, 8 moves by itself."""
    points_ego = np.full((12, 3), 200.0)
    points_ego[[3, 4]], points_ego[6] = car.center, (-30.0, 8.0, 1.6)
    sweeps = [
        make_sweep(0, num_points=12, moving=[3, 4, 6, 8], points_ego=points_ego),
        make_sweep(1, num_points=10),
        make_sweep(2, num_points=12, moving=[3], points_ego=points_ego),
    ]
    tracks = [
        make_driven(rows={0: [3, 4], 2: [3]}),
        make_driven("00000000-0000-4000-8000-00000000000f", [0], box_ego=[-30, 8, 1.6, 9, 2.5, 3.2, 0], score=0.3),
    ]
    return make_labels(tracks, sweeps=sweeps, with_points=True)


def test_every_point_of_every_sweep_has_a_label(read, moving):
    found = read(moving)
    assert {name: len(labels) for name, labels in found.items()} == {
        "000000.label": 12,
        "000001.label": 10,
        "000002.label": 12,
    }
    assert (found["000001.label"] == STATIC).all()


def test_points_of_tracks_move_and_others_stand(read, moving):
    labels = read(moving)["000000.label"]
    assert (labels & 0xFFFF).tolist() == [9, 9, 9, MOVING, MOVING, 9, 0, 9, 0, 9, 9, 9]  # doubtful: unlabeled
    assert (labels >> 16).tolist() == [0, 0, 0, 1, 1, 0, 0, 0, 0, 0, 0, 0]


def test_a_lower_cut_calls_more_of_them_moving(read, moving):
    labels = read(moving, min_score=0.0)["000000.label"]
    assert (labels & 0xFFFF).tolist() == [9, 9, 9, MOVING, MOVING, 9, MOVING, 9, 0, 9, 9, 9]
    assert labels[6] >> 16 not in (0, 1)


def test_an_object_keeps_its_instance(read, moving):
    found = read(moving)
    assert found["000000.label"][3] == found["000002.label"][3] == 1 << 16 | MOVING


def test_a_rejected_sweep_has_no_file(read, make_labels, make_sweep):
    sweeps = [make_sweep(0, num_points=5), make_sweep(1, reason="truncated")]
    assert list(read(make_labels([], sweeps=sweeps, with_points=True))) == ["000000.label"]


def test_labels_without_points_are_one_line(labels, tmp_path):
    with pytest.raises(InvalidInput, match=r"has no table of points, which this format needs: label it again with"):
        export_labels(labels, "semantickitti", tmp_path / "export")
    assert not (tmp_path / "export").exists()


def test_points_beyond_the_sweep_are_one_line(make_labels, make_sweep, export):
    sweep = make_sweep(0, num_points=2, moving=[5], points_ego=np.zeros((6, 3)))
    folder = make_labels([], sweeps=[sweep], with_points=True)
    with pytest.raises(InvalidInput, match=r"has points that sweep 0 does not have"):
        export(folder, "semantickitti")
