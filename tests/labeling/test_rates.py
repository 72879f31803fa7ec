"""One world, seen more or less often: whatever the rate of the sweeps, the same objects at the same speeds."""

import numpy as np
import pytest

from labeling.evaluation.box_ablation import rounded_rows
from labeling.evaluation.boxes import match, sweep_overlaps
from labeling.evaluation.evidence import gather_evidence
from labeling.evaluation.truth import read_truth
from labeling.line import label_tracks, make_clock, observe_sweeps
from labeling.synthetic.rigs import SpinningLidar
from labeling.synthetic.scene import Scene, drive, wall
from labeling.synthetic.shapes import block, car, cyclist, walker
from schemas.config import resolve_config

DURATION_S = 4.0
CONFIG = resolve_config("fast", {"static.vote_gaps_s": (0.5, 1.0)})
MOVERS = (
    drive(car(), (-12, 3.5), 0.0, 9.0),
    drive(car(), (42, 7), np.pi, 11.0),
    drive(cyclist(), (16, -4.5), 0.0, 5.0),
    drive(walker(), (10, -9), 0.0, 1.4),
    drive(car(), (18, 3.5), 0.0, ((0.0, 9.0), (2.0, 5.0), (4.0, 5.0))),  # brakes by 2 m/s2
)
PARKED = (drive(car(), (8, 10.5)), drive(car(), (20, -11.5)))


def label(rate_hz):
    """Label the world as it is seen so often; return the observations, the evidence, its right labels, and names."""
    scene = Scene(
        structures=(wall((-40, 14), (60, 14)), wall((-40, -14), (60, -14))),
        movers=MOVERS + PARKED,
        ego=drive(block(), speed_mps=6.0).path,
    )
    reader = scene.reader(round(DURATION_S * rate_hz), rate_hz, SpinningLidar(num_beams=32, azimuth_steps=600))
    observations = list(observe_sweeps(reader, CONFIG))
    clock = make_clock(observations)
    tracks = label_tracks([o.proposals for o in observations], clock, CONFIG, reader.segment_id)
    truth = read_truth(reader)
    poses = {int(index): truth.world_from_ego[index] for index in clock.sweep_index}
    evidence = gather_evidence(truth, rounded_rows(tracks), poses, None)
    return reader, observations, evidence, match(evidence, sweep_overlaps(evidence, evidence.label_boxes), "L1")


@pytest.mark.parametrize("rate_hz", [2.0, 5.0, 10.0, 20.0])
def test_any_rate_shows_the_same_objects_at_the_same_speeds(rate_hz):
    reader, observations, evidence, matching = label(rate_hz)
    rows = np.flatnonzero(matching.is_right)
    object_of_row = evidence.truth_object[matching.truth_of_label[rows]]
    off_mps = np.abs(evidence.label_speed_mps[rows] - evidence.truth_speed_mps[matching.truth_of_label[rows]])
    to_find = np.bincount(evidence.truth_object[matching.is_to_find], minlength=len(MOVERS))
    found = np.bincount(object_of_row, minlength=len(MOVERS))
    assert (found[: len(MOVERS)] >= 0.6 * to_find[: len(MOVERS)]).all(), (found, to_find)
    assert found.sum() >= 0.8 * to_find.sum()
    for number in range(len(MOVERS)):
        assert np.median(off_mps[object_of_row == number]) < 0.3
    assert matching.is_wrong.sum() <= 0.1 * len(matching.is_wrong)
    _check_displacements(reader, observations)


def _check_displacements(reader, observations):
    """The points table has displacements to the next sweep, however far flow looks."""
    index = len(observations) // 2
    points = observations[index].points
    truth_m = reader.read_point_truth(index).flow_ref_m[points.point_index]
    is_moving = np.linalg.norm(truth_m, axis=1) > 0
    off_m = np.linalg.norm(points.flow_world_m[is_moving], axis=1) - np.linalg.norm(truth_m[is_moving], axis=1)
    gap_s = (reader.timestamps_ns[index + 1] - reader.timestamps_ns[index]) * 1e-9
    assert is_moving.sum() > 100
    assert np.median(np.abs(off_m)) < 0.5 * gap_s
    assert observations[-1].points.flow_world_m is None
