"""How many numbers a row has, of a file that does not say: a row's columns differ, a wrong width mixes them."""

from typing import Final

import numpy as np

from schemas.arrays import Float32Array

WIDTHS: Final = range(3, 9)
_MAX_NUMBERS: Final = 840 * 60  # a multiple of each width
_MIN_NUMBERS: Final = 840  # fewer tell nothing
_MIN_SPREAD: Final = 1e-3
_CLEAR: Final = 0.15  # of the score, by which a wider row must be better: double width is as good as the right one


def scores_of_widths(numbers: Float32Array) -> dict[int, float]:
    """Return the mean log spread of the columns for each width that divides the numbers; the right one's is least.

    Mixed columns spread at least as much as the columns do in the mean, whatever the order of the points.
    """
    finite = np.nan_to_num(numbers[:_MAX_NUMBERS].astype(np.float64), posinf=0.0, neginf=0.0)
    scores = {}
    for width in WIDTHS:
        if len(numbers) % width == 0 and len(finite) >= width:
            table = finite[: len(finite) // width * width].reshape(-1, width)
            scores[width] = float(np.log(np.maximum(table.std(axis=0), _MIN_SPREAD)).mean())
    return scores


def best_width(numbers: Float32Array) -> int | None:
    """Return the likely number of columns; None when no width divides the numbers, or they are too few to tell."""
    scores = scores_of_widths(numbers) if len(numbers) >= _MIN_NUMBERS else {}
    least = min(scores.values(), default=0.0)
    return next((width for width, score in scores.items() if score <= least + _CLEAR), None)
