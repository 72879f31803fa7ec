"""The page: what it holds, what it lets run, and that it is whole or not there."""

import base64
import hashlib
import json
import re
from dataclasses import replace

import numpy as np
import pytest

from labeling.exporters.segments import SegmentLabels, read_segment
from labeling.readers.reader import open_segment
from labeling.replay.page import write_replay
from labeling.replay.payload import describe
from labeling.replay.points import NO_TRACK, decode
from schemas.errors import InvalidInput, UnreadableSweep
from schemas.frames import Annotations

HOSTILE = "</script><script>document.body.dataset.broken='yes'</script><!-- <img src=x onerror=alert(1)>"


@pytest.fixture
def recorded(tmp_path, label_recorded):
    """The segment's labels and its reader."""
    folder = label_recorded()
    reader = open_segment("av2", str(tmp_path / "log"))
    return read_segment(folder, reader.segment_id, min_score=0.0), reader


@pytest.fixture
def write(tmp_path, recorded):
    """Return a function that writes the page and returns its text."""

    def run(segment=recorded[0], reader=recorded[1], **options):
        write_replay(tmp_path / "replay.html", segment, reader, **options)
        return (tmp_path / "replay.html").read_text(encoding="utf-8")

    return run


def data_of(page):
    return json.loads(re.search(r'id="data">(.*?)</script>', page)[1])


def points_of(page):
    blocks = re.findall(r'class="sweep">(.*?)</script>', page)
    for block, header in zip(blocks, data_of(page)["sweeps"], strict=True):
        yield decode(base64.b64decode(block), header["num_static"], header["num_moving"])


def annotated(reader, categories, boxes_ego):
    """The reader, with the same annotations of each sweep."""
    found = Annotations(categories, categories, boxes_ego)
    reader.read_annotations = lambda index: found
    return reader


def test_points_come_back_from_the_page(write, recorded):
    _, reader = recorded
    for index, points in enumerate(points_of(write())):
        source = reader.read_sweep(index).points_ego
        found = points.points_ego
        order, rows = np.lexsort(found.round(1).T), np.lexsort(source.round(1).T)
        np.testing.assert_allclose(found[order], source[rows], rtol=0, atol=0.01 + 1e-6)
        assert points.num_static == 9
        np.testing.assert_array_equal(points.tracks, [0, 0, 0])
        np.testing.assert_allclose(points.velocity_mps, np.nan if index == 2 else 0.0)  # the car stands


def test_boxes_come_back_to_the_millimetre_by_track_and_time(write, recorded):
    segment, _ = recorded
    (track,) = data_of(write())["tracks"]
    found = np.array(track["boxes"])
    np.testing.assert_array_equal(found[:, 0], [0, 1, 2])
    np.testing.assert_allclose(found[:, 1:8], segment.rows.boxes, rtol=0, atol=5.1e-4)  # the vehicle is at the origin
    np.testing.assert_allclose(found[:, 8:10], segment.rows.velocity_mps[:, :2], atol=5.1e-3)
    np.testing.assert_allclose(found[:, 10], segment.rows.score)
    np.testing.assert_array_equal(found[:, 11:], [[321, 1]] * 3)


def test_places_begin_where_the_vehicle_begins(write, recorded):
    segment, _ = recorded
    moved = [replace(sweep, world_from_ego=np.eye(4) + far_away(index)) for index, sweep in enumerate(segment)]
    data = data_of(write(replace(segment, sweeps=tuple(moved))))
    poses = np.array([sweep["world_from_ego"] for sweep in data["sweeps"]]).reshape(-1, 4, 4)
    np.testing.assert_allclose(poses[:, :3, 3], [[0, 0, 0], [1, 0, 0], [2, 0, 0]], atol=1e-6)
    np.testing.assert_allclose(poses[:, :3, :3], [np.eye(3)] * 3)


def far_away(index):
    shift = np.zeros((4, 4))
    shift[:3, 3] = [500_000 + index, 4_000_000, 100]
    return shift


def test_the_most_doubtful_track_is_first(make_labels, make_driven, walker, doubtful):
    folder = make_labels([make_driven(), walker, doubtful])
    segment = read_segment(folder, folder.segment_ids[0], min_score=0.0)
    scores = [track["mean_score"] for track in describe(segment, [], (0, 1))["tracks"]]
    assert scores == [0.2, 0.6, 0.9]


def test_boxes_of_people_are_there_when_asked_for(write, recorded):
    box = np.array([[4.0, 3.0, 1.0, 4.0, 2.0, 1.5, 0.25]])
    reader = annotated(recorded[1], ("BUS",), box)
    assert data_of(write(reader=reader))["sweeps"][0]["truth"] == []
    for sweep in data_of(write(reader=reader, with_truth=True))["sweeps"]:
        assert sweep["truth"] == [{"category": "BUS", "box": box[0].tolist()}]


