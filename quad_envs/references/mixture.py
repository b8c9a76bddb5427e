"""A mixture of trajectories: in every episode one of another family, with parameters of its own."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from ..arguments.checks import Bound, require_number
from ..parameters import Array
from .trajectories import (
    Helix,
    Lemniscate,
    OutAndBack,
    RandomSmooth,
    Reference,
    SetPoint,
    SphericalSpiral,
    pack_rows,
)

_WEIGHT = Bound(0.0, 1e6, "", "only their ratios count")
_OFFSET = Bound(0.0, 1e3, "m", "a vehicle that starts farther away is lost")
_SHARE = Bound(0.0, 1.0)
_TURNING = 0.4  # rad/s, fastest heading
_Draw = Callable[[float, float], float]  # uniform between two numbers


def _some_helix(draw: _Draw) -> Helix:
    """Half of them any, half nearly as fast as that of the suite, on which alone networks learn its speed."""
    if draw(0.0, 1.0) < 0.5:
        return Helix(radius=draw(1.8, 6.6), rate=draw(0.2, 0.48), vertical_speed=draw(-3.2, 3.2))
    return Helix(radius=draw(4.8, 6.6), rate=draw(0.32, 0.44), vertical_speed=draw(2.0, 3.3))


def _some_spiral(draw: _Draw) -> SphericalSpiral:
    return SphericalSpiral(radius=draw(2.25, 4.95), rate=draw(0.15, 0.3), latitude_rate=draw(-0.36, 0.36))


def _some_lines(draw: _Draw) -> OutAndBack:
    return OutAndBack(speed=draw(-1.5, 1.5), vertical_speed=draw(-1.2, 1.2), turn_time=draw(2.0, 7.0))


def _some_lemniscate(draw: _Draw) -> Lemniscate:
    return Lemniscate(
        length=draw(1.5, 3.6), width=draw(0.75, 1.8), height=draw(-0.8, 0.8), rate=draw(0.36, 0.72)
    )


def _some_smooth(draw: _Draw) -> RandomSmooth:
    """The faster, the smaller, so that speeds stay."""
    pace = draw(0.6, 1.4)
    return RandomSmooth(
        amplitude=(3.0 / pace, 3.0 / pace, 1.5 / pace), rate_min=0.2 * pace, rate_max=1.2 * pace
    )


# Of each family a draw of its parameters, around those of the suite's own trajectories.
_FAMILIES: dict[str, Callable[[_Draw], Reference]] = {
    "setpoint": lambda draw: SetPoint(),
    "helix": _some_helix,
    "spiral": _some_spiral,
    "lines": _some_lines,
    "lemniscate": _some_lemniscate,
    "smooth": _some_smooth,
}


@dataclass(frozen=True, slots=True)
class Mixture:
    """In every episode a trajectory of another family, with random parameters, turned and displaced.

    The first fields are the weights of the families: `Mixture(helix=1, smooth=3)` changes two of them, 0
    leaves a family out. Speeds reach 4.5 m/s. What is drawn is turned about the vertical by any angle, and
    starts at a random point near the origin, a spiral on its sphere. The heading begins at 0 and stays there,
    or turns.

    Raises:
        ValueError: If a weight is negative, all are zero, or the offset is not allowed.
    """

    setpoint: float = 1.0  # weight of rest at a point
    helix: float = 2.0  # of helices, half of them nearly as fast as that of the suite
    spiral: float = 1.0  # of spherical spirals
    lines: float = 1.0  # of lines out and back
    lemniscate: float = 1.0  # of lemniscates, up to 1.2 times as fast as that of the suite
    smooth: float = 2.0  # of sums of sines, `RandomSmooth`
    offset: float = 2.0  # m, largest displacement along each axis; small ones are more frequent
    turning: float = 0.25  # share of the episodes in which the heading turns, at up to 0.4 rad/s
    random: ClassVar[bool] = True

    def __post_init__(self) -> None:
        for name in _FAMILIES:
            require_number(f"the weight {name!r} of a mixture", getattr(self, name), _WEIGHT)
        require_number("the offset of a mixture", self.offset, _OFFSET)
        require_number("the share of turning headings of a mixture", self.turning, _SHARE)
        if not any(self._weights()):
            raise ValueError(
                f"a mixture needs a family with a weight > 0, got 0 for all of {', '.join(_FAMILIES)}"
            )

    def _weights(self) -> list[float]:
        return [getattr(self, name) for name in _FAMILIES]

    def drawn(self, rng: np.random.Generator) -> Reference:
        """A trajectory of one of the families, neither turned nor displaced."""
        weights = np.cumsum(self._weights())
        family = int(np.searchsorted(weights, weights[-1] * rng.random(), side="right"))
        return list(_FAMILIES.values())[family](rng.uniform)

    def rows(self, t: Array, rng: np.random.Generator) -> Array:
        """Reference rows of a new trajectory, (n, 8)."""
        reference = self.drawn(rng)
        angle, share = rng.uniform(-np.pi, np.pi), rng.random()
        offset = share * self.offset * rng.uniform(-1.0, 1.0, 3)
        heading = rng.uniform(-_TURNING, _TURNING) if rng.random() < self.turning else 0.0
        rows = reference.rows(t, rng)
        c, s = math.cos(angle), math.sin(angle)
        turn = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
        return pack_rows(rows[:, :3] @ turn.T + offset, rows[:, 3:6] @ turn.T, heading * t)
