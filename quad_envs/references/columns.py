"""Names and units of columns: which of a table's are time, position, velocity, heading and attitude."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from typing import NamedTuple

from ..arguments.names import shown, suggestion

NEEDED = ("t", "x", "y", "z")
VELOCITIES = ("vx", "vy", "vz")
QUATERNION = ("qx", "qy", "qz", "qw")
COLUMNS = (*NEEDED, *VELOCITIES, "psi", *QUATERNION)
# Of tables without names, by the number of their columns: the second is the form of TUM's trajectories.
UNNAMED = {4: NEEDED, 8: (*NEEDED, *QUATERNION)}
_MOST_SHOWN = 8  # names in a message

# What a column may be called: in lower case, with _ for other signs, without its unit.
_OF_AXES = {
    ("", "xyz"): r"(p|t|pos|position)?_?AXIS|AXIS_?(pos|position|ref)|p_\w+_AXIS|\w+_position_AXIS",
    ("v", "xyz"): r"(v|vel|velocity)_?AXIS|dAXIS|AXIS_?(dot|vel)|v_\w+_AXIS|\w+_(velocity|linear)_AXIS",
    ("q", "xyzw"): r"(q|quat|quaternion|orientation)_?AXIS|q_\w+_AXIS|\w+_orientation_AXIS",
}
_FORMS = {
    "t": re.compile(r"t|times?|time_?stamp|stamp|secs?|seconds|elapsed(_time)?"),
    "psi": re.compile(r"psi|yaw|heading|(psi|yaw|heading)_(ref|angle)"),
    **{
        prefix + axis: re.compile(pattern.replace("AXIS", axis))
        for (prefix, axes), pattern in _OF_AXES.items()
        for axis in axes
    },
}
TIME_UNITS = {"s": 1.0, "sec": 1.0, "seconds": 1.0, "ms": 1e-3, "us": 1e-6, "µs": 1e-6, "ns": 1e-9}
ANGLE_UNITS = {"rad": 1.0, "radians": 1.0, "deg": math.pi / 180.0, "degrees": math.pi / 180.0}
_LENGTH_UNITS = {"m": 1.0, "meters": 1.0, "cm": 0.01, "mm": 1e-3}
_SPEED_UNITS = {"m/s": 1.0, "mps": 1.0, "ms^-1": 1.0, "ms-1": 1.0, "cm/s": 0.01, "mm/s": 1e-3}
_NO_UNITS = {"-": 1.0, "1": 1.0}
_UNITS: dict[str, Mapping[str, float]] = {
    "t": TIME_UNITS,
    "psi": ANGLE_UNITS,
    **dict.fromkeys("xyz", _LENGTH_UNITS),
    **dict.fromkeys(VELOCITIES, _SPEED_UNITS),
    **dict.fromkeys(QUATERNION, _NO_UNITS),
}


class Column(NamedTuple):
    """Where a column is, and how many of our units one of its own is."""

    at: int  # in the header
    factor: float | None  # None where the header names no unit


def find_columns(
    header: Sequence[str], source: str, given: Mapping[str, str] | None = None
) -> tuple[dict[str, Column], list[str]]:
    """The columns that are read, and the names of the others.

    Args:
        header: Names, as the table has them.
        source: Of the table, for messages.
        given: Names of columns that have unusual ones, as {"x": "mocap.x"}.

    Raises:
        ValueError: If one is missing, there twice, or in an unknown unit.
    """
    found: dict[str, Column] = {}
    ignored: list[str] = []
    chosen = _chosen(header, source, given or {})
    for index, name in enumerate(header):
        column, unit = chosen.get(name.strip(), ""), ""
        if not column:
            column, unit = _meaning(name)
            if column in chosen.values():
                column = ""  # the one that was chosen is read in its place
        if not column:
            ignored.append(name.strip())
            continue
        if column in found:
            first = header[found[column].at]
            alike = first.strip() == name.strip()  # a name then tells nothing
            remedy = f"say which is meant, as names={{'{column}': {shown(name)}}}"
            raise ValueError(
                f"{source}: the header names {column} twice, as {shown(first)} and {shown(name)}; "
                f"{'give one of them another name' if alike else remedy}"
            )
        if unit and unit not in _UNITS[column]:
            raise ValueError(
                f"{source}: unknown unit of column {shown(name)}; known: {', '.join(_UNITS[column])}"
            )
        found[column] = Column(index, _UNITS[column][unit] if unit else None)
    _require_whole(found, ignored, source)
    return found, ignored


def is_header(names: Sequence[str]) -> bool:
    """Whether all columns that a table needs are named."""
    return {_meaning(name)[0] for name in names} >= set(NEEDED)


def listed(names: Sequence[str]) -> str:
    """Names in a message, the first ones if there are many."""
    more = len(names) - _MOST_SHOWN
    return ", ".join(shown(name, 40) for name in names[:_MOST_SHOWN]) + (
        f" and {more} more" if more > 0 else ""
    )


def _meaning(name: str) -> tuple[str, str]:
    """Column and unit of a name; empty where there is none."""
    text = name.strip().lower()[:200]
    bracket = re.search(r"[\[(]([^\])]*)[\])]\s*$", text)
    unit = "" if bracket is None else re.sub(r"\s", "", bracket[1])
    if bracket is not None:
        text = text[: bracket.start()]
    text = re.sub(r"\W+", "_", text).strip("_")
    for column, form in _FORMS.items():
        if form.fullmatch(text):
            return column, unit
    stem, _, suffix = text.rpartition("_")  # as yaw_deg, timestamp_ns
    for column, form in _FORMS.items():
        if suffix in _UNITS[column] and form.fullmatch(stem):
            return column, suffix
    return "", ""


def _chosen(header: Sequence[str], source: str, given: Mapping[str, str]) -> dict[str, str]:
    """Name in the header -> column, of those that the user chose."""
    names = [name.strip() for name in header]
    for column, name in given.items():
        if column not in COLUMNS:
            raise ValueError(
                f"names says what columns are called, not {column!r}; {suggestion(column, COLUMNS)}"
            )
        if name not in names:
            raise ValueError(f"{source}: there is no column {shown(name)}; there are {listed(names)}")
    return {name: column for column, name in given.items()}


def _require_whole(found: Mapping[str, Column], ignored: Sequence[str], source: str) -> None:
    missing = [name for name in NEEDED if name not in found]
    if missing:
        raise ValueError(
            f"{source}: the header must name {', '.join(NEEDED)} (and may name {', '.join(COLUMNS[4:])}); "
            f"missing {missing}, unknown: {listed(ignored) or 'none'}. names={{'{missing[0]}': 'what it is "
            f"called'}} says which column is meant"
        )
    for group in (VELOCITIES, QUATERNION):
        given = [name in found for name in group]
        if any(given) and not all(given):
            raise ValueError(f"{source}: give all of {', '.join(group)} or none of them")
