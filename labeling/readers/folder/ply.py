"""Polygon files: element ``vertex`` of .ply, ascii and binary. Parsed here for the reason that .pcd is."""

import re
from collections.abc import Sequence
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

_TYPES: Final = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1", "short": "i2", "int16": "i2", "ushort": "u2",
    "uint16": "u2", "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4", "float": "f4", "float32": "f4",
    "double": "f8", "float64": "f8",
}  # fmt: skip
_ORDERS: Final = {"binary_little_endian": "<", "binary_big_endian": ">", "ascii": "<"}
_MAX_HEADER: Final = 1 << 16


def read_ply(content: bytes, wanted: Sequence[str]) -> dict[str, NDArray[Any]]:
    """Return those of the wanted properties that the vertices have; raise ValueError when the file is broken."""
    end = re.search(rb"^end_header[ \t]*\r?\n", content[:_MAX_HEADER], re.MULTILINE)
    if not content.startswith(b"ply") or end is None:
        raise ValueError("no .ply header: expected lines ply, format, element vertex, ..., end_header")
    kind, num_points, dtype = _read_header(content[: end.end()].decode("ascii", errors="replace").splitlines())
    properties = list(dtype.names or ())
    names = [name for name in wanted if name in properties]
    body = content[end.end() :]
    if kind == "ascii":
        size = num_points * len(properties)
        numbers = np.array(body.split(maxsplit=size)[:size], dtype=np.float64)
        if len(numbers) < size:
            raise ValueError(f"{len(numbers)} numbers, expected {num_points} points of {len(properties)}: truncated?")
        table = numbers.reshape(num_points, len(properties))
        return {name: table[:, properties.index(name)] for name in names}
    if len(body) < num_points * dtype.itemsize:
        raise ValueError(f"{len(body)} bytes, expected {num_points} points of {dtype.itemsize}: truncated?")
    vertices = np.frombuffer(body, dtype, num_points)
    return {name: vertices[name] for name in names}


def _read_header(lines: list[str]) -> tuple[str, int, np.dtype[Any]]:
    """Return the format, and number and type of the vertices, which have to be the first element."""
    kind = ""
    elements: list[tuple[str, int]] = []
    properties: list[tuple[str, str]] = []
    for words in map(str.split, lines):
        if words[:1] == ["format"] and len(words) > 1:
            kind = words[1]
        elif words[:1] == ["element"] and len(words) == 3 and words[2].isdecimal():
            elements.append((words[1], int(words[2])))
        elif words[:1] == ["property"] and len(elements) == 1:
            if len(words) != 3 or words[1] not in _TYPES:
                raise ValueError(f"property of vertex not understood: {' '.join(words)}")
            properties.append((words[2], words[1]))
    if kind not in _ORDERS:
        raise ValueError(f"format {kind or 'missing'}: expected {', '.join(_ORDERS)}")
    if not elements or elements[0][0] != "vertex" or not properties:
        raise ValueError("no points: the first element of a .ply has to be vertex, with properties x, y, z")
    try:
        return kind, elements[0][1], np.dtype([(name, _ORDERS[kind] + _TYPES[word]) for name, word in properties])
    except ValueError:
        raise ValueError("two properties of vertex have the same name") from None
