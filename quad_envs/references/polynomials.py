"""Trajectories of pieces of polynomials, in the form of Crazyswarm: duration, x^0 ... x^7, y^0 ... yaw^7."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import ClassVar

import numpy as np

from ..arguments.names import shown
from ..parameters import Array
from .axes import heading_in_ned, to_ned
from .text_tables import TextTable
from .trajectories import pack_rows

_ORDERS = 8
_NAMES = ("duration", *(f"{axis}^{k}" for axis in ("x", "y", "z", "yaw") for k in range(_ORDERS)))


@dataclass(frozen=True)
class Polynomials:
    """Polynomials of the time since each piece's start; after the last the vehicle rests at its end."""

    starts: Array  # s, (m + 1,), of the pieces, then the end
    coefficients: Array = field(repr=False)  # (m, 4, 8): x, y, z, yaw, ascending, in the axes below
    M: Array = field(repr=False)  # (3, 3), to NED
    random: ClassVar[bool] = False

    @property
    def interval(self) -> tuple[float, float]:
        """From when to when the trajectory is given, s."""
        return 0.0, float(self.starts[-1])

    def rows(self, t: Array, rng: np.random.Generator) -> Array:
        """Reference rows, (n, 8)."""
        inside = (t >= -1e-9) & (t <= self.starts[-1] + 1e-9)
        time = np.clip(t, 0.0, self.starts[-1])
        i = np.clip(np.searchsorted(self.starts, time, side="right") - 1, 0, len(self.coefficients) - 1)
        s = (time - self.starts[i])[:, None]
        c = self.coefficients[i]
        k = np.arange(1, _ORDERS)
        values = np.einsum("nak,nk->na", c, s ** np.arange(_ORDERS))
        slopes = np.einsum("nak,nk->na", k * c[:, :, 1:], s ** (k - 1))
        p, v = values[:, :3] @ self.M.T, np.where(inside[:, None], slopes[:, :3] @ self.M.T, 0.0)
        return pack_rows(p, v, heading_in_ned(values[:, 3], self.M))


def are_polynomials(header: Sequence[str]) -> bool:
    """Whether a header is that of polynomials."""
    names = {name.lower() for name in header}
    return {"duration", "x^0"} <= names


def read_polynomials(path: Path, text: TextTable, axes: str) -> Polynomials:
    """The pieces of a table.

    Raises:
        ValueError: If a coefficient is missing or not a finite number, or a duration is not positive.
    """
    names = [name.lower() for name in text.header]
    missing = [name for name in _NAMES if name not in names]
    if missing:
        raise ValueError(f"{path}: polynomials need the columns duration, x^0 ... yaw^7; missing {missing}")
    if not text.rows:
        raise ValueError(f"{path}: a trajectory needs at least one piece, got none")
    where = [names.index(name) for name in _NAMES]
    table = np.empty((len(text.rows), len(_NAMES)))
    for i, (number, row) in enumerate(zip(text.lines, text.rows, strict=True)):
        if len(row) < len(names):
            raise ValueError(
                f"{path}, line {number}: {len(row)} cells where the header names {len(names)} columns"
            )
        for j, index in enumerate(where):
            try:
                table[i, j] = float(row[index])
            except ValueError:
                table[i, j] = math.nan
            if not math.isfinite(table[i, j]) or (j == 0 and table[i, j] <= 0.0):
                wanted = "a number > 0 s" if j == 0 else "a finite number"
                raise ValueError(
                    f"{path}, line {number}: {_NAMES[j]} must be {wanted}, got {shown(row[index])}"
                )
    starts = np.concatenate([[0.0], np.cumsum(table[:, 0])])
    return Polynomials(starts, table[:, 1:].reshape(-1, 4, _ORDERS), to_ned(axes))
