"""Reference trajectories, as data: rows [p_ref 3, v_ref 3, sin psi_ref, cos psi_ref] at given times.

Positions are NED (z down), velocities inertial, SI. The defaults of helix, spiral and lines are the sets that
reproduce tables 4.1 and 4.2; the dissertation shows its trajectories only as figures. A trajectory of your
own is `from_function(f)`, `from_csv(path)`, or any object with `random` and `rows(t, rng)`.
"""

from __future__ import annotations

import csv
import math
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import ClassVar, Protocol, runtime_checkable

import numpy as np
from numpy.typing import ArrayLike

from .names import unknown_name
from .observations import N_REFERENCE
from .parameters import Array


@runtime_checkable
class Reference(Protocol):
    """What an environment needs of a trajectory."""

    @property
    def random(self) -> bool:
        """Whether `rows` draws from the generator, so that every episode has another trajectory."""
        ...

    def rows(self, t: Array, rng: np.random.Generator) -> Array:
        """Reference rows at times t (n,), s: (n, 8)."""
        ...


def pack_rows(p: ArrayLike, v: ArrayLike, psi: ArrayLike = 0.0) -> Array:
    """Rows (n, 8) of positions (n, 3), inertial velocities (n, 3) and headings (n,) or scalar, rad."""
    p, v = np.asarray(p, dtype=np.float64), np.asarray(v, dtype=np.float64)
    out = np.empty((p.shape[0], N_REFERENCE))
    out[:, :3], out[:, 3:6] = p, v
    out[:, 6], out[:, 7] = np.sin(psi), np.cos(psi)
    return out


@dataclass(frozen=True, slots=True)
class SetPoint:
    """Rest at one position."""

    position: tuple[float, float, float] = (0.0, 0.0, 0.0)  # m
    random: ClassVar[bool] = False

    def rows(self, t: Array, rng: np.random.Generator) -> Array:
        """Reference rows, (n, 8)."""
        p = np.broadcast_to(np.asarray(self.position, dtype=np.float64), (t.size, 3))
        return pack_rows(p, np.zeros_like(p))


@dataclass(frozen=True, slots=True)
class Line:
    """A straight line from the origin at constant velocity."""

    velocity: tuple[float, float, float] = (0.5, 0.0, -0.2)  # m/s
    random: ClassVar[bool] = False

    def rows(self, t: Array, rng: np.random.Generator) -> Array:
        """Reference rows, (n, 8)."""
        v = np.broadcast_to(np.asarray(self.velocity, dtype=np.float64), (t.size, 3))
        return pack_rows(t[:, None] * v, v)


@dataclass(frozen=True, slots=True)
class Helix:
    """[R sin wt, R (1 - cos wt), vz t]: starts at the origin, descends for vz > 0."""

    radius: float = 6.0  # m
    rate: float = 0.4  # rad/s
    vertical_speed: float = 3.0  # m/s, positive down
    random: ClassVar[bool] = False

    def rows(self, t: Array, rng: np.random.Generator) -> Array:
        """Reference rows, (n, 8)."""
        R, w, vz = self.radius, self.rate, self.vertical_speed
        p = np.stack([R * np.sin(w * t), R * (1.0 - np.cos(w * t)), vz * t], axis=1)
        v = np.stack([R * w * np.cos(w * t), R * w * np.sin(w * t), np.full_like(t, vz)], axis=1)
        return pack_rows(p, v)


@dataclass(frozen=True, slots=True)
class SphericalSpiral:
    """R [cos wt cos ct, sin wt cos ct, sin ct]: from the equator to a pole of a sphere around the origin."""

    radius: float = 4.5  # m
    rate: float = 0.25  # rad/s, w
    latitude_rate: float = 0.3  # rad/s, c; positive descends
    random: ClassVar[bool] = False

    def rows(self, t: Array, rng: np.random.Generator) -> Array:
        """Reference rows, (n, 8)."""
        R, w, c = self.radius, self.rate, self.latitude_rate
        sw, cw, sc, cc = np.sin(w * t), np.cos(w * t), np.sin(c * t), np.cos(c * t)
        p = R * np.stack([cw * cc, sw * cc, sc], axis=1)
        v = R * np.stack([-w * sw * cc - c * cw * sc, w * cw * cc - c * sw * sc, c * cc], axis=1)
        return pack_rows(p, v)


