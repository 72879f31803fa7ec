import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from labeling.evaluation.boxes import (
    curve,
    detection_curve,
    interval,
    match,
    oracle_boxes,
    resampled_curves,
    sweep_overlaps,
)
from labeling.evaluation.evidence import BoxEvidence, pool

CAR = (4.0, 2.0, 1.6, 0.0)


def make_evidence(labels, truths, num_sweeps=1):
    """Labels: (sweep, track, x, score[, yaw]); truths: (sweep, object, x, is_open, num_points). All cars on a line."""
    label_rows = [(*label, 0.0)[:5] for label in labels]
    count = len(label_rows)
    boxes = np.array([(x, 0, 0, 4, 2, 1.6, yaw) for _, _, x, _, yaw in label_rows]).reshape(-1, 7)
    column = lambda rows, index, kind: np.array([row[index] for row in rows], dtype=kind)  # noqa: E731
    return BoxEvidence(
        num_sweeps=num_sweeps,
        label_sweep=column(label_rows, 0, np.int64),
        label_track=column(label_rows, 1, np.int64),
        label_boxes=boxes,
        label_score=column(label_rows, 3, np.float64),
        label_speed_mps=np.zeros(count),
        truth_sweep=column(truths, 0, np.int64),
        truth_object=column(truths, 1, np.int64),
        truth_boxes=np.array([(x, 0, 0, *CAR) for _, _, x, _, _ in truths]).reshape(-1, 7),
        truth_speed_mps=np.full(len(truths), 5.0),
        truth_num_points=column(truths, 4, np.int64),
        truth_is_open=column(truths, 3, np.bool_),
        is_on_standing=np.zeros(count, dtype=bool),
    )


def matched(evidence, level="L1", overlap="3D"):
    return match(evidence, sweep_overlaps(evidence, evidence.label_boxes, overlap), level)


def test_one_false_box_of_two_halves_the_precision():
    evidence = make_evidence([(0, 0, 0.0, 0.9), (0, 1, 30.0, 0.9)], [(0, 0, 0.0, True, 50)])
    result = detection_curve(evidence, matched(evidence), 0.0)
    assert (result.precision, result.recall) == (0.5, 1.0)
    assert result.average_precision == 0.5  # equal scores enter together


def test_average_precision_of_a_curve_by_hand():
    # Falling score: right, wrong, right, wrong; 4 truths. Precision 1 up to recall 1/4, then 2/3 up to 1/2, then 0.
    score = np.array([0.9, 0.8, 0.7, 0.6])
    right, wrong = np.array([1.0, 0, 1, 0]), np.array([0, 1.0, 0, 1])
    heading = np.array([1.0, 0, 0.5, 0])
    result = curve(score, right, wrong, heading, 4, min_score=0.75)
    assert result.average_precision == pytest.approx((26 * 1 + 25 * 2 / 3) / 101)
    assert result.average_precision_heading == pytest.approx((26 * 1 + 25 * 1.5 / 3) / 101)
    assert (result.precision, result.recall) == (0.5, 0.25)


def test_the_best_score_takes_the_truth_and_the_second_box_is_wrong():
    evidence = make_evidence([(0, 0, 0.0, 0.5), (0, 1, 0.4, 0.9)], [(0, 0, 0.0, True, 50)])
    assert matched(evidence).truth_of_label.tolist() == [-1, 0]
    assert matched(evidence).is_wrong.tolist() == [True, False]


def test_a_label_prefers_the_truth_to_find_over_an_ignored_one_it_covers_better():
    evidence = make_evidence([(0, 0, 0.0, 0.9)], [(0, 0, 0.0, False, 50), (0, 1, 1.0, True, 50)])
    assert matched(evidence).truth_of_label.tolist() == [1]


def test_pausing_movers_are_neither_right_nor_wrong():
    evidence = make_evidence([(0, 0, 0.0, 0.9), (0, 1, 20.0, 0.9)], [(0, 0, 0.0, False, 50), (0, 1, 20.0, True, 50)])
    matching = matched(evidence)
    assert matching.is_ignored.tolist() == [True, False]
    result = detection_curve(evidence, matching, 0.0)
    assert (result.precision, result.recall, result.average_precision) == (1, 1, 1)


@pytest.mark.parametrize(
    ("num_points", "level", "num_to_find", "is_ignored"),
    [(6, "L1", 1, False), (5, "L1", 0, True), (5, "L2", 1, False), (1, "L2", 1, False), (0, "L2", 0, True)],
)
def test_levels_by_number_of_points(num_points, level, num_to_find, is_ignored):
    evidence = make_evidence([(0, 0, 0.0, 0.9)], [(0, 0, 0.0, True, num_points)])
    matching = matched(evidence, level)
    assert matching.is_to_find.sum() == num_to_find
    assert matching.is_ignored.tolist() == [is_ignored]
    assert not matching.is_wrong.any()


def test_backward_boxes_have_no_heading_precision():
    evidence = make_evidence([(0, 0, 0.0, 0.9, np.pi)], [(0, 0, 0.0, True, 50)])
    result = detection_curve(evidence, matched(evidence), 0.0)
    assert result.average_precision == 1
    assert result.average_precision_heading == pytest.approx(0, abs=1e-12)


