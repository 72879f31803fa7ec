"""Label folders written by hand, with a car whose corners are known."""

from types import SimpleNamespace

import numpy as np
import pytest

from labeling.exporters.exporter import ExportOptions, export_labels
from labeling.folders.entries import make_manifest, prepare_folder
from labeling.folders.folder import LabelFolder, publish_manifest
from labeling.folders.identity import LabelSet
from labeling.folders.writer import publish_segment
from labeling.geometry.boxes import transform_boxes
from labeling.geometry.transforms import rotate_vectors, yaw_translation
from labeling.readers.reader import segment_id_of
from labeling.storage.local import LocalStorage
from schemas.config import LabelingConfig
from schemas.manifest import SegmentEntry
from schemas.objects import LabeledTrack, SweepObservation, SweepPoints

START_NS = 1_700_000_000_000_000_000
CAR, WALKER, DOUBTFUL = (f"00000000-0000-4000-8000-00000000000{number}" for number in "123")
LATE_NS = 37_000_000  # how long after its sweep's time stamp the car was met


def pose(index):
    """world_from_ego of a vehicle that drives along y of the world, 3 m above it."""
    return yaw_translation(np.pi / 2, np.array([100.0, 50.0 + index, 3.0]))


def corners_of(center, ahead, left, length, width):
    """Return the places of a box's corners by name, from its centre and unit vectors ahead and to the left."""
    center, ahead, left = (np.asarray(vector, dtype=np.float64) for vector in (center, ahead, left))
    return {
        (end, side): tuple(center + along * ahead * length / 2 + across * left * width / 2)
        for end, along in (("front", 1), ("rear", -1))
        for side, across in (("left", 1), ("right", -1))
    }


@pytest.fixture
def car():
    """A car that keeps ahead of the vehicle, a little to the left, turned by 30 degrees; ego frame.

    Its lower corners are written out, so that nothing of ours is asked where they are.
    """
    return SimpleNamespace(
        box_ego=np.array([10.0, 2.0, 0.8, 4.5, 1.8, 1.6, np.pi / 6]),
        center=[10.0, 2.0, 0.8],
        corners={  # 2.25 m ahead or behind, 0.9 m left or right; cos 30 = 0.866025, sin 30 = 0.5
            ("front", "left"): (11.498557, 3.904423),
            ("front", "right"): (12.398557, 2.345577),
            ("rear", "left"): (7.601443, 1.654423),
            ("rear", "right"): (8.501443, 0.095577),
        },
        corners_of=corners_of,
        bottom_z=0.0,
        top_z=1.6,
        velocity_ego=np.array([8.0, 1.0, 0.0]),
        num_points=321,
        track_id=CAR,
    )


@pytest.fixture
def make_driven(car):
    """Return a builder: a track whose box in the ego frame is the same in all their sweeps."""

    def build(
        track_id=CAR, sweeps=(0, 1, 2), *, box_ego=None, score=0.9, rows=None, velocity_ego=car.velocity_ego, poses=None
    ):
        poses = poses or [pose(index) for index in sweeps]
        box_ego = car.box_ego if box_ego is None else np.asarray(box_ego, dtype=np.float64)
        boxes = np.concatenate([transform_boxes(pose_of, box_ego[None]) for pose_of in poses])
        return LabeledTrack(
            track_id=track_id,
            sweep_index=np.array(sweeps, dtype=np.int64),
            timestamp_ns=START_NS + np.array(sweeps, dtype=np.int64) * 100_000_000 + LATE_NS,
            boxes=boxes,
            velocity_mps=np.stack([rotate_vectors(pose_of, velocity_ego) for pose_of in poses]),
            score=np.full(len(sweeps), score),
            num_points=np.full(len(sweeps), car.num_points),
            is_observed=np.ones(len(sweeps), dtype=bool),
            boxes_visible=boxes,
            registration_error_m=np.full(len(sweeps), 0.05),
            point_rows=tuple(np.array((rows or {}).get(index, ()), dtype=np.int32) for index in sweeps),
        )

    return build


@pytest.fixture
def walker(make_driven):
    """A walker in sweep 1."""
    return make_driven(WALKER, [1], box_ego=[5.0, -3.0, 0.9, 0.7, 0.6, 1.8, 0.0], score=0.6)


