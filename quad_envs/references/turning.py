"""How fast a heading turns, from the rows of a reference, and the body rates of a vehicle that turns so.

A reference gives headings, as sine and cosine; their rate psi_dot is the mean of the differences to the rows
before and after. Where these two contradict each other the heading jumps, and a jump is not a rate: a step of
90 degrees between two samples would be 31 rad/s.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike

from ..compilation.decorators import inline_kernel, kernel
from ..plant import Array
from ..rotations import wrap_angle
from .table_row import HEADING, N_REFERENCE, N_TABLE
from .table_row import TURN_RATE as TURN_RATE

LARGEST_TURN = 2.0 * math.pi  # rad/s; what turns faster, jumps
_AGREEMENT = 1.0  # rad/s, by which the rates before and after a row may differ where it does not jump


@inline_kernel
def _one_rate(before: float, after: float, none: float) -> float:
    """The rate between two that should be alike; where they are not, the smaller, and `none` if alike."""
    if abs(before) > LARGEST_TURN:
        return after if abs(after) <= LARGEST_TURN else 0.0
    if abs(after) > LARGEST_TURN:
        return before
    if abs(before - after) <= _AGREEMENT:
        return none
    if before * after <= 0.0:
        return 0.0
    return before if abs(before) < abs(after) else after


@inline_kernel
def _difference(window: Array, i: int, dt: float) -> float:
    """Rate of the heading from row i to row i + 1, rad/s; exactly 0 where the heading stays."""
    if window[i, 6] == window[i + 1, 6] and window[i, 7] == window[i + 1, 7]:
        return 0.0
    sine = window[i + 1, 6] * window[i, 7] - window[i + 1, 7] * window[i, 6]
    cosine = window[i + 1, 7] * window[i, 7] + window[i + 1, 6] * window[i, 6]
    return math.atan2(sine, cosine) / dt


@kernel
def turn_rate(window: Array, stages: int, i: int, dt: float) -> float:
    """psi_dot at row i of a window, rad/s; from one side at its ends, and 0 in a window of one row.

    Args:
        window: Reference rows, (>= stages, >= 8).
        stages: Rows that may be read.
        i: Row.
        dt: Time between rows, s.
    """
    if stages < 2:
        return 0.0
    if 0 < i < stages - 1:
        before, after = _difference(window, i - 1, dt), _difference(window, i, dt)
        return _one_rate(before, after, 0.5 * (before + after))
    near = _difference(window, min(i, stages - 2), dt)
    if stages < 3:
        return _one_rate(near, near, near)
    return _one_rate(near, _difference(window, 1 if i == 0 else stages - 3, dt), near)


@kernel
def tabulate(rows: Array, dt: float, fastest: float, out: Array) -> bool:
    """`with_turn_rates` compiled, and whether the rows are finite and nowhere faster than `fastest`.

    Args:
        rows: Reference rows, (n, 8).
        dt: Time between them, s.
        fastest: m/s.
        out: Result, (n, N_TABLE).
    """
    sound = True
    for i in range(rows.shape[0]):
        total = 0.0
        for c in range(N_REFERENCE):
            out[i, c] = rows[i, c]
            total += abs(rows[i, c])
        square = rows[i, 3] ** 2 + rows[i, 4] ** 2 + rows[i, 5] ** 2
        sound &= (total < math.inf) & (square <= fastest * fastest)
        out[i, TURN_RATE] = turn_rate(rows, rows.shape[0], i, dt)
        out[i, HEADING] = math.atan2(rows[i, 6], rows[i, 7])
    return sound


def with_turn_rates(rows: ArrayLike, dt: float) -> Array:
    """Reference rows (n, 8) with psi_dot and psi behind them, readable twin of `tabulate`: (n, N_TABLE)."""
    rows = np.asarray(rows, dtype=np.float64)
    out = np.zeros((len(rows), N_TABLE))
    out[:, :N_REFERENCE] = rows[:, :N_REFERENCE]
    out[:, HEADING] = psi = np.arctan2(rows[:, 6], rows[:, 7])
    if len(rows) < 2:
        return out
    same = (rows[1:, 6:] == rows[:-1, 6:]).all(axis=1)
    steps = np.where(same, 0.0, wrap_angle(np.diff(psi)) / dt)
    # At the ends the row beyond counts as if the heading turned on as it did.
    second = min(1, len(steps) - 1)
    before, after = np.r_[steps[0], steps], np.r_[steps, steps[-1]]
    before[0], after[-1] = steps[second], steps[-1 - second]
    mean = 0.5 * (before + after)
    mean[0], mean[-1] = steps[0], steps[-1]
    smaller = np.where(np.abs(before) < np.abs(after), before, after)
    rate = np.where(before * after > 0.0, smaller, 0.0)
    rate = np.where(np.abs(before - after) <= _AGREEMENT, mean, rate)
    turns_before, turns_after = np.abs(before) <= LARGEST_TURN, np.abs(after) <= LARGEST_TURN
    rate = np.where(turns_before, rate, after)
    rate = np.where(turns_after, rate, before)
    out[:, TURN_RATE] = np.where(turns_before | turns_after, rate, 0.0)
    return out


def turning_rates(Theta: ArrayLike, psi_dot: ArrayLike) -> Array:
    """Omega_ref = E(Theta) [0, 0, psi_dot]: body rates at which only the heading turns.

    Args:
        Theta: Roll, pitch, yaw, (..., 3), rad.
        psi_dot: Rate of the heading, (...), rad/s.

    Returns:
        (..., 3), rad/s.
    """
    phi, theta, _ = np.moveaxis(np.asarray(Theta, dtype=np.float64), -1, 0)
    axis = [-np.sin(theta), np.sin(phi) * np.cos(theta), np.cos(phi) * np.cos(theta)]
    return np.asarray(np.stack(axis, axis=-1) * np.asarray(psi_dot, dtype=np.float64)[..., None])
