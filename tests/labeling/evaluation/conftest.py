"""A small made-up log with known motion, and labels made from its truth."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace

import numpy as np
import pyarrow as pa
import pytest

from labeling.evaluation.truth import points_in_boxes
from labeling.geometry.boxes import transform_boxes
from labeling.geometry.transforms import rotate_vectors, transform_points
from labeling.readers.reader import SegmentReader
from schemas.errors import UnreadableSweep
from schemas.frames import Annotations, PointTruth, Sweep
from schemas.tables import SCHEMAS

STEP_NS = 100_000_000


@dataclass(frozen=True)
class Thing:
    """A box that drives along its heading, and how many points the lidar has on it."""

    name: str
    start: tuple[float, float]
    speed_mps: float = 0.0
    yaw: float = 0.0
    size: tuple[float, float, float] = (4.0, 2.0, 1.6)
    num_points: int = 40
    moves: Callable[[float], float] | None = None  # way along the heading at a time, instead of a constant speed

    def box_world(self, time_s: float) -> np.ndarray:
        way = self.moves(time_s) if self.moves else self.speed_mps * time_s
        x, y = self.start[0] + way * np.cos(self.yaw), self.start[1] + way * np.sin(self.yaw)
        return np.array([x, y, self.size[2] / 2, *self.size, self.yaw])


@dataclass
class Log:
    """A SegmentReader over Things. Ego drives along its x axis; ``world_from_start`` places all of it."""

    things: list[Thing]
    num_sweeps: int = 8
    ego_speed_mps: float = 3.0
    world_from_start: np.ndarray = field(default_factory=lambda: np.eye(4))
    extra_points: np.ndarray = field(default_factory=lambda: np.zeros((0, 3)))  # world of the start, standing
    capture_offset_s: float = 0.0
    unreadable: tuple[int, ...] = ()
    unannotated: tuple[int, ...] = ()
    point_truth: dict[int, PointTruth] = field(default_factory=dict)
    segment_id: str = "log"
    dataset: str = "fake"
    uri: str = "fake:log"

    @property
    def timestamps_ns(self) -> np.ndarray:
        return 1_000_000_000 + STEP_NS * np.arange(self.num_sweeps)

    def pose(self, index: int) -> np.ndarray:
        start_from_ego = np.eye(4)
        start_from_ego[0, 3] = self.ego_speed_mps * index * 0.1
        return self.world_from_start @ start_from_ego

    def boxes_ego(self, index: int) -> np.ndarray:
        boxes = np.array([thing.box_world(index * 0.1) for thing in self.things]).reshape(-1, 7)
        return transform_boxes(np.linalg.inv(self.pose(index)) @ self.world_from_start, boxes)

    def read_sweep(self, index: int) -> Sweep:
        if index in self.unreadable:
            raise UnreadableSweep(f"sweep {index} is broken")
        clouds = [np.linalg.inv(self.pose(index)) @ self.world_from_start]
        points = [transform_points(clouds[0], self.extra_points)]
        for thing, box in zip(self.things, self.boxes_ego(index), strict=True):
            # Points high on the body, away from the ground rule.
            local = np.random.default_rng(1).uniform(-0.45, 0.45, (thing.num_points, 3)) * thing.size
            local[:, 2] = 0.4 * thing.size[2]
            turned = np.eye(4)
            turned[:2, :2] = [[np.cos(box[6]), -np.sin(box[6])], [np.sin(box[6]), np.cos(box[6])]]
            points.append(rotate_vectors(turned, local) + box[:3])
            ground = local.copy()
            ground[:, 2] = -thing.size[2] / 2 - 0.3  # road under the thing
            points.append(rotate_vectors(turned, ground) + box[:3])
        cloud = np.concatenate(points).astype(np.float32)
        return Sweep(
            index=index,
            timestamp_ns=int(self.timestamps_ns[index]),
            points_ego=cloud,
            capture_offset_s=np.full(len(cloud), self.capture_offset_s, dtype=np.float32),
            world_from_ego=self.pose(index),
            sensor_origins_ego=np.zeros((1, 3), dtype=np.float32),
            lidar_of_point=np.zeros(len(cloud), dtype=np.uint8),
        )

    def read_annotations(self, index: int) -> Annotations | None:
        if index in self.unannotated:
            return None
        names = tuple(thing.name for thing in self.things)
        return Annotations(names, ("thing",) * len(names), self.boxes_ego(index))

    def read_point_truth(self, index: int) -> PointTruth | None:
        return self.point_truth.get(index)


@dataclass
class Pair:
    """First and last sweep of a Log."""

    log: Log
    dataset: str = "fake"
    uri: str = "fake:pair"
    segment_id: str = "pair"

    @property
    def timestamps_ns(self) -> np.ndarray:
        return self.log.timestamps_ns[[0, -1]]

    def read_sweep(self, index: int) -> Sweep:
        return replace(self.log.read_sweep(index * (self.log.num_sweeps - 1)), index=index)

    def read_annotations(self, index: int) -> Annotations | None:
        return self.log.read_annotations(index * (self.log.num_sweeps - 1))

    def read_point_truth(self, index: int) -> PointTruth | None:
        return None


class AnnotatedPair(Pair):
    """A Pair that keeps the annotations of the sweeps it lost."""

    def read_annotations_between(self) -> Iterator[tuple[int, np.ndarray, Annotations]]:
        for index in range(1, self.log.num_sweeps - 1):
            yield int(self.log.timestamps_ns[index]), self.log.pose(index), self.log.read_annotations(index)


def pair_of(log: Log, has_annotations_between: bool = False) -> Pair:
    return AnnotatedPair(log) if has_annotations_between else Pair(log)


@dataclass(frozen=True)
class Recorded:
    """What the row builders need of a recorded log."""

    reader: SegmentReader
    world_from_ego: np.ndarray
    unreadable: tuple[int, ...] = ()

    @property
    def dataset(self) -> str:
        return self.reader.dataset

    @property
    def segment_id(self) -> str:
        return self.reader.segment_id

    @property
    def timestamps_ns(self) -> np.ndarray:
        return self.reader.timestamps_ns

    @property
    def num_sweeps(self) -> int:
        return len(self.reader.timestamps_ns)

    def pose(self, index: int) -> np.ndarray:
        return self.world_from_ego[index]


@dataclass
class Folder:
    """Label tables in memory."""

    tables: dict[tuple[str, str], pa.Table]
    recommended_min_score: float = 0.5

    @property
    def segment_ids(self) -> tuple[str, ...]:
        return tuple(sorted({segment for _, segment in self.tables}))

    def table(self, name: str, segment_id: str) -> pa.Table | None:
        return self.tables.get((name, segment_id))


def label_row(
    log: Log, index: int, track: str, box_ego: np.ndarray, score: float = 1.0, speed_mps: float = 0.0
) -> dict:
    """One row of the labels table for a box in the ego frame."""
    x, y, z, length, width, height, yaw = transform_boxes(log.pose(index), box_ego[None])[0]
    row = dict.fromkeys(SCHEMAS["labels"].names)
    return row | {
        "dataset": log.dataset,
        "segment_id": log.segment_id,
        "sweep_index": index,
        "timestamp_ns": int(log.timestamps_ns[index]),
        "track_id": track,
        "center_x_m": x,
        "center_y_m": y,
        "center_z_m": z,
        "length_m": length,
        "width_m": width,
        "height_m": height,
        "yaw_rad": yaw,
        "velocity_x_mps": speed_mps,
        "velocity_y_mps": 0.0,
        "velocity_z_mps": 0.0,
        "score": score,
        "num_points": 9,
        "box_source": "observed",
    }


def true_rows(log: Log, names: set[str] | None = None, score: float = 1.0) -> list[dict]:
    """Rows of a perfect labeling of the things that move (or of the named ones)."""
    return [
        label_row(log, index, f"track-{thing.name}", box, score, thing.speed_mps)
        for index in range(log.num_sweeps)
        for thing, box in zip(log.things, log.boxes_ego(index), strict=True)
        if (thing.speed_mps > 1 if names is None else thing.name in names)
    ]


def point_rows(log: Log, flow_world_m: Callable[[Thing], np.ndarray] | None = None) -> list[dict]:
    """Rows of the points table: all points of things that move, with their true or a given flow."""
    rows = []
    for index in range(log.num_sweeps):
        if index in log.unreadable:
            continue
        sweep = log.read_sweep(index)
        members = points_in_boxes(sweep.points_ego, log.boxes_ego(index))
        for thing, inside in zip(log.things, members, strict=True):
            heading = np.array([np.cos(thing.yaw), np.sin(thing.yaw), 0]) * thing.speed_mps * 0.1
            flow = rotate_vectors(log.world_from_start, heading) if flow_world_m is None else flow_world_m(thing)
            is_last = index + 1 >= log.num_sweeps or index + 1 in log.unreadable
            x, y, z = (None,) * 3 if is_last else flow
            if thing.speed_mps > 1:
                rows += [
                    {
                        "dataset": log.dataset,
                        "segment_id": log.segment_id,
                        "sweep_index": index,
                        "timestamp_ns": int(log.timestamps_ns[index]),
                        "point_index": int(point),
                        "flow_x_m": x,
                        "flow_y_m": y,
                        "flow_z_m": z,
                        "cluster_id": 0,
                        "track_id": None,
                    }
                    for point in inside
                ]
    return rows


def sweep_rows(log: Log | Recorded, labelled: range | None = None) -> list[dict]:
    return [
        {
            "dataset": log.dataset,
            "segment_id": log.segment_id,
            "sweep_index": index,
            "timestamp_ns": int(log.timestamps_ns[index]),
            "world_from_ego": log.pose(index).ravel().tolist(),
            "num_points": 0,
            "num_ground": 0,
            "num_static": 0,
            "num_clusters": 0,
            "num_failed_fits": 0,
            "status": "rejected" if index in log.unreadable else "ok",
            "reason": "broken" if index in log.unreadable else "",
        }
        for index in labelled or range(log.num_sweeps)
    ]


def make_folder(
    log: Log, labels: list[dict], points: list[dict] | None = None, labelled: range | None = None
) -> Folder:
    tables = {
        ("labels", log.segment_id): pa.Table.from_pylist(labels, SCHEMAS["labels"]),
        ("sweeps", log.segment_id): pa.Table.from_pylist(sweep_rows(log, labelled), SCHEMAS["sweeps"]),
    }
    if points is not None:
        tables["points", log.segment_id] = pa.Table.from_pylist(points, SCHEMAS["points"])
    return Folder(tables)


@dataclass(frozen=True)
class Kit:
    """The builders above, for tests that cannot import from each other."""

    thing = Thing
    log = Log
    recorded = Recorded
    pair_of = staticmethod(pair_of)
    folder = staticmethod(make_folder)
    label_row = staticmethod(label_row)
    true_rows = staticmethod(true_rows)
    point_rows = staticmethod(point_rows)
    replace = staticmethod(replace)


@pytest.fixture(scope="session")
def kit() -> type[Kit]:
    return Kit
