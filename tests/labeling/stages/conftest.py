"""What the tests of the stages share: memory, clouds and proposals made by hand or seen by the synthetic lidar."""

from pathlib import Path

import numpy as np
import pytest

from labeling.geometry.boxes import tight_box
from labeling.geometry.transforms import invert, transform_points, yaw_translation
from labeling.stages.proposals import make_proposal
from schemas.lidars import Beams
from schemas.objects import AlignedTrack, Clusters, DynamicPoints, Proposal, Track

START_NS = 1_700_000_000_000_000_000
SIDES = {"front": (0, 0.5), "back": (0, -0.5), "left": (1, 0.5), "right": (1, -0.5), "top": (2, 0.5)}


@pytest.fixture
def peak_growth_mb():
    """Return a function that runs something and returns by how many MB the process grew at its peak."""

    def measure(run):
        try:
            Path("/proc/self/clear_refs").write_text("5")  # the peak counts from here
        except OSError:
            pytest.skip("the peak memory of this process cannot be reset")
        before = _status_mb("VmRSS")
        run()
        return _status_mb("VmHWM") - before

    return measure


def _status_mb(name):
    (line,) = (line for line in Path("/proc/self/status").read_text().splitlines() if line.startswith(name))
    return int(line.split()[1]) / 1024


@pytest.fixture
def block_cloud():
    """Return a maker of points on the sides and the top of a block standing on z = 0, in its own frame."""

    def make(size_m=(4.0, 2.0, 1.5), num_points=400, seed=0, sides=tuple(SIDES)):
        rng = np.random.default_rng(seed)
        points = rng.uniform(-0.5, 0.5, (num_points, 3))
        for k in range(num_points):
            axis, value = SIDES[sides[k % len(sides)]]
            points[k, axis] = value
        return (points * size_m + np.array([0, 0, size_m[2] / 2])).astype(np.float32)

    return make


@pytest.fixture
def proposal_at():
    """Return a maker of the proposal of ``cloud`` (own frame) at a place on the ground, at 10 sweeps a second."""

    def make(cloud, sweep_index, place_m, yaw=0.0, velocity_mps=None, *, first_row=0, heading=None, ground_z_m=0.0):
        place = np.append(np.asarray(place_m, dtype=np.float64), ground_z_m)
        points = transform_points(yaw_translation(yaw, place), cloud)
        heading = yaw if heading is None else heading
        speed = np.zeros(3) if velocity_mps is None else np.append(velocity_mps, 0.0)
        return Proposal(
            sweep_index=sweep_index,
            timestamp_ns=START_NS + sweep_index * 100_000_000,
            box_visible=tight_box(points, heading),
            velocity_mps=speed,
            points_world=points,
            point_rows=np.arange(first_row, first_row + len(points), dtype=np.int32),
            ground_z_m=ground_z_m,
            sensor_origin_world=np.array([0.0, 0.0, 1.8]),
            num_vacated=len(points),
            range_noise_m=0.02,
        )

    return make


@pytest.fixture
def aligned_at(proposal_at):
    """Return a maker of an aligned track: clouds (own frame) at places that registration took ``slides_m`` off."""

    def make(clouds, places_m, yaw=0.0, slides_m=None, velocity_mps=None):
        sweeps = enumerate(zip(clouds, places_m, strict=True))
        proposals = tuple(proposal_at(cloud, k, place, yaw, velocity_mps) for k, (cloud, place) in sweeps)
        slides_m = np.zeros((len(clouds), 2)) if slides_m is None else slides_m
        believed_m = np.column_stack([np.add(places_m, slides_m), np.zeros(len(clouds))])
        model_from_world = np.stack([invert(yaw_translation(0.0, place)) for place in believed_m])
        views = [transform_points(t, p.points_world) for t, p in zip(model_from_world, proposals, strict=True)]
        return AlignedTrack(
            track=Track("track", proposals),
            model_from_world=model_from_world,
            model_points=np.concatenate(views).astype(np.float32),
            model_view=np.repeat(np.arange(len(views), dtype=np.int32), [len(view) for view in views]),
            model_yaw=yaw,
            target_view=0,
            error_m=np.full(len(views), 0.05),
        )

    return make


@pytest.fixture(scope="session")
def seen_proposal():
    """Return a maker of the proposal of what the lidar of a scene saw of a mover; None when it saw hardly anything.

    It moves as it truly does. Several movers are parts of one object; ``pose`` moves the world. The last sweep of a
    scene has no truth flow.
    """

    def make(reader, index, movers=(0,), pose=None):
        sweep, ground = reader.read_sweep(index), reader.scene.ground
        world = transform_points(sweep.world_from_ego, sweep.points_ego)
        height_m = (world[:, 2] - ground.height(world[:, 0], world[:, 1])).astype(np.float32)
        rows = np.flatnonzero(np.isin(reader.object_index(index), movers) & (height_m > 0.25))
        if len(rows) < 5:
            return None
        dynamic = DynamicPoints(
            index,
            sweep.timestamp_ns,
            sweep.world_from_ego if pose is None else pose @ sweep.world_from_ego,
            Clusters(rows, np.array([0, len(rows)])),
            sweep.points_ego[rows],
            Beams(reader.lidars, sweep.lidar_of_point[rows]),
            sweep.capture_offset_s[rows],
            height_m[rows],
            np.ones(len(rows), dtype=bool),
        )
        gap_s = (reader.timestamps_ns[index + 1] - reader.timestamps_ns[index]) * 1e-9
        velocity = reader.read_point_truth(index).flow_ref_m[rows].mean(axis=0) / gap_s
        return make_proposal(dynamic, np.arange(len(rows)), velocity, is_deskewed=True)

    return make