def test_what_is_far_beyond_the_grid_is_left_out_and_counted(write, recorded):
    _, reader = recorded
    read_sweep = reader.read_sweep

    def with_far_points(index):
        sweep = read_sweep(index)
        points_ego = sweep.points_ego.copy()
        points_ego[[0, 9]] = [700, 0, 0]
        return replace(sweep, points_ego=points_ego)

    reader.read_sweep = with_far_points
    page = write()
    assert [sweep["num_far"] for sweep in data_of(page)["sweeps"]] == [2, 2, 2]
    assert [len(points.points_ego) for points in points_of(page)] == [10, 10, 10]


def test_points_of_no_track_say_so(write, recorded):
    segment, _ = recorded
    without = read_segment(segment.folder, segment.segment_id, min_score=0.95)  # no box is left
    assert all((points.tracks == NO_TRACK).all() for points in points_of(write(without)))


def test_points_are_as_fast_as_their_flow_says(write, recorded, monkeypatch):
    flow_world_m = np.array([[1.0, -2.0, 0.0]] * 3, dtype=np.float32)  # to the next sweep, 0.1 s later
    moving = [(sweep, replace(rows, flow_world_m=flow_world_m)) for sweep, rows in recorded[0].with_points()]
    monkeypatch.setattr(SegmentLabels, "with_points", lambda self: iter(moving))
    for index, points in enumerate(points_of(write())):
        np.testing.assert_allclose(points.velocity_mps, [[np.nan] * 2 if index == 2 else [10, -20]] * 3, atol=1e-6)


def test_only_what_the_policy_names_can_run(write):
    page = write()
    policy = re.search(r'Content-Security-Policy" content="(.*?)"', page)[1]
    scripts = re.findall(r"<script>(.*?)</script>", page, re.DOTALL)
    styles = re.findall(r"<style>(.*?)</style>", page, re.DOTALL)
    assert (len(scripts), len(styles)) == (2, 1)
    named = [
        f"'sha256-{base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()}'" for text in (*scripts, *styles)
    ]
    assert policy == (
        f"default-src 'none'; script-src {named[0]} {named[1]}; style-src {named[2]}; base-uri 'none'; "
        "form-action 'none'"
    )
    assert not re.search(r"<[^>]+ (src|href|style|on\w+)=", page.replace(scripts[0], ""))
    assert not re.search(r"\beval\(|new Function|innerHTML|insertAdjacentHTML|document\.write", scripts[1])


def test_names_that_are_markup_end_no_block(write, recorded):
    segment, reader = recorded
    box = np.array([[4.0, 3.0, 1.0, 4.0, 2.0, 1.5, 0.25]])
    page = write(replace(segment, dataset=HOSTILE), annotated(reader, (HOSTILE,), box), with_truth=True)
    assert data_of(page)["dataset"] == HOSTILE
    assert data_of(page)["sweeps"][0]["truth"][0]["category"] == HOSTILE
    assert "dataset.broken" not in re.sub(r'id="data">.*?</script>', "", page)
    assert page.count("<script>") == 2


def test_the_same_labels_make_the_same_page(write):
    assert write() == write()


def test_a_page_is_whole_or_not_there(tmp_path, write, recorded):
    _, reader = recorded
    before = write()
    read_sweep = reader.read_sweep

    def fail_at_the_end(index):
        if index == 2:
            raise UnreadableSweep("sweep 2 is truncated")
        return read_sweep(index)

    reader.read_sweep = fail_at_the_end
    with pytest.raises(UnreadableSweep):
        write()
    assert (tmp_path / "replay.html").read_text(encoding="utf-8") == before
    assert not list(tmp_path.glob(".*"))


@pytest.mark.parametrize("place", ["missing/replay.html", "folder"])
def test_a_place_that_takes_no_page_is_named(tmp_path, recorded, place):
    (tmp_path / "folder").mkdir()
    with pytest.raises(InvalidInput, match="cannot write the page"):
        write_replay(tmp_path / place, *recorded)
    assert not list(tmp_path.rglob(".*"))


def test_a_sweep_is_written_before_the_next_is_read(write, recorded):
    _, reader = recorded
    read_sweep, happened = reader.read_sweep, []

    def note_and_read(index):
        happened.append(("read", index))
        return read_sweep(index)

    reader.read_sweep = note_and_read
    write(on_sweep=lambda num_done: happened.append(("wrote", num_done - 1)))
    assert happened == [(what, index) for index in range(3) for what in ("read", "wrote")]


def test_no_truth_is_told(write):
    with pytest.raises(InvalidInput, match=r"--truth: .* has no annotations of any sweep"):
        write(with_truth=True)


def test_no_table_of_points_is_told(write, recorded, make_labels, make_driven):
    folder = make_labels([make_driven()], name="bare")
    with pytest.raises(InvalidInput, match=r"has no table of points, .*: label it again with --points"):
        write(read_segment(folder, folder.segment_ids[0], min_score=0.0))


def test_no_labelled_sweep_is_told(write, recorded):
    with pytest.raises(InvalidInput, match=r"segment .* has no sweep that was labelled"):
        write(replace(recorded[0], sweeps=()))
