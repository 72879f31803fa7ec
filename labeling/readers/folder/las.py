"""LAS and LAZ files, through laspy, which believes what a header says: counts that cannot be are refused before."""

import io
import struct
from collections.abc import Sequence
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

_MIN_RECORD: Final = {"VLRs": 54, "EVLRs": 60}  # bytes of a header alone
_MAX_POINTS_A_BYTE: Final = 10  # compressed ones take more than a bit each


def read_las(content: bytes, wanted: Sequence[str]) -> dict[str, NDArray[Any]]:
    """Return those of the wanted dimensions that a file has, x, y and z scaled; raise ValueError when it is broken."""
    try:
        import laspy
    except ImportError:
        raise ValueError("needs an extra: pip install motionlabel[las]") from None
    try:
        _require_possible_counts(content)
        cloud = laspy.read(io.BytesIO(content))
        known = {"x", "y", "z", *cloud.point_format.dimension_names}
        return {name: np.asarray(cloud[name]) for name in wanted if name in known}
    except Exception as error:  # noqa: BLE001 - of bytes that are broken, laspy and its backends raise anything
        reason = " ".join(str(error).split())[:200]
        raise ValueError(f"no readable .las or .laz, truncated? ({reason or type(error).__name__})") from None


def _require_possible_counts(content: bytes) -> None:
    """Raise ValueError for more records or points than the bytes can hold. Source: LAS 1.4 R15, table 3."""
    if len(content) < 227 or not content.startswith(b"LASF"):
        raise ValueError("no header LASF")
    (num_points,) = struct.unpack_from("<I", content, 107)
    counts = {"VLRs": struct.unpack_from("<I", content, 100)[0]}
    if content[25] >= 4 and len(content) >= 375:
        counts["EVLRs"] = struct.unpack_from("<I", content, 243)[0]
        num_points = max(num_points, struct.unpack_from("<Q", content, 247)[0])
    for name, count in counts.items():
        if count * _MIN_RECORD[name] > len(content):
            raise ValueError(f"{count} {name} in {len(content)} bytes")
    if num_points > _MAX_POINTS_A_BYTE * len(content):
        raise ValueError(f"{num_points} points in {len(content)} bytes")
