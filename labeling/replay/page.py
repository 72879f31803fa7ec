"""The page itself: one file that holds its scripts, its style and its data, and asks for nothing else.

Its policy lets two scripts and one style run, by their hashes, and nothing load. What users named is in blocks of JSON,
where no text ends a block, and the script shows it as text.
"""

import base64
import hashlib
import json
import secrets
from collections.abc import Callable
from importlib.resources import files
from pathlib import Path
from typing import BinaryIO, Final

import numpy as np

from labeling.exporters.segments import SegmentLabels
from labeling.readers.reader import SegmentReader
from labeling.replay.payload import MAX_POINTS, Json, describe, read_sweeps
from labeling.replay.points import encode
from schemas.arrays import Float64Array
from schemas.errors import InvalidInput

HEIGHT_PERCENTILES: Final = (2, 98)  # of the first sweep: the ends of the colours of height

_STATIC: Final = files("labeling.replay") / "static"
_SCRIPTS: Final = ("data.js", "colours.js", "scene.js", "control.js")  # one after the other, in one scope


def write_replay(
    path: Path,
    segment: SegmentLabels,
    reader: SegmentReader,
    *,
    max_points: int = MAX_POINTS,
    with_truth: bool = False,
    on_sweep: Callable[[int], None] | None = None,
) -> Json:
    """Write the page, whole or not at all, and return what it tells of the segment. One sweep is in memory at a time.

    Raises:
        InvalidInput: As ``read_sweeps``, or ``path`` cannot be written.
        UnreadableSweep: A sweep cannot be read now.

    """
    if path.is_dir():
        raise InvalidInput(f"cannot write the page {path}: it is a folder")
    temporary = path.with_name(f".{secrets.token_hex(8)}.tmp")
    try:
        with temporary.open("xb") as file:
            told = _write(file, segment, reader, max_points, with_truth, on_sweep or (lambda num_done: None))
        temporary.replace(path)
    except OSError as error:
        raise InvalidInput(f"cannot write the page {path}: {error.strerror or error}") from None
    finally:
        temporary.unlink(missing_ok=True)
    return told


def _write(
    file: BinaryIO,
    segment: SegmentLabels,
    reader: SegmentReader,
    max_points: int,
    with_truth: bool,
    on_sweep: Callable[[int], None],
) -> Json:
    before, after = _shell().split("<!-- sweeps -->\n")
    headers: list[Json] = []
    height_m = (0.0, 1.0)
    for sweep in read_sweeps(segment, reader, max_points=max_points, with_truth=with_truth):
        if not headers:
            file.write(before.encode())
            height_m = _ends_of_height(sweep.points.points_ego)
        block = base64.b64encode(encode(sweep.points))
        file.write(b'<script type="text/plain" class="sweep">%b</script>\n' % block)
        headers.append(sweep.header())
        on_sweep(len(headers))
    told = describe(segment, headers, height_m)
    file.write(after.replace("<!-- data -->", _json_block(told)).encode())
    return told


def _ends_of_height(points_ego: Float64Array) -> tuple[float, float]:
    if len(points_ego) == 0:
        return 0.0, 1.0
    low, high = np.percentile(points_ego[:, 2], HEIGHT_PERCENTILES).tolist()
    return low, max(high, low + 1.0)


def _shell() -> str:
    """Return the page without its data."""
    library, style = _read("three.min.js"), _read("replay.css")
    script = '"use strict";\n(() => {\n' + "\n".join(map(_read, _SCRIPTS)) + "})();\n"
    policy = (
        f"default-src 'none'; script-src {_hash(library)} {_hash(script)}; style-src {_hash(style)}; "
        "base-uri 'none'; form-action 'none'"
    )
    page = _read("replay.html").replace("<!-- policy -->", policy)
    for name, content in (("style", style), ("library", library), ("script", script)):
        page = page.replace(f"<!-- {name} -->", content)
    return page


def _json_block(values: Json) -> str:
    """Return JSON in which no text can end the block that it stands in, or begin a comment."""
    return json.dumps(values, separators=(",", ":"), allow_nan=False).replace("<", "\\u003c")


def _read(name: str) -> str:
    return (_STATIC / name).read_text(encoding="utf-8")


def _hash(content: str) -> str:
    return f"'sha256-{base64.b64encode(hashlib.sha256(content.encode()).digest()).decode()}'"
