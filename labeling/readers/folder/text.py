"""Text files of numbers: rows of cells, with or without names of columns, and times of any unit."""

import csv
import re
from dataclasses import dataclass
from decimal import Decimal, InvalidOperation
from typing import Final

import numpy as np

from labeling.readers.folder.description import NANOSECONDS, TimeUnit
from schemas.errors import InvalidInput, quote

TIME_NAMES: Final = ("timestamp_ns", "timestamp", "time", "stamp", "t", "time_ns", "time_s", "timestamp_s", "stamp_ns")
_DATE: Final = re.compile(r"\d{4}-\d\d-\d\d[ T]\d\d:\d\d:\d\d(\.\d{1,9})?")
_NAME: Final = re.compile(r"(?!(nan|inf)\b)[a-z_]", re.IGNORECASE)  # of a column
_MAX_NS: Final = 2**63 - 1


@dataclass(frozen=True, slots=True)
class Row:
    """One line that is not blank."""

    number: int  # in the file, from 1 on
    cells: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class Table:
    """The rows of a text file, and the lower-case names of its columns where the first line has some."""

    place: str
    rows: tuple[Row, ...]
    names: tuple[str, ...] = ()

    def column(self, *names: str) -> int | None:
        """Return the position of the first of these names that there is."""
        return next((self.names.index(name) for name in names if name in self.names), None)

    def where(self, row: Row) -> str:
        """Return place and line, to begin a message with."""
        return f"{self.place}: line {row.number}"


def parse_table(content: bytes, place: str) -> Table:
    """Return the lines of a text file as cells: between commas or semicolons, else between blanks.

    Blank lines and those that begin with ``#`` are skipped; one of names only, at the top, names the columns. A date
    and a time are one cell.

    Raises:
        InvalidInput: There are no rows.

    """
    names: tuple[str, ...] = ()
    rows: list[Row] = []
    for number, line in enumerate(content.decode("utf-8-sig", errors="replace").splitlines(), start=1):
        text = line.strip()
        if not text:
            continue
        is_comment = text.startswith("#")
        try:
            cells = _cells(text.lstrip("# "))
        except csv.Error as error:
            raise InvalidInput(f"{place}: line {number}: no row of cells: {error}") from None
        is_header = not rows and all(_NAME.match(cell) for cell in cells)
        if is_header and (len(cells) > 1 or not is_comment):
            names = tuple(cell.lower() for cell in cells)  # the last such line, for words may stand above it
        elif not is_comment and not is_header:
            rows.append(Row(number, cells))
    if not rows:
        raise InvalidInput(f"{place}: no rows")
    return Table(place, tuple(rows), names if len(names) == len(rows[0].cells) else ())


def _cells(text: str) -> tuple[str, ...]:
    separator = "," if "," in text else ";" if ";" in text else None
    if separator is None:
        return tuple(_DATE.sub(lambda date: date[0].replace(" ", "T"), text).split())
    (cells,) = csv.reader([text], delimiter=separator, skipinitialspace=True)
    return tuple(cell.strip() for cell in cells)


def unit_of(cell: str, name: str = "") -> TimeUnit:
    """Tell the unit of a time by its column's name, or else by its size: since 1970, or seconds."""
    suffix = name.rpartition("_")[2]
    if suffix in NANOSECONDS:
        return suffix  # type: ignore[return-value]
    digits = len(cell.lstrip("+-0"))
    if not cell.lstrip("+-").isdecimal() or digits < 12:
        return "s"
    return "ms" if digits < 15 else "us" if digits < 18 else "ns"


def time_ns(cell: str, unit: TimeUnit) -> int:
    """Return a time as whole nanoseconds, exactly; a date is UTC. Raise ValueError for what is none."""
    if _DATE.fullmatch(cell):
        return int(np.datetime64(cell, "ns").astype(np.int64))
    try:
        time = Decimal(cell)
    except InvalidOperation:
        time = Decimal("NaN")
    if not time.is_finite() or abs(time) * NANOSECONDS[unit] > _MAX_NS:
        raise ValueError(f"expected a time, got {quote(cell)}")
    return int((time * NANOSECONDS[unit]).to_integral_value())
