"""Limits of a flight, each a value from which environments, adjoint, MPC rows, tables, page, docs follow.

A limit is a box on some of the outputs y_k = [x_k, u_k - u_k-1], (16,), Eqs. (3.10) and (3.11): the state
after a step, and the change of the rotor commands in it. A new one is a row of `LIMITS`, a bound in `Limits`
and an argument in `LimitOptions`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from .arguments.kinds import is_limit, is_number, require_kinds
from .arguments.names import shown
from .plant import N_INPUT, N_STATE, POSITION, RATES, VELOCITY, Array

MOST_KAPPA = 20.0  # thrust-to-weight 80, beyond any vehicle; the dissertation has 1
LEAST_LIMIT = 1e-6  # SI; below, the relative size of a violation means nothing
N_OUTPUT = N_STATE + N_INPUT
_Triple = tuple[float, float, float]


class Limit(NamedTuple):
    """A limit; `Limits` has its bound, `LimitOptions` the environment's argument."""

    name: str  # in `task.constraint_names` and in `Limits`; the argument is `<name>_limit`
    unit: str  # of its value
    outputs: slice  # the entries of y that it bounds
    about: str  # what they are
    scale: float | None = None  # violation that costs the whole reward of a step; None: the bound itself
    per_second: bool = False  # whether the bound is given per second, and holds for a control period
    box: bool = False  # whether the bound is `<name>_lower`, `<name>_upper` instead of one magnitude
    below: tuple[float, str] = (math.inf, "")  # what a finite bound is less than, and in words

    @property
    def option(self) -> str:
        """The environment's argument."""
        return f"{self.name}_limit"

    @property
    def given_unit(self) -> str:
        """Unit of the bound as it is given."""
        return f"{self.unit}/s" if self.per_second else self.unit


# In the order of `task.constraint_names`.
LIMITS = (
    Limit("tilt", "rad", slice(6, 8), "roll and pitch", 0.1, below=(math.pi / 2, "pi/2")),
    Limit("velocity", "m/s", VELOCITY, "each component of the body velocity", 0.5),
    Limit("position", "m", POSITION, "the position, NED", 0.1, box=True),
    Limit("rate", "N", slice(N_STATE, N_OUTPUT), "the change of each rotor command", per_second=True),
    Limit("body_rate", "rad/s", RATES, "each body rate: p, q, r", 0.5),
)
# Of each value in `info["constraint_values"]`; what only teams have is the distance between vehicles.
UNITS = {limit.name: limit.unit for limit in LIMITS} | {"separation": "m"}


@dataclass(frozen=True, slots=True)
class Limits:
    """What a flight may not exceed. Infinity means no limit.

    The rotor box is physical: the plant saturates. The others are constraints, Eqs. (3.10) and (3.11):
    exceeding them is counted, costs reward, and is what an MPC plans around.

    Raises:
        ValueError: If kappa leaves no hover, a limit is not positive, or the position box is empty.
    """

    # -, largest rotor force as a fraction of the weight, Eq. (2.39): one number, or one per rotor
    kappa: float | tuple[float, ...] = 1.0
    rate: float = math.inf  # N/s, change of each rotor command
    tilt: float = math.inf  # rad, |roll| and |pitch|
    velocity: float = math.inf  # m/s, each body velocity component
    position_lower: _Triple = (-math.inf, -math.inf, -math.inf)  # m, NED
    position_upper: _Triple = (math.inf, math.inf, math.inf)  # m, NED
    body_rate: float = math.inf  # rad/s, |p|, |q| and |r|

    def __post_init__(self) -> None:
        require_kinds(self)
        if len(self.kappas) != N_INPUT:
            raise ValueError(f"kappa must be one number or one per rotor, got {shown(self.kappa)}")
        for i, kappa in enumerate(self.kappas):
            if not (is_number(kappa) and 0.25 < kappa <= MOST_KAPPA):
                which = f" for rotor {i + 1}" if isinstance(self.kappa, tuple) else ""
                raise ValueError(
                    "kappa, the largest rotor force as a fraction of the weight, must lie in "
                    f"(1/4, {MOST_KAPPA:g}], got {shown(kappa)}{which}; hover needs m g / 4 of every rotor. "
                    "It is a quarter of the thrust-to-weight ratio; 0.3125 gives the dissertation's 2.45 N"
                )
        for limit in LIMITS:
            if limit.box:
                self._require_box(limit)
            else:
                self._require_magnitude(limit)

    def _require_magnitude(self, limit: Limit) -> None:
        value, unit = getattr(self, limit.name), limit.given_unit
        if not (is_limit(value) and value > 0.0):
            raise ValueError(f"{limit.name} limit must be > 0 {unit} (math.inf for none), got {shown(value)}")
        if value < LEAST_LIMIT:
            raise ValueError(
                f"{limit.name} limit must be at least {LEAST_LIMIT:g} {unit}, so that a violation can be "
                f"told from rounding, got {shown(value)}"
            )
        most, words = limit.below
        if math.isfinite(value) and value >= most:
            raise ValueError(
                f"{limit.name} limit must be below {words} {unit} (math.inf for none), got {shown(value)}"
            )

    def _require_box(self, limit: Limit) -> None:
        lower, upper = self._given(limit)
        if len(lower) != 3 or len(upper) != 3:
            raise ValueError(f"{limit.name} limits need three numbers (x, y, z), {limit.unit}")
        for axis, low, high in zip("xyz", lower, upper, strict=True):
            if not (is_limit(low) and is_limit(high) and low < high):
                raise ValueError(
                    f"{limit.name} limit on {axis} needs numbers lower < upper, got [{shown(low)}, "
                    f"{shown(high)}] {limit.unit}"
                )

    def _given(self, limit: Limit) -> tuple[Any, Any]:
        """The bounds as they were given: two triples, or two numbers."""
        if limit.box:
            return getattr(self, f"{limit.name}_lower"), getattr(self, f"{limit.name}_upper")
        return -getattr(self, limit.name), getattr(self, limit.name)

    @property
    def kappas(self) -> tuple[float, ...]:
        """The largest force of each rotor as a fraction of the weight, (4,)."""
        return self.kappa if isinstance(self.kappa, tuple) else (self.kappa,) * N_INPUT

    @property
    def has_position(self) -> bool:
        """Whether any face of the position box is finite."""
        return any(math.isfinite(value) for value in (*self.position_lower, *self.position_upper))

    def chosen(self) -> tuple[Limit, ...]:
        """The limits that are set, in the order of `LIMITS`."""
        return tuple(
            limit for limit in LIMITS if np.isfinite(np.array(self._given(limit), dtype=float)).any()
        )

    def output_box(self, dt: float) -> tuple[Array, Array]:
        """Lower and upper bound of every output y, (16,) each, +-inf where nothing bounds it.

        Args:
            dt: Control period, s.
        """
        lower, upper = np.full(N_OUTPUT, -math.inf), np.full(N_OUTPUT, math.inf)
        for limit in LIMITS:
            period = dt if limit.per_second else 1.0
            lower[limit.outputs], upper[limit.outputs] = (np.multiply(b, period) for b in self._given(limit))
        return lower, upper

    def state_box(self) -> tuple[Array, Array]:
        """Lower and upper bound of every entry of the state, (12,) each, +-inf where nothing bounds it."""
        lower, upper = self.output_box(1.0)
        return lower[:N_STATE], upper[:N_STATE]

    def scale(self, limit: Limit, dt: float) -> float:
        """Violation of a limit that costs the whole reward of a step."""
        if limit.scale is not None:
            return limit.scale
        return float(getattr(self, limit.name) * (dt if limit.per_second else 1.0))


