"""Known answers of the flow stage on road users as a lidar sees them: from one side, anew each sweep, column by column.

The ground and the structures are taken away by the truth, so that these answers are the flow's own. Errors are in m/s:
a tenth of them is the displacement of a sweep.
"""

from dataclasses import dataclass, replace
from functools import cache
from itertools import pairwise

import numpy as np
import pytest

from labeling.geometry.transforms import invert, rotate_vectors, transform_points, yaw_translation
from labeling.stages.decomposition import decompose
from labeling.stages.flow import estimate_flow
from labeling.stages.targets import FlowTarget
from labeling.synthetic.rigs import SpinningLidar
from labeling.synthetic.scene import Scene, drive, wall
from labeling.synthetic.shapes import block, bus, car, cyclist, walker
from schemas.config import DecompositionParams, FlowParams, resolve_config
from schemas.lidars import Beams
from schemas.objects import Clusters

LIDAR = SpinningLidar(num_beams=64, azimuth_steps=1200)
NEIGHBORS = (1, 2, -1, -2)  # sweeps that the flow looks at, the wanted one first
RIGID, NETS = FlowParams(method="rigid"), FlowParams()
METHODS = pytest.mark.parametrize("params", [RIGID, NETS], ids=["rigid", "nsfp++"])


@dataclass(frozen=True, eq=False)
class Seen:
    """What the flow stage is given of one sweep, and the truth about its points."""

    points: np.ndarray  # (M, 3) ref frame, grouped by cluster
    beams: Beams  # (M,)
    clusters: Clusters
    targets: list[FlowTarget]
    mover: np.ndarray  # (M,) row of the scene's movers
    truth_mps: np.ndarray  # (M, 3)


@cache
def look(scene, hz=10.0, index=2, num_sweeps=5):
    reader = scene.reader(num_sweeps, hz, LIDAR)
    ref_from_world = invert(reader.world_from_ego(index))

    def read(k):
        sweep = reader.read_sweep(k)
        points = transform_points(ref_from_world @ sweep.world_from_ego, sweep.points_ego).astype(np.float32)
        stands = ~reader.read_point_truth(k).is_ground
        beams = Beams(reader.lidars, sweep.lidar_of_point).moved(ref_from_world @ sweep.world_from_ego)
        return points, stands & (reader.object_index(k) >= 0), stands, beams

    targets = []
    for k in NEIGHBORS:
        points, is_dynamic, stands, beams = read(index + k)
        targets.append(FlowTarget(k / hz, points[is_dynamic], points[stands], beams.of(is_dynamic), beams.of(stands)))
    points, is_dynamic, _, beams = read(index)
    clusters = decompose(points, beams, is_dynamic, DecompositionParams())
    rows = clusters.point_rows
    truth_mps = reader.read_point_truth(index).flow_ref_m[rows] * hz
    return Seen(points[rows], beams.of(rows), clusters, targets, reader.object_index(index)[rows], truth_mps)


def flow_mps(seen, params):
    flow = estimate_flow(seen.points, seen.beams, seen.clusters, seen.targets, params, np.random.default_rng)
    assert not flow.is_failed.any()
    return flow.flow_ref_m / flow.gap_s


def errors_mps(seen, params, mover=0):
    """Return the mean end-point error of a mover, and the error of its mean velocity."""
    of_it = seen.mover == mover
    error = (flow_mps(seen, params) - seen.truth_mps)[of_it]
    return np.linalg.norm(error, axis=1).mean(), np.linalg.norm(error.mean(axis=0))


EGO = drive(block(), speed_mps=15.0).path
STRAIGHT = {  # scene and bound, m/s
    "car ahead": (Scene(movers=(drive(car(), (12, -4), 0.0, 8.0),)), 0.15),
    "car crossing": (Scene(movers=(drive(car(), (14, -8), np.pi / 2, 10.0),)), 0.2),
    "slow car": (Scene(movers=(drive(car(), (12, 5), np.pi, 1.5),)), 0.05),  # its rows alone say .34 too little
    "cyclist": (Scene(movers=(drive(cyclist(), (10, 5), np.pi, 5.0),)), 0.2),
    "oncoming, 20 m/s": (Scene(movers=(drive(car(), (15, 3.5), np.pi, 20.0),)), 0.5),
    "oncoming, far": (Scene(movers=(drive(car(), (35, 3.5), np.pi, 20.0),)), 1.5),  # the vote is right to 0.04
    "oncoming, closing at 35 m/s": (Scene(movers=(drive(car(), (30, 3.5), np.pi, 20.0),), ego=EGO), 0.3),
}


