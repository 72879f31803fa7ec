"""What the tests of the stages share: memory, clouds and proposals made by hand."""

from pathlib import Path

import numpy as np
import pytest

from labeling.geometry.boxes import tight_box
from labeling.geometry.transforms import transform_points, yaw_translation
from schemas.objects import Proposal

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
        )

    return make
