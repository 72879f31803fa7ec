from dataclasses import dataclass, field

import numpy as np
import pyarrow as pa
import pytest
from matplotlib.image import imread

from labeling.geometry.transforms import rotate_vectors, transform_points, yaw_of, yaw_translation
from labeling.pictures import GAP_PX, HEIGHT_PX, MAP_PX, REACH_X_M, REACH_Y_M, WIDTH_PX, render_sweep
from schemas.errors import InvalidInput
from schemas.frames import Sweep
from schemas.tables import SCHEMAS

KEY = {"dataset": "synthetic", "segment_id": "street"}
STEP_NS = 100_000_000
NOTHING = SCHEMAS["labels"].empty_table()


@dataclass
class Folder:
    labels: pa.Table | None
    points: pa.Table | None = None
    recommended_min_score: float = 0.5
    sweeps: tuple[int, ...] = (0, 1, 2)
    num_points: int = 80 * 50 + 21 * 21 * 3  # of each sweep: the road and the block

    def table(self, name, segment_id):
        assert segment_id == "street"
        row = KEY | {"world_from_ego": np.eye(4).ravel(), "num_points": self.num_points, "status": "ok", "reason": ""}
        row |= dict.fromkeys(("num_ground", "num_static", "num_clusters", "num_failed_fits"), 0)
        rows = [row | {"sweep_index": index, "timestamp_ns": index * STEP_NS} for index in self.sweeps]
        sweeps = pa.Table.from_pylist(rows, SCHEMAS["sweeps"])
        return {"labels": self.labels, "points": self.points, "sweeps": sweeps}[name]


@dataclass
class Reader:
    """A flat road, and a block of points at ``block_ego`` in every sweep."""

    world_from_ego: np.ndarray = field(default_factory=lambda: np.eye(4))
    block_ego: tuple[float, float] = (20.0, 10.0)
    dataset = "synthetic"
    uri = "synthetic:street"
    segment_id = "street"
    timestamps_ns = np.arange(3, dtype=np.int64) * STEP_NS

    @property
    def points(self):
        grid = np.mgrid[-40:40:1.0, -25:25:1.0].reshape(2, -1).T
        block = np.mgrid[-1.0:1.01:0.1, -1.0:1.01:0.1, 0.6:1.5:0.4].reshape(3, -1).T
        road = np.column_stack([grid, np.zeros(len(grid))])
        return np.concatenate([road, block + np.array([*self.block_ego, 0.0])]).astype(np.float32), len(road)

    def read_sweep(self, index):
        points, _ = self.points
        origin = np.array([[0, 0, 1.8]], dtype=np.float32)
        offsets = np.zeros(len(points), dtype=np.float32)
        lidar = np.zeros(len(points), dtype=np.uint8)
        return Sweep(index, int(self.timestamps_ns[index]), points, offsets, self.world_from_ego, origin, lidar)


def labels_of(world_from_ego=None, sweeps=(1,), velocity=(9.0, 0.0, 0.0), score=0.9, source="observed"):
    """One track whose box stands around the block."""
    pose = np.eye(4) if world_from_ego is None else world_from_ego
    x, y, z = transform_points(pose, np.array([[20.0, 10.0, 0.9]]))[0]
    velocity = rotate_vectors(pose, np.array(velocity))
    box = {"center_x_m": x, "center_y_m": y, "center_z_m": z, "length_m": 4.0, "width_m": 2.4, "height_m": 1.8}
    box |= {"yaw_rad": yaw_of(pose)}
    row = KEY | box | {"track_id": "abcd-1", "score": score, "num_points": 99, "box_source": source}
    row |= {f"velocity_{axis}_mps": v for axis, v in zip("xyz", velocity, strict=True)}
    row |= {f"visible_{name}": value for name, value in box.items()} if source == "observed" else {}
    rows = [row | {"sweep_index": k, "timestamp_ns": k * STEP_NS} for k in sweeps]
    return pa.Table.from_pylist(rows, schema=SCHEMAS["labels"])