@dataclass(frozen=True, slots=True, kw_only=True)
class LimitOptions:
    """The limits as every environment takes them; none but kappa is set by default."""

    # largest rotor force as a fraction of the weight m g, in (1/4, 20]: one number, or one per rotor
    kappa: float | tuple[float, float, float, float] = 1.0
    rate_limit: float = math.inf  # N/s, change of each rotor command
    tilt_limit: float = math.inf  # rad, |roll| and |pitch|
    velocity_limit: float = math.inf  # m/s, each component of the body velocity
    position_limit: tuple[_Triple, _Triple] | None = None  # m, NED: ((x, y, z) lower, (x, y, z) upper)
    # An MPC does not model the 20 ms of the rotors, which body rates follow at once: it exceeds its own bound
    # by up to a fifth, and a `margin` of that size keeps the limit.
    body_rate_limit: float = math.inf  # rad/s, |p|, |q| and |r|

    def require_limits(self) -> None:
        """Check the shapes of what was given; `make_limits` checks the values.

        Raises:
            ValueError: If one is not allowed.
        """
        rotors = self.kappa if isinstance(self.kappa, tuple) else (self.kappa,) * N_INPUT
        if len(rotors) != N_INPUT or not all(map(is_number, rotors)):
            raise ValueError(
                f"kappa must be a number or {N_INPUT} of them, one per rotor, got {shown(self.kappa)}"
            )
        for limit in LIMITS:
            box = getattr(self, limit.option)
            if limit.box and not (
                box is None or (isinstance(box, tuple) and len(box) == 2 and all(map(_is_triple, box)))
            ):
                raise ValueError(
                    f"{limit.option} must be None or ((x, y, z) lower, (x, y, z) upper), got {shown(box)}"
                )
            if not limit.box and not isinstance(box, int | float | np.integer | np.floating):
                raise ValueError(
                    f"{limit.option} must be a number, {limit.given_unit} (math.inf for none), "
                    f"got {shown(box)}"
                )

    def make_limits(self) -> Limits:
        """The limits that are set."""
        bounds: dict[str, Any] = {}
        for limit in LIMITS:
            given = getattr(self, limit.option)
            if not limit.box:
                bounds[limit.name] = given
            elif given is not None:
                bounds[f"{limit.name}_lower"], bounds[f"{limit.name}_upper"] = given
        return Limits(kappa=self.kappa, **bounds)


def _is_triple(value: object) -> bool:
    """Whether it is three numbers, possibly infinite."""
    return isinstance(value, tuple) and len(value) == 3 and all(map(is_limit, value))
