"""A segment as a page, by command and in a browser."""

import json
import re

import pytest

STREET = "synthetic:street?sweeps=6&seed=1&beams=16&azimuth_steps=300"


@pytest.fixture
def page(cli, fast_stages, tmp_path):
    """A page of a short street whose stages are trivial: one track goes through all sweeps."""
    arguments = ["--dataset", "synthetic", "--output", tmp_path / "out", "--points"]
    assert cli("label", STREET, *arguments)[0] == 0
    path = tmp_path / "replay.html"
    code, said, err = cli("replay", tmp_path / "out", STREET, "--dataset", "synthetic", "--html", path, "--truth")
    assert (code, err) == (0, [])
    assert re.fullmatch(rf"{path}: sweeps: 6, tracks: 1, points: (\d+) of \1, \d\.\d MB\n", said)
    return path


@pytest.fixture
def shown(browser, page):
    """A browser that shows the page."""
    browser.open(page.as_uri())
    browser.wait_for("document.body.dataset.ready === 'true' && document.body.dataset.drawn === '0'")
    yield browser
    assert browser.complaints == []


def slide(browser, sweep):
    browser.ask(
        f"const slider = document.getElementById('time'); slider.value = {sweep};"
        "slider.dispatchEvent(new Event('input')); undefined"
    )


def test_the_page_opens_from_disk_and_asks_for_nothing(shown, page):
    assert shown.ask("performance.getEntriesByType('resource').length") == 0
    assert "sweeps: 6, tracks: 1." in shown.ask("document.getElementById('told').textContent")
    assert shown.ask("document.getElementById('tracks').rows.length") == 1


def test_the_slider_moves_the_time(shown):
    slide(shown, 4)
    shown.wait_for("document.body.dataset.drawn === '4'")
    assert shown.ask("document.getElementById('clock').textContent").startswith("0.40 s")


def test_keys_step_through_time_and_tracks(shown):
    shown.press("ArrowRight", 39)
    shown.wait_for("document.body.dataset.sweep === '1'")
    shown.press("n", 78)
    shown.wait_for("document.querySelectorAll('tr.chosen').length === 1")
    assert shown.ask("document.getElementById('camera').value") == "track"
    shown.press("Escape", 27)
    shown.wait_for("document.body.dataset.track === ''")
    assert shown.ask("document.getElementById('camera').value") == "vehicle"


def test_keys_may_be_faster_than_sweeps_are_unpacked(shown):
    shown.ask(
        "for (const key of ['ArrowRight', 'ArrowRight', 'c', 'ArrowRight', 'ArrowLeft', 'c'])"
        "document.dispatchEvent(new KeyboardEvent('keydown', {key})); undefined"
    )
    shown.wait_for("document.body.dataset.drawn === '2'")


def test_a_damaged_page_says_so(browser, page):
    page.write_text(re.sub('class="sweep">.{40}', 'class="sweep">', page.read_text()))
    browser.open(page.as_uri())
    browser.wait_for("document.getElementById('trouble').textContent.startsWith('The points cannot be unpacked')")


def test_a_track_is_followed_when_its_row_is_clicked(shown):
    shown.ask("document.getElementById('tracks').rows[0].click()")
    shown.wait_for("document.querySelectorAll('#names .chosen').length === 1")
    place = "document.querySelector('#names .chosen').getBoundingClientRect().left"
    before = shown.ask(place)
    slide(shown, 5)
    shown.wait_for("document.body.dataset.drawn === '5'")
    assert abs(shown.ask(place) - before) < 5  # it stays in the middle of the view


def test_play_plays_to_the_end(shown):
    shown.press(" ", 32)
    shown.wait_for("document.body.dataset.sweep === '5' && document.body.dataset.playing === 'false'")


@pytest.mark.parametrize("colour", ["flow", "height", "track", "score"])
def test_every_colour_is_drawn(shown, colour):
    shown.ask(
        "delete document.body.dataset.drawn; const select = document.getElementById('colour');"
        f"select.value = {json.dumps(colour)}; select.dispatchEvent(new Event('change')); undefined"
    )
    shown.wait_for("document.body.dataset.drawn === '0'")
    assert shown.ask("document.getElementById('legend-bar').className") == colour


def test_names_that_are_markup_are_shown_as_text(browser, page):
    hostile = "<img src=x onerror=\"document.body.dataset.broken='yes'\"></script><script>1</script>"
    names = r'("(?:dataset|segment|track_id)":)".*?"'
    page.write_text(re.sub(names, lambda found: found[1] + escaped(hostile), page.read_text()))
    browser.open(page.as_uri())
    browser.wait_for("document.body.dataset.ready === 'true'")
    assert browser.ask("document.getElementById('segment').textContent") == hostile
    assert browser.ask("document.querySelectorAll('img').length") == 0
    assert browser.ask("document.body.dataset.broken") is None
    assert browser.complaints == []


def escaped(text):
    return json.dumps(text).replace("<", "\\u003c")


def test_points_are_thinned_where_nothing_moves_and_that_is_told(cli, page, tmp_path):
    arguments = ["--dataset", "synthetic", "--html", tmp_path / "thin.html", "--max-points", 15000]
    code, said, _ = cli("replay", tmp_path / "out", STREET, *arguments)
    assert code == 0
    assert "(of what stands still, one a voxel of up to 0." in said


def test_bad_input_is_one_line(cli, label, write_log, fast_stages, tmp_path):
    log = write_log()
    assert label(log)[0] == 0
    html = ["--html", tmp_path / "replay.html"]
    for arguments, message in [
        ([tmp_path, log, *html], "no labels at"),
        ([tmp_path / "out", write_log("other"), *html], "holds no labels of segment other-"),
        ([tmp_path / "out", tmp_path / "gone", *html], "gone"),
        ([tmp_path / "out", log, "--html", tmp_path / "none/replay.html"], "--html"),
        ([tmp_path / "out", log, "--html", ""], "cannot write the page .: it is a folder"),
        ([tmp_path / "out", log, *html], "has no table of points"),
        ([tmp_path / "out", log, *html, "--max-points", 0], "--max-points"),
    ]:
        code, said, (line,) = cli("replay", *arguments, "--dataset", "av2")
        assert (code, said) == (2, "")
        assert message in line
    assert not (tmp_path / "replay.html").exists()
