"""Between the rows of a table: cubic Hermite interpolation; before and after it the vehicle rests."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np

from ..parameters import Array
from .trajectories import pack_rows


@dataclass(frozen=True)
class Spline:
    """Cubic Hermite interpolation of a table; before and after it the vehicle rests at its ends."""

    t: Array  # s, of the episode, (n,)
    p: Array  # m, (n, 3)
    v: Array  # m/s, (n, 3)
    psi: Array = field(repr=False)  # rad, (n,), unwrapped
    random: ClassVar[bool] = False

    @property
    def interval(self) -> tuple[float, float]:
        """From when to when the trajectory is given, s."""
        return float(self.t[0]), float(self.t[-1])

    def rows(self, t: Array, rng: np.random.Generator) -> Array:
        """Reference rows, (n, 8)."""
        inside = (t >= self.t[0] - 1e-9) & (t <= self.t[-1] + 1e-9)
        time = np.clip(t, self.t[0], self.t[-1])
        i = np.clip(np.searchsorted(self.t, time, side="right") - 1, 0, self.t.size - 2)
        h = (self.t[i + 1] - self.t[i])[:, None]
        s = (time - self.t[i])[:, None] / h
        p0, p1, v0, v1 = self.p[i], self.p[i + 1], self.v[i] * h, self.v[i + 1] * h
        a, b = 2.0 * (p0 - p1) + v0 + v1, 3.0 * (p1 - p0) - 2.0 * v0 - v1
        p = ((a * s + b) * s + v0) * s + p0
        v = ((3.0 * a * s + 2.0 * b) * s + v0) / h
        return pack_rows(p, np.where(inside[:, None], v, 0.0), np.interp(time, self.t, self.psi))


def slopes(t: Array, p: Array) -> Array:
    """Velocities (n, 3) of positions (n, 3) at times (n,): central, and 0 along an axis that rests."""
    v = np.gradient(p, t, axis=0)
    rests = np.diff(p, axis=0) == 0.0
    v[1:][rests] = 0.0
    v[:-1][rests] = 0.0
    return np.asarray(v)
