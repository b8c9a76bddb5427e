"""Trajectories as arrays of rows, one per control period from the start on."""

from __future__ import annotations

import warnings
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar

import numpy as np

from ..arguments.names import shown
from ..parameters import Array
from .plausible import contradiction
from .spline import Spline, slopes
from .trajectories import Heading, Reference, SetPoint

_FORMS = {  # by the number of columns
    3: "x, y, z",
    4: "x, y, z, psi",
    5: "x, y, z, sin psi, cos psi",
    6: "x, y, z, vx, vy, vz",
    7: "x, y, z, vx, vy, vz, psi",
    8: "x, y, z, vx, vy, vz, sin psi, cos psi",
}


@dataclass(frozen=True, eq=False)
class ArrayTable:
    """A trajectory from an array (n, 3 to 8), a row per control period; after the last it rests.

    By the number of columns they are 3: x, y, z; 4: x, y, z, psi; 5: x, y, z, sin psi, cos psi; 6: x, y, z,
    vx, vy, vz; 7: these and psi; 8: these, sin psi and cos psi, the first of `env.unwrapped.reference`. m,
    m/s, rad, NED; velocities are inertial. Without them they are differences.

    Args:
        values: The rows.
        dt: Time between two rows, s; None: the environment's control period.

    Raises:
        ValueError: If the shape is another, a number is not finite or dt is not positive.
    """

    values: Any = field(repr=False)
    dt: float | None = None
    trajectory: Spline | None = field(init=False, repr=False, default=None)
    random: ClassVar[bool] = False

    def __post_init__(self) -> None:
        table = array_of(self.values)
        if table is None or table.ndim != 2 or table.shape[0] < 2 or table.shape[1] not in _FORMS:
            forms = "; ".join(f"{width}: {form}" for width, form in _FORMS.items())
            got = shown(self.values) if table is None else f"shape {table.shape}"
            raise ValueError(
                f"a reference as an array has 2 or more rows of 3 to 8 columns ({forms}), got {got}"
            )
        if not np.isfinite(table).all():
            k = int(np.argmin(np.isfinite(table).all(axis=1)))
            raise ValueError(
                f"row {k} of the reference must be finite numbers, got {shown(table[k].tolist())}"
            )
        if self.dt is None:
            return
        if not (isinstance(self.dt, int | float) and self.dt > 0.0):
            raise ValueError(f"dt of a reference as an array must be a number > 0 s, got {shown(self.dt)}")
        object.__setattr__(self, "trajectory", _spline(table, self.dt))

    @property
    def interval(self) -> tuple[float, float] | None:
        """From when to when the trajectory is given, s."""
        return None if self.trajectory is None else self.trajectory.interval

    def in_episode(self, dt: float, time_limit: float) -> ArrayTable:
        """The same with rows at the control period, s."""
        return replace(self, dt=dt) if self.dt is None else self

    def rows(self, t: Array, rng: np.random.Generator) -> Array:
        """Reference rows, (n, 8)."""
        if self.trajectory is None:
            raise ValueError("the time between the rows of the array is not known: give it dt, s")
        return self.trajectory.rows(t, rng)


def _spline(table: Array, dt: float) -> Spline:
    """The trajectory of rows at times 0, dt, 2 dt, ..."""
    t: Array = dt * np.arange(len(table), dtype=np.float64)
    width = table.shape[1]
    p = table[:, :3]
    v = table[:, 3:6] if width >= 6 else slopes(t, p)
    turn = table[:, 3:] if width < 6 else table[:, 6:]
    psi = np.zeros(len(t)) if turn.shape[1] == 0 else turn[:, 0]
    if turn.shape[1] == 2:
        psi = np.arctan2(turn[:, 0], turn[:, 1])
    said = contradiction(t, p, v) if width >= 6 else ""
    if width >= 4 and _counts(table[:, 0]) and not all(map(_counts, table[:, 1:4].T)):
        said = (
            f"its first column increases as times do, and is read as x; the columns are {_FORMS[width]}. "
            "With times, give columns: {'t': ..., 'x': ..., 'y': ..., 'z': ...}"
        )
    if said:
        warnings.warn(f"the reference as an array: {said}", stacklevel=2)
    return Spline(t, p, v, np.unwrap(psi))


def _counts(column: Array) -> bool:
    """Whether it increases evenly from 0."""
    step = np.diff(column)
    return bool(column[0] == 0.0 and step[0] > 0.0 and np.allclose(step, step[0], rtol=1e-6))


def array_of(values: Any) -> Array | None:
    """Rows as an array of float64; None if they are not of numbers."""
    try:
        out = np.array(values, dtype=np.float64)
    except (TypeError, ValueError, OverflowError):
        return None
    return out


def from_numbers(values: Any) -> Reference:
    """A reference from an array: 3 numbers are a set point, 4 one with a heading, rows a trajectory."""
    found = array_of(values)
    if found is not None and found.shape in ((3,), (4,)) and np.isfinite(found).all():
        x, y, z, *psi = found.tolist()
        rest = SetPoint((x, y, z))
        return Heading(rest, yaw=psi[0]) if psi else rest
    return ArrayTable(values)
