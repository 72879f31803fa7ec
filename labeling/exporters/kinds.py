"""What a moving box most likely is, by its size alone: formats of named classes ask for it."""

from collections.abc import Mapping
from enum import Enum
from typing import Final

from schemas.arrays import Float64Array
from schemas.errors import InvalidInput
from schemas.objects import BOX_HEIGHT, BOX_LENGTH

# By construction and by law. A vehicle of two tracks is wider than this, a walker shorter, swinging arms and legs.
_NARROW_M: Final = 1.2
# What a car, a van or a pick-up does not reach.
_LARGE_LENGTH_M: Final = 6.5
_LARGE_HEIGHT_M: Final = 2.6


class Kind(Enum):
    """Classes that a size can tell apart."""

    PEDESTRIAN = "pedestrian"
    CYCLIST = "cyclist"  # on a bicycle or a motorcycle, together with it
    CAR = "car"
    TRUCK = "truck"  # or a bus


def kinds_of(boxes: Float64Array) -> list[Kind]:
    """Return the likely kind of each of (B, 7) boxes. A track has one size, so it has one kind."""
    return [_kind_of(*sizes) for sizes in boxes[:, BOX_LENGTH : BOX_HEIGHT + 1].tolist()]


def _kind_of(length_m: float, width_m: float, height_m: float) -> Kind:
    if width_m <= _NARROW_M:
        return Kind.PEDESTRIAN if length_m <= _NARROW_M else Kind.CYCLIST
    return Kind.TRUCK if length_m > _LARGE_LENGTH_M or height_m > _LARGE_HEIGHT_M else Kind.CAR


def names_of(boxes: Float64Array, names: Mapping[Kind, str], category: str | None) -> list[str]:
    """Return a format's name for each of (B, 7) boxes: ``category`` where it is given, else that of the likely kind."""
    return [names[kind] for kind in kinds_of(boxes)] if category is None else [category] * len(boxes)


def require_category(category: str | None, known: tuple[str, ...]) -> None:
    """Raise InvalidInput when a category is given that the format does not have."""
    if category is not None and category not in known:
        raise InvalidInput(f"--category {category}: expected one of {', '.join(known)}")
