"""Which auto labels show what people labelled.

Rule. An auto box overlaps a person's box when they share at least ``min_overlap`` of the smaller one's area, seen from
above. Of the smaller one, and not of their union: a part of a lorry that was labelled as an object of its own, or a box
around a walker and her stroller, has a small IoU with what the person drew and is no unknown object all the same. An
auto track of which more than ``max_share`` of the boxes overlap is an object that people labelled, and goes as a whole,
also where it does not overlap: its end would be a second, wrong object. All other tracks stay as a whole: whoever walks
past a car is still there meanwhile.
"""

from dataclasses import dataclass
from typing import Final

from labeling.open_set.categories import categories_without, known_categories
from schemas.errors import InvalidInput

MIN_OVERLAP: Final = 0.3  # of the smaller box: less is a walker beside a car, whose box is a hand too wide
MAX_SHARE: Final = 0.5  # of a track's boxes that may overlap: on more, it is the same object


@dataclass(frozen=True, slots=True)
class MergeRule:
    """Whose boxes people drew, and which auto tracks show the same objects."""

    human: frozenset[str]  # categories that people annotate
    held_out: frozenset[str] | None = None  # the other ones that may occur; None: any
    min_overlap: float = MIN_OVERLAP
    max_share: float = MAX_SHARE

    def __post_init__(self) -> None:
        """Check the values.

        Raises:
            InvalidInput: No category, or a value out of range.

        """
        if not self.human or not all(self.human):
            raise InvalidInput("--human: expected one or more categories, as --human PEDESTRIAN,BICYCLIST")
        if not 0 < self.min_overlap <= 1:
            raise InvalidInput(f"--min-overlap {self.min_overlap:g}: expected a share above 0 and up to 1")
        if not 0 <= self.max_share < 1:
            raise InvalidInput(f"--max-share {self.max_share:g}: expected a share from 0 to below 1")


def hold_out_rule(dataset: str, hold_out: str) -> MergeRule:
    """Return the rule of the paper's leave-one-out sets: people label vehicles only, or vulnerable road users only.

    Raises:
        InvalidInput: As ``categories_without``.

    """
    human = categories_without(dataset, hold_out)
    return MergeRule(human, known_categories(dataset) - human)
