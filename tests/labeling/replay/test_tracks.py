"""What tells a doubtful track."""

import numpy as np
import pytest

from labeling.replay.tracks import TrackSummary, doubt, summarize
from schemas.tables.labels import LabelRows


@pytest.fixture
def rows(make_driven):
    return LabelRows.of_tracks([make_driven(sweeps=(0, 1, 2, 3), poses=[np.eye(4)] * 4, velocity_ego=np.zeros(3))])


def changed(rows, **columns):
    return LabelRows(**{name: columns.get(name, getattr(rows, name)) for name in rows.__slots__})


def test_a_track_that_stands_has_nothing_to_doubt(rows):
    assert summarize(rows) == TrackSummary(rows.track_id[0], 4, pytest.approx(0.9), 0.0, 0.0, 0.0)


def test_a_jump_is_what_velocity_does_not_explain(rows):
    boxes = rows.boxes + np.outer([0, 1, 2, 3], [1, 0, 0, 0, 0, 0, 0])
    velocity_mps = np.tile([10.0, 0, 0], (4, 1))
    assert summarize(changed(rows, boxes=boxes, velocity_mps=velocity_mps)).jump_m == pytest.approx(0, abs=1e-6)
    boxes[2:, 1] += 2.5
    found = summarize(changed(rows, boxes=boxes, velocity_mps=velocity_mps))
    assert found.jump_m == pytest.approx(2.5)
    assert found.top_speed_mps == 10


def test_a_change_of_size_is_that_of_the_worst_side(rows):
    boxes = rows.boxes.copy()
    boxes[1, 3] *= 1.25
    boxes[2, 4] *= 1.1
    assert summarize(changed(rows, boxes=boxes)).size_change == pytest.approx(0.25)


def test_the_lowest_score_comes_first_then_the_largest_jump_then_size():
    tracks = [
        TrackSummary("good", 9, 0.91, 5.0, 1.0, 3.0),
        TrackSummary("grows", 9, 0.301, 0.0, 0.5, 3.0),
        TrackSummary("jumps", 9, 0.304, 2.0, 0.0, 3.0),
        TrackSummary("plain", 9, 0.299, 0.0, 0.0, 3.0),
        TrackSummary("worst", 9, 0.1, 0.0, 0.0, 3.0),
    ]
    assert [track.track_id for track in sorted(tracks, key=doubt)] == ["worst", "jumps", "grows", "plain", "good"]
