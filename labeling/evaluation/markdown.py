"""Aligned Markdown tables and the form of their numbers. None is a dash."""

from collections.abc import Sequence
from math import degrees

Row = Sequence[str]


def render_rows(title: str, header: str, rows: Sequence[Row]) -> str:
    """Return an aligned Markdown table, first column left, others right; nothing without rows."""
    if not rows:
        return ""
    cells = [[cell.strip() for cell in header.split("|")], *rows]
    widths = [max(len(row[column]) for row in cells) for column in range(len(cells[0]))]
    rule = ["-" * widths[0], *("-" * (width - 1) + ":" for width in widths[1:])]
    lines = []
    for row in (cells[0], rule, *rows):
        padded = [
            row[0].ljust(widths[0]),
            *(cell.rjust(width) for cell, width in zip(row[1:], widths[1:], strict=True)),
        ]
        lines.append(f"| {' | '.join(padded)} |")
    return "\n".join([f"**{title}**", "", *lines])


def format_number(value: float | None) -> str:
    """Write three decimals."""
    return "-" if value is None else f"{value:.3f}"


def format_percent(value: float | None) -> str:
    """Write a share in percent."""
    return "-" if value is None else f"{100 * value:.1f}"


def format_degrees(value: float | None) -> str:
    """Write radians in degrees."""
    return "-" if value is None else f"{degrees(value):.1f}"


def format_interval(bounds: tuple[float, float] | None) -> str:
    """Write an interval of shares in percent."""
    return "-" if bounds is None else f"{100 * bounds[0]:.0f}-{100 * bounds[1]:.0f}"
