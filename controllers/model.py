"""Prediction models: state-dependent coefficients, exact Jacobian, zero-order hold, RK4 with sensitivities.

Every MPC turns one of these into the pairs (A_i, B_i) and the affine terms c_i of the OCP-QP (`ocp.py`). The
derivative itself is `quad_envs.dynamics.rigid_body`; nothing here writes it again.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from quad_envs.compilation.decorators import inline_kernel, kernel
from quad_envs.dynamics import rigid_body
from quad_envs.parameters import (
    DRAG_RATE,
    GRAVITY,
    GYRO_X,
    GYRO_Y,
    GYRO_Z,
    INV_MASS,
    N_INPUT,
    N_STATE,
    Array,
    QuadrotorParams,
)
from quad_envs.rotations import sincos

from .qp.linalg import fill, matmul
from .qp.vectors import WIDTH, add_scaled, entry, load, store, zero

ZOH_SCRATCH = 3  # (12, 12) matrices that `zero_order_hold` needs
RK4_SCRATCH = 52  # rows of 16 that `rk4_sensitivities` needs
_ZOH_ORDER = 12  # terms of the series: 2e-16 where |A_c| h <= 1.2
_ZOH_NORM = 1.2
_SMALL_ANGLE = 1e-4  # below it the series of sin a / a is exact to the last digit
_SMALLEST_COSINE = 1e-2  # of pitch, in W: keeps the coefficients finite at the singular point |theta| = pi/2


@inline_kernel
def _sine_over_angle(sine: float, angle: float) -> float:
    """s(a) = sin a / a, 1 at a = 0."""
    return 1.0 - angle * angle / 6.0 if abs(angle) < _SMALL_ANGLE else sine / angle


@inline_kernel
def _cosine_less_one_over_angle(angle: float) -> float:
    """k(a) = (cos a - 1) / a = -(a/2) s(a/2)^2, 0 at a = 0."""
    half = 0.5 * angle
    s = _sine_over_angle(sincos(half)[0], half)
    return -half * s * s


@inline_kernel
def _set_euler_rates(sf: float, cf: float, st: float, ct: float, out: Array) -> None:
    """Block (Theta, Omega) = W."""
    bounded = max(ct, _SMALLEST_COSINE) if ct >= 0.0 else min(ct, -_SMALLEST_COSINE)
    out[6, 9], out[6, 10], out[6, 11] = 1.0, sf * st / bounded, cf * st / bounded
    out[7, 10], out[7, 11] = cf, -sf
    out[8, 10], out[8, 11] = sf / bounded, cf / bounded


@inline_kernel
def _set_rotation(sf: float, cf: float, st: float, ct: float, ss: float, cs: float, out: Array) -> None:
    """Block (p, V_B) = R_BI'."""
    out[0, 3], out[0, 4], out[0, 5] = ct * cs, st * cs * sf - ss * cf, st * cs * cf + ss * sf
    out[1, 3], out[1, 4], out[1, 5] = ct * ss, st * ss * sf + cs * cf, st * ss * cf - cs * sf
    out[2, 3], out[2, 4], out[2, 5] = -st, ct * sf, ct * cf


