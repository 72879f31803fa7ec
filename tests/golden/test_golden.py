"""Labels of three small segments are those of their label version; and what guards them does."""

import copy
import importlib.util
import json
import sys
from dataclasses import replace
from pathlib import Path

import pytest

SPEC = importlib.util.spec_from_file_location("golden", Path(__file__).with_name("golden.py"))
golden = importlib.util.module_from_spec(SPEC)
sys.modules["golden"] = golden  # dataclasses look their module up
SPEC.loader.exec_module(golden)


@pytest.mark.parametrize("segment", golden.GOLDEN, ids=lambda segment: segment.name)
def test_labels_are_those_of_their_version(segment):
    kept = golden.read(segment)
    assert kept is not None, f"no labels of {segment.name} are kept: run `make golden`"
    moved = golden.moved(segment, kept, golden.label(segment))
    assert not moved, (
        f"labels have moved: {moved[0]} ({len(moved)} differences). If they are meant to: raise LABEL_VERSION in "
        "labeling/folders/identity.py, run `make golden`, and say in CHANGELOG.md what moved"
    )
    assert kept["label_version"] == golden.LABEL_VERSION, "LABEL_VERSION was raised: run `make golden`"


def test_the_segments_are_unlike_and_small():
    kept = [golden.read(segment) for segment in golden.GOLDEN]
    assert {each["question"]["profile"] for each in kept} == {"default", "fast", "paper"}
    assert all(len(each["tables"]["labels"]) > 20 for each in kept)
    assert sum("points" in each["tables"] for each in kept) == 1
    assert sum(segment.path.stat().st_size for segment in golden.GOLDEN) < 200_000


@pytest.fixture
def segment(tmp_path, monkeypatch):
    """A kept segment in a folder of its own, and what labelling it gives: at first the same."""
    first = golden.GOLDEN[1]
    found = copy.deepcopy(golden.read(first)["tables"])
    monkeypatch.setattr(golden, "HERE", tmp_path)
    monkeypatch.setattr(golden, "label", lambda _: found)
    golden.write(first, found)
    return first, found


@pytest.mark.parametrize(
    ("table", "column", "change"),
    [
        ("labels", "x", 0.003),
        ("labels", "yaw", 0.004),
        ("labels", "velocity_y", 0.02),
        ("labels", "score", 0.004),
        ("labels", "num_points", 3),
        ("labels", "visible_width", -0.003),
        ("labels", "track", 1),
        ("sweeps", "num_static", 3),
        ("sweeps", "num_failed_fits", 1),
        ("points", "flow_x", 0.003),
        ("points", "num_without_cluster", -3),
    ],
)
def test_labels_that_move_need_another_version(segment, monkeypatch, capsys, table, column, change):
    golden_segment, found = segment
    place = [name for name, _ in golden.COLUMNS[table]].index(column)
    row = next(row for row in found[table] if row[place] is not None)
    row[place] += change
    before = golden_segment.path.read_text()
    assert golden.remake([golden_segment]) == 1
    assert f"LABEL_VERSION is still {golden.LABEL_VERSION}: raise it" in capsys.readouterr().err
    assert golden_segment.path.read_text() == before
    monkeypatch.setattr(golden, "LABEL_VERSION", golden.LABEL_VERSION + 1)
    assert golden.remake([golden_segment]) == 0
    assert json.loads(golden_segment.path.read_text())["label_version"] == golden.LABEL_VERSION
    assert golden.read(golden_segment)["tables"] == found


@pytest.mark.parametrize("change", [lambda rows: rows.pop(), lambda rows: rows.append(rows[-1])], ids=["less", "more"])
def test_a_row_less_or_more_is_a_move(segment, change):
    golden_segment, found = segment
    change(found["labels"])
    assert golden.remake([golden_segment]) == 1


def test_last_digits_and_turns_are_no_move(segment):
    golden_segment, found = segment
    before = golden_segment.path.read_text()
    found["labels"][0][2] += 0.0009
    found["labels"][0][8] += 6.2832
    assert golden.remake([golden_segment]) == 0
    assert golden_segment.path.read_text() == before


def test_another_question_has_another_answer(segment):
    golden_segment, _ = segment
    other = replace(golden_segment, overrides={"seed": 1})
    assert golden.read(other) is None
    assert golden.remake([other]) == 0
    assert golden.read(other)["question"]["overrides"] == {"seed": 1}
