"""Point Cloud Library files: ascii, binary, and binary_compressed, whose columns are LZF-compressed one after another.

Parsed here because they come as bytes, from a disk or a bucket: the libraries that know them open paths only.
"""

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

_TYPES: Final = {
    ("F", 4): "<f4", ("F", 8): "<f8",
    ("I", 1): "<i1", ("I", 2): "<i2", ("I", 4): "<i4", ("I", 8): "<i8",
    ("U", 1): "<u1", ("U", 2): "<u2", ("U", 4): "<u4", ("U", 8): "<u8",
}  # fmt: skip
_MAX_HEADER: Final = 1 << 16


@dataclass(frozen=True, slots=True)
class _Field:
    name: str
    dtype: np.dtype[Any]
    count: int  # numbers a point; 0 and more for padding


def read_pcd(content: bytes, wanted: Sequence[str]) -> dict[str, NDArray[Any]]:
    """Return those of the wanted columns that a file has; raise ValueError when it is broken."""
    header, start = _read_header(content)
    fields, num_points = _fields_of(header), _num_points(header)
    kind = header["DATA"][0].lower()
    if kind == "ascii":
        return _read_ascii(content[start:], fields, num_points, wanted)
    if kind == "binary":
        return _read_rows(content[start:], fields, num_points, wanted)
    if kind == "binary_compressed":
        return _read_compressed(content[start:], fields, num_points, wanted)
    raise ValueError(f"DATA {kind}: expected ascii, binary or binary_compressed")


def _read_header(content: bytes) -> tuple[dict[str, list[str]], int]:
    end = re.search(rb"^DATA[ \t]+\S+[ \t]*\r?\n", content[:_MAX_HEADER], re.MULTILINE)
    if end is None:
        raise ValueError("no .pcd header: expected lines FIELDS, SIZE, TYPE, ..., DATA")
    lines = content[: end.end()].decode("ascii", errors="replace").splitlines()
    header = {words[0]: words[1:] for line in lines if (words := line.split()) and not line.startswith("#")}
    missing = [key for key in ("FIELDS", "SIZE", "TYPE") if not header.get(key)]
    if missing:
        raise ValueError(f".pcd header without {', '.join(missing)}")
    return header, end.end()


def _fields_of(header: dict[str, list[str]]) -> list[_Field]:
    names = header["FIELDS"]
    counts = header.get("COUNT", ["1"] * len(names))
    try:
        rows = list(zip(names, header["SIZE"], header["TYPE"], counts, strict=True))
        fields = [_Field(name, np.dtype(_TYPES[kind, int(size)]), int(count)) for name, size, kind, count in rows]
    except (KeyError, ValueError):
        fields = []
    if not fields or min(field.count for field in fields) < 0:
        raise ValueError("FIELDS, SIZE, TYPE and COUNT of the .pcd header do not fit each other")
    return fields


def _num_points(header: dict[str, list[str]]) -> int:
    try:
        sizes = header["POINTS"][:1] if "POINTS" in header else header["WIDTH"][:1] + header["HEIGHT"][:1]
        num_points = math.prod(int(size) for size in sizes)
    except (KeyError, ValueError):
        num_points = -1
    if num_points < 0:
        raise ValueError(".pcd header without a number of POINTS")
    return num_points


def _read_ascii(
    content: bytes, fields: list[_Field], num_points: int, wanted: Sequence[str]
) -> dict[str, NDArray[Any]]:
    numbers = np.array(content.split(), dtype=np.float64)
    width = sum(field.count for field in fields)
    if len(numbers) != num_points * width:
        raise ValueError(f"{len(numbers)} numbers, expected {num_points} points of {width}: truncated?")
    table, column, columns = numbers.reshape(num_points, width), 0, {}
    for field in fields:
        if field.name in wanted and field.count:
            columns[field.name] = table[:, column]
        column += field.count
    return columns


def _read_rows(content: bytes, fields: list[_Field], num_points: int, wanted: Sequence[str]) -> dict[str, NDArray[Any]]:
    stride = sum(field.dtype.itemsize * field.count for field in fields)
    if len(content) < num_points * stride:
        raise ValueError(f"{len(content)} bytes, expected {num_points} points of {stride}: truncated?")
    offset, columns = 0, {}
    for field in fields:
        if field.name in wanted and field.count:
            shape, strides = (num_points,), (stride,)
            columns[field.name] = np.ndarray(shape, field.dtype, content, offset, strides)
        offset += field.dtype.itemsize * field.count
    return columns


def _read_compressed(
    content: bytes, fields: list[_Field], num_points: int, wanted: Sequence[str]
) -> dict[str, NDArray[Any]]:
    stride = sum(field.dtype.itemsize * field.count for field in fields)
    if len(content) < 8:
        raise ValueError("no sizes before the compressed points: truncated?")
    compressed, whole = (int(size) for size in np.frombuffer(content, dtype="<u4", count=2))
    if len(content) < 8 + compressed:
        raise ValueError(f"{len(content) - 8} compressed bytes, expected {compressed}: truncated?")
    if whole < num_points * stride:
        raise ValueError(f"compressed points have {whole} bytes, expected {num_points} of {stride}")
    data, offset, columns = decompress_lzf(content[8 : 8 + compressed], whole), 0, {}
    for field in fields:
        if field.name in wanted and field.count:
            numbers = np.frombuffer(data, field.dtype, num_points * field.count, offset)
            columns[field.name] = numbers.reshape(num_points, field.count)[:, 0]
        offset += field.dtype.itemsize * field.count * num_points
    return columns


def decompress_lzf(compressed: bytes, size: int) -> bytes:
    """Return ``size`` bytes: runs of up to 32 as they are, and copies of earlier ones. Source: LibLZF, lzf_d.c."""
    found, position, end = bytearray(), 0, len(compressed)
    try:
        while position < end:
            control = compressed[position]
            position += 1
            if control < 32:
                found += compressed[position : position + control + 1]
                position += control + 1
                continue
            length = control >> 5
            if length == 7:
                length += compressed[position]
                position += 1
            back = ((control & 31) << 8) + compressed[position] + 1
            position += 1
            begin, length = len(found) - back, length + 2
            if begin < 0:
                raise ValueError("compressed points are broken: a copy of what is before their beginning")
            while length > back:  # it overlaps with what it makes
                found += found[begin : begin + back]
                length -= back
            found += found[begin : begin + length]
            if len(found) > size:
                break
    except IndexError:
        raise ValueError("compressed points end too early: truncated?") from None
    if len(found) != size:
        raise ValueError(f"compressed points have {len(found)} bytes, expected {size}")
    return bytes(found)
