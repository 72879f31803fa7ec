"""Array aliases and the one check that stands where arrays enter."""

from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from schemas.errors import InvalidInput

Float32Array = NDArray[np.float32]
Float64Array = NDArray[np.float64]
FloatArray = NDArray[np.floating[Any]]
UInt8Array = NDArray[np.uint8]
Int32Array = NDArray[np.int32]
Int64Array = NDArray[np.int64]
BoolArray = NDArray[np.bool_]

ScalarT = TypeVar("ScalarT", bound=np.generic)


def require(
    name: str,
    array: Any,  # what a caller handed over: proving its type is this function's job
    shape: tuple[int | None, ...],
    dtype: type[np.generic],
) -> None:
    """Raise unless ``array`` has this shape (None matches any length) and dtype.

    Raises:
        InvalidInput: With the name, what was expected and what came.

    """
    expected = f"({', '.join('N' if n is None else str(n) for n in shape)}) {np.dtype(dtype)}"
    if not isinstance(array, np.ndarray):
        raise InvalidInput(f"{name} must be {expected}, got {type(array).__name__}")
    is_fitting = len(array.shape) == len(shape) and all(
        n is None or n == m for n, m in zip(shape, array.shape, strict=True)
    )
    if not is_fitting or array.dtype != np.dtype(dtype):
        raise InvalidInput(f"{name} must be {expected}, got {array.shape} {array.dtype}")


def read_only(array: NDArray[ScalarT]) -> NDArray[ScalarT]:
    """Return a view that refuses writes, as arrays handed over by Ray do."""
    view = array.view()
    view.flags.writeable = False
    return view