@dataclass(frozen=True, slots=True)
class OutAndBack:
    """A straight line out and, from `turn_time` on, back: s [v, v, vz] with s = t, then 2 T1 - t."""

    speed: float = 1.25  # m/s along x and along y
    vertical_speed: float = 1.0  # m/s, positive down
    turn_time: float = 5.0  # s, T1
    random: ClassVar[bool] = False

    def rows(self, t: Array, rng: np.random.Generator) -> Array:
        """Reference rows, (n, 8); the sample at the turn already has the velocity of the way back."""
        direction = np.array([self.speed, self.speed, self.vertical_speed])
        out = t < self.turn_time - 1e-9
        s = np.where(out, t, 2.0 * self.turn_time - t)
        return pack_rows(s[:, None] * direction, np.where(out, 1.0, -1.0)[:, None] * direction)


@dataclass(frozen=True, slots=True)
class Lemniscate:
    """A figure of eight: [a sin wt, b sin 2wt, h sin wt], starting at its centre."""

    length: float = 3.0  # m, a
    width: float = 1.5  # m, b
    height: float = 0.5  # m, h
    rate: float = 0.6  # rad/s, w
    random: ClassVar[bool] = False

    def rows(self, t: Array, rng: np.random.Generator) -> Array:
        """Reference rows, (n, 8)."""
        a, b, h, w = self.length, self.width, self.height, self.rate
        p = np.stack([a * np.sin(w * t), b * np.sin(2.0 * w * t), h * np.sin(w * t)], axis=1)
        v = w * np.stack([a * np.cos(w * t), 2.0 * b * np.cos(2.0 * w * t), h * np.cos(w * t)], axis=1)
        return pack_rows(p, v)


@dataclass(frozen=True, slots=True)
class Racetrack:
    """Along the walls of a box: |x/a|^n + |y/b|^n = 1 at a constant rate of its angle, rising and falling.

    The higher n, the sharper the corners. The reference itself touches the planes x = +-a and y = +-b.
    """

    length: float = 2.0  # m, a
    width: float = 1.2  # m, b
    height: float = 0.5  # m, amplitude of z at half the rate
    rate: float = 1.2  # rad/s
    sharpness: float = 4.0  # -, n >= 2
    random: ClassVar[bool] = False

    def rows(self, t: Array, rng: np.random.Generator) -> Array:
        """Reference rows, (n, 8)."""
        n, w = self.sharpness, self.rate
        s, c = np.sin(w * t), np.cos(w * t)
        r = (np.abs(c) ** n + np.abs(s) ** n) ** (-1.0 / n)
        # dr/d(angle), from the derivative of r^-n
        slope = -(r ** (n + 1)) * (np.abs(s) ** (n - 2) * s * c - np.abs(c) ** (n - 2) * c * s)
        a, b, h = self.length, self.width, self.height
        p = np.stack([a * r * c, b * r * s, h * np.sin(0.5 * w * t)], axis=1)
        climb = 0.5 * h * np.cos(0.5 * w * t)
        v = np.stack([a * (slope * c - r * s), b * (slope * s + r * c), climb], axis=1)
        return pack_rows(p, w * v)


@dataclass(frozen=True, slots=True)
class RandomSmooth:
    """A sum of sines per axis with random amplitudes, rates and phases, shifted to start at the origin.

    Raises:
        ValueError: If the rates are not 0 < rate_min <= rate_max or there is no harmonic.
    """

    amplitude: tuple[float, float, float] = (3.0, 3.0, 1.5)  # m, bound on the sum of the sines per axis
    rate_min: float = 0.2  # rad/s
    rate_max: float = 1.2  # rad/s
    harmonics: int = 3
    random: ClassVar[bool] = True

    def __post_init__(self) -> None:
        if not 0.0 < self.rate_min <= self.rate_max:
            raise ValueError(
                f"need 0 < rate_min <= rate_max, got {self.rate_min!r} and {self.rate_max!r} rad/s"
            )
        if self.harmonics < 1:
            raise ValueError(f"harmonics must be >= 1, got {self.harmonics!r}")

    def rows(self, t: Array, rng: np.random.Generator) -> Array:
        """Reference rows of a new random trajectory, (n, 8)."""
        draws = rng.random((3, 3, self.harmonics))
        share = draws[0] / draws[0].sum(axis=1, keepdims=True)
        amplitude = share * np.asarray(self.amplitude)[:, None]
        rate = self.rate_min + (self.rate_max - self.rate_min) * draws[1]
        phase = 2.0 * np.pi * draws[2]
        angle = t[:, None, None] * rate + phase
        p = np.sum(amplitude * (np.sin(angle) - np.sin(phase)), axis=2)
        return pack_rows(p, np.sum(amplitude * rate * np.cos(angle), axis=2))


