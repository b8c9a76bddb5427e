"""Trajectories as functions of time, which may jump, and are asked within the episode only."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..arguments.names import shown
from ..parameters import Array
from ..rotations import wrap_angle
from .plausible import contradiction
from .trajectories import Reference, pack_rows
from .turning import LARGEST_TURN

_STEP = 1e-3  # s, of the differences where the function gives no velocity
_CORNER = 1.0  # m/s between the slopes before and after; a smooth path needs 1000 m/s^2 for it
_CLOSER = 0.1  # of the step, at which a jump has ten times the slope and a corner the same
_DIVERGES = 3.0
_WANTED = "a reference function must return 3 (p), 4 (p, psi), 6 (p, v) or 7 (p, v, psi) numbers"


@dataclass(frozen=True)
class FunctionReference:
    """A function t -> position, optionally velocity and heading; `from_function` documents it.

    Between 0 and `end` the function is asked; after it the trajectory goes on with its last velocity,
    and the heading with its last rate.
    """

    function: Callable[[float], ArrayLike]
    end: float = math.inf  # s, of the episode
    random: ClassVar[bool] = False

    def in_episode(self, dt: float, time_limit: float) -> FunctionReference:
        """The same within an episode of this length, s."""
        return replace(self, end=time_limit)

    def rows(self, t: Array, rng: np.random.Generator) -> Array:
        """Reference rows, (n, 8)."""
        asked, which = np.unique(np.clip(t, 0.0, self.end), return_inverse=True)
        values = self._values(asked)
        width = values.shape[1]
        if width >= 6:
            v = values[:, 3:6]
            said = contradiction(asked, values[:, :3], v) if asked.size > 1 else ""
            if said:
                warnings.warn(f"the reference function: {said}", stacklevel=2)
        else:
            v = self._slopes(asked, values[:, :3])
        psi = values[:, {4: 3, 7: 6}[width]] if width in (4, 7) else np.zeros(asked.size)
        beyond = t - asked[which]
        p = values[which, :3] + beyond[:, None] * v[which]
        return pack_rows(p, v[which], psi[which] + beyond * self._last_turn(asked, psi))

    def _last_turn(self, t: Array, psi: Array) -> float:
        """Rate at which the heading goes on after the episode, rad/s: its last one, 0 after a jump."""
        if t.size < 2:
            return 0.0
        rate = float(wrap_angle(psi[-1] - psi[-2]) / (t[-1] - t[-2]))
        return rate if abs(rate) <= LARGEST_TURN else 0.0

    def _slopes(self, t: Array, p: Array) -> Array:
        """Derivatives of the positions p (n, 3) at times t (n,): of the smooth side where there is a jump."""
        before, after = self._sided(t, p, -_STEP), self._sided(t, p, _STEP)
        inner = (t - _STEP >= 0.0) & (t + _STEP <= self.end)
        apart = np.linalg.norm(after - before, axis=1) > _CORNER
        out = 0.5 * (before + after)
        out[~inner] = np.where((t < _STEP)[:, None], after, before)[~inner]
        sharp = np.flatnonzero(inner & apart)
        if sharp.size:
            left, jumps_before = self._closer(t[sharp], p[sharp], before[sharp], -_STEP)
            right, jumps_after = self._closer(t[sharp], p[sharp], after[sharp], _STEP)
            # At a corner the sample has the velocity of the way on; alone between two jumps it rests.
            left[jumps_before] = 0.0
            out[sharp] = np.where(jumps_after[:, None], left, right)
        return out

    def _sided(self, t: Array, p: Array, step: float) -> Array:
        """One-sided difference quotients at times t (n,), (n, 3), of second order at the episode's ends."""
        near = self._values(np.clip(t + step, 0.0, self.end))[:, :3]
        out = (near - p) / step
        ends = np.flatnonzero((t - abs(step) < 0.0) if step > 0.0 else (t + abs(step) > self.end))
        for k in ends:
            far = t[k] + 2.0 * step
            if not 0.0 <= far <= self.end:
                continue
            second = (self._values(np.array([far]))[0, :3] - near[k]) / step
            if np.linalg.norm(second - out[k]) <= _CORNER:
                out[k] += 0.5 * (out[k] - second)
        return out

    def _closer(self, t: Array, p: Array, slope: Array, step: float) -> tuple[Array, NDArray[np.bool_]]:
        """Quotients (n, 3) of a shorter step, and whether they grow with that: there is a jump, (n,)."""
        closer = (self._values(t + _CLOSER * step)[:, :3] - p) / (_CLOSER * step)
        jumps = np.linalg.norm(closer, axis=1) > _DIVERGES * np.linalg.norm(slope, axis=1)
        return closer, jumps & (np.linalg.norm(closer, axis=1) > _CORNER)

    def _values(self, t: Array) -> Array:
        given = [self.function(float(time)) for time in t]
        try:
            out = np.array(given, dtype=np.float64)
        except (TypeError, ValueError, OverflowError):
            raise ValueError(f"{_WANTED} at every time, got {shown(given[0])} at first") from None
        if out.ndim != 2 or out.shape[1] not in (3, 4, 6, 7):
            raise ValueError(f"{_WANTED}, got shape {out.shape[1:]}")
        if not np.isfinite(out).all():
            bad = t[~np.isfinite(out).all(axis=1)][0]
            raise ValueError(f"the reference function returned a non-finite number at t = {bad:g} s")
        return out


def from_function(function: Callable[[float], ArrayLike]) -> Reference:
    """Any trajectory given as a function of time.

    Args:
        function: t in s -> 3 (p), 4 (p, psi), 6 (p, v) or 7 (p, v, psi) numbers, SI, NED. It is sampled when
            an environment is made, at the control period, from 0 to the time limit and never beyond; the
            preview goes on with the last velocity and rate of the heading. Without v it is also called a
            millisecond before and after; where it jumps, the velocity is that of the smooth side.

    Returns:
        A reference for `gym.make(..., reference=...)`. It pickles if the function does.

    Raises:
        ValueError: When sampled, if the function returns another shape or a non-finite number, or moves
            faster than any vehicle.
    """
    if not callable(function):
        raise ValueError(f"from_function needs a function of time, got {shown(function)}")
    return FunctionReference(function)
