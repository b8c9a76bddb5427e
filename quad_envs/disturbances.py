"""Disturbances, as data: [torque 3 (body axes, N m), force 3 (inertial axes, N)] at the stage times of RK4.

A disturbance gives its value at nodes t of shape (n_steps, 2 substeps + 1): row k holds the stage times of
control step k, so that a step may begin or end a pulse without smearing it over its neighbour.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any, ClassVar, Protocol, TypeAlias, runtime_checkable

import numpy as np
from numpy.typing import ArrayLike

from .arguments.kinds import as_tuple, is_number, make_kind, refuse_class, require_kinds, without_booleans
from .arguments.names import shown, unknown_name
from .authority import hover_authority
from .compilation.decorators import inline_kernel, kernel
from .compilation.normals import draw, drawn_size, key_of
from .limits import Limits
from .parameters import Array, QuadrotorParams

_Vector = tuple[float, float, float]
_ZERO: _Vector = (0.0, 0.0, 0.0)


@runtime_checkable
class Disturbance(Protocol):
    """What an environment needs of a disturbance.

    One that also has `size()`, (6,), its standard deviation where it is random and else its peak, is compared
    with what the vehicle can hold. An impulse is over before a rotor can answer, and has none.
    """

    @property
    def random(self) -> bool:
        """Whether `values` draws from the generator."""
        ...

    def values(self, t: Array, rng: np.random.Generator) -> Array:
        """Torque and force at the nodes t (n_steps, n_nodes), s: (n_steps, n_nodes, 6)."""
        ...


@dataclass(frozen=True, slots=True)
class TorquePulse:
    """e^{-0.1 a} [sin 10a, cos 10a, 0] N m while start < t < stop, section 4.6.

    The text does not say from when `a` counts. `clock="absolute"` (a = t) is the reading that a vehicle with
    the printed rotors survives; `"relative"` (a = t - start) starts with 1 N m, beyond its roll authority of
    0.65 N m.

    Raises:
        ValueError: If the clock is unknown or start >= stop.
    """

    start: float = 5.0  # s
    stop: float = 10.0  # s
    amplitude: float = 1.0  # N m at a = 0
    frequency: float = 10.0  # rad/s
    decay: float = 0.1  # 1/s
    clock: str = "absolute"
    random: ClassVar[bool] = False

    def __post_init__(self) -> None:
        require_kinds(self)
        if self.clock not in ("absolute", "relative"):
            raise ValueError(f"clock must be 'absolute' or 'relative', got {shown(self.clock)}")
        if not self.start < self.stop:
            raise ValueError(f"a pulse needs start < stop, got {shown(self.start)} and {self.stop!r} s")

    def size(self) -> Array:
        """Largest value of each component, (6,)."""
        peak = abs(self.amplitude)
        if self.clock == "absolute":
            peak *= max(math.exp(-self.decay * time) for time in (self.start, self.stop))
        return np.array([peak, peak, 0.0, 0.0, 0.0, 0.0])

    def values(self, t: Array, rng: np.random.Generator) -> Array:
        """Torque and force at the nodes, (n_steps, n_nodes, 6); a step is inside or outside as a whole."""
        a = t - self.start if self.clock == "relative" else t
        middle = t[:, t.shape[1] // 2]
        inside = ((middle > self.start) & (middle < self.stop))[:, None]
        size = np.where(inside, self.amplitude * np.exp(-self.decay * a), 0.0)
        out = np.zeros((*t.shape, 6))
        out[..., 0] = size * np.sin(self.frequency * a)
        out[..., 1] = size * np.cos(self.frequency * a)
        return out


@dataclass(frozen=True, slots=True)
class Steady:
    """A constant force and torque: wind, a shifted centre of mass."""

    force: _Vector = (0.5, 0.0, 0.0)  # N, inertial
    torque: _Vector = _ZERO  # N m, body
    random: ClassVar[bool] = False

    def size(self) -> Array:
        """Size of each component, (6,)."""
        return np.abs(np.array([*self.torque, *self.force], dtype=np.float64))

    def values(self, t: Array, rng: np.random.Generator) -> Array:
        """Torque and force at the nodes, (n_steps, n_nodes, 6)."""
        return np.broadcast_to(np.array([*self.torque, *self.force]), (*t.shape, 6)).copy()


# Gusts that are not given in numbers: shares of what the vehicle holds in hover, `hover_authority`.
_TORQUE_SHARES = np.array(
    [0.03, 0.03, 0.1]
)  # roll, pitch, yaw: yaw is weak, and propellers turn with the wind
_ANGULAR_ACCELERATION = 1.0  # rad/s^2: a light vehicle has more authority than a control period can use
_FORCE_SHARE = 0.25  # and not above
_FORCE_OF_WEIGHT = 1.0 / 16.0  # 0.49 N of the default vehicle


# What normal numbers of an episode's key are for, see `normals.draw`.
_AT_FIRST, _FROM_NODE_TO_NODE = 0, 1
_FIRST_NUMBERS = drawn_size(6)


@inline_kernel
def blow(nodes: Array, key: int, period: int, keep: float, size: Array, drawn: Array) -> None:
    """Gusts of the next control period: first-order Gauss-Markov processes, exactly discretised.

    Each component goes on as x_i = e^(-h / tau) x_i-1 + sqrt(1 - e^(-2 h / tau)) sigma z_i from stage time to
    stage time, h apart, and begins as sigma z_0.

    Args:
        nodes: Those of the period before, of which the last is the first of this one, (2 substeps + 1, 6).
        key: Of the episode.
        period: Control period, from 0.
        keep: e^(-h / tau), what is left of a value from node to node.
        size: Standard deviations sigma, (6,).
        drawn: Scratch, (gust_numbers(2 substeps + 1),).
    """
    last = nodes.shape[0] - 1
    if period == 0:
        draw(key, 0, _AT_FIRST, drawn[:_FIRST_NUMBERS])
        for c in range(6):
            nodes[last, c] = size[c] * drawn[c]
    for c in range(6):
        nodes[0, c] = nodes[last, c]
    draw(key, period, _FROM_NODE_TO_NODE, drawn)
    fresh = math.sqrt(1.0 - keep * keep)
    for i in range(1, last + 1):
        for c in range(6):
            nodes[i, c] = keep * nodes[i - 1, c] + fresh * size[c] * drawn[6 * (i - 1) + c]


def gust_numbers(nodes: int) -> int:
    """Length of the scratch of `blow` for control periods of so many nodes."""
    return drawn_size(6 * (nodes - 1))


@kernel
def _tabulate_gusts(key: int, keep: float, size: Array, drawn: Array, out: Array) -> None:
    """Gusts of all periods, (steps, nodes, 6)."""
    last = out.shape[1] - 1
    for k in range(out.shape[0]):
        for c in range(6):
            out[k, last, c] = out[max(k - 1, 0), last, c]
        blow(out[k], key, k, keep, size, drawn)


@dataclass(frozen=True, slots=True)
class Gusts:
    """Force and torque as first-order Gauss-Markov processes: turbulence with a correlation time.

    What is None follows the vehicle: a force of 1/16 of its weight (at most a quarter of what it can hold)
    and torques of 3, 3 and 10 % of what its rotors can hold about roll, pitch and yaw in hover, at most
    1 rad/s^2. That is 0.49 N and (0.019, 0.019, 0.0017) N m for the default vehicle.

    Raises:
        ValueError: If a deviation is negative or the correlation time is not positive.
    """

    force: float | _Vector | None = None  # N, standard deviation of the inertial components
    torque: float | _Vector | None = None  # N m, standard deviation of the body components
    correlation_time: float = 1.0  # s
    random: ClassVar[bool] = True

    def __post_init__(self) -> None:
        require_kinds(self)
        for name, unit in (("force", "N"), ("torque", "N m")):
            value = getattr(self, name)
            size = np.asarray(0.0 if value is None else value, dtype=np.float64)
            if size.shape not in ((), (3,)) or not (np.isfinite(size).all() and (size >= 0.0).all()):
                raise ValueError(
                    f"{name} of gusts must be None, one standard deviation >= 0 or three of them, {unit}, "
                    f"got {shown(value)}"
                )
        if not self.correlation_time > 0.0:
            raise ValueError(f"correlation_time must be > 0 s, got {shown(self.correlation_time)}")

    def for_vehicle(self, params: QuadrotorParams, limits: Limits) -> Gusts:
        """These gusts with the deviations that are None in numbers of a vehicle."""
        authority = hover_authority(params, limits)
        force = min(_FORCE_OF_WEIGHT * params.weight, _FORCE_SHARE * float(authority[3:].min()))
        most = _ANGULAR_ACCELERATION * np.array(params.inertia)
        x, y, z = np.minimum(_TORQUE_SHARES * authority[:3], most).tolist()
        return replace(
            self,
            force=force if self.force is None else self.force,
            torque=(x, y, z) if self.torque is None else self.torque,
        )

    def size(self) -> Array:
        """Standard deviation of each component, (6,)."""
        known = self
        if self.force is None or self.torque is None:
            known = self.for_vehicle(QuadrotorParams(), Limits())
        parts = (np.asarray(value, dtype=np.float64) for value in (known.torque, known.force))
        return np.concatenate([np.broadcast_to(part, 3) for part in parts])

    def keep(self, h: float) -> float:
        """What is left of a value after a time h, s."""
        return math.exp(-h / self.correlation_time)

    def values(self, t: Array, rng: np.random.Generator) -> Array:
        """Torque and force at the nodes, (n_steps, n_nodes, 6), continuous from step to step.

        They follow from one uniform number of the generator. Environments draw them period by period.
        """
        steps, nodes = t.shape
        out = np.zeros((steps, nodes, 6))
        key, drawn = int(key_of(rng.random())), np.empty(gust_numbers(nodes))
        _tabulate_gusts(key, self.keep(float(t[0, 1] - t[0, 0])), self.size(), drawn, out)
        return out


@dataclass(frozen=True, slots=True)
class VariedGusts(Gusts):
    """Air that differs from episode to episode: calm, gusts, or gusts about a steady force and torque.

    Each of the three is as likely. Gusts have a random share of `largest` times the deviations of `Gusts`,
    the steady part lies within `largest` times these, and the correlation time is half to three times the
    given one.
    """

    largest: float = 1.5  # of gusts and of the steady part, in deviations of `Gusts`

    def __post_init__(self) -> None:
        Gusts.__post_init__(self)
        if not (is_number(self.largest) and self.largest >= 0.0):
            raise ValueError(f"largest of varied gusts must be finite and >= 0, got {shown(self.largest)}")

    def values(self, t: Array, rng: np.random.Generator) -> Array:
        """Torque and force at the nodes of a new episode, (n_steps, n_nodes, 6)."""
        kind, share, steady = rng.integers(3), self.largest * rng.random(), rng.uniform(-1.0, 1.0, 6)
        if kind == 0:
            return np.zeros((*t.shape, 6))
        varied = replace(self, correlation_time=self.correlation_time * rng.uniform(0.5, 3.0))
        gusts = share * Gusts.values(varied, t, rng)
        return gusts + self.largest * self.size() * steady if kind == 2 else gusts


@dataclass(frozen=True, slots=True)
class Impulse:
    """A push: linear and angular momentum given evenly over the control period that contains `time`."""

    time: float = 2.0  # s
    momentum: _Vector = (0.8, 0.0, 0.0)  # N s, inertial
    angular_momentum: _Vector = _ZERO  # N m s, body
    random: ClassVar[bool] = False

    def values(self, t: Array, rng: np.random.Generator) -> Array:
        """Torque and force at the nodes, (n_steps, n_nodes, 6)."""
        out = np.zeros((*t.shape, 6))
        hit = (t[:, 0] <= self.time + 1e-9) & (self.time + 1e-9 < t[:, -1])
        duration = t[0, -1] - t[0, 0]
        out[hit] = np.array([*self.angular_momentum, *self.momentum]) / duration
        return out


@dataclass(frozen=True, slots=True)
class FunctionDisturbance:
    """A function t -> force (3), N, inertial, or force and torque (6), N m, body axes."""

    function: Callable[[float], ArrayLike]
    random: ClassVar[bool] = False

    def values(self, t: Array, rng: np.random.Generator) -> Array:
        """Torque and force at the nodes, (n_steps, n_nodes, 6); a jump does not reach the step before it."""
        times = t.copy()
        times[:, -1] -= 1e-6 * (t[:, -1] - t[:, 0])
        given = [self.function(float(time)) for time in times.ravel()]
        try:
            out = np.array(given, dtype=np.float64)
        except (TypeError, ValueError, OverflowError):
            out = np.empty((0, 0))
        if out.ndim != 2 or out.shape[1] not in (3, 6):
            raise ValueError(
                "a disturbance as a function must return 3 (force) or 6 (force, torque) numbers at every "
                f"time, got {shown(given[0])} at first"
            )
        torque = out[:, 3:] if out.shape[1] == 6 else np.zeros_like(out)
        return np.concatenate([torque, out[:, :3]], axis=1).reshape(*t.shape, 6)


DISTURBANCES: dict[str, Disturbance] = {
    "torque-pulse": TorquePulse(),
    "steady": Steady(),
    "gusts": Gusts(),
    "varied-gusts": VariedGusts(),
    "impulse": Impulse(),
}
DisturbanceLike: TypeAlias = (
    "str | Disturbance | Mapping[str, Any] | tuple[float, ...] | Callable[[float], ArrayLike] | None"
)


def make_disturbance(what: DisturbanceLike) -> Disturbance | None:
    """A disturbance from what a user has at hand.

    Args:
        what: A name, a mapping {"kind": "steady", "force": [0, 1, 0]}, three numbers (a constant force, N,
            inertial) or six (and a torque, N m, body axes), a function of time that returns as many, a
            Disturbance, or None (also "none").

    Raises:
        ValueError: If it is none of these.
    """
    if what is None or (isinstance(what, str) and what == "none"):
        return None
    refuse_class("disturbance", what)
    if isinstance(what, Disturbance):
        checked: Disturbance = without_booleans("disturbance", what, DISTURBANCES)
        return checked
    if isinstance(what, str):
        if what in DISTURBANCES:
            return DISTURBANCES[what]
        raise ValueError(unknown_name("disturbance", what, ["none", *DISTURBANCES]))
    if isinstance(what, Mapping):
        made: Disturbance = make_kind("disturbance", what, DISTURBANCES)
        return made
    if callable(what):
        return FunctionDisturbance(what)
    numbers = as_tuple(what)
    if not isinstance(numbers, tuple) or len(numbers) not in (3, 6) or not all(map(is_number, numbers)):
        raise ValueError(
            "disturbance must be None, a name, a mapping with 'kind', a force of 3 finite numbers, N (or 6, "
            f"with a torque, N m), a function of time or a Disturbance, got {shown(what)}"
        )
    force, torque = numbers[:3], numbers[3:] or _ZERO
    return Steady(force=force, torque=torque)


def disturbance_of(what: DisturbanceLike, params: QuadrotorParams, limits: Limits) -> Disturbance | None:
    """`make_disturbance` for a vehicle: with the deviations that follow from it."""
    made = make_disturbance(what)
    if isinstance(made, Gusts):
        return made.for_vehicle(params, limits)
    return made


_COMPONENTS = (*(f"torque about body {axis}" for axis in "xyz"), *(f"force along {axis}" for axis in "xyz"))


def beyond_authority(disturbance: Disturbance | None, params: QuadrotorParams, limits: Limits) -> str:
    """What a person should know of a disturbance that no policy can hold; empty where there is nothing."""
    size = getattr(disturbance, "size", None)
    if size is None:
        return ""
    found, authority = np.asarray(size(), dtype=np.float64), hover_authority(params, limits)
    excess = found / authority
    worst = int(np.argmax(excess))
    if not excess[worst] > 1.0:
        return ""
    unit, kind = "N m" if worst < 3 else "N", "1 sigma" if disturbance and disturbance.random else "peak"
    return (
        f"the disturbance's {_COMPONENTS[worst]}, {found[worst]:.3g} {unit} ({kind}), exceeds the "
        f"{authority[worst]:.3g} {unit} that the vehicle can hold in hover: no policy can fly it for long; "
        "lower it (disturbance='gusts' has sizes that follow from the vehicle)"
    )