@kernel
def sdc_matrix(x: Array, alpha: float, c: Array, out: Array) -> None:
    """A_c(x) with A_c(x) x + B_c (F - u_T) = f(x, F) exactly, for every alpha; Eqs. (4.5), (4.6).

    -Omega x V_B is split as -(1 - alpha) [Omega]x V_B + alpha [V_B]x Omega; alpha = 1/2 is the dissertation's
    choice.

    Deviation:
        sin a / a and (cos a - 1) / a are evaluated exactly instead of by the Taylor polynomials of 4.7, and W
        with |cos theta| >= 0.01, so that the matrix stays finite at |theta| = pi/2.

    Args:
        x: State, (12,).
        alpha: Share of the second form, in [0, 1].
        c: QuadrotorParams.coefficients().
        out: Result, (12, 12).
    """
    u, v, w = x[3], x[4], x[5]
    phi, theta = x[6], x[7]
    p, q, r = x[9], x[10], x[11]
    beta = 1.0 - alpha
    sf, cf = sincos(phi)
    st, ct = sincos(theta)
    ss, cs = sincos(x[8])
    fill(out, 0.0)
    _set_rotation(sf, cf, st, ct, ss, cs, out)
    _set_euler_rates(sf, cf, st, ct, out)
    out[3, 3], out[3, 4], out[3, 5] = -c[DRAG_RATE], beta * r, -beta * q
    out[4, 3], out[4, 4], out[4, 5] = -beta * r, -c[DRAG_RATE], beta * p
    out[5, 3], out[5, 4], out[5, 5] = beta * q, -beta * p, -c[DRAG_RATE]
    out[3, 10], out[3, 11] = -alpha * w, alpha * v
    out[4, 9], out[4, 11] = alpha * w, -alpha * u
    out[5, 9], out[5, 10] = -alpha * v, alpha * u
    out[3, 7] = -c[GRAVITY] * _sine_over_angle(st, theta)
    out[4, 6] = c[GRAVITY] * ct * _sine_over_angle(sf, phi)
    out[5, 6] = 0.5 * c[GRAVITY] * (ct + 1.0) * _cosine_less_one_over_angle(phi)
    out[5, 7] = 0.5 * c[GRAVITY] * (cf + 1.0) * _cosine_less_one_over_angle(theta)
    out[9, 10], out[9, 11] = 0.5 * c[GYRO_X] * r, 0.5 * c[GYRO_X] * q
    out[10, 9], out[10, 11] = 0.5 * c[GYRO_Y] * r, 0.5 * c[GYRO_Y] * p
    out[11, 9], out[11, 10] = 0.5 * c[GYRO_Z] * q, 0.5 * c[GYRO_Z] * p


@inline_kernel
def rotated_derivatives(
    sf: float, cf: float, st: float, ct: float, ss: float, cs: float, a0: float, a1: float, a2: float
) -> tuple[float, ...]:
    """Derivative of R_BI(Theta) a by (phi, theta, psi), for an inertial vector a.

    Returns:
        Nine numbers, row by row.
    """
    forward = cs * a0 + ss * a1
    side = cs * a1 - ss * a0
    down = st * forward + ct * a2
    b1 = ct * forward - st * a2
    b2 = sf * down + cf * side
    b3 = cf * down - sf * side
    return (
        0.0, -down, ct * side,
        b3, sf * b1, sf * st * side - cf * forward,
        -b2, cf * b1, cf * st * side + sf * forward,
    )  # fmt: skip


@kernel
def jacobian(x: Array, d: Array, c: Array, out: Array) -> None:
    """df/dx of `rigid_body`, exact.

    Args:
        x: State, (12,), |theta| < pi/2.
        d: Disturbance, (6,): torque in body axes, N m, and force in inertial axes, N, as `rigid_body` takes
            it.
        c: QuadrotorParams.coefficients().
        out: Result, (12, 12).
    """
    u, v, w = x[3], x[4], x[5]
    p, q, r = x[9], x[10], x[11]
    sf, cf = sincos(x[6])
    st, ct = sincos(x[7])
    ss, cs = sincos(x[8])
    fill(out, 0.0)
    _set_rotation(sf, cf, st, ct, ss, cs, out)
    side = cf * v - sf * w  # V_B turned back through phi, then through theta
    under = sf * v + cf * w
    forward = ct * u + st * under
    down = ct * under - st * u
    out[0, 6], out[0, 7], out[0, 8] = cs * st * side + ss * under, cs * down, -ss * forward - cs * side
    out[1, 6], out[1, 7], out[1, 8] = ss * st * side - cs * under, ss * down, cs * forward - ss * side
    out[2, 6], out[2, 7] = ct * side, -forward
    g0, g1, g2 = c[INV_MASS] * d[3], c[INV_MASS] * d[4], c[INV_MASS] * d[5] + c[GRAVITY]
    G = rotated_derivatives(sf, cf, st, ct, ss, cs, g0, g1, g2)
    out[3, 3], out[3, 4], out[3, 5] = -c[DRAG_RATE], r, -q
    out[4, 3], out[4, 4], out[4, 5] = -r, -c[DRAG_RATE], p
    out[5, 3], out[5, 4], out[5, 5] = q, -p, -c[DRAG_RATE]
    out[3, 6], out[3, 7], out[3, 8] = G[0], G[1], G[2]
    out[4, 6], out[4, 7], out[4, 8] = G[3], G[4], G[5]
    out[5, 6], out[5, 7], out[5, 8] = G[6], G[7], G[8]
    out[3, 10], out[3, 11], out[4, 9], out[4, 11], out[5, 9], out[5, 10] = -w, v, w, -u, -v, u
    turn = sf * q + cf * r  # cos(theta) psi'
    out[6, 6], out[6, 7] = st / ct * (cf * q - sf * r), turn / (ct * ct)
    out[7, 6] = -turn
    out[8, 6], out[8, 7] = (cf * q - sf * r) / ct, turn * st / (ct * ct)
    out[6, 9], out[6, 10], out[6, 11] = 1.0, sf * st / ct, cf * st / ct
    out[7, 10], out[7, 11] = cf, -sf
    out[8, 10], out[8, 11] = sf / ct, cf / ct
    out[9, 10], out[9, 11] = c[GYRO_X] * r, c[GYRO_X] * q
    out[10, 9], out[10, 11] = c[GYRO_Y] * r, c[GYRO_Y] * p
    out[11, 9], out[11, 10] = c[GYRO_Z] * q, c[GYRO_Z] * p