def points_of(reader, flow_ego_m, sweep=1):
    points, first = reader.points
    flow = dict(zip("xyz", rotate_vectors(reader.world_from_ego, np.array(flow_ego_m)), strict=True))
    row = KEY | {"sweep_index": sweep, "timestamp_ns": sweep * STEP_NS, "cluster_id": 0, "track_id": "abcd-1"}
    row |= {f"flow_{axis}_m": v for axis, v in flow.items()}
    return pa.Table.from_pylist([row | {"point_index": i} for i in range(first, len(points))], schema=SCHEMAS["points"])


def picture(tmp_path, reader, folder, sweep=1):
    path = tmp_path / "pictures" / "sweep.png"
    render_sweep(reader, folder, sweep, path)
    return imread(path)[..., :3]


def pixel(x_ego, y_ego):
    """Row and column of a place on the map; row 0 is the top."""
    column = MAP_PX[0] + (x_ego / REACH_X_M + 1) / 2 * MAP_PX[2]
    return round(HEIGHT_PX - MAP_PX[1] - (y_ego / REACH_Y_M + 1) / 2 * MAP_PX[3]), round(column)


def patch(image, x_ego, y_ego, half_px=3):
    row, column = pixel(x_ego, y_ego)
    return image[row - half_px : row + half_px + 1, column - half_px : column + half_px + 1]


def most_colored(image):
    flat = image.reshape(-1, 3)
    return flat[np.ptp(flat, axis=1).argmax()]


def on_map(image):
    return image[HEIGHT_PX - MAP_PX[1] - MAP_PX[3] : HEIGHT_PX - MAP_PX[1], GAP_PX:-GAP_PX]


def test_picture_has_the_promised_size_and_makes_its_folder(tmp_path):
    assert picture(tmp_path, Reader(), Folder(labels_of())).shape == (HEIGHT_PX, WIDTH_PX, 3)


def test_box_changes_the_map_only_around_its_object(tmp_path):
    with_box = on_map(picture(tmp_path, Reader(), Folder(labels_of())))
    without = on_map(picture(tmp_path, Reader(), Folder(labels_of(sweeps=(0,)))))
    rows, columns = np.nonzero(np.abs(with_box - without).max(axis=2) > 0.02)
    is_legend = columns > 0.9 * MAP_PX[2]  # the wheel's scale follows the fastest box
    x = (columns[~is_legend] / MAP_PX[2] * 2 - 1) * REACH_X_M
    y = (1 - rows[~is_legend] / MAP_PX[3] * 2) * REACH_Y_M
    assert x.min() == pytest.approx(17, abs=1.6)  # the id is wider than the box
    assert x.max() == pytest.approx(23, abs=1.6)
    assert y.min() == pytest.approx(8.8, abs=0.2)
    assert 11.2 < y.max() < 13.5


@pytest.mark.parametrize(
    ("flow_ego_m", "is_of_hue"),
    [
        pytest.param((1.0, 0, 0), lambda r, g, b: r > 1.5 * g and r > 1.5 * b, id="ahead-is-red"),
        pytest.param((-1.0, 0, 0), lambda r, g, b: g > 1.5 * r and b > 1.5 * r, id="back-is-cyan"),
        pytest.param((0, 1.0, 0), lambda r, g, b: g > r > 1.5 * b, id="left-is-yellow-green"),
        pytest.param((0, -1.0, 0), lambda r, g, b: b > r > 1.5 * g, id="right-is-violet"),
    ],
)
def test_hue_of_the_points_is_the_direction_of_their_flow(tmp_path, flow_ego_m, is_of_hue):
    reader = Reader(world_from_ego=yaw_translation(2.0, np.array([100.0, -50.0, 3.0])))
    folder = Folder(labels_of(reader.world_from_ego, sweeps=(0,)), points_of(reader, flow_ego_m))
    assert is_of_hue(*most_colored(patch(picture(tmp_path, reader, folder), 20, 10)))