@dataclass(frozen=True, slots=True)
class Heading:
    """Another trajectory with a heading of its own: psi = yaw + rate t, or along the path where `tangent`."""

    reference: Reference
    yaw: float = 0.0  # rad
    rate: float = 0.0  # rad/s
    tangent: bool = False

    @property
    def random(self) -> bool:
        """As the trajectory inside."""
        return self.reference.random

    def rows(self, t: Array, rng: np.random.Generator) -> Array:
        """Reference rows, (n, 8)."""
        rows = self.reference.rows(t, rng)
        psi = self.yaw + self.rate * t
        if self.tangent:
            psi = psi + np.arctan2(rows[:, 4], rows[:, 3])
        return pack_rows(rows[:, :3], rows[:, 3:6], psi)


@dataclass(frozen=True)
class _FromFunction:
    function: Callable[[float], ArrayLike]
    step: float = 1e-3  # s, of the central difference where the function gives no velocity
    random: ClassVar[bool] = False

    def rows(self, t: Array, rng: np.random.Generator) -> Array:
        """Reference rows, (n, 8)."""
        values = self._values(t)
        if values.shape[1] >= 6:
            v = values[:, 3:6]
        else:
            v = (self._values(t + self.step)[:, :3] - self._values(t - self.step)[:, :3]) / (2.0 * self.step)
        psi = values[:, 3] if values.shape[1] == 4 else values[:, 6] if values.shape[1] == 7 else 0.0
        return pack_rows(values[:, :3], v, psi)

    def _values(self, t: Array) -> Array:
        out = np.array([np.asarray(self.function(float(time)), dtype=np.float64) for time in t])
        if out.ndim != 2 or out.shape[1] not in (3, 4, 6, 7):
            raise ValueError(
                "a reference function must return 3 (p), 4 (p, psi), 6 (p, v) or 7 (p, v, psi) numbers, "
                f"got shape {out.shape[1:]}"
            )
        if not np.isfinite(out).all():
            bad = t[~np.isfinite(out).all(axis=1)][0]
            raise ValueError(f"the reference function returned a non-finite number at t = {bad:g} s")
        return out


def from_function(function: Callable[[float], ArrayLike]) -> Reference:
    """Any trajectory given as a function of time.

    Args:
        function: t in s -> 3 (p), 4 (p, psi), 6 (p, v) or 7 (p, v, psi) numbers, SI, NED. It is sampled when
            an environment is made, at the control period; without v it is also called a millisecond before
            and after.

    Returns:
        A reference for `gym.make(..., reference=...)`. It pickles if the function does.

    Raises:
        ValueError: When sampled, if the function returns another shape or a non-finite number.
    """
    if not callable(function):
        raise ValueError(f"from_function needs a function of time, got {function!r}")
    return _FromFunction(function)


_CSV_COLUMNS = ("t", "x", "y", "z", "vx", "vy", "vz", "psi")


@dataclass(frozen=True)
class _Waypoints:
    """Cubic Hermite interpolation of a table; before and after it the vehicle rests at its ends."""

    t: Array
    p: Array
    v: Array
    psi: Array = field(repr=False)
    random: ClassVar[bool] = False

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


