"""Plain text tables."""

from __future__ import annotations

import math
from collections.abc import Sequence


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
