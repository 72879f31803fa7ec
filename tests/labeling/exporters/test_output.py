import pytest

from labeling.exporters.output import ExportFolder
from schemas.errors import ShardConflict


@pytest.fixture(params=["disk", "bucket"])
def place(request, tmp_path):
    """A new place, local or in a bucket."""
    return str(tmp_path / "export") if request.param == "disk" else f"{request.getfixturevalue('bucket')}/export"


def test_a_file_is_put_once_kept_when_it_is_the_same_and_never_replaced(place, monkeypatch):
    monkeypatch.setattr("labeling.exporters.output._CHUNK_BYTES", 4)  # so that comparing takes several reads
    output = ExportFolder(place)
    for content in (b"0123456789", b"0123456789"):
        output.put("a/b.txt", content)
    assert (output.num_written, output.num_kept) == (1, 1)
    for other in (b"012345678X", b"0123X56789", b"012345678", b"0123456789X", b""):
        with pytest.raises(ShardConflict, match=r"export/a/b.txt is there with other content"):
            output.put("a/b.txt", other)
    ExportFolder(place).put("a/b.txt", b"0123456789")


def test_an_empty_file_is_one_too(place):
    output = ExportFolder(place)
    output.put("empty", b"")
    output.put("empty", b"")
    assert (output.num_written, output.num_kept) == (1, 1)


def test_what_fails_while_it_is_written_is_not_put(tmp_path):
    output = ExportFolder(tmp_path)

    def write_half():
        with output.writing("a.txt") as file:
            file.write(b"half")
            raise RuntimeError

    with pytest.raises(RuntimeError):
        write_half()
    assert not (tmp_path / "a.txt").exists()
    assert output.num_written == 0
    with output.writing("a.txt") as file:
        file.write(b"whole")
    assert (tmp_path / "a.txt").read_bytes() == b"whole"
