"""The dissertation's filter for an aircraft: a point mass in polar velocity, section 6.2.2, Eq. (6.12).

State X = [r; V, gamma, chi] (6): position, m, NED; speed, m/s; climb and course angle, rad.
r' = V [cos chi cos gamma, sin chi cos gamma, -sin gamma]; what the pilot does to V, gamma, chi is noise.

Deviation: (6.12) is printed with z up, and with V' = V_c - V where the filter does not know V_c, which makes
the speed decay (`speed="decaying"`, for the record: its normalised errors are 3 to 5). The default is V' = 0.
With unknown inputs nothing is divided by V or cos gamma, so that no clamp is needed; but the angles lose
their meaning as V passes 0. The Cartesian filter (`ekf.py`) comes close to this one and has no such point.
"""

from __future__ import annotations

import math
from typing import Literal, get_args

import numpy as np
from numpy.typing import ArrayLike

from controllers.qp.linalg import matmul, symmetrise
from quad_envs.arguments.names import unknown_name
from quad_envs.compilation.decorators import Int, kernel
from quad_envs.parameters import Array

from .arguments import as_floats, require_non_negative
from .ekf import TargetFilter

Speed = Literal["constant", "decaying"]
SPEED, CLIMB, COURSE = 3, 4, 5
POLAR_NOISE = (0.3**2, 0.15**2, 0.15**2)  # q_V^2, m^2/s^3; q_gamma^2, q_chi^2, rad^2/s
POLAR_SIGMA = (0.5, 0.3, 0.1)  # m, m/s, rad: standard deviations of the first guess
SUBSTEPS = 2
POLAR_SCRATCH = 2 * 36


@kernel
def _euler_step(X: Array, P: Array, h: float, q: Array, decay: float, A: Array, T: Array) -> None:
    """X <- X + h f, P <- (I + h F) P (I + h F)' + h Q; P + h (F P + P F' + Q) could lose its sign."""
    V = X[SPEED]
    sg, cg = math.sin(X[CLIMB]), math.cos(X[CLIMB])
    sc, cc = math.sin(X[COURSE]), math.cos(X[COURSE])
    for i in range(6):
        for j in range(6):
            A[i, j] = 1.0 if i == j else 0.0
    A[0, SPEED], A[0, CLIMB], A[0, COURSE] = h * cc * cg, -h * V * cc * sg, -h * V * sc * cg
    A[1, SPEED], A[1, CLIMB], A[1, COURSE] = h * sc * cg, -h * V * sc * sg, h * V * cc * cg
    A[2, SPEED], A[2, CLIMB] = -h * sg, -h * V * cg
    A[SPEED, SPEED] -= h * decay
    X[0] += h * V * cc * cg
    X[1] += h * V * sc * cg
    X[2] -= h * V * sg
    X[SPEED] -= h * decay * V
    matmul(A, P, T)
    for i in range(6):
        for j in range(6):
            total = 0.0
            for k in range(6):
                total += T[i, k] * A[j, k]
            P[i, j] = total
    for a in range(3):
        P[3 + a, 3 + a] += h * q[a]
    symmetrise(P)


@kernel
def polar_predict_kernel(
    X: Array, P: Array, dt: float, q: Array, decay: float, substeps: Int, scratch: Array
) -> None:
    """Prediction of one vehicle's X (6,), P (6, 6) in place; q (3,), scratch (POLAR_SCRATCH,)."""
    A, T = scratch[:36].reshape(6, 6), scratch[36:72].reshape(6, 6)
    for _ in range(substeps):
        _euler_step(X, P, dt / substeps, q, decay, A, T)


@kernel
def _predict_rows(
    X: Array, P: Array, dt: float, q: Array, decay: float, substeps: Int, scratch: Array
) -> None:
    for i in range(X.shape[0]):
        polar_predict_kernel(X[i], P[i], dt, q, decay, substeps, scratch)


def polar_filter(X: ArrayLike, sigma: tuple[float, float, float] = POLAR_SIGMA) -> TargetFilter:
    """A filter that starts from a guess.

    Args:
        X: [r; V, gamma, chi], (n, 6).
        sigma: Standard deviations of the position per axis, m, the speed, m/s, and both angles, rad.
    """
    state = as_floats("X", X, (None, 6)).copy()
    variances = np.square([sigma[0]] * 3 + [sigma[1]] + [sigma[2]] * 2)
    return TargetFilter(state, np.tile(np.diag(variances), (len(state), 1, 1)))


def predict(
    state: TargetFilter, dt: float, q: ArrayLike = POLAR_NOISE, speed: Speed = "constant"
) -> TargetFilter:
    """Propagation (6.7), (6.8) in two Euler steps. The update is that of `ekf.py`: it reads r alone at age 0.

    Args:
        state: n filters, x = [r; V, gamma, chi].
        dt: Step, s.
        q: Densities of the noise in V', m^2/s^3, gamma' and chi', rad^2/s, (3,).
        speed: "constant" (V' = 0) or "decaying" (V' = -V, as printed).

    Raises:
        ValueError: If a shape or a name is wrong, a number is not finite, or dt or q is negative.
    """
    if speed not in get_args(Speed):
        raise ValueError(unknown_name("speed", speed, get_args(Speed)))
    X = as_floats("x", state.x, (None, 6)).copy()
    P = as_floats("P", state.P, (len(X), 6, 6)).copy()
    noise = as_floats("q", q, (3,))
    if (noise < 0.0).any():
        raise ValueError(f"q must be three noise densities >= 0, got {noise}")
    decay = 1.0 if speed == "decaying" else 0.0
    _predict_rows(X, P, require_non_negative("dt", dt, "s"), noise, decay, SUBSTEPS, np.empty(POLAR_SCRATCH))
    return TargetFilter(X, P)


def velocity(X: ArrayLike) -> Array:
    """Velocity of the states (..., 6) in NED axes, (..., 3), m/s."""
    V, gamma, chi = np.moveaxis(np.asarray(X, dtype=np.float64)[..., SPEED:], -1, 0)
    return np.stack(
        [V * np.cos(chi) * np.cos(gamma), V * np.sin(chi) * np.cos(gamma), -V * np.sin(gamma)], axis=-1
    )
