from collections import Counter

import numpy as np
import pytest
import shapely
from scipy.spatial import cKDTree

from labeling.evidence.vehicle import points_when_seen
from labeling.geometry.boxes import bev_corners, points_in_box
from labeling.geometry.transforms import transform_points
from labeling.readers import reader as readers
from labeling.readers.reader import make_segment_id
from labeling.synthetic.street import build_street
from schemas.errors import InvalidInput


def open_segment(uri):
    return readers.open_segment("synthetic", uri)


SMALL = "beams=32&azimuth_steps=600"


@pytest.fixture(scope="module")
def street():
    return open_segment(f"synthetic:street?sweeps=4&seed=1&{SMALL}")


@pytest.fixture(scope="module")
def scenes():
    return [build_street(seed, 20.0) for seed in range(4)]


def _all_boxes(reader, time_s):
    return np.array([reader.box_at(i, time_s) for i in range(len(reader.scene.movers))])


def test_opens_by_name():
    reader = readers.open_segment("synthetic", "synthetic:street")

    assert isinstance(reader, readers.SegmentReader)
    assert reader.dataset == "synthetic"
    assert reader.uri == "synthetic:street"
    assert len(reader.timestamps_ns) == 20
    assert set(np.diff(reader.timestamps_ns)) == {100_000_000}


def test_uri_is_normal_and_names_the_segment():
    messy = open_segment("synthetic:street?sweeps=3&movers=false&seed=7&beams=32&hz=10&noise_m=0.02")
    other = open_segment("synthetic:street?sweeps=4&movers=true&seed=7&beams=32")

    assert messy.uri == "synthetic:street?beams=32&movers=0&seed=7&sweeps=3"
    assert other.uri == "synthetic:street?beams=32&seed=7&sweeps=4"
    assert messy.segment_id == make_segment_id("street-s7", messy.uri)
    assert other.segment_id != messy.segment_id


@pytest.mark.parametrize(
    ("uri", "message"),
    [
        ("street?seed=1", "called like synthetic:street"),
        ("synthetic:motorway", "unknown world 'motorway': expected one of street"),
        ("synthetic:street?swps=3", "unknown option 'swps': expected sweeps, seed, beams"),
        ("synthetic:street?sweeps=0", "option sweeps='0'"),
        ("synthetic:street?sweeps=2001", "option sweeps='2001'"),
        ("synthetic:street?seed=-1", "option seed='-1'"),
        ("synthetic:street?seed=one", "option seed='one'"),
        ("synthetic:street?hz=nan", "option hz='nan'"),
        ("synthetic:street?beams=7", "option beams='7'"),
        ("synthetic:street?movers=some", "option movers='some'"),
        ("synthetic:street?dropout=", "option dropout=''"),
        ("synthetic:street?body=boat", "option body='boat'"),
        ("synthetic:street?sweeps", "name=value"),
        ("synthetic:street?seed=1&seed=2", "given twice"),
    ],
)
def test_wrong_options_fail_in_one_line(uri, message):
    with pytest.raises(InvalidInput, match=r"^[^\n]+$") as caught:
        open_segment(uri)

    assert message in str(caught.value)
    assert uri in str(caught.value)


@pytest.mark.parametrize(
    ("body", "low_m", "high_m"),
    [
        ("bonnet", (2.3, -0.85, 0.7), (3.7, 0.85, 0.95)),
        ("cab", (5.0, -1.1, 0.0), (5.6, 1.1, 1.2)),
        ("roof", (-0.6, -0.75, 1.25), (2.3, 0.75, 1.56)),
    ],
)
def test_the_vehicle_rides_along_hides_what_is_behind_it_and_stands_in_truth(street, body, low_m, high_m):
    reader = open_segment(f"{street.uri}&body={body}")
    before, sweep, truth = reader.read_sweep(1), reader.read_sweep(2), reader.read_point_truth(2)
    when_seen = points_when_seen(sweep, before)
    is_own = ((when_seen > np.subtract(low_m, 0.1)) & (when_seen < np.add(high_m, 0.1))).all(axis=1)

    assert is_own.sum() > 100
    assert (reader.object_index(2)[is_own] == -1).all()
    assert not truth.is_ground[is_own].any()
    assert (truth.flow_ref_m[is_own] == 0).all()
    num_hidden = street.read_point_truth(2).is_ground.sum() - truth.is_ground.sum()
    assert num_hidden > 0.5 * is_own.sum()