def test_overlap_threshold_is_inclusive_of_four_tenths():
    # Shifted by d along its length of 4 m a box has IoU (4 - d) / (4 + d): 0.4 at 12 / 7 m.
    below, above = 12 / 7 + 1e-6, 12 / 7 - 1e-6
    for shift, found in ((above, True), (below, False)):
        evidence = make_evidence([(0, 0, shift, 0.9)], [(0, 0, 0.0, True, 50)])
        assert matched(evidence).is_right.tolist() == [found]
        assert matched(evidence, overlap="BEV").is_right.tolist() == [found]


def test_height_counts_in_3d_only():
    evidence = make_evidence([(0, 0, 0.0, 0.9)], [(0, 0, 0.0, True, 50)])
    raised = evidence.label_boxes.copy()
    raised[:, 2] += 1.2  # shares 0.4 of 1.6 m: IoU 1 / 7
    assert not match(evidence, sweep_overlaps(evidence, raised, "3D"), "L1").is_right.any()
    assert match(evidence, sweep_overlaps(evidence, raised, "BEV"), "L1").is_right.all()


def test_missed_sweeps_count_against_recall():
    evidence = make_evidence([(1, 0, 0.0, 0.9)], [(t, 0, 0.0, True, 50) for t in range(4)], num_sweeps=4)
    result = detection_curve(evidence, matched(evidence), 0.0)
    assert result.recall == 0.25
    assert result.average_precision == pytest.approx(26 / 101)


def test_nothing_labelled_and_nothing_to_find():
    empty_labels = make_evidence([], [(0, 0, 0.0, True, 50)])
    result = detection_curve(empty_labels, matched(empty_labels), 0.0)
    assert (result.average_precision, result.precision, result.recall) == (0, None, 0)
    empty_truth = make_evidence([(0, 0, 0.0, 0.9)], [])
    result = detection_curve(empty_truth, matched(empty_truth), 0.0)
    assert (result.average_precision, result.precision, result.recall) == (None, 0, None)


def test_pooled_logs_share_no_ids():
    log = make_evidence([(0, 0, 0.0, 0.9), (1, 0, 0.0, 0.9)], [(0, 0, 0.0, True, 50), (1, 0, 0.0, True, 50)], 2)
    other = make_evidence([(0, 0, 9.0, 0.4)], [(0, 0, 0.0, True, 50)])
    both = pool([log, other])
    assert both.num_sweeps == 3
    assert both.label_sweep.tolist() == both.truth_sweep.tolist() == [0, 1, 2]
    assert both.label_track.tolist() == both.truth_object.tolist() == [0, 0, 1]
    result = detection_curve(both, matched(both), 0.5)
    assert (result.precision, result.recall) == (1, pytest.approx(2 / 3))


def test_intervals_draw_whole_objects_and_repeat():
    # Ten objects of which half are found in all their sweeps: recall of a round is a multiple of 1 / 10.
    labels = [(t, k, 10.0 * k, 0.9) for t in range(5) for k in range(5)]
    truths = [(t, k, 10.0 * k, True, 50) for t in range(5) for k in range(10)]
    evidence = make_evidence(labels, truths, num_sweeps=5)
    rounds = resampled_curves(evidence, matched(evidence), 0.0, np.random.default_rng(0))
    recalls = np.array([one.recall for one in rounds])
    np.testing.assert_allclose(recalls * 10, np.round(recalls * 10))
    low, high = interval(list(recalls))
    assert low < 0.5 < high
    assert low >= 0.15  # binomial: 90 % of draws of 10 with p = 1/2 lie in 0.2 to 0.8
    assert high <= 0.85
    again = resampled_curves(evidence, matched(evidence), 0.0, np.random.default_rng(0))
    assert [one.average_precision for one in again] == [one.average_precision for one in rounds]


def test_oracle_boxes_take_parts_from_the_truth_they_touch():
    evidence = make_evidence([(0, 0, 1.9, 0.9, 0.3), (0, 1, 40.0, 0.9, 0.3)], [(0, 0, 0.0, True, 50)])
    ours, truth = evidence.label_boxes[0], evidence.truth_boxes[0]
    mixed = oracle_boxes(evidence, sweep_overlaps(evidence, evidence.label_boxes))
    np.testing.assert_array_equal(mixed["all from truth"][0], truth)
    np.testing.assert_array_equal(mixed["position ours"][0], [*ours[:3], *truth[3:]])
    np.testing.assert_array_equal(mixed["size ours"][0], [*truth[:3], *ours[3:6], truth[6]])
    np.testing.assert_array_equal(mixed["heading ours"][0], [*truth[:6], ours[6]])
    for boxes in mixed.values():
        np.testing.assert_array_equal(boxes[1], evidence.label_boxes[1])


scored = st.lists(st.tuples(st.sampled_from([0.2, 0.5, 0.5001, 0.9]), st.booleans()), min_size=1, max_size=20)


@given(rows=scored, missed=st.integers(0, 5), seed=st.integers(0, 99))
def test_average_precision_ignores_row_order_and_stays_below_best_precision(rows, missed, seed):
    score, right = np.array([r[0] for r in rows]), np.array([float(r[1]) for r in rows])
    order = np.random.default_rng(seed).permutation(len(rows))
    ones, num = np.ones(len(rows)), right.sum() + missed
    plain = curve(score, right, 1 - right, ones, num, 0.0)
    shuffled = curve(score[order], right[order], 1 - right[order], ones, num, 0.0)
    assert plain == shuffled
    if num:
        assert 0 <= plain.average_precision <= 1
        assert plain.average_precision == plain.average_precision_heading
        assert plain.average_precision <= (int(100 * plain.recall + 1e-9) + 1) / 101 + 1e-9
