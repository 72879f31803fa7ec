import numpy as np
import pytest

from labeling.readers.reader import canonical_segment, id_of_canonical, make_segment_id, open_segment, segment_id_of
from schemas.errors import InvalidInput


def test_an_unknown_data_set_is_answered_with_the_known_ones():
    with pytest.raises(InvalidInput, match="unknown dataset 'kitty': expected one of av2, kitti_raw"):
        open_segment("kitty", "anywhere")


def test_segments_of_one_name_in_two_places_have_two_ids():
    ids = {make_segment_id("0001", f"s3://bucket-{letter}/0001") for letter in "ab"}
    assert len(ids) == 2
    assert make_segment_id("0001", "s3://bucket-a/0001") in ids


@pytest.mark.parametrize("name", ["a/b", "../..", "x y?z", "", "ß" * 5, "n" * 300], ids=range(6))
def test_a_segment_id_is_safe_in_a_file_name(name):
    segment_id = make_segment_id(name, "file:///data")
    assert segment_id.isascii()
    assert not set(segment_id) & set("/\\ ?*:\n")
    assert 9 < len(segment_id) <= 100


@pytest.fixture
def log(tmp_path, write_av2):
    folder = write_av2(tmp_path / "a log", [0.0], [np.ones((3, 3))])
    (tmp_path / "link").symlink_to(folder)
    return folder


def test_all_spellings_of_a_segment_have_one_name_and_one_id_opened_or_not(log, monkeypatch):
    monkeypatch.chdir(log.parent)
    reader = open_segment("av2", str(log))
    assert reader.uri == str(log)
    for spelling in (str(log), f"{log}/", log.as_uri(), str(log.parent / "link")):
        assert canonical_segment("av2", spelling) == str(log)
        assert segment_id_of("av2", spelling) == open_segment("av2", spelling).segment_id == reader.segment_id
    assert segment_id_of("av2", "a log") == open_segment("av2", "link").segment_id == reader.segment_id
    (log / "city_SE3_egovehicle.feather").unlink()
    assert segment_id_of("av2", "a log") == reader.segment_id


def test_the_id_of_a_known_name_is_found_without_a_look_at_the_disk(log, monkeypatch):
    expected = segment_id_of("av2", str(log))

    def hang(*_):
        raise AssertionError("asked the disk")

    monkeypatch.setattr("os.path.realpath", hang)
    monkeypatch.setattr("os.lstat", hang)
    monkeypatch.setattr("os.stat", hang)
    assert id_of_canonical("av2", str(log)) == expected
    monkeypatch.undo()


@pytest.mark.parametrize(
    ("dataset", "name"),
    [("av2", "file:///data/log"), ("av2", "log"), ("synthetic", "synthetic:street?seed=x"), ("synthetic", "/data")],
)
def test_what_a_former_version_stored_has_an_id_whatever_it_was(dataset, name):
    """The dispatcher asks for it in its tick: an exception there would end it."""
    assert id_of_canonical(dataset, name) == make_segment_id(name, name)


def test_all_spellings_of_a_street_have_one_name_and_one_id_opened_or_not():
    spellings = [
        "synthetic:street?seed=9&sweeps=4",
        "synthetic:street?sweeps=4&seed=9",
        "synthetic:street?sweeps=4&seed=9&hz=10&movers=true",
    ]
    assert {canonical_segment("synthetic", uri) for uri in spellings} == {spellings[0]}
    ids = {segment_id_of("synthetic", uri) for uri in spellings}
    assert ids == {open_segment("synthetic", uri).segment_id for uri in spellings}
    assert len(ids) == 1


def test_what_cannot_be_a_segment_has_an_id_too():
    ids = {segment_id_of("synthetic", uri) for uri in ("synthetic:street?seed=x", "synthetic:lane", "/data")}
    assert len(ids) == 3
