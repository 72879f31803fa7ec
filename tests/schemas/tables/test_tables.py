"""What is written comes back, and what comes back is written the same."""

import numpy as np
import pyarrow as pa
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from schemas.errors import InvalidInput
from schemas.objects import SweepObservation
from schemas.tables import SCHEMAS, labels, points, sweeps
from schemas.tables.labels import LabelRows
from schemas.tables.points import PointRows

NUMBERS = st.floats(-1e6, 1e6)
SINGLES = st.floats(-1e6, 1e6, width=32)  # what a float32 column holds as it is
NAMES = st.text(  # a NUL at their end is lost in numpy
    st.characters(exclude_characters="\0", exclude_categories=["Cs"]), min_size=1, max_size=40
)
INDICES = st.integers(0, 2**31 - 1)
STAMPS = st.integers(0, 2**63 - 1)


def column(values, size, dtype, width=None):
    return arrays(dtype, size if width is None else (size, width), elements=values)


@st.composite
def label_rows(draw):
    size = draw(st.integers(0, 5))
    is_observed = draw(column(st.booleans(), size, bool))
    boxes = draw(column(NUMBERS, size, float, 7))
    boxes[:, 3:6] = draw(column(SINGLES, size, float, 3))
    return LabelRows(
        sweep_index=draw(column(INDICES, size, np.int64)),
        timestamp_ns=draw(column(STAMPS, size, np.int64)),
        track_id=np.array(draw(st.lists(NAMES, min_size=size, max_size=size)), dtype=np.str_),
        boxes=boxes,
        velocity_mps=draw(column(SINGLES, size, float, 3)),
        score=draw(column(st.floats(0, 1, width=32), size, float)),
        num_points=draw(column(INDICES, size, np.int64)),
        is_observed=is_observed,
        boxes_visible=np.where(is_observed[:, None], draw(column(NUMBERS, size, float, 7)), np.nan),
        registration_error_m=draw(column(SINGLES | st.just(np.nan), size, float)),
    )


@st.composite
def point_rows(draw):
    size = draw(st.integers(0, 6))
    track_ids = tuple(draw(st.lists(NAMES, max_size=3, unique=True)))
    has_flow = draw(column(st.booleans(), size, bool))
    flow = draw(column(SINGLES, size, np.float32, 3))
    return PointRows(
        sweep_index=draw(column(INDICES, size, np.int64)),
        timestamp_ns=draw(column(STAMPS, size, np.int64)),
        point_index=draw(column(INDICES, size, np.int32)),
        flow_world_m=np.where(has_flow[:, None], flow, np.float32(np.nan)),
        cluster_id=draw(column(INDICES, size, np.int32)),
        is_in_cluster=draw(column(st.booleans(), size, bool)),
        track_ids=track_ids,
        track=draw(column(st.integers(-1, len(track_ids) - 1), size, np.int64)),
    )


@st.composite
def observations(draw):
    counts = st.integers(0, 2**31 - 1)
    return SweepObservation(
        draw(INDICES), draw(STAMPS), draw(column(NUMBERS, 4, float, 4)), *(draw(counts) for _ in range(5)),
        reason=draw(st.text(max_size=20)), proposals=(), points=None,
    )  # fmt: skip


@given(label_rows())
def test_labels_come_back(rows):
    table = labels.to_table("av2", "log-1", rows)
    assert table.schema.equals(SCHEMAS["labels"])
    again = labels.from_table(table)
    for name in LabelRows.__slots__:
        ours, theirs = getattr(rows, name), getattr(again, name)
        np.testing.assert_array_equal(ours, theirs, err_msg=name)
        assert ours.dtype.kind == theirs.dtype.kind
    assert labels.to_table("av2", "log-1", again).equals(table)


@given(point_rows())
def test_points_come_back(rows):
    table = points.to_table("av2", "log-1", rows)
    assert table.schema.equals(SCHEMAS["points"])
    again = points.from_table(table)
    for name in ("sweep_index", "timestamp_ns", "point_index", "flow_world_m", "is_in_cluster"):
        np.testing.assert_array_equal(getattr(rows, name), getattr(again, name), err_msg=name)
    np.testing.assert_array_equal(rows.cluster_id[rows.is_in_cluster], again.cluster_id[rows.is_in_cluster])
    for mine, theirs in zip(rows.track, again.track, strict=True):
        assert (mine < 0) == (theirs < 0)
        assert mine < 0 or rows.track_ids[mine] == again.track_ids[theirs]
    assert points.to_table("av2", "log-1", again).equals(table)


@given(st.lists(observations(), max_size=4))
def test_sweeps_come_back(observed):
    table = sweeps.to_table("av2", "log-1", observed)
    assert table.schema.equals(SCHEMAS["sweeps"])
    again = sweeps.from_table(table)
    for ours, theirs in zip(observed, again, strict=True):
        for name in SweepObservation.__slots__:
            np.testing.assert_array_equal(getattr(ours, name), getattr(theirs, name), err_msg=name)
    assert sweeps.to_table("av2", "log-1", again).equals(table)


def test_rows_of_tracks_are_ordered_by_sweep_and_track(make_track):
    rows = LabelRows.of_tracks([make_track("b", [0, 1], {0: [3], 1: [2]}), make_track("a", [0, 1, 2], {1: [1]})])
    order = [(0, "a"), (0, "b"), (1, "a"), (1, "b"), (2, "a")]
    assert list(zip(rows.sweep_index.tolist(), rows.track_id.tolist(), strict=True)) == order
    assert rows.is_observed.tolist() == [False, True, True, True, False]
    assert np.isnan(rows.boxes_visible).all(axis=1).tolist() == [True, False, False, False, True]
    assert len(LabelRows.of_tracks([])) == 0


def test_rows_can_be_chosen_by_mask_and_by_number(make_track):
    rows = LabelRows.of_tracks([make_track("a", [0, 1, 2], {})])
    assert rows.take(rows.sweep_index > 0).sweep_index.tolist() == [1, 2]
    assert rows.take(np.array([2, 0])).boxes[:, 0].tolist() == [2.0, 0.0]


def test_tables_of_several_files_are_read_as_one(make_track):
    parts = [labels.to_table("av2", "log-1", LabelRows.of_tracks([make_track(name, [0], {})])) for name in "ab"]
    assert labels.from_table(pa.concat_tables(parts)).track_id.tolist() == ["a", "b"]


def test_columns_of_other_lengths_are_refused():
    with pytest.raises(InvalidInput, match="flow_world_m must be"):
        PointRows(*(np.zeros(2, dtype=np.int64) for _ in range(2)), np.zeros(2, dtype=np.int32),
                  np.zeros((3, 3), dtype=np.float32), np.zeros(2, dtype=np.int32), np.zeros(2, dtype=bool),
                  (), np.zeros(2, dtype=np.int64))  # fmt: skip
