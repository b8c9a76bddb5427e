"""Tables as plain text and, for notebooks, as HTML."""

from __future__ import annotations

import html
import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

from .column import COUNTED, REPORTED, Column


def format_number(value: float, digits: int = 4) -> str:
    """Four significant digits; '-' for what is not a number."""
    if not math.isfinite(value):
        return "-"
    if value == 0.0:
        return "0"
    if abs(value) < 10.0**-digits or abs(value) >= 10.0 ** (digits + 2):
        return f"{value:.{digits - 2}e}"
    decimals = max(0, digits - 1 - math.floor(math.log10(abs(value))))
    return f"{value:.{min(decimals, digits)}f}"


def format_table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Columns aligned: the first to the left, the others to the right."""
    widths = [max(len(row[i]) for row in (header, *rows)) for i in range(len(header))]

    def line(cells: Sequence[str]) -> str:
        others = zip(cells[1:], widths[1:], strict=True)
        return "  ".join([cells[0].ljust(widths[0]), *(cell.rjust(width) for cell, width in others)])

    rule = "  ".join("-" * width for width in widths)
    return "\n".join([line(header), rule, *map(line, rows)])


class Table(NamedTuple):
    """A table with what is said above and below it."""

    before: tuple[str, ...]  # lines; the first is the title
    header: Sequence[str]
    rows: Sequence[Sequence[str]]
    after: tuple[str, ...] = ()

    def __str__(self) -> str:
        return "\n".join([*self.before, format_table(self.header, self.rows), *self.after])

    def html(self) -> str:
        """The same for a notebook, which brings its own style."""

        def cells(kind: str, row: Sequence[str]) -> str:
            aligned = (f' style="text-align: {"left" if i == 0 else "right"}"' for i in range(len(row)))
            return "".join(
                f"<{kind}{style}>{html.escape(cell)}</{kind}>"
                for style, cell in zip(aligned, row, strict=True)
            )

        body = "".join(f"<tr>{cells('td', row)}</tr>" for row in self.rows)
        above, below = (
            "".join(f"<div>{html.escape(line)}</div>" for line in lines)
            for lines in (self.before[1:], self.after)
        )
        return (
            f"<div><strong>{html.escape(self.before[0])}</strong></div>{above}"
            f"<table><thead><tr>{cells('th', self.header)}</tr></thead><tbody>{body}</tbody></table>{below}"
        )


def printed_table(
    rows: Sequence[Mapping[str, Any]], columns: Sequence[Column], base: str, *, drop_empty: bool = False
) -> Table:
    """Columns of rows as they are printed, with nothing above and below.

    A number with an interval, `<name>_low` and `<name>_high`, has it in brackets.

    Args:
        rows: Column name -> number, all rows of the same columns.
        columns: That may stand in it; those without a printed heading, or that no row has, do not.
        base: Title of the policy of the differences.
        drop_empty: Whether to leave out columns without any number, which mean nothing here.
    """
    kept = [
        column
        for column in columns
        if column.printed
        and column.name in rows[0]
        and not (
            (drop_empty or column.has(REPORTED)) and not any(math.isfinite(row[column.name]) for row in rows)
        )
    ]
    header = [column.heading.format(base=base) for column in kept]
    return Table((), header, [[_cell(row, column) for column in kept] for row in rows])


def _cell(row: Mapping[str, Any], column: Column) -> str:
    value, low = row[column.name], f"{column.name}_low"
    if column.has(COUNTED):
        return str(value)
    if low not in row or not math.isfinite(row[low]):
        return format_number(column.factor * value)
    numbers = (value, row[low], row[f"{column.name}_high"])
    return said_interval(*(column.factor * number for number in numbers))


def said_interval(value: float, low: float, high: float, unit: str = "") -> str:
    """A number with the ends of its interval in brackets, '-' where there is none."""
    text = f"{format_number(value)} {unit}".rstrip()
    return f"{text} [{format_number(low, 3)}, {format_number(high, 3)}]"