@METHODS
@pytest.mark.parametrize("name", STRAIGHT)
def test_a_straight_way_is_found(name, params):
    scene, bound_mps = STRAIGHT[name]
    assert errors_mps(look(scene), params)[0] < bound_mps


@METHODS
@pytest.mark.parametrize("index", [2, 4, 7])
def test_a_walker_moves_at_walking_pace_whatever_the_legs_do(params, index):
    """Feet are still or twice as fast; three phases of the stride."""
    seen = look(Scene(movers=(drive(walker(), (8, -4), np.pi / 2, 1.4),)), index=index, num_sweeps=10)
    velocity = flow_mps(seen, params)
    np.testing.assert_allclose(np.median(velocity, axis=0), [0, 1.4, 0], atol=0.2)
    is_leg = seen.points[:, 2] < seen.points[:, 2].min() + 0.7
    assert is_leg.sum() > 20
    assert np.linalg.norm(velocity[is_leg] - [0, 1.4, 0], axis=1).max() < 2.0


@pytest.mark.parametrize(
    ("scene", "truth_mps", "bound_mps"),
    [
        (Scene(movers=(drive(walker(), (8, -4), np.pi / 2, 1.4),)), (0, 1.4, 0), 0.3),
        (Scene(movers=(drive(cyclist(), (10, 5), np.pi, 5.0),)), (-5, 0, 0), 0.6),
        (Scene(movers=(drive(car(), (12, -4), 0.0, 8.0),)), (8, 0, 0), 0.4),
        (Scene(movers=(drive(car(), (12, -4)),)), (0, 0, 0), 0.8),
    ],
    ids=["walker", "cyclist", "car", "parked car"],
)
def test_the_nets_of_profile_paper_find_it_from_nothing(scene, truth_mps, bound_mps):
    """No vote and no standstill test to help them; fewer iterations and points than the profile's."""
    params = resolve_config("paper", {"flow.iterations": 60, "flow.max_points": 128}).flow
    velocity = flow_mps(look(scene), params)
    assert np.linalg.norm(velocity - truth_mps, axis=1).mean() < bound_mps


@pytest.mark.parametrize(
    ("place", "yaw", "bound_mps"),
    [((12, -4), 0.0, 1.5), ((20, 5), 0.0, 1.2), ((8, -8), 1.2, 1.6), ((-10, 6), 0.0, 2.2)],
)
def test_a_turning_car_is_found_up_to_its_turn(place, yaw, bound_mps):
    """At 1 rad/s no translation comes nearer than 0.7 to 1 m/s on average. The nets leave most of that, and some slide
    along the long side: they seldom explain the points so much better that the vote gives way.
    """
    error_mps, of_mean_mps = errors_mps(look(Scene(movers=(drive(car(), place, yaw, 6.0, 1.0),))), NETS)
    assert error_mps < bound_mps
    assert of_mean_mps < 0.8 * bound_mps


@METHODS
@pytest.mark.parametrize("gap_m", [2.0, 0.8, 0.4])
def test_two_cars_passing_close_keep_their_own_flow(gap_m, params):
    """8 m/s each. The farther one is half hidden, and what comes out behind the nearer one looks like motion."""
    seen = look(Scene(movers=(drive(car(), (10, 3), 0.0, 8.0), drive(car(), (14, 4.85 + gap_m), np.pi, 8.0))))
    for mover in (0, 1):
        assert errors_mps(seen, params, mover)[0] < 1.0


@METHODS
@pytest.mark.parametrize(
    ("place", "other_place", "speed_mps", "other_mps"),
    [((10, 3), (13, 5.15), 15.0, 3.0), ((14, -5), (16, -7.25), 15.0, 3.0), ((12, 3), (12, 5.15), 8.0, 8.0)],
)
def test_two_cars_that_pass_in_one_cluster_keep_their_own_flow(place, other_place, speed_mps, other_mps, params):
    """0.3 to 0.4 m apart: one velocity for both is 16 m/s off for one of them."""
    movers = (drive(car(), place, 0.0, speed_mps), drive(car(), other_place, np.pi, other_mps))
    seen = look(Scene(movers=movers))
    of_both = [set(seen.clusters.cluster_of_point[seen.mover == k]) for k in (0, 1)]
    assert of_both[0] & of_both[1]
    assert errors_mps(seen, params, 0)[0] < 0.3
    assert errors_mps(seen, params, 1)[0] < 1.5


