from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from labeling.storage import places
from schemas.errors import InvalidInput


@pytest.fixture
def root(tmp_path):
    for name in ("data/log", "data-of-others", "elsewhere"):
        (tmp_path / name).mkdir(parents=True)
    return tmp_path / "data"


def test_all_spellings_of_a_folder_are_one_place(root):
    log = str(root / "log")
    (root / "link").symlink_to("log")
    for spelling in (
        log, f"{log}/", f"{root}//log", f"{root}/./log", f"{root}/link/",
        f"file://{log}", f"file://localhost{log}/", f"file:{log}",
    ):  # fmt: skip
        assert places.canonical(spelling) == log
        assert places.under_root(spelling, [str(root)]) == log
    assert places.canonical(places.as_uri(log)) == log


@pytest.mark.parametrize(
    "place", ["/a/with space", "/a/100%25", "/a/#1?x=y", "/\u00fc\u2603", "/", "s3://b", "s3://b/a b/\u00fc"]
)
def test_a_canonical_place_stays_what_it_is_and_survives_as_a_uri(place):
    assert places.canonical(place) == places.canonical(places.as_uri(place)) == places.absolute(place) == place


@given(st.lists(st.text("abc.%# \u00e4", min_size=1).filter(lambda name: name not in (".", "..")), min_size=1))
def test_join_and_split_undo_each_other(names):
    for top in ("/", "s3://bucket"):
        place = places.join(top, *names)
        assert place == top.rstrip("/") + "/" + "/".join(names)
        assert places.split(place) == (places.join(top, *names[:-1]) if names[:-1] else top, names[-1])
    assert places.split("s3://bucket") == ("s3://bucket", "")


def test_percent_signs_are_decoded_in_file_uris_only(root):
    assert places.canonical(f"file://{root}/a%20b") == f"{root}/a b"
    assert places.canonical(f"{root}/a%20b") == f"{root}/a%20b"


def test_links_inside_a_root_are_followed_and_links_out_of_it_refused(root):
    (root / "inside").symlink_to(root / "log")
    (root / "outside").symlink_to(root.parent / "elsewhere")
    assert places.under_root(str(root / "inside"), [str(root)]) == str(root / "log")
    with pytest.raises(InvalidInput, match="under no data root"):
        places.under_root(str(root / "outside/log"), [str(root)])


def test_what_is_not_there_yet_may_lie_under_a_root_and_a_root_under_itself(root):
    assert places.under_root(f"{root}/not/there/yet", ["/nowhere", str(root)]) == f"{root}/not/there/yet"
    assert places.under_root(str(root), [str(root)]) == str(root)
    with pytest.raises(InvalidInput, match="none is set"):
        places.under_root(str(root), [])


@pytest.mark.parametrize(
    ("place", "reason"),
    [
        ("{root}-of-others/log", "under no data root"),
        ("/", "under no data root"),
        ("{root}/../elsewhere", r'has "\.\."'),
        ("file://{root}/%2e%2e/elsewhere", r'has "\.\."'),
        ("file://host{root}", "without host"),
        ("file://{root}?x=1", "without host, query"),
        ("{root}/a\0b", "control characters"),
        ("file://{root}/a%00b", "control characters"),
        ("log", "expected an absolute path"),
        ("~/log", "expected an absolute path"),
        ("", "expected an absolute path"),
        ("http://host/log", "expected an absolute path"),
        ("synthetic:street", "expected an absolute path"),
        ("s3://other/logs", "under no data root"),
        ("s3://bucket/logs-of-others", "under no data root"),
        ("s3://bucket/logs/../x", "expected s3://bucket/prefix"),
        ("s3://bucket/logs/%2e%2e/x", "expected s3://bucket/prefix"),
        ("s3://bucket/logs//x", "expected s3://bucket/prefix"),
        ("s3:///logs", "expected s3://bucket/prefix"),
    ],
)
def test_everything_else_is_refused(root, place, reason):
    with pytest.raises(InvalidInput, match=reason):
        places.under_root(place.format(root=root), [str(root), "s3://bucket/logs"])


def test_s3_prefixes():
    assert places.under_root("s3://bucket/logs/a/", ["s3://bucket/logs"]) == "s3://bucket/logs/a"
    assert places.under_root("s3://bucket/logs", ["s3://bucket"]) == "s3://bucket/logs"


def test_the_whole_disk_may_be_a_root_but_no_bucket_is_on_it():
    assert places.under_root("/data", ["/"]) == places.under_root("/data", ["/data"])
    with pytest.raises(InvalidInput):
        places.under_root("s3://bucket/a", ["/"])


def test_users_write_paths_from_where_they_are(root, monkeypatch):
    monkeypatch.chdir(root)
    monkeypatch.setenv("HOME", str(root))
    for spelling in ("log", "./log/", "../data/log", "~/log", str(root / "log")):
        assert places.absolute(spelling) == str(root / "log")
    for uri in ("", "file:///data/log", "s3://bucket/log", "synthetic:street?seed=1"):
        assert places.absolute(uri) == uri


def test_a_users_links_stay_unless_he_climbs_from_them(root, monkeypatch):
    (root / "far").mkdir()
    (root.parent / "link").symlink_to(root / "far")
    monkeypatch.chdir(root.parent)
    assert places.absolute("link/x") == str(root.parent / "link/x")
    assert places.absolute("link/../log") == str(root / "log")
    assert Path(places.absolute("link/../log")).samefile("link/../log")