def test_faster_points_are_brighter(tmp_path):
    slow, fast = (
        picture(tmp_path, Reader(), Folder(labels_of(sweeps=(0,)), points_of(Reader(), (flow, 0, 0))))
        for flow in (0.1, 0.5)
    )
    assert patch(fast, 20, 10).max() > patch(slow, 20, 10).max() + 0.2


def test_points_without_flow_are_grey(tmp_path):
    reader, hidden = Reader(), labels_of(sweeps=(0,))
    no_table = patch(picture(tmp_path, reader, Folder(hidden)), 20, 10)
    last_sweep = patch(picture(tmp_path, reader, Folder(hidden, points_of(reader, (None,) * 3, 2)), sweep=2), 20, 10)
    assert np.ptp(no_table, axis=2).max() < 0.12
    assert np.ptp(last_sweep, axis=2).max() < 0.12
    assert last_sweep.max() > no_table.max() > 0.4  # called dynamic by the run, though nobody knows where to


def test_moving_the_world_does_not_change_the_picture(tmp_path):
    pose = yaw_translation(-2.3, np.array([4.0e3, -7.0e3, 120.0]))
    here, there = (
        picture(tmp_path, reader, Folder(labels_of(reader.world_from_ego, (0, 1)), points_of(reader, (1.0, 0, 0))))
        for reader in (Reader(), Reader(world_from_ego=pose))
    )
    assert (np.abs(here - there).max(axis=2) > 0.1).mean() < 1e-4  # rounding may move a line's edge


def test_uncertain_and_interpolated_boxes_are_drawn_with_less_ink(tmp_path):
    def ink(**kwargs):
        image = picture(tmp_path, Reader(block_ego=(-30, -15)), Folder(labels_of(**kwargs)))
        return patch(image, 20, 9, 24)[..., 0].sum()  # the box without its text, which stands above it

    sure, uncertain, interpolated = ink(score=0.9), ink(score=0.2), ink(source="interpolated")
    assert uncertain < 0.9 * sure
    assert interpolated < 0.97 * sure


def test_tail_shows_where_the_track_came_from(tmp_path):
    labels = labels_of(sweeps=(0, 1))
    moved = labels.set_column(
        labels.schema.get_field_index("center_x_m"), labels.schema.field("center_x_m"), pa.array([10.0, 20.0])
    )
    came, whole = (picture(tmp_path, Reader(), Folder(table)) for table in (labels_of(), moved))
    added = (whole - came)[..., 0]  # the track flows ahead: its tail is red
    assert patch(added, 15, 10).max() > 0.3
    assert np.abs(patch(added, 25, 10)).max() == 0


def test_a_street_where_nothing_moves_is_a_normal_picture(tmp_path):
    assert picture(tmp_path, Reader(), Folder(NOTHING, SCHEMAS["points"].empty_table())).shape[0] == HEIGHT_PX


@pytest.mark.parametrize("sweep", [-1, 3])
def test_unknown_sweep_is_refused(tmp_path, sweep):
    with pytest.raises(InvalidInput, match="has sweeps 0 to 2"):
        render_sweep(Reader(), Folder(labels_of()), sweep, tmp_path / "a.png")


def test_segment_without_labels_is_refused(tmp_path):
    with pytest.raises(InvalidInput, match="nothing of segment street"):
        render_sweep(Reader(), Folder(None), 0, tmp_path / "a.png")


@pytest.mark.parametrize(
    ("folder", "told"),
    [
        pytest.param(Folder(NOTHING, sweeps=(0, 2)), "was not labelled", id="outside-the-range"),
        pytest.param(Folder(NOTHING, num_points=7), "made from 7", id="another-recording"),
    ],
)
def test_sweep_that_the_labels_do_not_speak_of_is_refused(tmp_path, folder, told):
    with pytest.raises(InvalidInput, match=told):
        render_sweep(Reader(), folder, 1, tmp_path / "a.png")


def test_unwritable_place_is_named(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(InvalidInput, match=r"cannot write the picture .*a\.png"):
        render_sweep(Reader(), Folder(labels_of()), 0, tmp_path / "file" / "a.png")
