"""When sweeps were taken: told by their names, or by a file of times."""

import re
from bisect import bisect_left
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import PurePosixPath
from typing import Final

import numpy as np

from labeling.readers.folder.description import NANOSECONDS, Stamps, TimeUnit
from labeling.readers.folder.text import TIME_NAMES, Row, Table, time_ns, unit_of
from schemas.arrays import Int64Array
from schemas.errors import InvalidInput

_MIN_DIGITS_OF_STAMP: Final = 12  # of one number: milliseconds since 1970 have 13
_SECONDS: Final = re.compile(r"(?<!\d)(\d{9,10})[._-](\d{1,9})(?!\d)")
_NUMBER: Final = re.compile(r"\d+")
_NAME_COLUMNS: Final = ("file", "filename", "file_name", "name", "sweep", "frame", "index", "id")


@dataclass(frozen=True, slots=True)
class TimedSweeps:
    """The sweeps of a folder in the order of time."""

    names: tuple[str, ...]
    timestamps_ns: Int64Array  # (T,) strictly ascending
    faults: dict[int, str]  # why some have no time stamp of their own; the one they have lies between their neighbours'


def stem_of(name: str) -> str:
    """Return a file's name without folder and format; ``.pcd.bin`` is one format."""
    return PurePosixPath(name).name.rpartition(".")[0].removesuffix(".pcd")


def count_of(name: str) -> int | None:
    """Return the last number in a name, which counts files where it is no time."""
    numbers = _NUMBER.findall(stem_of(name))
    return int(numbers[-1]) if numbers and len(numbers[-1]) <= 18 else None


def in_order(names: Sequence[str]) -> list[str]:
    """Return names in the order of the numbers in them: 2 before 10."""
    return sorted(names, key=lambda name: ([int(part) for part in _NUMBER.findall(stem_of(name))], name))


def stamp_in_name(name: str) -> int | None:
    """Return the time since 1970 that a name ends with, in ns; None when its last number is none."""
    stem = stem_of(name)
    seconds = list(_SECONDS.finditer(stem))
    if seconds and seconds[-1].end() == len(stem):
        whole, part = seconds[-1].groups()
        is_nanoseconds = stem[seconds[-1].end(1)] != "."  # 1700000000_5 is 5 ns after, 1700000000.5 half a second
        return int(whole) * 10**9 + int(part if is_nanoseconds else part.ljust(9, "0"))
    numbers = _NUMBER.findall(stem)
    if not numbers or len(numbers[-1]) < _MIN_DIGITS_OF_STAMP:
        return None
    stamp_ns = int(numbers[-1]) * NANOSECONDS[unit_of(numbers[-1])]
    return stamp_ns if stamp_ns < 2**63 else None


def stamps_of_names(names: Sequence[str], rate_hz: float | None, place: str) -> TimedSweeps:
    """Return sweeps by the times in their names, or by their count at a given rate.

    Raises:
        InvalidInput: Names say neither, or two the same.

    """
    stamps: list[int | None] = [None if rate_hz is not None else stamp_in_name(name) for name in names]
    if None in stamps:
        counts = [count_of(name) for name in names]
        if rate_hz is None or None in counts:
            odd = names[stamps.index(None)]
            raise InvalidInput(
                f"{place}/{odd}: no time in its name: name sweeps by time, or put a file timestamps.txt beside, or "
                "say `rate_hz` in motionlabel.yaml for numbered ones"
            )
        stamps = [round((count or 0) * 1e9 / rate_hz) for count in counts]
    known = sorted(zip((stamp or 0 for stamp in stamps), names, strict=True))
    for (stamp, name), (following, other) in pairwise(known):
        if stamp == following:
            raise InvalidInput(f"{place}/{other}: same time stamp as {name}")
    return TimedSweeps(tuple(name for _, name in known), np.array([stamp for stamp, _ in known], np.int64), {})


def stamps_of_table(names: Sequence[str], table: Table, stamps: Stamps) -> TimedSweeps:
    """Return sweeps, in the order of their names, by rows with times: one a sweep, or each with a sweep's name.

    A sweep whose time is missing, broken or out of order is at fault, alone.

    Raises:
        InvalidInput: Rows do not fit the sweeps.

    """
    column = _time_column(table)
    by_name = _rows_by_name(names, table)
    if by_name is not None:
        rows: list[Row | None] = [by_name.get(name) for name in names]
    else:
        positions = rows_of_sweeps(len(table.rows), names, table.place, "times")
        rows = [table.rows[position] for position in positions]
    unit = stamps.unit or _unit(table, column)
    found: list[int | None] = []
    faults: dict[int, str] = {}
    for index, row in enumerate(rows):
        found.append(None)
        if row is None:
            faults[index] = f"{table.place}: no line of {names[index]}, so the sweep has no time stamp"
            continue
        try:
            found[-1] = time_ns(row.cells[column], unit)
        except (ValueError, IndexError) as error:
            faults[index] = f"{table.where(row)}: {error if isinstance(error, ValueError) else 'no time in it'}"
    if by_name is not None:
        return _sorted_by_time(names, found, rows, faults, table)
    for index in _out_of_order(found):
        row = rows[index]
        assert row is not None
        faults[index] = f"{table.where(row)}: not after the time stamps before it, or after those that follow"
    return TimedSweeps(tuple(names), _filled(found, faults, table.place), faults)


