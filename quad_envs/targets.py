"""Targets to follow or to estimate, as data: rows [r 3, v 3] at given times; NED, inertial, SI.

The defaults are the motions of chapters 6 and 7. A target of your own is `target_from_function(f)`,
`PathTarget(reference)` of any reference, the path of a table, or any object with `random` and
`rows(t, rng)`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, Protocol, TypeAlias, runtime_checkable

import numpy as np
from numpy.typing import ArrayLike

from .arguments.kinds import make_kind, refuse_class, without_booleans
from .arguments.names import shown, unknown_name
from .parameters import Array
from .references import (
    REFERENCES,
    CsvTable,
    Reference,
    ReferenceLike,
    SetPoint,
    from_function,
    is_table,
    make_reference,
    plain_reference,
)

N_TARGET = 6  # r, v
_VECTORS = ("position", "velocity")
_Vector: TypeAlias = tuple[float, float, float]
_Manoeuvre: TypeAlias = Callable[[float], _Vector]

_LEAST_SPEED = 0.2  # m/s; gamma' and chi' are singular at rest
_LARGEST_CLIMB = math.radians(80.0)  # chi' is singular in vertical flight
_LONGEST_STEP = 0.02  # s, of RK4; its error over 20 s of the default manoeuvre is below 1e-8 m


@runtime_checkable
class Target(Protocol):
    """What an environment needs of a target."""

    @property
    def random(self) -> bool:
        """Whether `rows` draws from the generator, so that every episode has another motion."""
        ...

    def rows(self, t: Array, rng: np.random.Generator) -> Array:
        """Position and velocity at times t (n,), s, which start at or after 0 and increase: (n, 6)."""
        ...


def _require_finite(target: object, *names: str) -> None:
    """Refuse a target whose `position` and `velocity` are not three finite numbers, or others not one."""
    for name in names:
        value = getattr(target, name)
        shape, what = ((3,), "three finite numbers") if name in _VECTORS else ((), "a finite number")
        try:
            numbers = np.asarray(value, dtype=np.float64)
        except (TypeError, ValueError, OverflowError):
            numbers = np.empty(0)
        if numbers.shape != shape or not np.isfinite(numbers).all():
            raise ValueError(f"{name} of {type(target).__name__} must be {what}, got {shown(value)}")


def _require_times(t: Array) -> None:
    if t.size and (t[0] < 0.0 or (np.diff(t) < 0.0).any()):
        raise ValueError("times of a target that is integrated must start at or after 0 s and increase")


@dataclass(frozen=True, slots=True)
class StaticTarget:
    """At rest.

    Raises:
        ValueError: If the position is not three finite numbers.
    """

    position: _Vector = (3.0, 0.0, 0.0)  # m
    random: ClassVar[bool] = False

    def __post_init__(self) -> None:
        _require_finite(self, "position")

    def rows(self, t: Array, rng: np.random.Generator) -> Array:
        """Position and velocity, (n, 6)."""
        out = np.zeros((t.size, N_TARGET))
        out[:, :3] = self.position
        return out


@dataclass(frozen=True, slots=True)
class ConstantVelocity:
    """Constant velocity, disturbed by white acceleration of density q, section 6.2: the filter's own model.

    x_{k+1} = F x_k + w_k, w_k ~ N(0, Q), F = [[I, dt I], [0, I]],
    Q = q [[dt^3/3, dt^2/2], [dt^2/2, dt]] (x) I_3: exact for any sampling.

    Raises:
        ValueError: If a number is not finite or q < 0.
    """

    position: _Vector = (3.0, 0.0, 0.0)  # m, at t = 0
    velocity: _Vector = (0.6, 0.2, -0.1)  # m/s, at t = 0
    q: float = 0.0  # m^2/s^3

    def __post_init__(self) -> None:
        _require_finite(self, "position", "velocity", "q")
        if self.q < 0.0:
            raise ValueError(f"q of ConstantVelocity must be >= 0 m^2/s^3, got {shown(self.q)}")

    @property
    def random(self) -> bool:
        """Whether the acceleration is disturbed."""
        return self.q > 0.0

    def rows(self, t: Array, rng: np.random.Generator) -> Array:
        """Position and velocity, (n, 6)."""
        out = np.empty((t.size, N_TARGET))
        out[:, 3:] = self.velocity
        out[:, :3] = np.asarray(self.position) + t[:, None] * out[:, 3:]
        if self.random:
            _require_times(t)
            dt = np.diff(t, prepend=0.0)[:, None]
            # Q = L L' of each axis, L = sqrt(q dt) [[dt / sqrt 3, 0], [sqrt 3 / 2, 1 / 2]]
            white = rng.standard_normal((2, t.size, 3)) * np.sqrt(self.q * dt)
            gust = math.sqrt(0.75) * white[0] + 0.5 * white[1]
            change = np.cumsum(gust, axis=0)
            out[:, 3:] += change
            out[:, :3] += np.cumsum(dt * (change - gust) + dt * white[0] / math.sqrt(3.0), axis=0)
        return out


@dataclass(frozen=True, slots=True)
class TurningTarget:
    """A level turn at constant speed and rate, sinking or climbing steadily; rate 0 is a straight line.

    Raises:
        ValueError: If a number is not finite.
    """

    position: _Vector = (3.0, 0.0, 0.0)  # m, at t = 0
    speed: float = 0.8  # m/s, horizontal
    rate: float = 0.25  # rad/s, positive to the right
    vertical_speed: float = -0.1  # m/s, positive down
    heading: float = 0.0  # rad, at t = 0
    random: ClassVar[bool] = False

    def __post_init__(self) -> None:
        _require_finite(self, "position", "speed", "rate", "vertical_speed", "heading")

    def rows(self, t: Array, rng: np.random.Generator) -> Array:
        """Position and velocity, (n, 6)."""
        half = 0.5 * self.rate * t
        chord = self.speed * t * np.sinc(half / np.pi)  # 2 V / w sin(w t / 2), finite at w = 0
        middle, course = self.heading + half, self.heading + 2.0 * half
        r = np.stack([chord * np.cos(middle), chord * np.sin(middle), self.vertical_speed * t], axis=1)
        vz = np.full_like(t, self.vertical_speed)
        v = np.stack([self.speed * np.cos(course), self.speed * np.sin(course), vz], axis=1)
        return np.concatenate([np.asarray(self.position) + r, v], axis=1)


def weaving_climb(t: float) -> _Vector:
    """The default manoeuvre of `Aircraft`: V_c (m/s), a_v and a_h (m/s^2) at t."""
    return 2.0 + 0.5 * math.sin(0.4 * t), 0.5 * math.cos(0.5 * t), math.sin(0.3 * t)


@dataclass(frozen=True, slots=True)
class Aircraft:
    """A point-mass aircraft, Eq. (6.10), on a given manoeuvre.

    x' = V cos chi cos gamma, y' = V sin chi cos gamma, z' = -V sin gamma, V' = V_c - V, gamma' = a_v / V,
    chi' = a_h / (V cos gamma).

    Deviation: the text has z up; V >= 0.2 m/s and |gamma| <= 80 deg are kept, where it is singular.

    Raises:
        ValueError: If a number is not finite, the start is beyond these bounds, or the manoeuvre is not a
            function of time that returns three finite numbers.
    """

    position: _Vector = (6.0, -2.0, -5.0)  # m, at t = 0
    speed: float = 2.0  # m/s, V at t = 0
    climb: float = 0.05  # rad, gamma at t = 0, positive up
    course: float = 0.6  # rad, chi at t = 0
    manoeuvre: _Manoeuvre = weaving_climb  # t in s -> V_c (m/s), a_v up, a_h to the right (m/s^2)
    random: ClassVar[bool] = False

    def __post_init__(self) -> None:
        _require_finite(self, "position", "speed", "climb", "course")
        if self.speed < _LEAST_SPEED or abs(self.climb) > _LARGEST_CLIMB:
            raise ValueError(
                f"an aircraft needs speed >= {_LEAST_SPEED} m/s and |climb| <= {_LARGEST_CLIMB:.3f} rad, "
                f"got {shown(self.speed)} and {self.climb!r}"
            )
        if not callable(self.manoeuvre):
            raise ValueError(f"manoeuvre must be a function of time, got {shown(self.manoeuvre)}")
        self._inputs(0.0)

    def rows(self, t: Array, rng: np.random.Generator) -> Array:
        """Position and velocity, (n, 6), by RK4."""
        _require_times(t)
        x, now = np.array([*self.position, self.speed, self.climb, self.course]), 0.0
        out = np.empty((t.size, N_TARGET))
        for k, time in enumerate(t.tolist()):
            steps = math.ceil((time - now) / _LONGEST_STEP - 1e-9)
            h = (time - now) / max(steps, 1)
            for i in range(steps):
                x = self._step(now + i * h, x, h)
            now = time
            out[k, :3], out[k, 3:] = x[:3], self._derivative(now, x)[:3]
        return out

    def _step(self, t: float, x: Array, h: float) -> Array:
        f = self._derivative
        k1 = f(t, x)
        k2 = f(t + 0.5 * h, x + 0.5 * h * k1)
        k3 = f(t + 0.5 * h, x + 0.5 * h * k2)
        k4 = f(t + h, x + h * k3)
        x = x + (h / 6.0) * (k1 + 2.0 * (k2 + k3) + k4)
        x[3], x[4] = max(x[3], _LEAST_SPEED), min(max(x[4], -_LARGEST_CLIMB), _LARGEST_CLIMB)
        return x

    def _derivative(self, t: float, x: Array) -> Array:
        V, gamma = max(float(x[3]), _LEAST_SPEED), min(max(float(x[4]), -_LARGEST_CLIMB), _LARGEST_CLIMB)
        chi = float(x[5])
        V_c, a_v, a_h = self._inputs(t)
        level = V * math.cos(gamma)
        return np.array(
            [
                level * math.cos(chi),
                level * math.sin(chi),
                -V * math.sin(gamma),
                V_c - V,
                a_v / V,
                a_h / level,
            ]
        )

    def _inputs(self, t: float) -> _Vector:
        inputs = self.manoeuvre(t)
        if np.shape(inputs) != (3,) or not all(map(math.isfinite, inputs)):
            raise ValueError(
                f"manoeuvre must return three finite numbers (V_c, a_v, a_h), got {shown(inputs)} "
                f"at t = {t:g} s"
            )
        return inputs


@dataclass(frozen=True, slots=True)
class PathTarget:
    """A target on any trajectory whose rows begin with position and velocity; its heading is not read."""

    path: Reference | Target

    @property
    def random(self) -> bool:
        """As the trajectory inside."""
        return self.path.random

    def rows(self, t: Array, rng: np.random.Generator) -> Array:
        """Position and velocity, (n, 6)."""
        return np.array(self.path.rows(t, rng), dtype=np.float64)[..., :N_TARGET]


def target_from_function(function: Callable[[float], ArrayLike]) -> Target:
    """A target from a function t -> r (3) or [r, v] (6); without v it is differenced over 2 ms.

    Raises:
        ValueError: If it is not a function; when sampled, if it returns another shape or is not finite.
    """
    return PathTarget(from_function(function))


TARGETS: dict[str, Any] = {
    "static": StaticTarget(),
    "cv": ConstantVelocity(),
    "turn": TurningTarget(),
    "aircraft": Aircraft(),
    "chapter-6": ConstantVelocity((3.0, 3.0, -6.0), (0.8, 0.3, -0.1), 0.02),
    "path": PathTarget,
}
_KINDS = {**TARGETS, **REFERENCES}  # a target may move along any reference
TargetLike: TypeAlias = "Target | ReferenceLike"


def make_target(what: Any) -> Target:
    """A target from what a user has at hand.

    Args:
        what: A name, the path of a table, a mapping {"kind": "turn", "rate": 0.1}, a function t -> r (3) or
            [r, v] (6), an array as `ArrayTable` has it, three numbers (at rest), any reference, or a Target.

    Raises:
        ValueError: If it is none of these.
    """
    refuse_class("target", what)
    if isinstance(what, StaticTarget | ConstantVelocity | TurningTarget | Aircraft | PathTarget):
        checked: Target = without_booleans("target", what, TARGETS)
        return checked
    if isinstance(what, Target):
        return PathTarget(what)
    if isinstance(what, str) and what in _KINDS:
        return make_target({"kind": what})
    if isinstance(what, Mapping) and "kind" in what:
        return make_target(make_kind("target", what, _KINDS, {"reference": make_reference, "path": _path_of}))
    if isinstance(what, str) and not is_table(what):
        raise ValueError(f"{unknown_name('target', what, _KINDS)}, or the path of a table")
    made = CsvTable(what) if is_table(what) else plain_reference(what)
    if made is None:
        raise ValueError(
            "target must be a name, the path of a table, a mapping with 'kind', a function of time, an array "
            f"or a Target, got {shown(what)}"
        )
    return StaticTarget(made.position) if isinstance(made, SetPoint) else PathTarget(made)


def _path_of(what: Any) -> Any:
    """What the field `path` holds: of a table its file, of a `PathTarget` another trajectory."""
    return what if is_table(what) else make_target(what)
