import numpy as np
import pytest

from labeling.evaluation.boxes import match, sweep_overlaps
from labeling.evaluation.evidence import BoxEvidence
from labeling.evaluation.tracks import HOTA_IOUS, hota_sums, track_figures


def cars_at(x_m):
    return np.column_stack([x_m, *np.tile([[0], [0], [4], [2], [1.6], [0]], len(x_m))])


def make_evidence(labels, truths, num_sweeps):
    """Labels and truths: (sweep, id, x). Boxes of 4 x 2 x 1.6 m on a line, all to find, all of score 1."""
    label_rows, truth_rows = (np.array(sorted(rows), dtype=float).reshape(-1, 3) for rows in (labels, truths))
    return BoxEvidence(
        num_sweeps=num_sweeps,
        label_sweep=label_rows[:, 0].astype(np.int64),
        label_track=label_rows[:, 1].astype(np.int64),
        label_boxes=cars_at(label_rows[:, 2]),
        label_score=np.ones(len(label_rows)),
        label_speed_mps=np.zeros(len(label_rows)),
        truth_sweep=truth_rows[:, 0].astype(np.int64),
        truth_object=truth_rows[:, 1].astype(np.int64),
        truth_boxes=cars_at(truth_rows[:, 2]),
        truth_speed_mps=np.zeros(len(truth_rows)),
        truth_num_points=np.full(len(truth_rows), 50),
        truth_is_open=np.ones(len(truth_rows), dtype=bool),
        is_on_standing=np.zeros(len(label_rows), dtype=bool),
    )


def score(labels, truths, num_sweeps):
    evidence = make_evidence(labels, truths, num_sweeps)
    overlaps = sweep_overlaps(evidence, evidence.label_boxes)
    matching = match(evidence, overlaps, "L1")
    is_kept = np.ones(len(labels), dtype=bool)
    return track_figures(evidence, matching, is_kept, hota_sums(evidence, matching, overlaps, is_kept))


TWO_CARS = [(t, k, 20.0 * k + t) for t in range(10) for k in range(2)]


def test_perfect_tracks():
    result = score(TWO_CARS, TWO_CARS, 10)
    assert (result.purity, result.completeness, result.num_id_switches) == (1, 1, 0)
    assert result.hota == pytest.approx(1)


def test_a_track_broken_in_the_middle():
    labels = [(t, k + 2 * (t >= 6), x) for t, k, x in TWO_CARS]
    result = score(labels, TWO_CARS, 10)
    assert (result.purity, result.completeness, result.num_id_switches) == (1, pytest.approx(0.6), 2)
    assert result.detection_accuracy == pytest.approx(1)
    # Of 10 sweeps, 6 associate with 6 / 10 and 4 with 4 / 10.
    assert result.association_accuracy == pytest.approx(0.6 * 0.6 + 0.4 * 0.4)
    assert result.hota == pytest.approx(np.sqrt(0.52))


def test_tracks_that_change_cars():
    labels = [(t, (k + (t >= 5)) % 2, x) for t, k, x in TWO_CARS]
    result = score(labels, TWO_CARS, 10)
    assert (result.purity, result.completeness, result.num_id_switches) == (0.5, 0.5, 2)
    assert result.association_accuracy == pytest.approx(5 / 15)  # 5 shared of 10 + 10 - 5


def test_half_of_the_cars_and_a_ghost():
    labels = [(t, k + 5 * (k == 1), x + 300 * (k == 1)) for t, k, x in TWO_CARS]
    result = score(labels, TWO_CARS, 10)
    assert (result.purity, result.completeness) == (1, 0.5)
    assert result.detection_accuracy == pytest.approx(10 / 30)
    assert (result.num_truth_tracks, result.num_label_tracks) == (2, 2)


def test_hota_averages_over_overlap_thresholds():
    # Shifted by 1 m of 4 m: IoU 3 / 5, a hit at 12 of the 19 thresholds.
    result = score([(t, k, x + 1) for t, k, x in TWO_CARS], TWO_CARS, 10)
    assert result.hota == pytest.approx((HOTA_IOUS <= 0.6 + 1e-9).sum() / 19)
    assert result.purity == 1


def test_nothing_labelled_and_nothing_to_find():
    missed = score([], TWO_CARS, 10)
    assert (missed.purity, missed.completeness, missed.hota) == (None, 0, 0)
    ghost = score(TWO_CARS, [], 10)
    assert (ghost.purity, ghost.completeness, ghost.hota, ghost.num_label_tracks) == (None, None, None, 2)
