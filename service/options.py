"""Arguments and options that several commands share, and how their text is read."""

import json
import math
from pathlib import Path
from typing import Annotated, Any

import typer

from labeling.readers.reader import READERS
from labeling.storage import places
from schemas.config import PLACES, PROFILES
from schemas.errors import InvalidInput, shorten


def refuse_empty_output(output: str) -> str:
    """Refuse what a variable that is not set leaves of an option: it would be the folder that one stands in."""
    if not output:
        raise InvalidInput("--output is empty: expected a path or s3://bucket/prefix, or . for this folder")
    return output


Segments = Annotated[
    list[str],
    typer.Argument(
        metavar="SEGMENT",
        help="Folder of one log or drive, or s3://bucket/prefix; or synthetic:street?sweeps=20&seed=1.",
    ),
]
Segment = Annotated[str, typer.Argument(metavar="SEGMENT", help="The segment, as it was given to `label`.")]
Dataset = Annotated[str, typer.Option(metavar="NAME", help=f"Data set: {', '.join(READERS)}.")]
Output = Annotated[
    str,
    typer.Option(
        metavar="OUT", help="Label folder to write: a path or s3://bucket/prefix.", callback=refuse_empty_output
    ),
]
OutputFolder = Annotated[
    str,
    typer.Option(
        "--output", metavar="DIR", help="Folder to write: a path or s3://bucket/prefix.", callback=refuse_empty_output
    ),
]
MinTrackScore = Annotated[
    float | None,
    typer.Option(
        "--min-score",
        metavar="S",
        help="Leave out tracks whose boxes score less on average; by default what the labels recommend.",
    ),
]
Profile = Annotated[str, typer.Option(metavar="NAME", help=f"Parameters: {', '.join(PROFILES)}.")]
Overrides = Annotated[
    list[str] | None,
    typer.Option("--set", metavar="KEY=VALUE", help="Override a parameter, as flow.iterations=80. Repeatable."),
]
Sweeps = Annotated[
    str | None, typer.Option(metavar="START:STOP", help="Label these sweeps only; STOP is not included.")
]
Points = Annotated[bool, typer.Option("--points", help="Also write flow, cluster and track of each point.")]
LabelsAt = Annotated[str, typer.Argument(metavar="OUT", help="Label folder: a path or s3://bucket/prefix.")]


def parse_overrides(pairs: list[str]) -> dict[str, Any]:  # values are checked by the config
    """Read the pairs of ``--set``: a value is JSON where it can be, else text."""
    values: dict[str, Any] = {}
    for pair in pairs:
        key, is_pair, text = pair.partition("=")
        if not is_pair or not key:
            raise InvalidInput(f"--set {shorten(pair)}: expected KEY=VALUE, as --set flow.iterations=80")
        if key in ("profile", "sweeps", "write_points"):
            option = "points" if key == "write_points" else key
            raise InvalidInput(f"--set {pair}: use the option --{option} instead")
        try:
            values[key] = json.loads(text, parse_constant=_refuse_number, parse_float=_finite)
        except (ValueError, RecursionError):
            values[key] = places.absolute(text) if key in PLACES else text
    return values


def _refuse_number(text: str) -> float:
    raise ValueError(f"{text} is no number of JSON")  # it travels as text, and the config refuses it by name


def _finite(text: str) -> float:
    return number if math.isfinite(number := float(text)) else _refuse_number(text)


def parse_sweeps(text: str) -> tuple[int, int]:
    """Read the half-open range of ``--sweeps``."""
    start, _, stop = text.partition(":")
    if not (start.isdecimal() and stop.isdecimal() and int(start) < int(stop)):
        raise InvalidInput(f"--sweeps {text}: expected START:STOP with START below STOP, as --sweeps 0:50")
    return int(start), int(stop)


def require_folder_of(option: str, path: Path | None) -> None:
    """Refuse a file to write, before the work, when the folder it would stand in is missing."""
    if path is not None and not path.absolute().parent.is_dir():
        raise InvalidInput(f"{option} {path}: no folder {path.absolute().parent}")