@kernel
def _horner_step(X: Array, S: Array, factor: float, out: Array) -> None:
    """I + factor X S, skipping the zeros of X (at least 106 of its 144 entries)."""
    for i in range(N_STATE):
        t0, t1, t2 = zero(), zero(), zero()
        for k in range(N_STATE):
            x = entry(X, i, k)
            if x != 0.0:
                scaled = factor * x
                t0 = add_scaled(t0, scaled, load(S, k, 0))
                t1 = add_scaled(t1, scaled, load(S, k, WIDTH))
                t2 = add_scaled(t2, scaled, load(S, k, 2 * WIDTH))
        store(t0, out, i, 0)
        store(t1, out, i, WIDTH)
        store(t2, out, i, 2 * WIDTH)
        out[i, i] += 1.0


@kernel
def zero_order_hold(A_c: Array, B_c: Array, dt: float, A: Array, B: Array, scratch: Array) -> None:
    """Exact discretisation for a held input, Eq. (4.8): A = exp(A_c dt), B = int_0^dt exp(A_c s) ds B_c.

    Horner's scheme for Psi = sum_k X^k / (k+1)!, X = A_c h; A = I + X Psi, B = h Psi B_c; h is dt halved
    until |X| <= 1.2, and then doubled again by S(2h) = S(h) + Phi(h) S(h) for S = h Psi, and Phi(2h) =
    Phi(h)^2.

    Args:
        A_c: Continuous state matrix, (12, 12).
        B_c: Continuous input matrix, (12, 4).
        dt: Control period, s.
        A: Result, (12, 12).
        B: Result, (12, 4).
        scratch: Overwritten, (ZOH_SCRATCH, 12, 12).
    """
    X, S, T = scratch[0], scratch[1], scratch[2]
    n = A_c.shape[0]
    norm = 0.0
    for i in range(n):
        total = 0.0
        for j in range(n):
            total += abs(A_c[i, j])
        norm = max(norm, total)
    norm *= dt
    h = dt
    squarings = 0
    while norm > _ZOH_NORM and squarings < 30:
        norm *= 0.5
        h *= 0.5
        squarings += 1
    for i in range(n):
        for j in range(n):
            X[i, j] = A_c[i, j] * h
            S[i, j] = X[i, j] / (_ZOH_ORDER + 1)
        S[i, i] += 1.0
    for k in range(_ZOH_ORDER, 1, -1):
        _horner_step(X, S, 1.0 / k, T)
        S, T = T, S
    _horner_step(X, S, 1.0, A)
    for _ in range(squarings):
        matmul(A, S, T)
        for i in range(n):
            for j in range(n):
                S[i, j] += T[i, j]
                X[i, j] = A[i, j]
        matmul(X, X, A)
    matmul(S, B_c, B)
    for i in range(n):
        for j in range(B.shape[1]):
            B[i, j] *= h


@inline_kernel
def _follow(
    slope: Any, column: int, i: int, weight: float, ahead: float, V_total: Array, V_next: Array
) -> None:
    """Four entries of a row of `_step_sensitivities`, from their slope."""
    store(add_scaled(load(V_total, i, column), weight, slope), V_total, i, column)
    store(add_scaled(zero(), ahead, slope), V_next, i, column)


