"""The error e(x) of the reward and its derivative, of which an MPC on the exact model has to know both."""

from __future__ import annotations

from quad_envs.compilation.decorators import kernel
from quad_envs.parameters import N_STATE, Array
from quad_envs.rotations import sincos, wrap_angle_scalar

from ..model import rotated_derivatives
from ..qp.linalg import copy


@kernel
def velocity_residual(Theta: Array, v_ref: Array, D: Array) -> tuple[float, float, float]:
    """R_BI(Theta) v_ref, and its derivative by Theta.

    Args:
        Theta: Roll, pitch, yaw, (3,).
        v_ref: In the axes from which yaw counts, (3,).
        D: Result, (3, 3).
    """
    sf, cf = sincos(Theta[0])
    st, ct = sincos(Theta[1])
    ss, cs = sincos(Theta[2])
    G = rotated_derivatives(sf, cf, st, ct, ss, cs, v_ref[0], v_ref[1], v_ref[2])
    for a in range(3):
        D[0, a], D[1, a], D[2, a] = G[a], G[3 + a], G[6 + a]
    forward = cs * v_ref[0] + ss * v_ref[1]
    side = cs * v_ref[1] - ss * v_ref[0]
    down = st * forward + ct * v_ref[2]
    return ct * forward - st * v_ref[2], sf * down + cf * side, cf * down - sf * side


@kernel
def rates_residual(Theta: Array, psi_dot: float, D: Array) -> tuple[float, float, float]:
    """Omega_ref = E(Theta) [0, 0, psi_dot], and its derivative by Theta.

    Args:
        Theta: Roll, pitch, yaw, (3,).
        psi_dot: Rate of the heading, rad/s.
        D: Result, (3, 3).
    """
    sf, cf = sincos(Theta[0])
    st, ct = sincos(Theta[1])
    D[0, 0], D[1, 0], D[2, 0] = 0.0, psi_dot * cf * ct, -psi_dot * sf * ct
    D[0, 1], D[1, 1], D[2, 1] = -psi_dot * ct, -psi_dot * sf * st, -psi_dot * cf * st
    D[0, 2], D[1, 2], D[2, 2] = 0.0, 0.0, 0.0
    return -psi_dot * st, psi_dot * sf * ct, psi_dot * cf * ct


@kernel
def gauss_newton_weight(Q: Array, D: Array, out: Array) -> None:
    """E'Q E for E = I but for the blocks (V_B, Theta) and (Omega, Theta) = -D; derivative of the residual.

    Args:
        Q: (12, 12), symmetric.
        D: (6, 3), or (3, 3) of V_B alone.
        out: Result, (12, 12).
    """
    n = N_STATE
    copy(Q, out)
    for i in range(n):
        for a in range(3):
            for k in range(D.shape[0]):
                out[i, 6 + a] -= Q[i, 3 + k if k < 3 else 6 + k] * D[k, a]
    for a in range(3):
        for j in range(n):
            total = 0.0
            for k in range(D.shape[0]):
                total += D[k, a] * out[3 + k if k < 3 else 6 + k, j]
            out[6 + a, j] -= total


@kernel
def stage_residual(inertial: bool, heading: bool, X: Array, row: Array, e: Array, D: Array) -> int:
    """The error of the reward, e = E (x - r) to the first order about X.

    e = [p - p_ref; V_B - R_BI(Theta) v_ref; Theta - Theta_ref; Omega - E(Theta) [0, 0, psi_dot]].

    Args:
        inertial: Whether v_ref is turned by the attitude.
        heading: Whether the yaw error is wrapped.
        X: State, (12,).
        row: Reference in the axes of the problem, (12,).
        e: Result, (12,).
        D: Result, (6, 3): derivatives of the turned v_ref and Omega_ref by Theta.

    Returns:
        Rows of D that count for `gauss_newton_weight`: 6, or 3 where the heading of the reference is still.
    """
    for a in range(N_STATE):
        e[a] = X[a] - row[a]
    if heading:
        e[8] = wrap_angle_scalar(e[8])
    if inertial:
        v = velocity_residual(X[6:9], row[3:6], D)
        for k in range(3):
            e[3 + k] = X[3 + k] - v[k]
    if row[11] == 0.0:  # psi_dot
        return 3
    rates = rates_residual(X[6:9], row[11], D[3:])
    for k in range(3):
        e[9 + k] = X[9 + k] - rates[k]
    return 6
