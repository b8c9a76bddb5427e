"""Random starts inside an ellipsoid, flown on the linear model and on the nonlinear plant."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from controllers.stability.invariant import Ellipsoid, Halfspaces, sample_ellipsoid
from quad_envs.dynamics import simulate
from quad_envs.observations.tracking import N_REFERENCE
from quad_envs.parameters import N_INPUT, N_STATE, Array

STEPS = 400  # 20 s at the usual control period: the slowest mode of hover decays to 1 %
CONVERGED = 0.01  # of the level from which they started
_TOLERANCE = 1e-3  # of the level, and of a limit in its SI unit, as a violation counts in the environments
_KEPT_FLIGHTS = 12  # of which the figure shows the tracks, evenly from all
_FRACTIONS = (1.0, 0.5, 0.25, 0.125, 0.0625)  # of the ellipsoid's radius


class Stay(NamedTuple):
    """What became of random starts in an ellipsoid; shares of the starts."""

    fraction: float  # of the ellipsoid's radius from which they started
    inside: float  # never left the ellipsoid from which they started
    limits: float  # never exceeded a limit
    converged: float  # came to rest
    together: float  # all three
    outermost: float  # largest x'P x / level that was met, level being that of the starts
    tracks: Array  # (a dozen, STEPS + 1, 12), to be drawn

    @property
    def holds(self) -> bool:
        """Whether every start stayed inside, kept the limits and came to rest."""
        return self.together == 1.0

    @property
    def safe(self) -> bool:
        """Whether every start kept the limits and came to rest, be it outside in between."""
        return self.limits == 1.0 and self.converged == 1.0

    def numbers(self) -> dict[str, float]:
        """For JSON."""
        return {name: value for name, value in self._asdict().items() if name != "tracks"}


def linear_stay(ellipsoid: Ellipsoid, limits: Halfspaces, A_K: Array, starts: Array) -> Stay:
    """Under x+ = (A - B K) x, without clipping: the limits are kept or they are not."""
    return _judge(ellipsoid, limits, starts, 1.0, lambda x: x @ A_K.T)


def plant_stay(
    ellipsoid: Ellipsoid, limits: Halfspaces, controller: Any, K: Array, starts: Array, fraction: float = 1.0
) -> Stay:
    """Under the policy's own controller on the nonlinear plant with its rotor lag, at hover at the origin.

    The command before the first one is that of the law, so that a rate limit fits; the rotors start in trim.
    """
    task, n = controller.task, len(starts)
    window = np.zeros((n, controller.horizon + 1, N_REFERENCE))
    window[:, :, -1] = 1.0  # heading 0
    hover = task.hover_force
    plants = np.concatenate([starts, np.full((n, N_INPUT), hover)], axis=1)
    last, memory = np.clip(hover - starts @ K.T, 0.0, task.force_max), np.zeros((n, controller.memory_size))

    def step(x: Array) -> Array:
        nonlocal plants, last, memory
        decision = controller.decide(plants, window, last, np.zeros((n, 6)), memory)
        last, memory = decision.command, decision.memory
        plants = simulate(plants, last, task.params, force_max=task.force_max, duration=task.dt)
        return np.array(plants[:, :N_STATE])

    return _judge(ellipsoid, limits, starts, fraction, step)


def shrunk_stay(
    ellipsoid: Ellipsoid, limits: Halfspaces, controller: Any, K: Array, starts: Array
) -> list[Stay]:
    """From the ellipsoid shrunk to a half, a quarter, ...: up to the first from which all starts are safe."""
    found = []
    for fraction in _FRACTIONS:
        found.append(plant_stay(ellipsoid, limits, controller, K, fraction * starts, fraction))
        if found[-1].safe:
            break
    return found


def random_starts(ellipsoid: Ellipsoid, count: int, seed: int) -> Array:
    """Half of them uniform in the volume, half on the boundary, (count, 12)."""
    rng = np.random.default_rng(seed)
    inner = sample_ellipsoid(ellipsoid, count - count // 2, rng)
    return np.concatenate([inner, sample_ellipsoid(ellipsoid, count // 2, rng, boundary=True)])


def _judge(
    ellipsoid: Ellipsoid,
    limits: Halfspaces,
    starts: Array,
    fraction: float,
    step: Callable[[Array], Array],
) -> Stay:
    """Follow all starts at once."""
    kept = np.linspace(0, len(starts) - 1, min(_KEPT_FLIGHTS, len(starts))).astype(np.int64)
    x, tracks = np.array(starts), [starts[kept]]
    outermost, worst = ellipsoid.value(x), np.full(len(x), -np.inf)
    for _ in range(STEPS):
        beyond = np.abs(x @ limits.normals.T) - limits.bounds
        worst = np.maximum(worst, beyond.max(axis=1))
        x = step(x)
        outermost = np.fmax(outermost, ellipsoid.value(x))
        tracks.append(x[kept])
    inside = outermost <= fraction**2 * (1.0 + _TOLERANCE)
    in_limits = worst <= _TOLERANCE
    rest = ellipsoid.value(x) <= CONVERGED * fraction**2
    return Stay(
        fraction,
        float(inside.mean()),
        float(in_limits.mean()),
        float(rest.mean()),
        float((inside & in_limits & rest).mean()),
        float(outermost.max() / fraction**2),
        np.stack(tracks, axis=1),
    )
