"""Trajectories as tables with named columns: files, and columns at hand."""

from __future__ import annotations

import math
import os
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from numpy.typing import ArrayLike

from ..arguments.names import shown, unknown_name
from ..parameters import Array
from .axes import heading_in_ned, heading_of_quaternions, to_ned
from .columns import (
    ANGLE_UNITS,
    COLUMNS,
    QUATERNION,
    TIME_UNITS,
    UNNAMED,
    VELOCITIES,
    Column,
    find_columns,
    is_header,
    listed,
)
from .plausible import contradiction, points_up
from .polynomials import are_polynomials, read_polynomials
from .spline import Spline, slopes
from .text_tables import TextTable, read_text_table
from .trajectories import Reference


@dataclass(frozen=True, kw_only=True)
class _TableForm:
    """How a table is to be read. `CsvTable` documents each field."""

    t0: str | float = "first"
    time_unit: str | None = None
    axes: str | None = None
    yaw: str | None = None
    names: Mapping[str, str] | None = None
    max_gap: float = 1.0
    ignored: tuple[str, ...] = field(init=False, repr=False, compare=False, default=())
    trajectory: Any = field(init=False, repr=False, compare=False, default=None)  # what was read
    random: ClassVar[bool] = False

    @property
    def interval(self) -> tuple[float, float]:
        """From when to when the trajectory is given, s of the episode."""
        start, end = self.trajectory.interval
        return float(start), float(end)

    def rows(self, t: Array, rng: np.random.Generator) -> Array:
        """Reference rows, (n, 8)."""
        return np.asarray(self.trajectory.rows(t, rng))

    def _check_form(self) -> None:
        for name, units in (("time_unit", TIME_UNITS), ("yaw", ANGLE_UNITS)):
            value = getattr(self, name)
            if value is not None and not (isinstance(value, str) and value in units):
                raise ValueError(unknown_name(name, value, units))
        to_ned(self.axes or "ned")
        start = isinstance(self.t0, int | float | np.integer | np.floating) and math.isfinite(self.t0)
        if not (start or self.t0 in ("first", "absolute")):
            raise ValueError(
                "t0 must be 'first' (the episode begins at the first row), 'absolute' (at 0 s of the "
                f"table) or the table's time at which it begins, s; got {shown(self.t0)}"
            )
        if not (isinstance(self.max_gap, int | float) and self.max_gap > 0.0):
            raise ValueError(f"max_gap must be a number > 0 s, got {shown(self.max_gap)}")

    def _take(self, source: str, ignored: Sequence[str], trajectory: Reference) -> None:
        """Keep what was read, and say which columns were not."""
        if ignored:
            warnings.warn(
                f"{source}: not read: {listed(ignored)}; known: {', '.join(COLUMNS)} (names=... for others)",
                stacklevel=4,
            )
        object.__setattr__(self, "ignored", tuple(ignored))
        object.__setattr__(self, "trajectory", trajectory)

    def _spline(
        self,
        columns: Mapping[str, Column],
        values: Mapping[str, Array],
        place: Callable[[int], str],
        source: str,
    ) -> Spline:
        """The trajectory of columns of numbers; `place(i)` names row i in messages."""
        t = self._times(values["t"], columns["t"].factor, place, source)
        M = to_ned(self.axes or "ned")

        def vectors(names: Sequence[str]) -> Array:
            return np.stack([values[name] * (columns[name].factor or 1.0) for name in names], axis=1) @ M.T

        p = vectors("xyz")
        if all(name in values for name in VELOCITIES):
            v = vectors(VELOCITIES)
            said = contradiction(t, p, v)
        else:
            v, said = slopes(t, p), ""
        if self.axes is None:
            said = said or points_up(p)
        if said:
            warnings.warn(f"{source}: {said}", stacklevel=5)
        headings = self._headings(columns, values, place)
        psi = np.zeros(t.size) if headings is None else heading_in_ned(headings, M)
        return Spline(t, p, v, psi)

    def _times(self, t: Array, factor: float | None, place: Callable[[int], str], source: str) -> Array:
        """Times of the episode, s."""
        if t.size < 2:
            raise ValueError(f"{source}: a trajectory needs at least two lines, got {t.size}")
        unit = TIME_UNITS[self.time_unit] if self.time_unit else factor or 1.0
        step = unit * np.diff(t)
        if (step <= 0.0).any():
            i = int(np.argmax(step <= 0.0))
            raise ValueError(f"{place(i + 1)}: time must increase from line to line")
        if (step > self.max_gap).any():
            i = int(np.argmax(step > self.max_gap))
            hint = ", time_unit='ms', 'us' or 'ns' if it is no s" if np.median(step) > self.max_gap else ""
            raise ValueError(
                f"{place(i + 1)}: a gap of {step[i]:g} s is longer than max_gap = {self.max_gap:g} s; "
                f"a larger max_gap lets it pass{hint}"
            )
        begins = {"first": float(t[0]), "absolute": 0.0}
        begin = begins[self.t0] if isinstance(self.t0, str) else self.t0 / unit
        return np.asarray(unit * (t - begin))

    def _headings(
        self, columns: Mapping[str, Column], values: Mapping[str, Array], place: Callable[[int], str]
    ) -> Array | None:
        """Headings in the table's axes, (n,), rad; None where there are none."""
        if "psi" in values:
            unit = ANGLE_UNITS[self.yaw] if self.yaw else columns["psi"].factor or 1.0
            return unit * values["psi"]
        if QUATERNION[0] not in values:
            return None
        try:
            return heading_of_quaternions(np.stack([values[name] for name in QUATERNION], axis=1))
        except ValueError as error:
            row, _, what = str(error).partition(":")
            raise ValueError(
                f"{place(int(row))}:{what}; {', '.join(QUATERNION)} must have length 1"
            ) from None


