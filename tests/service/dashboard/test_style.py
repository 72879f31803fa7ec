"""Colours can be told apart by WCAG 2.1: 4.5 for text, 3 for bars and rings."""

import importlib.resources
import re

import pytest

CSS = importlib.resources.files("service.dashboard").joinpath("static/dashboard.css").read_text()
PALETTES = [
    dict(re.findall(r"--([\w-]+): (#\w{6});", block)) for block in re.findall(r":root \{(.*?)\}", CSS, re.DOTALL)
]
TEXTS = ("text", "faint", "link", "good", "busy", "fair", "bad")


def luminance(colour):
    channels = [int(colour[start : start + 2], 16) / 255 for start in (1, 3, 5)]
    linear = [c / 12.92 if c <= 0.04045 else ((c + 0.055) / 1.055) ** 2.4 for c in channels]
    return 0.2126 * linear[0] + 0.7152 * linear[1] + 0.0722 * linear[2]


def contrast(one, other):
    low, high = sorted([luminance(one), luminance(other)])
    return (high + 0.05) / (low + 0.05)


def test_contrast_of_known_pairs():
    assert contrast("#000000", "#ffffff") == pytest.approx(21)
    assert contrast("#777777", "#ffffff") == pytest.approx(4.48, abs=0.01)


@pytest.mark.parametrize("palette", PALETTES, ids=["light", "dark"])
def test_every_text_stands_out(palette):
    pairs = [(text, ground) for text in TEXTS for ground in ("page", "card")] + [("text", "bad-card")]
    assert {pair: contrast(*map(palette.get, pair)) for pair in pairs if contrast(*map(palette.get, pair)) < 4.5} == {}
    assert contrast(palette["busy"], palette["line"]) >= 3


def test_colours_are_said_once():
    assert [set(palette) for palette in PALETTES] == [set(PALETTES[0])] * 2
    assert not re.findall("#[0-9a-f]{3,6}", CSS.partition("* {")[2])
    assert set(re.findall(r"var\(--([\w-]+)\)", CSS)) == set(PALETTES[0])