@pytest.mark.parametrize(
    ("x_m", "speed_mps", "bound_mps"),
    [
        (15, 3, 0.2),
        (15, 8, 0.2),
        (15, 15, 1.0),
        (-12, 3, 0.2),
        (-12, 8, 0.4),
        (-12, 15, 1.0),
        (6, 15, 1.2),
        (0, 15, 2.5),
        (6, 3, 1.0),
        (0, 3, 1.0),
        (0, 8, 1.0),
    ],
)
def test_a_bus_along_a_wall_does_not_stick_to_its_flat_side(x_m, speed_mps, bound_mps):
    """Twelve metres of side 3.2 m from the lidar's way, a wall 0.7 m behind it; right beside, both ends are far off."""
    scene = Scene(structures=(wall((-60, 6.5), (60, 6.5), 6.0),), movers=(drive(bus(), (x_m, 4.5), 0.0, speed_mps),))
    assert errors_mps(look(scene), NETS)[0] < bound_mps


@METHODS
def test_a_parked_row_stays_while_the_vehicle_drives_by(params):
    """Even if static removal left all of it. Splinters of two dozen points may jump; no car does."""
    parked = tuple(drive(car(), (x, -6.0)) for x in (-10, -4, 2, 8, 14, 20))
    seen = look(Scene(movers=parked, ego=drive(block(), speed_mps=8.0).path))
    speed_mps = np.linalg.norm(flow_mps(seen, params), axis=1)
    is_car = np.diff(seen.clusters.offsets)[seen.clusters.cluster_of_point] > 100
    assert is_car.mean() > 0.99
    np.testing.assert_array_equal(speed_mps[is_car], 0)


@METHODS
@pytest.mark.parametrize("hz", [5.0, 20.0])
def test_speeds_do_not_depend_on_the_turns_a_second(params, hz):
    scene = Scene(movers=(drive(car(), (12, -4), 0.0, 8.0),))
    assert errors_mps(look(scene, hz), params)[1] < 0.3


TRAFFIC = Scene(
    movers=(
        drive(car(), (12, -4), 0.2, 8.0),
        drive(walker(), (8, 5), np.pi / 2, 1.4),
        drive(car(), (-12, 4), 0.2, 6.0, 0.8),
        drive(car(), (20, 4)),
    )
)


ONE_SHRED = pytest.mark.xfail(strict=True, reason="one point of 2567 fits elsewhere once cells are turned: 8 m/s off")


@METHODS
@pytest.mark.parametrize(
    ("yaw", "shift_m", "atol_mps"),
    [
        (0.0, (32.0, -16.0, 2.0), 1e-3),
        (np.pi / 2, (0, 0, 0), 1e-3),
        # Bins of the vote and sides of the box query lie along x and y.
        pytest.param(0.4, (0, 0, 0), 0.6, marks=ONE_SHRED),
        pytest.param(2.5, (60, 40, 1), 0.6, marks=ONE_SHRED),
    ],
    ids=["shift", "quarter turn", "turn", "turn and shift"],
)
def test_moving_the_whole_scene_turns_the_flow_and_changes_nothing_else(yaw, shift_m, atol_mps, params):
    seen = look(TRAFFIC)
    there_from_here = yaw_translation(yaw, np.array(shift_m, dtype=np.float64))

    def move(points):
        return transform_points(there_from_here, points).astype(np.float32)

    targets = [
        replace(
            t,
            points_ref=move(t.points_ref),
            standing_points_ref=move(t.standing_points_ref),
            beams=t.beams.moved(there_from_here),
            standing_beams=t.standing_beams.moved(there_from_here),
        )
        for t in seen.targets
    ]
    beams = seen.beams.moved(there_from_here)
    moved = flow_mps(replace(seen, points=move(seen.points), targets=targets, beams=beams), params)
    np.testing.assert_allclose(moved, rotate_vectors(there_from_here, flow_mps(seen, params)), atol=atol_mps)


@METHODS
def test_a_cluster_gets_the_flow_it_would_get_alone(params):
    """One batch of all against a batch each. Shreds are led by what is beside them: that is switched off here."""
    seen, params = look(TRAFFIC), params.leave_out("pieces")
    together = flow_mps(seen, params)
    for c, (start, stop) in enumerate(pairwise(seen.clusters.offsets)):
        rows = np.arange(stop - start)
        alone = estimate_flow(
            seen.points[start:stop],
            seen.beams.of(slice(start, stop)),
            Clusters(rows, np.array([0, len(rows)])),
            seen.targets,
            params,
            lambda _, c=c: np.random.default_rng(c),
        )
        np.testing.assert_allclose(alone.flow_ref_m / alone.gap_s, together[start:stop], atol=0.05)
