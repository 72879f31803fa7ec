import numpy as np
import pytest

from labeling.exporters.kinds import Kind, kinds_of, names_of, require_category
from schemas.errors import InvalidInput


@pytest.mark.parametrize(
    ("length", "width", "height", "kind"),
    [
        (0.6, 0.6, 1.7, Kind.PEDESTRIAN),
        (1.2, 1.2, 1.7, Kind.PEDESTRIAN),
        (1.7, 0.6, 1.7, Kind.CYCLIST),
        (2.2, 0.9, 1.5, Kind.CYCLIST),  # a motorcycle
        (2.7, 1.6, 1.5, Kind.CAR),  # a small one
        (4.5, 1.8, 1.6, Kind.CAR),
        (5.9, 2.0, 2.5, Kind.CAR),  # a van
        (5.9, 2.1, 2.8, Kind.TRUCK),
        (12.0, 2.5, 2.5, Kind.TRUCK),  # a low bus
    ],
)
def test_a_size_tells_the_kind(length, width, height, kind):
    assert kinds_of(np.array([[0, 0, 0, length, width, height, 0.0]])) == [kind]


def test_a_category_that_is_given_holds_for_all():
    boxes = np.array([[0, 0, 0, 4.5, 1.8, 1.6, 0], [0, 0, 0, 0.6, 0.6, 1.7, 0.0]])
    names = {kind: kind.name for kind in Kind}
    assert names_of(boxes, names, None) == ["CAR", "PEDESTRIAN"]
    assert names_of(boxes, names, "tram") == ["tram", "tram"]
    assert names_of(boxes[:0], names, None) == names_of(boxes[:0], names, "tram") == []


def test_a_category_that_the_format_does_not_have_is_refused():
    require_category(None, ("a", "b"))
    require_category("b", ("a", "b"))
    with pytest.raises(InvalidInput, match="--category c: expected one of a, b"):
        require_category("c", ("a", "b"))
