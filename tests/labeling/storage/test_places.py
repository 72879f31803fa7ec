import pytest

from labeling.storage.places import canonical_root, locate, locate_segment
from schemas.errors import InvalidInput


@pytest.fixture
def root(tmp_path):
    for name in ("data/log", "data-of-others", "elsewhere"):
        (tmp_path / name).mkdir(parents=True)
    return tmp_path / "data"


def test_folders_under_a_root_are_found_by_one_name(root):
    log = str(root / "log")
    for uri in (log, f"{log}/", f"{root}//log", f"{root}/./log", f"file://{log}", f"file://localhost{log}"):
        assert locate(uri, [str(root)]) == log
    assert locate(str(root / "not/there/yet"), ["/nowhere", str(root)]) == str(root / "not/there/yet")
    assert locate(str(root), [str(root)]) == str(root)


def test_percent_signs_are_decoded_in_file_uris_only(root):
    assert locate(f"file://{root}/a%20b", [str(root)]) == f"{root}/a b"
    assert locate(f"{root}/a%20b", [str(root)]) == f"{root}/a%20b"


def test_links_inside_a_root_are_followed_and_links_out_of_it_refused(root):
    (root / "inside").symlink_to(root / "log")
    (root / "outside").symlink_to(root.parent / "elsewhere")
    assert locate(str(root / "inside"), [str(root)]) == str(root / "log")
    with pytest.raises(InvalidInput, match="under no data root"):
        locate(str(root / "outside/log"), [str(root)])


@pytest.mark.parametrize(
    ("uri", "reason"),
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
        ("", "expected an absolute path"),
        ("http://host/log", "expected an absolute path"),
        ("s3://other/logs", "under no data root"),
        ("s3://bucket/logs-of-others", "under no data root"),
        ("s3://bucket/logs/../x", "expected s3://bucket/prefix"),
        ("s3://bucket/logs/%2e%2e/x", "expected s3://bucket/prefix"),
        ("s3://bucket/logs//x", "expected s3://bucket/prefix"),
        ("s3:///logs", "expected s3://bucket/prefix"),
    ],
)
def test_everything_else_is_refused(root, uri, reason):
    with pytest.raises(InvalidInput, match=reason):
        locate(uri.format(root=root), [str(root), "s3://bucket/logs"])


def test_s3_prefixes(root):
    assert locate("s3://bucket/logs/a/", ["s3://bucket/logs"]) == "s3://bucket/logs/a"
    assert locate("s3://bucket/logs", ["s3://bucket"]) == "s3://bucket/logs"


def test_the_whole_disk_may_be_a_root_but_no_bucket_is_on_it():
    assert locate("/data", ["/"]) == locate("/data", ["/data"])
    with pytest.raises(InvalidInput):
        locate("s3://bucket/a", ["/"])


def test_synthetic_segments_need_no_root():
    assert locate_segment("synthetic:street?seed=1", []) == "synthetic:street?seed=1"
    with pytest.raises(InvalidInput, match="none is set"):
        locate_segment("/data/log", [])


def test_roots_may_be_relative(root, monkeypatch):
    monkeypatch.chdir(root)
    assert canonical_root("../data/./log/") == str(root / "log")
