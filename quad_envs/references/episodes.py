"""A reference within an episode: how long it lasts, where it starts, and what of it is flown."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np

from ..parameters import Array
from .table_row import TURN_RATE

_NEAR = 0.02  # of the episode, by which a table may end earlier or later without a word
_INSIDE = ("reference", "path")  # fields in which a reference or target holds another


def _inner(reference: Any) -> str | None:
    """Name of the field that holds another trajectory, if one does."""
    return next((name for name in _INSIDE if hasattr(getattr(reference, name, None), "rows")), None)


def in_episode(reference: Any, dt: float, time_limit: float) -> Any:
    """A reference or target as it is in episodes of this length and control period, s."""
    name = _inner(reference)
    if name is not None:
        return replace(reference, **{name: in_episode(getattr(reference, name), dt, time_limit)})
    fit = getattr(reference, "in_episode", None)
    return reference if fit is None else fit(dt, time_limit)


def interval_of(reference: Any) -> tuple[float, float] | None:
    """From when to when a trajectory is given, s of the episode; None where it has no end."""
    name = _inner(reference)
    return getattr(reference, "interval", None) if name is None else interval_of(getattr(reference, name))


def length_of(reference: Any, dt: float) -> float:
    """Time limit that flies all of a reference, whole control periods, s.

    Raises:
        ValueError: If it has no end.
    """
    interval = interval_of(in_episode(reference, dt, math.inf))
    if interval is None:
        raise ValueError(
            "time_limit='reference' needs a reference that has an end, as a table; "
            f"{type(reference).__name__} has none: give seconds"
        )
    return max(1, math.ceil(interval[1] / dt - 1e-6)) * dt


def mismatch(reference: Any, dt: float, time_limit: float) -> str:
    """Said of a trajectory that is given for a part of the episode only, or flown in part; else empty.

    Raises:
        ValueError: If nothing of it is flown.
    """
    interval = interval_of(reference)
    if interval is None:
        return ""
    start, end = interval
    near = max(2.0 * dt, _NEAR * time_limit)
    spans = (
        f"{_name(reference)} is given from {start:g} to {end:g} s, the episode is from 0 to {time_limit:g} s"
    )
    if end <= 0.0 or start >= time_limit:
        raise ValueError(
            f"{spans}: nothing of it is flown. t0='first' begins with its first row, t0=... at another time"
        )
    said = []
    if abs(start) > near:
        what = f"it rests until {start:g} s" if start > 0.0 else "what is before is not flown"
        said.append(f"{what} (t0='first' begins with the first row)")
    if end < time_limit - near:
        said.append(f"it rests from {end:g} s on (time_limit='reference' ends there)")
    elif end > time_limit + near:
        said.append(f"the rest is not flown (time_limit='reference' or {end:g} flies all of it)")
    return f"{spans}: {', and '.join(said)}" if said else ""


def state_on(row: Array) -> Array:
    """State (12,) of a vehicle that flies level on a row of a table, and turns with its heading."""
    x = np.zeros(12)
    sin, cos = row[6], row[7]
    x[:3] = row[:3]
    x[3:6] = cos * row[3] + sin * row[4], cos * row[4] - sin * row[3], row[5]
    x[8], x[11] = math.atan2(sin, cos), row[TURN_RATE]
    return x


def _name(reference: Any) -> str:
    """What to call a trajectory in a message."""
    name = _inner(reference)
    if name is not None:
        return _name(getattr(reference, name))
    path = getattr(reference, "path", None)
    return f"the {type(reference).__name__}" if path is None else f"the table {path!s}"