@kernel
def _step_sensitivities(
    J: Array, V: Array, B_c: Array, weight: float, ahead: float, V_total: Array, V_next: Array
) -> None:
    """V_total += weight S and V_next = [I 0] + ahead S, for the slope S = J V + [0 B_c] of V, (12, 16).

    Of `jacobian` only blocks that are not zero are read: (p; V_B, Theta), (V_B; V_B, Theta, Omega),
    (Theta; Theta, Omega) and (Omega; Omega).
    """
    for i in range(N_STATE):
        first = 3 if i < 6 else (6 if i < 9 else 9)
        s0, s1, s2, s3 = zero(), zero(), zero(), load(B_c, i, 0)
        for k in range(first, 9 if i < 3 else N_STATE):
            factor = entry(J, i, k)
            s0 = add_scaled(s0, factor, load(V, k, 0))
            s1 = add_scaled(s1, factor, load(V, k, WIDTH))
            s2 = add_scaled(s2, factor, load(V, k, 2 * WIDTH))
            s3 = add_scaled(s3, factor, load(V, k, 3 * WIDTH))
        _follow(s0, 0, i, weight, ahead, V_total, V_next)
        _follow(s1, WIDTH, i, weight, ahead, V_total, V_next)
        _follow(s2, 2 * WIDTH, i, weight, ahead, V_total, V_next)
        _follow(s3, 3 * WIDTH, i, weight, ahead, V_total, V_next)
        V_next[i, i] += 1.0


@kernel
def rk4_sensitivities(
    x: Array,
    F: Array,
    d: Array,
    c: Array,
    B_c: Array,
    h: float,
    x_next: Array,
    A: Array,
    B: Array,
    scratch: Array,
) -> None:
    """One RK4 step of the exact 12-state model without rotor lag, with its derivatives.

    Args:
        x: State, (12,).
        F: Rotor forces, held, (4,), N.
        d: Disturbance, held, (6,), as in `rigid_body`.
        c: QuadrotorParams.coefficients().
        B_c: QuadrotorParams.input_matrix(), (12, 4).
        h: Step, s.
        x_next: Result, phi(x, F), (12,).
        A: Result, d phi / dx, (12, 12).
        B: Result, d phi / dF, (12, 4).
        scratch: Overwritten, (RK4_SCRATCH, 16).
    """
    y, total = scratch[0, :N_STATE], scratch[1, :N_STATE]
    J = scratch[2:11].reshape(-1).reshape(N_STATE, N_STATE)
    V, V_next, V_total = scratch[14:26], scratch[26:38], scratch[38:50]
    for i in range(N_STATE):
        y[i] = x[i]
        total[i] = 0.0
        for j in range(N_STATE + N_INPUT):
            V[i, j] = 0.0
            V_total[i, j] = 0.0
        V[i, i] = 1.0
    for stage in range(4):
        k = rigid_body(y, F, d, c)  # type: ignore[arg-type]
        jacobian(y, d, c, J)
        weight = h / 6.0 if stage == 0 or stage == 3 else h / 3.0
        ahead = h if stage == 2 else 0.5 * h
        for i in range(N_STATE):
            total[i] += weight * k[i]
            y[i] = x[i] + ahead * k[i]
        _step_sensitivities(J, V, B_c, weight, ahead, V_total, V_next)
        V, V_next = V_next, V
    for i in range(N_STATE):
        x_next[i] = x[i] + total[i]
        for j in range(N_STATE):
            A[i, j] = V_total[i, j]
        A[i, i] += 1.0
        for j in range(N_INPUT):
            B[i, j] = V_total[i, N_STATE + j]


def sdc_pair(x: ArrayLike, params: QuadrotorParams, dt: float, alpha: float = 1.0) -> tuple[Array, Array]:
    """Discrete pair of the state-dependent-coefficient model at x, Eq. (4.8).

    Args:
        x: State, (12,).
        params: The vehicle.
        dt: Control period, s.
        alpha: Factorisation, see `sdc_matrix`.

    Returns:
        A, (12, 12), and B, (12, 4).
    """
    A_c, A, B = np.empty((N_STATE, N_STATE)), np.empty((N_STATE, N_STATE)), np.empty((N_STATE, N_INPUT))
    sdc_matrix(np.ascontiguousarray(x, dtype=np.float64), float(alpha), params.coefficients(), A_c)
    zero_order_hold(A_c, params.input_matrix(), float(dt), A, B, np.empty((ZOH_SCRATCH, N_STATE, N_STATE)))
    return A, B


def hover_pair(params: QuadrotorParams, dt: float) -> tuple[Array, Array]:
    """Discrete pair of the hover linearisation, Eqs. (3.4), (3.5): the SDC pair at x = 0 for every alpha."""
    return sdc_pair(np.zeros(N_STATE), params, dt)
