import numpy as np
import pytest

from schemas.arrays import read_only, require
from schemas.errors import InvalidInput


@pytest.mark.parametrize("length", [0, 1, 7])
def test_none_matches_any_length(length):
    require("points_ego", np.zeros((length, 3), np.float32), (None, 3), np.float32)


@pytest.mark.parametrize(
    ("array", "got"),
    [
        pytest.param(np.zeros((4, 3), np.float64), "(4, 3) float64", id="dtype"),
        pytest.param(np.zeros((4, 2), np.float32), "(4, 2) float32", id="columns"),
        pytest.param(np.zeros(3, np.float32), "(3,) float32", id="axes"),
        pytest.param([[0.0, 0.0, 0.0]], "list", id="not-an-array"),
    ],
)
def test_a_misfit_is_named_with_what_was_expected_and_what_came(array, got):
    with pytest.raises(InvalidInput) as caught:
        require("points_ego", array, (None, 3), np.float32)
    assert str(caught.value) == f"points_ego must be (N, 3) float32, got {got}"


def test_read_only_guards_the_view_and_not_the_original():
    original = np.zeros(3)
    view = read_only(original)
    with pytest.raises(ValueError, match="read-only"):
        view[0] = 1
    original[0] = 2
    assert view[0] == 2