@pytest.fixture
def doubtful(make_driven):
    """A lorry that is hardly there, in sweep 0."""
    return make_driven(DOUBTFUL, [0], box_ego=[-30.0, 8.0, 1.6, 9.0, 2.5, 3.2, -1.0], score=0.2)


@pytest.fixture
def make_sweep():
    """Return a builder of what a run says of one sweep; ``moving`` are rows of points that it left to motion."""

    def build(index, *, reason="", num_points=100, moving=(), points_ego=None, world_from_ego=None):
        rows = np.array(moving, dtype=np.int32)
        places = np.full((len(rows), 3), 500.0) if points_ego is None else points_ego[rows]
        found = SweepPoints(
            points_ego=places.astype(np.float32),
            point_index=rows,
            is_dynamic=np.ones(len(rows), dtype=bool),
            cluster_id=np.zeros(len(rows), dtype=np.int32),
            flow_world_m=np.ones((len(rows), 3), dtype=np.float32),
        )
        return SweepObservation(
            sweep_index=index,
            timestamp_ns=START_NS + index * 100_000_000,
            world_from_ego=pose(index) if world_from_ego is None else world_from_ego,
            num_points=0 if reason else num_points,
            num_ground=0,
            num_static=0,
            num_clusters=0,
            num_failed_fits=0,
            reason=reason,
            proposals=(),
            points=None if reason else found,
        )

    return build


@pytest.fixture
def make_labels(tmp_path, make_sweep):
    """Return a function that writes one segment's labels into the folder ``name`` and opens it."""

    def write(tracks, *, sweeps=None, name="labels", uri="/data/log", dataset="av2", failed=(), with_points=False):
        config = LabelingConfig(write_points=with_points)
        storage = LocalStorage(str(tmp_path / name))
        prepare_folder(storage, config)
        segment_id = segment_id_of(dataset, uri)
        shards = publish_segment(
            storage,
            LabelSet(dataset, segment_id, "00", config),
            [make_sweep(index) for index in range(3)] if sweeps is None else sweeps,
            tracks,
        )
        entries = [SegmentEntry(segment_id=segment_id, uri=uri, state="SUCCEEDED", shards=shards)]
        entries += [SegmentEntry(segment_id=lost, uri=lost, state="FAILED", reason="no points") for lost in failed]
        publish_manifest(storage, make_manifest(dataset, entries, config))
        return LabelFolder.open(tmp_path / name)

    return write


@pytest.fixture
def labels(make_labels, make_driven, walker, doubtful):
    """A folder of one segment: three sweeps, the car in all of them, a walker and a doubtful lorry in one each."""
    return make_labels([make_driven(), walker, doubtful])


@pytest.fixture
def label_recorded(tmp_path, write_av2, make_labels, make_sweep, make_driven, car):
    """Return a function that labels a log of a vehicle that stands: rows 0 to 8 are a wall, 9 to 11 lie on the car."""
    wall = np.array([[15.0 + step, -4.0, 1.0] for step in range(9)])
    points_ego = np.concatenate([wall, car.center + np.array([[0.0, 0.2, 0.1], [0.3, 0.0, 0.0], [-0.4, 0.1, 0.3]])])

    def label(name="labels", *, moving=(9, 10, 11), box_ego=None):
        if not (tmp_path / "log").exists():
            write_av2(tmp_path / "log", [0.0, 0.1, 0.2], [points_ego] * 3)
        stands = {"points_ego": points_ego, "num_points": len(points_ego), "world_from_ego": np.eye(4)}
        sweeps = [make_sweep(index, moving=moving, **stands) for index in range(3)]
        track = make_driven(rows=dict.fromkeys(range(3), moving), box_ego=box_ego, poses=[np.eye(4)] * 3)
        return make_labels([track], sweeps=sweeps, name=name, uri=str(tmp_path / "log"), with_points=True)

    return label


@pytest.fixture
def export(tmp_path):
    """Return a function that exports a folder and returns the local folder of the export."""

    def run(folder, format_name, output="export", **options):
        export_labels(folder, format_name, tmp_path / output, ExportOptions(**options))
        return tmp_path / output

    return run


@pytest.fixture
def contents():
    """Return a function that reads all files below a folder: their names there, and their bytes."""
    return lambda folder: {
        path.relative_to(folder).as_posix(): path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()
    }
