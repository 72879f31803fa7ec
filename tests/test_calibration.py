"""The fit of the scores: laws of its maths, the form of its committed result, and that code and docs say the same."""

import importlib.util
import json
import sys
from pathlib import Path

import numpy as np
import pytest
from scipy.special import expit

from labeling.stages.scoring import INTERCEPT, TERMS
from schemas.manifest import RECOMMENDED_MIN_SCORE

ROOT = Path(__file__).resolve().parents[1]


@pytest.fixture(scope="module")
def calibration():
    folder = str(ROOT / "benchmarks")
    sys.path.insert(0, folder)  # scripts there import each other, as they do when they run
    try:
        spec = importlib.util.spec_from_file_location("calibration", f"{folder}/calibration.py")
        module = importlib.util.module_from_spec(spec)
        sys.modules["calibration"] = module  # dataclasses look their module up
        spec.loader.exec_module(module)
        yield module
    finally:
        sys.path.remove(folder)
        sys.modules.pop("calibration", None)


@pytest.fixture(scope="module")
def result():
    return json.loads((ROOT / "benchmarks/results/calibration.json").read_text())


def drawn(calibration, num_rows=60_000, seed=0):
    """Return features, what is right, and the weights by which it was drawn: +0.8 for what speaks for, -0.8 against."""
    rng = np.random.default_rng(seed)
    weight = np.array([-0.8 if name in calibration.AGAINST else 0.8 for name in calibration.NAMES])
    features = rng.normal(size=(num_rows, len(weight))) * 3 + 5
    is_right = rng.random(num_rows) < expit(0.5 + (features - 5) / 3 @ weight)
    return features, is_right, weight


def test_the_fit_finds_the_weights_that_chances_were_drawn_with(calibration):
    features, is_right, weight = drawn(calibration)
    fit = calibration.fit_chances(features, is_right)
    np.testing.assert_allclose(fit.weight, weight, atol=0.05)
    np.testing.assert_allclose(fit.intercept, 0.5, atol=0.05)
    chance = fit.chances(features)
    assert chance.mean() == pytest.approx(is_right.mean(), abs=1e-4)  # the intercept has no prior
    again = calibration.fit_chances(features, is_right)
    np.testing.assert_array_equal(again.weight, fit.weight)


def test_a_weight_of_the_wrong_sign_is_zero(calibration):
    features, is_right, _ = drawn(calibration)
    fit = calibration.fit_chances(features, ~is_right)
    np.testing.assert_array_equal(fit.weight, 0)


def test_a_feature_that_never_varies_has_no_weight(calibration):
    features, is_right, _ = drawn(calibration)
    features[:, 2] = 4.0
    fit = calibration.fit_chances(features, is_right)
    assert fit.weight[2] == 0
    assert fit.scale[2] == 1


def test_worlds_are_drawn_alike_and_differ(calibration):
    uris = [calibration.draw_world(number) for number in range(40)]
    assert uris == [calibration.draw_world(number) for number in range(40)]
    assert len(set(uris)) == 40
    for part in ("beams=32", "beams=64", "beams=128", "hz=10.0", "hz=20.0"):
        assert any(part in uri for uri in uris), part
    for uri in uris:
        calibration.open_segment("synthetic", uri)


def test_the_cache_makes_a_value_again_only_when_its_key_changed(calibration, tmp_path, capsys):
    made = []

    def make():
        made.append(len(made))
        return made[-1]

    path = tmp_path / "folder" / "value.pickle"
    assert [calibration.cached(path, key, make) for key in ("a", "a", "b", "b")] == [0, 0, 1, 1]
    capsys.readouterr()


def test_the_code_has_the_weights_of_the_committed_result(result):
    assert result["intercept"] == INTERCEPT
    assert result["terms"] == [{"name": t.name, "mean": t.mean, "scale": t.scale, "weight": t.weight} for t in TERMS]


def test_the_committed_result_has_its_form(calibration, result):
    assert len(result["worlds"]) == len(set(result["worlds"])) == calibration.NUM_WORLDS
    assert result["worlds"] == [calibration.draw_world(number) for number in range(calibration.NUM_WORLDS)]
    assert result["num_right"] + result["num_ignored"] < result["num_rows"]
    assert len(result["versions"]["motionlabel_commit"]) == 40
    for name in ("held_out", "in_use", "former"):
        judged = result[name]
        assert 0 <= judged["brier"] <= 1
        assert 0 <= judged["expected_calibration_error"] <= 1
        assert judged["ap_interval"][0] <= judged["ap"] <= judged["ap_interval"][1]
        assert [row["low"] for row in judged["reliability"]] == list(calibration.BIN_EDGES[:-1])
        assert [row["min_score"] for row in judged["cuts"]] == list(calibration.CUTS)
        recalls = [row["recall"] for row in judged["cuts"]]
        assert recalls == sorted(recalls, reverse=True)


def test_the_recommended_cut_is_right_nine_times_in_ten_on_held_out_worlds(result):
    (row,) = (row for row in result["held_out"]["cuts"] if row["min_score"] == RECOMMENDED_MIN_SCORE)
    assert row["precision"] >= 0.9


def test_the_page_shows_the_committed_tables(calibration, result):
    page = (ROOT / "docs/scores.md").read_text()
    for table in calibration.tables(result):
        assert table.partition("\n\n")[2] in page