def rows_of_sweeps(num_rows: int, names: Sequence[str], place: str, what: str) -> list[int]:
    """Return which row is whose: one a sweep, in order; or, where files are missing, the one that its number counts.

    Raises:
        InvalidInput: Neither fits.

    """
    if num_rows == len(names):
        return list(range(num_rows))
    counts = [count_of(name) for name in names]
    known = [count for count in counts if count is not None]
    if len(set(known)) == len(names) and min(known) >= 0 and max(known) < num_rows:
        return known
    raise InvalidInput(
        f"{place}: {num_rows} {what} for {len(names)} sweeps, {names[0]} to {names[-1]}: expected one a sweep, or one "
        "for each number from 0 on; of another recording, or cut off?"
    )


def _time_column(table: Table) -> int:
    named = table.column(*TIME_NAMES)
    if named is not None:
        return named
    width = len(table.rows[0].cells)
    if table.names and width > 2:
        raise InvalidInput(f"{table.place}: no column {' or '.join(TIME_NAMES[:3])}; it has {', '.join(table.names)}")
    return width - 1  # a time alone, or after a name


def _unit(table: Table, column: int) -> TimeUnit:
    return unit_of(table.rows[0].cells[column], table.names[column] if table.names else "")


def _rows_by_name(names: Sequence[str], table: Table) -> dict[str, Row] | None:
    """Return the row of each sweep that is named in one; None when rows name no sweeps."""
    if len(table.rows[0].cells) < 2:
        return None
    column = table.column(*_NAME_COLUMNS) or 0
    keys = {stem_of(name): name for name in names} | {PurePosixPath(name).name: name for name in names}
    keys |= {name: name for name in names}
    numbers = {count_of(name): name for name in names if stem_of(name).isdecimal()}
    found: dict[str, Row] = {}
    for row in table.rows:
        cell = row.cells[column] if column < len(row.cells) else ""
        name = keys.get(cell) or (numbers.get(int(cell)) if cell.isdecimal() and len(cell) <= 18 else None)
        if name is not None:
            found[name] = row
    return found or None


def _sorted_by_time(
    names: Sequence[str], found: list[int | None], rows: list[Row | None], faults: dict[int, str], table: Table
) -> TimedSweeps:
    """Put named sweeps in the order of their times; one of a time that another has is at fault."""
    first: dict[int, str] = {}
    for index, stamp in enumerate(found):
        if stamp is not None and first.setdefault(stamp, names[index]) != names[index]:
            row = rows[index]
            assert row is not None
            faults[index], found[index] = f"{table.where(row)}: same time stamp as {first[stamp]}", None
    lacking = [index for index, stamp in enumerate(found) if stamp is None]
    order = sorted((k for k in range(len(names)) if k not in lacking), key=lambda k: found[k] or 0)
    for index in lacking:  # behind the one whose name is before its own
        before = [position for position, k in enumerate(order) if k < index]
        order.insert(before[-1] + 1 if before else 0, index)
    stamps_ns = _filled([found[k] for k in order], faults, table.place)
    moved = {order.index(k): reason for k, reason in faults.items()}
    return TimedSweeps(tuple(names[k] for k in order), stamps_ns, moved)


def _out_of_order(found: list[int | None]) -> list[int]:
    """Return the fewest positions without which the times ascend."""
    last_of_length: list[int] = []  # position of the least time at which an ascending run of each length ends
    before: dict[int, int | None] = {}
    for index, stamp in enumerate(found):
        if stamp is None:
            continue
        length = bisect_left([found[k] or 0 for k in last_of_length], stamp)
        if length < len(last_of_length) and found[last_of_length[length]] == stamp:
            continue  # the first of two equal ones is believed
        before[index] = last_of_length[length - 1] if length else None
        last_of_length[length : length + 1] = [index]
    kept: set[int] = set()
    index_or_none = last_of_length[-1] if last_of_length else None
    while index_or_none is not None:
        kept.add(index_or_none)
        index_or_none = before[index_or_none]
    return [index for index, stamp in enumerate(found) if stamp is not None and index not in kept]


def _filled(found: list[int | None], faults: dict[int, str], place: str) -> Int64Array:
    """Return times that ascend: of a sweep at fault, one between its neighbours'."""
    known = [index for index in range(len(found)) if index not in faults]
    if not known:
        raise InvalidInput(f"{place}: no time stamp of any sweep: {next(iter(faults.values()))}")
    known_ns = [found[index] or 0 for index in known]
    gap_ns = int(np.median(np.diff(known_ns))) if len(known) > 1 else 10**8
    stamps = []
    for index in range(len(found)):
        after = bisect_left(known, index)
        if after < len(known) and known[after] == index:
            stamps.append(known_ns[after])
        elif after == 0:
            stamps.append(known_ns[0] - (known[0] - index) * gap_ns)
        elif after == len(known):
            stamps.append(known_ns[-1] + (index - known[-1]) * gap_ns)
        else:
            left, right = known[after - 1], known[after]
            step_ns = (known_ns[after] - known_ns[after - 1]) // (right - left)
            stamps.append(known_ns[after - 1] + (index - left) * step_ns)
    return np.array(stamps, dtype=np.int64)