def test_reading_one_sweep_alone_gives_the_same_bytes(street):
    alone = open_segment(street.uri).read_sweep(3)
    in_order = [street.read_sweep(i) for i in range(4)][3]

    assert alone.points_ego.tobytes() == in_order.points_ego.tobytes()
    assert alone.capture_offset_s.tobytes() == in_order.capture_offset_s.tobytes()
    assert alone.world_from_ego.tobytes() == in_order.world_from_ego.tobytes()


def test_longer_segment_begins_the_same(street):
    longer = open_segment(f"synthetic:street?sweeps=100&seed=1&{SMALL}")

    assert longer.read_sweep(2).points_ego.tobytes() == street.read_sweep(2).points_ego.tobytes()


def test_seeds_differ(scenes):
    assert len({scene.ground for scene in scenes}) == 4
    assert len({scene.ego.states.tobytes() for scene in scenes}) == 4


def test_full_sweep_is_as_dense_as_a_real_one():
    sweep = open_segment("synthetic:street?sweeps=1").read_sweep(0)

    assert 80_000 < sweep.num_points < 115_200
    assert sweep.capture_offset_s.min() >= 0
    assert sweep.capture_offset_s.max() < 0.1


@pytest.mark.parametrize("seed", range(4))
def test_nobody_drives_through_anybody(scenes, seed):
    reader = scenes[seed].reader(200)
    for time_s in np.arange(0, 20, 0.5):
        boxes = _all_boxes(reader, time_s)
        ego = reader.scene.ego.at(np.array([time_s]))[0]
        ego_box = np.array([[ego[0], ego[1], 0, 4.9, 2.0, 1.7, ego[2]]])
        near = np.vstack([ego_box, boxes[np.hypot(*(boxes[:, :2] - ego[:2]).T) < 100]])
        outlines = shapely.polygons(bev_corners(near))
        first, second = shapely.STRtree(outlines).query(outlines, predicate="intersects")
        assert (first == second).all(), f"touching at {time_s} s"
    kinds = Counter(mover.shape.kind for mover in reader.scene.movers if not mover.path.is_still)
    assert min(kinds["car"], kinds["cyclist"], kinds["walker"]) >= 5
    assert kinds["truck"] + kinds["bus"] >= 1


@pytest.mark.parametrize("seed", range(4))
def test_traffic_is_various(scenes, seed):
    scene = scenes[seed]
    times = np.arange(0, 2, 0.1)
    ego = scene.ego.at(times)
    near = [
        (mover, mover.path.at(times))
        for mover in scene.movers
        if not mover.path.is_still and np.hypot(*(mover.path.states[0, :2] - ego[0, :2])) < 60
    ]
    speed = {id(mover): np.diff(states[:, 3]).mean() / 0.1 for mover, states in near}
    cars = [(mover, states) for mover, states in near if mover.shape.kind == "car"]

    assert any(1.4 < speed[id(mover)] < 2.6 for mover, _ in cars)  # looks for a place to park
    assert any(5 < speed[id(mover)] < 20 and np.cos(states[0, 2]) < -0.9 for mover, states in cars)  # oncoming
    assert any(np.ptp(states[:, 2]) > 0.3 for _, states in cars)  # turns off
    assert {"car", "walker", "cyclist"} <= {mover.shape.kind for mover, _ in near}
    assert 3 < np.diff(ego[:, 3]).mean() / 0.1 < 12


