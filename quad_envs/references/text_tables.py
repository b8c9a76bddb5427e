"""Tables as other programs write them: a text file becomes a header and rows of cells with their lines.

Cells are separated by semicolons, tabs, commas or white space, which the header and the first line of numbers
show by themselves. Blank lines are left out, and so are those that begin with # or %; the last of these that
reads like a header is one, as TUM trajectories and `numpy.savetxt` have it. In tables with semicolons or tabs
the decimal sign may be a comma.
"""

from __future__ import annotations

import codecs
import csv
import re
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

_COMMENT = ("#", "%")
_MOST_BYTES = 256 * 2**20
_NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+|\d*,\d+)(e[+-]?\d+)?|[+-]?(nan|inf|infinity)", re.IGNORECASE)


class TextTable(NamedTuple):
    """What a file says, still as text."""

    header: list[str]  # empty where there is none
    lines: list[int]  # number of each row's line, from 1
    rows: list[list[str]]


def read_text_table(path: Path, is_header: Callable[[Sequence[str]], bool]) -> TextTable:
    """The cells of a file.

    Args:
        path: The file.
        is_header: Whether names that stand in a comment are those of columns.

    Raises:
        OSError: If the file cannot be read.
        ValueError: If it is no text or its quotes are broken; the message names the line.
    """
    numbered = [(i, line.strip()) for i, line in enumerate(re.split(r"\r\n|\r|\n", _text(path)), 1)]
    comments = [line.lstrip("#% \t") for _, line in numbered if line.startswith(_COMMENT)]
    content = [(i, line) for i, line in numbered if line and not line.startswith(_COMMENT)]
    header: list[str] = []
    if content:
        number, line = content[0]
        first = _cells(path, number, line, _separator(line))
        if not all(_NUMBER.fullmatch(cell) for cell in first if cell):
            header, content = first, content[1:]
        else:
            named = ([cell.strip() for cell in _split(line, _separator(line))] for line in comments[::-1])
            header = next((names for names in named if is_header(names)), [])
    while header and not header[-1]:
        header.pop()  # the line ends with a separator
    if not content:
        return TextTable(header, [], [])
    separator = _separator(content[0][1])
    rows = [_cells(path, number, line, separator) for number, line in content]
    return TextTable(header, [number for number, _ in content], rows)


def _text(path: Path) -> str:
    """The file as text: UTF-8, or UTF-16 if it says so."""
    if path.exists() and not (path.is_file() or path.is_dir()):
        raise ValueError(f"{path} is not a regular file: give the path of a table")
    with path.open("rb") as file:
        data = file.read(_MOST_BYTES + 1)
    if len(data) > _MOST_BYTES:
        raise ValueError(f"{path} is larger than {_MOST_BYTES >> 20} MiB: thin the table out")
    wide = data.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE))
    try:
        text = data.decode("utf-16" if wide else "utf-8-sig")
    except UnicodeDecodeError as error:
        line = data[: error.start].count(b"\n") + 1
        raise ValueError(f"{path}, line {line}: no UTF-8 text; save the table as UTF-8") from None
    if "\0" in text:
        line = text[: text.index("\0")].count("\n") + 1
        raise ValueError(f"{path}, line {line}: no text but binary data; save the table as UTF-8 text")
    return text


def _separator(line: str) -> str | None:
    """The sign between cells, None for white space."""
    return next((sign for sign in (";", "\t", ",") if sign in line), None)


def _split(line: str, separator: str | None) -> list[str]:
    if separator is None:
        return line.split()
    return next(csv.reader([line], delimiter=separator, strict=True, skipinitialspace=True))


def _cells(path: Path, number: int, line: str, separator: str | None) -> list[str]:
    """The cells of a line."""
    try:
        cells = [cell.strip() for cell in _split(line, separator)]
    except csv.Error as error:
        what = str(error)
        if "field limit" in what:
            what = f"a cell is longer than {csv.field_size_limit()} characters"
        elif "end of data" in what:
            what = "a quote is not closed"
        raise ValueError(f"{path}, line {number}: {what}") from None
    if separator in (";", "\t"):
        return [cell.replace(",", ".") if "," in cell and _NUMBER.fullmatch(cell) else cell for cell in cells]
    return cells