@dataclass(frozen=True)
class CsvTable(_TableForm):
    """A trajectory from a table in a text file.

    Columns are found by their names, in any order and any capitals: time `t` (time, timestamp), position
    `x`, `y`, `z` (px, pos_x, tx), and if there are, velocity `vx`, `vy`, `vz` (xdot, vel_x; else they are
    differences), `psi` (yaw, heading) or a quaternion `qx`, `qy`, `qz`, `qw`. Units may stand in brackets,
    as `timestamp [ns]` or `yaw [deg]`. Others are not read; a warning and `ignored` name them. Separators
    are commas, semicolons, tabs or white space; lines with # or % are comments. TUM trajectories (timestamp
    tx ty tz qx qy qz qw) and Crazyswarm polynomials (duration, x^0 ... yaw^7) are read as they are.

    Args:
        path: The file; ~ is the home folder.
        t0: "first": the episode begins at the first row. "absolute": at 0 s of the table's clock. A number:
            when that clock shows it, s.
        time_unit: "s", "ms", "us" or "ns"; None: as the header says, else s.
        axes: "ned" or "frd" (z down), "enu", "nwu" or "flu" (z up), of positions, velocities, headings. None:
            z down, with a warning where it seems to point up; Crazyswarm polynomials have forward, left, up.
        yaw: "rad" or "deg"; None: as the header says, else rad.
        names: Of columns that have unusual ones, as {"x": "mocap.x"}.
        max_gap: Longest time between two rows, s; a longer one is taken for lost data.

    Raises:
        OSError: If the file cannot be read.
        ValueError: If a column is missing, a cell is not a finite number, time does not increase, rows are
            missing, or a quaternion is not of length 1; the message names file and line.
    """

    path: str | os.PathLike[str]

    def __post_init__(self) -> None:
        self._check_form()
        path = _path_of(self.path)
        text = read_text_table(path, is_header)
        if are_polynomials(text.header):
            self._take(str(path), (), read_polynomials(path, text, self.axes or "flu"))
            return
        header = text.header
        if not header and text.rows:
            if len(text.rows[0]) not in UNNAMED:
                raise ValueError(
                    f"{path}, line {text.lines[0]}: {len(text.rows[0])} columns without names; "
                    "give the table a header, as t,x,y,z"
                )
            header = list(UNNAMED[len(text.rows[0])])
        columns, ignored = find_columns(header, str(path), self.names)
        values = _numbers(path, text, header, columns)
        trajectory = self._spline(columns, values, lambda i: f"{path}, line {text.lines[i]}", str(path))
        self._take(str(path), ignored, trajectory)


@dataclass(frozen=True)
class ColumnTable(_TableForm):
    """A trajectory from columns at hand: a mapping from names to equally long lists, or a data frame.

    Args:
        columns: As {"t": ..., "x": ..., "y": ..., "z": ...}; `CsvTable` documents the rest.
        t0: As there.
        time_unit: As there.
        axes: As there.
        yaw: As there.
        names: As there.
        max_gap: As there.

    Raises:
        ValueError: If a column is missing, or the columns are not what a trajectory needs.
    """

    columns: Mapping[str, ArrayLike]

    def __post_init__(self) -> None:
        self._check_form()
        if not (isinstance(self.columns, Mapping) or hasattr(self.columns, "columns")):
            raise ValueError(f"columns must be a mapping from names to lists, got {shown(self.columns)}")
        header = [str(name) for name in self.columns]
        columns, ignored = find_columns(header, "the table", self.names)
        values: dict[str, Array] = {}
        for name, column in columns.items():
            values[name] = self._column(header[column.at])
            if values[name].shape != values[next(iter(columns))].shape:
                raise ValueError(f"the table's columns must be equally long, {name} is not")
        trajectory = self._spline(columns, values, lambda i: f"the table, row {i}", "the table")
        self._take("the table", ignored, trajectory)

    def _column(self, name: str) -> Array:
        """The numbers of a column, (n,)."""
        try:
            out = np.asarray(self.columns[name], dtype=np.float64)
        except (TypeError, ValueError, OverflowError):
            out = np.empty((0, 0))
        if out.ndim != 1:
            raise ValueError(f"the table's column {shown(name)} must be a list of numbers")
        if not np.isfinite(out).all():
            row = int(np.argmin(np.isfinite(out)))
            raise ValueError(f"the table, row {row}: {name} must be a finite number, got {out[row]}")
        return out


from_csv = CsvTable


def _path_of(what: object) -> Path:
    """A path whose ~ is the home folder."""
    if not isinstance(what, str | os.PathLike):
        raise ValueError(f"path must be that of a table, got {shown(what)}")
    try:
        return Path(what).expanduser()
    except RuntimeError as error:
        raise ValueError(f"{shown(str(what))}: {error}") from None


def _numbers(
    path: Path, text: TextTable, header: Sequence[str], columns: Mapping[str, Column]
) -> dict[str, Array]:
    """The columns that are read, as numbers."""
    out: dict[str, list[float]] = {name: [] for name in columns}
    for number, row in zip(text.lines, text.rows, strict=True):
        if len(row) != len(header) and (len(row) < len(header) or any(row[len(header) :])):
            raise ValueError(
                f"{path}, line {number}: {len(row)} cells where the header names {len(header)} columns"
            )
        for name, column in columns.items():
            try:
                value = float(row[column.at])
            except ValueError:
                value = math.nan
            if not math.isfinite(value):
                raise ValueError(
                    f"{path}, line {number}: {name} must be a finite number, got {shown(row[column.at])}"
                )
            out[name].append(value)
    return {name: np.array(values) for name, values in out.items()}
