"""The trajectories of the suite: rows [p_ref 3, v_ref 3, sin psi_ref, cos psi_ref] at given times.

Positions are NED (z down), velocities inertial, SI. The defaults of helix, spiral and lines are the sets that
reproduce tables 4.1 and 4.2; the dissertation shows its trajectories only as figures.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar, Protocol, runtime_checkable

import numpy as np
from numpy.typing import ArrayLike

from ..arguments.checks import require_whole
from ..arguments.kinds import require_kinds
from ..arguments.names import shown
from ..compilation.decorators import entry_of, inline_kernel, kernel
from ..compilation.packed import IntArray
from ..parameters import Array
from ..rotations import sincos
from .plausible import FASTEST
from .table_row import COSINE, N_REFERENCE, SINE

_RESTING_SPEED = 0.05  # m/s
_MOST_HARMONICS = 1000
_ROUNDING = 1e-9  # of steps of time, by which equal ones may differ


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


@inline_kernel
def _turn(sine: Array, cosine: Array, s: float, c: float, later_sine: Array, later_cosine: Array) -> None:
    """Sines and cosines of angles (n,) that are turned by the angle of sine s and cosine c."""
    for k in range(later_sine.size):
        later_sine[k], later_cosine[k] = sine[k] * c + cosine[k] * s, cosine[k] * c - sine[k] * s


@inline_kernel
def _sines(t: Array, w: float, phi: float, equal: bool, sine: Array, cosine: Array) -> None:
    """Sine and cosine of w t + phi at all times (n,), where steps are equal by turning ever more of them."""
    known = min(4, t.size) if equal else t.size
    for k in range(known):
        sine[k], cosine[k] = sincos(w * t[k] + phi)
    while known < t.size:
        s, c = sincos(w * (t[known] - t[0]))
        end = min(2 * known, t.size)
        _turn(sine, cosine, s, c, sine[known:end], cosine[known:end])
        known = end


@inline_kernel
def _has_equal_steps(t: Array) -> bool:
    """Whether times differ by the same step, but for rounding."""
    equal = t.size > 1
    for k in range(2, t.size):
        equal &= abs((t[k] - t[k - 1]) - (t[1] - t[0])) <= _ROUNDING * (t[1] - t[0])
    return equal


@kernel
def tabulate_smooth(
    uniform: Array, choice: Array, t: Array, index: IntArray, out: Array, work: Array
) -> None:
    """Tables of random sums of a (sin(w t + phi) - sin(phi)) and their derivatives.

    Args:
        uniform: For each table three numbers in [0, 1) of each axis and harmonic, (m, 9 H): its share in the
            amplitude, its rate, its phase.
        choice: Bounds on the sum of the sines of each axis, m, and on their rates, rad/s, (5,).
        t: Times, (n,), s.
        index: Which tables are written, (m,).
        out: All tables, (M, n, >= 8); what is behind the heading is zero.
        work: Overwritten, (8, n).
    """
    drawn = uniform.reshape(uniform.shape[0], 3, 3, uniform.shape[1] // 9)
    paths, sine, cosine, equal = work[:6], work[6], work[7], _has_equal_steps(t)
    for m in range(index.size):
        paths[:] = 0.0
        for axis in range(3):
            shares, position, velocity = drawn[m, 0, axis], paths[axis], paths[3 + axis]
            total = 0.0
            for i in range(shares.size):
                total += shares[i]
            for i in range(shares.size):
                a = shares[i] / total * choice[axis]
                w = choice[3] + (choice[4] - choice[3]) * drawn[m, 1, axis, i]
                phi = 2.0 * math.pi * drawn[m, 2, axis, i]
                first, _ = sincos(phi)
                _sines(t, w, phi, equal, sine, cosine)
                for k in range(t.size):
                    position[k] += a * (sine[k] - first)
                    velocity[k] += a * w * cosine[k]
        table = out[index[m]]
        for k in range(t.size):
            for c in range(6):
                table[k, c] = paths[c, k]
            table[k, SINE], table[k, COSINE] = 0.0, 1.0
            for c in range(N_REFERENCE, table.shape[1]):
                table[k, c] = 0.0


_tabulate_smooth = entry_of(tabulate_smooth)


@dataclass(frozen=True, slots=True)
class RandomSmooth:
    """A sum of sines per axis with random amplitudes, rates and phases, shifted to start at the origin.

    Raises:
        ValueError: If the rates are not 0 < rate_min <= rate_max, there is no harmonic, or one that is drawn
            may be faster than any vehicle.
    """

    amplitude: tuple[float, float, float] = (3.0, 3.0, 1.5)  # m, bound on the sum of the sines per axis
    rate_min: float = 0.2  # rad/s
    rate_max: float = 1.2  # rad/s
    harmonics: int = 3
    random: ClassVar[bool] = True

    def __post_init__(self) -> None:
        require_kinds(self)
        if not 0.0 < self.rate_min <= self.rate_max:
            raise ValueError(
                f"need 0 < rate_min <= rate_max, got {shown(self.rate_min)} and {shown(self.rate_max)} rad/s"
            )
        require_whole("harmonics", self.harmonics, 1, _MOST_HARMONICS)
        fastest = self.rate_max * math.hypot(*self.amplitude)
        if not fastest <= FASTEST:
            raise ValueError(
                f"a random reference of amplitude {shown(self.amplitude)} m and rates up to "
                f"{self.rate_max:g} rad/s may move at {fastest:.4g} m/s, and no quadrotor flies faster than "
                f"{FASTEST:g} m/s: lower one of them"
            )

    @property
    def numbers(self) -> int:
        """How many uniform numbers make a trajectory."""
        return 9 * self.harmonics

    def rows(self, t: Array, rng: np.random.Generator) -> Array:
        """Reference rows of a new random trajectory, (n, 8)."""
        out = np.empty((1, t.size, N_REFERENCE))
        self.tabulate(rng.random((1, self.numbers)), t, np.zeros(1, dtype=np.int64), out)
        return np.asarray(out[0])

    def tabulate(self, uniform: Array, t: Array, index: IntArray, out: Array) -> None:
        """Write tables of random trajectories; arguments as in `tabulate_smooth`."""
        choice = np.array([*self.amplitude, self.rate_min, self.rate_max])
        work = np.empty((8, t.size))
        _tabulate_smooth(np.ascontiguousarray(uniform), choice, np.ascontiguousarray(t), index, out, work)


@dataclass(frozen=True, slots=True)
class Heading:
    """Another trajectory with a heading of its own: psi = yaw + rate t, or along the path where `tangent`.

    Where the path rests (below 0.05 m/s in the horizontal plane) it has no direction: a tangent heading stays
    as it was, and before the path sets out it is that of its first movement. A heading that turns by more
    than 2 pi rad/s jumps: controllers and reward take its rate for 0.
    """

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
            psi = psi + _path_direction(rows[:, 3:5])
        return pack_rows(rows[:, :3], rows[:, 3:6], psi)


def _path_direction(v: Array) -> Array:
    """Direction of horizontal velocities (n, 2) in order of time, unwrapped; kept in rests, (n,)."""
    moves = np.hypot(v[:, 0], v[:, 1]) >= _RESTING_SPEED
    if not moves.any():
        return np.zeros(len(v))
    last = np.maximum.accumulate(np.where(moves, np.arange(len(v)), int(np.argmax(moves))))
    return np.unwrap(np.arctan2(v[:, 1], v[:, 0])[last])
