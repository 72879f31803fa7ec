import pytest

from labeling.readers.reader import make_segment_id, open_segment
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
