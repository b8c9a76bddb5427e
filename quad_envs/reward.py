"""THE reward: one bounded formula for every task and policy, monotone step by step in the MPCs' stage cost.

    reward = (1 - v) / (1 + l),   l = |x - x_ref|_Q^2 + |u - u_T|_R^2,   v = min(1, sum_j hinge_j / scale_j)

It is positive while the vehicle flies within its limits and a crash ends the episode, so that crashing early
is never better than flying badly. x_ref = [p_ref; R_BI v_ref; 0, 0, psi_ref; E(Theta) [0, 0, psi_dot]]: the
velocity error is the inertial one, seen in body axes; the yaw error is wrapped; the wanted body rates are
those of a heading that turns (`quad_envs.references.turning`).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from .compilation.decorators import inline_kernel
from .parameters import Array, Weights
from .references.table_row import HEADING, TURN_RATE
from .references.turning import turning_rates
from .rotations import rotation_body_from_inertial, sincos, wrap_angle, wrap_angle_scalar

# Of the stage cost; the last one is that of teams.
LOSS_PARTS = ("position", "velocity", "attitude", "rates", "effort", "formation")
Numbers = Sequence[float] | Array  # kernels take both


@inline_kernel
def stage_cost_parts(
    x: Numbers,
    sines: Numbers,
    row: Numbers,
    command: Numbers,
    hover: float,
    Q: Numbers,
    R: Numbers,
) -> tuple[float, float, float, float, float]:
    """The stage cost l of one vehicle in parts: position, velocity, attitude, rates, effort; all >= 0.

    Args:
        x: State, (>= 12,).
        sines: Sine and cosine of roll, pitch and yaw, (6,).
        row: Row of a reference table, (10,): p_ref, v_ref, sin and cos of psi_ref, psi_dot, psi_ref.
        command: Rotor commands, (4,), N.
        hover: u_T, N.
        Q: Diagonal, (12,).
        R: Diagonal, (4,).

    Returns:
        The parts, whose sum is l.
    """
    sf, cf, st, ct, ss, cs = sines[0], sines[1], sines[2], sines[3], sines[4], sines[5]
    vx, vy, vz, psi_dot = row[3], row[4], row[5], row[TURN_RATE]
    forward = cs * vx + ss * vy  # the reference velocity in the heading frame
    right = cs * vy - ss * vx
    down = st * forward + ct * vz
    e0, e1, e2 = x[0] - row[0], x[1] - row[1], x[2] - row[2]
    e3 = x[3] - (ct * forward - st * vz)
    e4 = x[4] - (sf * down + cf * right)
    e5 = x[5] - (cf * down - sf * right)
    e8 = wrap_angle_scalar(x[8] - row[HEADING])
    e9, e10, e11 = x[9] + st * psi_dot, x[10] - sf * ct * psi_dot, x[11] - cf * ct * psi_dot
    u0, u1, u2, u3 = command[0] - hover, command[1] - hover, command[2] - hover, command[3] - hover
    return (
        Q[0] * e0 * e0 + Q[1] * e1 * e1 + Q[2] * e2 * e2,
        Q[3] * e3 * e3 + Q[4] * e4 * e4 + Q[5] * e5 * e5,
        Q[6] * x[6] * x[6] + Q[7] * x[7] * x[7] + Q[8] * e8 * e8,
        Q[9] * e9 * e9 + Q[10] * e10 * e10 + Q[11] * e11 * e11,
        R[0] * u0 * u0 + R[1] * u1 * u1 + R[2] * u2 * u2 + R[3] * u3 * u3,
    )


@inline_kernel
def stage_cost_kernel(x: Array, row: Array, command: Array, hover: float, Q: Array, R: Array) -> float:
    """The stage cost l of one vehicle; arguments as in `stage_cost_parts`, of the row only the first nine."""
    sines = sincos(x[6]) + sincos(x[7]) + sincos(x[8])
    p, v, psi = (row[0], row[1], row[2]), (row[3], row[4], row[5]), np.arctan2(row[6], row[7])
    wanted = p + v + (row[6], row[7], row[TURN_RATE], psi)
    position, velocity, attitude, rates, effort = stage_cost_parts(x, sines, wanted, command, hover, Q, R)
    return float(position + velocity + attitude + rates + effort)


def tracking_error(x: ArrayLike, rows: ArrayLike) -> Array:
    """X - x_ref of the reward, the error whose weighted square is the stage cost.

    Args:
        x: States, (..., >= 12).
        rows: Reference rows, (..., >= 9); psi_dot counts as 0 in rows of 8 numbers.

    Returns:
        (..., 12).
    """
    x, rows = np.asarray(x, dtype=np.float64)[..., :12], np.asarray(rows, dtype=np.float64)
    error = x.copy()
    error[..., 0:3] -= rows[..., 0:3]
    error[..., 3:6] -= np.einsum("...ij,...j->...i", rotation_body_from_inertial(x[..., 6:9]), rows[..., 3:6])
    error[..., 8] = wrap_angle(x[..., 8] - np.arctan2(rows[..., 6], rows[..., 7]))
    if rows.shape[-1] > TURN_RATE:
        error[..., 9:12] -= turning_rates(x[..., 6:9], rows[..., TURN_RATE])
    return error


def stage_cost(x: ArrayLike, rows: ArrayLike, command: ArrayLike, hover: float, weights: Weights) -> Array:
    """The stage cost l on arrays, readable twin of `stage_cost_kernel`.

    Args:
        x: States, (..., >= 12).
        rows: Reference rows, (..., >= 9) or (..., 8), see `tracking_error`.
        command: Rotor commands, (..., 4), N.
        hover: u_T, N.
        weights: Q and R.

    Returns:
        (...).
    """
    du = np.asarray(command, dtype=np.float64) - hover
    error = tracking_error(x, rows)
    return np.asarray((error * error) @ np.asarray(weights.Q) + (du * du) @ np.asarray(weights.R))