def from_csv(path: str | Path, *, max_gap: float = 1.0) -> Reference:
    """A trajectory from a table with a header line.

    Args:
        path: Columns t, x, y, z (s, m, NED), optionally vx, vy, vz (m/s, inertial) and psi (rad), in any
            order. Without velocities they are central differences. Before the first and after the last line
            the reference rests there.
        max_gap: Longest time between two lines, s; a longer one is taken for lost data.

    Returns:
        A reference for `gym.make(..., reference=...)`.

    Raises:
        FileNotFoundError: If there is no such file.
        ValueError: If a column is missing or unknown, a cell is empty, not a number or not finite, time does
            not increase, or lines are missing; the message names the line.
    """
    with Path(path).open(newline="", encoding="utf-8-sig") as file:
        lines = list(csv.reader(file))
    names = [name.strip() for name in lines[0]] if lines else []
    if len(set(names)) < len(names):
        raise ValueError(f"{path}: the header names a column twice: {', '.join(names)}")
    missing = [name for name in _CSV_COLUMNS[:4] if name not in names]
    unknown = [name for name in names if name not in _CSV_COLUMNS]
    if missing or unknown:
        raise ValueError(
            f"{path}: the header must name {', '.join(_CSV_COLUMNS[:4])} "
            f"(and may name {', '.join(_CSV_COLUMNS[4:])}); "
            f"missing {missing}, unknown {unknown}"
        )
    table = np.array(
        [_parse_csv_line(path, number, names, line) for number, line in enumerate(lines[1:], 2) if line]
    )
    if table.shape[0] < 2:
        raise ValueError(f"{path}: a trajectory needs at least two lines, got {table.shape[0]}")
    column = {name: table[:, i] for i, name in enumerate(names)}
    step = np.diff(column["t"])
    if (step <= 0.0).any():
        raise ValueError(
            f"{path}, line {int(np.argmax(step <= 0.0)) + 3}: time must increase from line to line"
        )
    if (step > max_gap).any():
        i = int(np.argmax(step > max_gap))
        raise ValueError(
            f"{path}, line {i + 3}: a gap of {step[i]:g} s is longer than max_gap = {max_gap:g} s"
        )
    p = np.stack([column[axis] for axis in "xyz"], axis=1)
    given = [name in names for name in ("vx", "vy", "vz")]
    if any(given) and not all(given):
        raise ValueError(f"{path}: give all of vx, vy, vz or none of them")
    v = (
        np.stack([column[name] for name in ("vx", "vy", "vz")], axis=1)
        if all(given)
        else np.gradient(p, column["t"], axis=0)
    )
    psi = np.unwrap(column["psi"]) if "psi" in names else np.zeros(len(p))
    return _Waypoints(column["t"], p, v, psi)


def _parse_csv_line(path: str | Path, number: int, names: list[str], line: list[str]) -> list[float]:
    if len(line) != len(names):
        raise ValueError(
            f"{path}, line {number}: {len(line)} cells where the header names {len(names)} columns"
        )
    values = []
    for name, cell in zip(names, line, strict=True):
        try:
            value = float(cell)
        except ValueError:
            value = math.nan
        if not math.isfinite(value):
            raise ValueError(f"{path}, line {number}: {name} must be a finite number, got {cell.strip()!r}")
        values.append(value)
    return values


_BY_NAME: dict[str, Callable[[], Reference]] = {
    "setpoint": SetPoint,
    "helix": Helix,
    "spiral": SphericalSpiral,
    "lines": OutAndBack,
    "lemniscate": Lemniscate,
    "racetrack": Racetrack,
    "random": RandomSmooth,
    "line": Line,
    "fast-line": lambda: Line((1.5, 0.0, -0.5)),
    "slow-helix": lambda: Helix(2.0, 0.3, -0.1),
}


def make_reference(what: str | Reference) -> Reference:
    """A reference from a name, the path of a .csv file, or itself.

    Raises:
        ValueError: If it is none of these.
    """
    if isinstance(what, Reference):
        return what
    if isinstance(what, str):
        if what in _BY_NAME:
            return _BY_NAME[what]()
        if what.endswith(".csv"):
            return from_csv(what)
        raise ValueError(f"{unknown_name('reference', what, _BY_NAME)}, or a path ending in .csv")
    raise ValueError(f"reference must be a name, a path ending in .csv or a Reference, got {what!r}")
