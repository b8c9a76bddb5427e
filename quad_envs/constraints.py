"""Limits as constraint rows (names, values, scales); the map between actions and rotor forces."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .compilation.decorators import inline_kernel, kernel
from .limits import Limits
from .plant import N_INPUT, N_STATE, Array

TOLERANCE = 1e-3  # SI: 1 mm, 1 mm/s, 1 mrad, 1 mN; below what a model without rotor lag can promise


def constraint_names(limits: Limits) -> tuple[str, ...]:
    """Names of the constraint rows that these limits make, in the order of `constraint_values`."""
    return tuple(limit.name for limit in limits.chosen())


def constraint_values(
    plant: ArrayLike, command: ArrayLike, previous: ArrayLike, limits: Limits, dt: float
) -> Array:
    """Value minus limit of each row, SI; positive means violated. Readable twin of the environments' kernel.

    Args:
        plant: [p, V_B, Theta, Omega, ...], (..., >= 12).
        command: Rotor commands of the step that led there, (..., 4), N.
        previous: Rotor commands of the step before, (..., 4), N.
        limits: The limits.
        dt: Control period, s.

    Returns:
        (..., number of rows).
    """
    x = np.asarray(plant, dtype=np.float64)[..., :N_STATE]
    change = np.asarray(command, dtype=np.float64) - np.asarray(previous, dtype=np.float64)
    y = np.concatenate([x, np.broadcast_to(change, (*x.shape[:-1], N_INPUT))], axis=-1)
    lower, upper = limits.output_box(dt)
    outside = np.maximum(lower - y, y - upper)
    rows = [outside[..., limit.outputs].max(axis=-1) for limit in limits.chosen()]
    return np.stack(rows, axis=-1) if rows else np.zeros((*x.shape[:-1], 0))


def constraint_scales(limits: Limits, dt: float) -> Array:
    """Violation of each row that costs the whole reward of a step, (number of rows,)."""
    return np.array([limits.scale(limit, dt) for limit in limits.chosen()])


@inline_kernel
def force_from_action(action: float, hover: float, force_max: float) -> float:
    """Rotor command of one action entry: -1 -> 0, 0 -> hover, +1 -> force_max, piecewise linear."""
    return hover + action * (hover if action < 0.0 else force_max - hover)


@inline_kernel
def action_from_force(force: float, hover: float, force_max: float) -> float:
    """Action entry that commands a rotor force, clipped to [-1, 1]: the inverse of `force_from_action`."""
    change = force - hover
    return min(max(change / (hover if change < 0.0 else force_max - hover), -1.0), 1.0)


@kernel
def _actions_from_forces(forces: Array, hover: float, force_max: Array, out: NDArray[np.float32]) -> None:
    for i in range(forces.size):
        out[i] = action_from_force(forces[i], hover, force_max[i % N_INPUT])


def actions_from_forces(forces: Array, hover: float, force_max: ArrayLike) -> NDArray[np.float32]:
    """Actions that command these rotor forces, the inverse of `forces_from_actions`.

    Args:
        forces: (..., 4), N, C-contiguous; forces outside [0, force_max] are clipped.
        hover: Force of action 0, N.
        force_max: Force of action +1, N: one number or (4,), one per rotor.

    Returns:
        (..., 4), float32.
    """
    out = np.empty(forces.shape, dtype=np.float32)
    most = np.array(np.broadcast_to(np.asarray(force_max, dtype=np.float64), N_INPUT))
    _actions_from_forces(forces.reshape(-1), hover, most, out.reshape(-1))
    return out


def forces_from_actions(actions: ArrayLike, hover: float, force_max: ArrayLike) -> Array:
    """Rotor commands of actions in [-1, 1], (..., 4), N; force_max is one number or one per rotor."""
    a = np.clip(np.asarray(actions, dtype=np.float64), -1.0, 1.0)
    return np.asarray(hover + a * np.where(a < 0.0, hover, np.asarray(force_max, dtype=np.float64) - hover))