def test_a_vehicle_stops_and_goes_on(scenes):
    stops = 0
    for scene in scenes:
        for mover in scene.movers:
            if not mover.path.is_still and mover.shape.kind in ("car", "bus", "truck"):
                speed = np.diff(mover.path.at(np.arange(0, 20, 0.1))[:, 3]) / 0.1
                standing = np.flatnonzero(speed < 0.1)
                stops += len(standing) > 10 and speed[: standing[0]].max() > 4 and speed[standing[-1] :].max() > 4
    assert stops >= 2


def test_points_lie_in_their_boxes_and_flow_with_them(street):
    for index in range(3):
        sweep, truth, found = street.read_sweep(index), street.read_point_truth(index), street.read_annotations(index)
        owner = street.object_index(index)
        gap_s = 0.1
        for track_id, box in zip(found.track_ids, found.boxes_ego, strict=True):
            i = int(track_id.split("-")[1])
            rows, mover = owner == i, street.scene.movers[i]
            if rows.sum() < 5:
                continue
            moved_m = np.ptp(sweep.capture_offset_s[rows]) * 17  # it drives on while it is scanned
            slack = 0.15 + 0.03 * box[3] / 2 + moved_m + (0.3 if mover.shape.kind == "walker" else 0)
            assert points_in_box(sweep.points_ego[rows], box, slack).all(), track_id
            flow = np.linalg.norm(truth.flow_ref_m[rows], axis=1)
            if mover.path.is_still:
                assert not flow.any()
            else:
                now = index * gap_s
                speed = np.diff(mover.path.at(np.array([now, now + 2 * gap_s]))[:, 3])[0] / (2 * gap_s)
                assert flow.mean() / gap_s == pytest.approx(speed, abs=0.35 + 0.05 * speed)
        assert not truth.flow_ref_m[owner < 0].any()
    assert np.isnan(street.read_point_truth(3).flow_ref_m).all()


def test_annotations_keep_their_track_ids(street):
    first, second = street.read_annotations(0), street.read_annotations(1)
    shared = set(first.track_ids) & set(second.track_ids)

    assert len(shared) > 30
    assert {"REGULAR_VEHICLE", "PEDESTRIAN", "BICYCLIST"} <= set(first.categories)
    for name in shared:
        a, b = (found.boxes_ego[found.track_ids.index(name)] for found in (first, second))
        np.testing.assert_allclose(a[3:6], b[3:6])
        assert np.hypot(*(a - b)[:2]) < 4


def test_ground_truth_follows_the_slope(street):
    world = transform_points(street.world_from_ego(0), street.read_sweep(0).points_ego)
    is_ground = street.read_point_truth(0).is_ground
    height = world[:, 2] - street.scene.ground.base(world[:, 0], world[:, 1])

    assert is_ground.mean() > 0.2
    assert height[is_ground].min() > -0.2
    assert height[is_ground].max() < 0.12 + 0.1  # pavement and noise
    assert np.ptp(world[is_ground, 2]) > 0.5


def test_no_movers_leaves_a_still_world():
    reader = open_segment(f"synthetic:street?sweeps=3&movers=0&seed=1&{SMALL}")
    truth = reader.read_point_truth(0)
    clouds = [
        transform_points(
            reader.world_from_ego(i), reader.read_sweep(i).points_ego[~reader.read_point_truth(i).is_ground]
        )
        for i in (0, 2)
    ]
    near = clouds[0][np.linalg.norm(clouds[0] - clouds[0].mean(axis=0), axis=1) < 20]

    assert not truth.flow_ref_m.any()
    assert len(reader.read_annotations(0).track_ids) > 10  # parked
    assert np.median(cKDTree(clouds[1]).query(near)[0]) < 0.25  # the spacing of 32 beams


@pytest.mark.parametrize("count", [1, 6])
def test_movers_can_be_counted(scenes, count):
    moving = [mover for mover in build_street(3, 2.0, count).movers if not mover.path.is_still]

    assert len(moving) == count
    for mover, first in zip(moving, scenes[3].movers, strict=False):
        np.testing.assert_array_equal(mover.path.states, first.path.states)
    assert len({mover.shape.kind for mover in moving}) >= min(count, 3)
