"""How far a plan and its multipliers are from stationary, from the problem alone.

The states are rolled out anew, and summed in another order than in the solver: on an unstable model a plan
that only round-off of one kind makes stationary is found out.
"""

from __future__ import annotations

import math

from quad_envs.compilation.decorators import kernel
from quad_envs.parameters import Array

from .linalg import fill
from .ocp import OcpQp, weight_of_changes
from .products import add_matvec_transposed
from .rows import RowData

REFINED = 1e-9  # relative stationarity above which a solution is refined once
STATIONARY = 1e-8  # and above which it is not called optimal: 1e-6 less what another order of summation adds
_MILD = 1e7  # times round-off this is `REFINED`


@kernel
def is_mild(A: Array, R: Array, Q_f: Array, horizon: int, scratch: Array) -> bool:
    """Whether round-off cannot spoil an unconstrained optimum: it grows by |A_i| .. |A_0| in the states.

    The gradient sees the square of that growth, times the largest weight over the smallest.

    Args:
        A: (1 or N, 12, 12).
        R: (1 or N, 4, 4).
        Q_f: (12, 12), the largest weight of a state.
        horizon: N.
        scratch: Overwritten, (>= 2, 12).
    """
    n = A.shape[1]
    for a in range(n):
        scratch[0, a] = 1.0
    growth = 1.0
    for i in range(horizon):
        w, w_next = scratch[i % 2], scratch[1 - i % 2]
        pair = A[i if A.shape[0] > 1 else 0]
        for a in range(n):
            w_next[a] = 0.0
        for b in range(n):
            factor = w[b]
            for a in range(n):
                w_next[a] += factor * abs(pair[b, a])
        for a in range(n):
            growth = max(growth, w_next[a])
    largest, smallest = 0.0, math.inf
    for a in range(n):
        largest = max(largest, Q_f[a, a])
    for i in range(R.shape[0]):
        for a in range(R.shape[1]):
            smallest = min(smallest, R[i, a, a])
    return growth * growth * max(largest, smallest) <= _MILD * smallest


@kernel
def _pull_of_rows(rows: RowData, multipliers: Array, base: int, force: Array) -> None:
    """Sum over the state rows of multiplier times normal, stage by stage."""
    K = rows.normal.shape[0]
    fill(force, 0.0)
    for k in range(K):
        pull = multipliers[base + k] - multipliers[base + K + k]
        if pull != 0.0:
            h = rows.normals[rows.normal[k]]
            for a in range(h.shape[0]):
                force[rows.stage[k], a] += pull * h[a]


@kernel
def _roll_out(c: Array, x_0: Array, transposed: Array, u: Array, x: Array) -> None:
    """x_{i+1} = B_i u_i + A_i x_i + c_i, in this order; `recursion.step_plan` begins with c_i and A_i x_i."""
    n = x.shape[1]
    for a in range(n):
        x[0, a] = x_0[a]
    for i in range(u.shape[0]):
        pair = transposed[i if transposed.shape[0] > 1 else 0]
        for a in range(n):
            x[i + 1, a] = 0.0
        add_matvec_transposed(pair[n:], u[i], 1.0, x[i + 1])
        add_matvec_transposed(pair[:n], x[i], 1.0, x[i + 1])
        for a in range(n):
            x[i + 1, a] += c[i, a]


@kernel
def _pull_of_changes(S: Array, u_last: Array, u: Array, i: int, a: int) -> tuple[float, float]:
    """Entry a of S (u_i - u_{i-1}) and of S (u_{i+1} - u_i), the latter 0 at the end of the horizon."""
    before, after = 0.0, 0.0
    for b in range(S.shape[0]):
        before += S[a, b] * (u[i, b] - (u[i - 1, b] if i > 0 else u_last[b]))
        if i + 1 < u.shape[0]:
            after += S[a, b] * (u[i + 1, b] - u[i, b])
    return before, after


@kernel
def _pull_of_states(qp: OcpQp, x: Array, force: Array, gradient: Array, scratch: Array) -> None:
    """B_i' y_{i+1} into gradient, for the costate `y_i = Q_i (x_i - r_i) + A_i' y_{i+1} - force_i`."""
    A, B, Q = qp.A, qp.B, qp.Q
    (N, n), m = qp.c.shape, B.shape[2]
    difference = scratch[2]
    for i in range(N, 0, -1):
        y, y_next = scratch[i % 2], scratch[1 - i % 2]
        for a in range(n):
            difference[a] = x[i, a] - qp.r[i, a]
            y[a] = -force[i, a]
        add_matvec_transposed(qp.Q_f if i == N else Q[i if Q.shape[0] > 1 else 0], difference, 1.0, y)
        if i < N:
            add_matvec_transposed(A[i if A.shape[0] > 1 else 0], y_next, 1.0, y)
        block = gradient[m * (i - 1) : m * i]
        for a in range(m):
            block[a] = 0.0
        add_matvec_transposed(B[i - 1 if B.shape[0] > 1 else 0], y, 1.0, block)


@kernel
def lagrangian_gradient(
    qp: OcpQp,
    transposed: Array,
    rows: RowData,
    u: Array,
    multipliers: Array,
    states: Array,
    force: Array,
    gradient: Array,
    scratch: Array,
) -> float:
    """Gradient in u of cost - sum lambda (a'u - b), by the costate: `g_i = R_i u_i + B_i' y_{i+1} - pulls`.

    Args:
        qp: The problem; R_rate is an array, (0, 4) where changes have no weight.
        transposed: [A_i B_i]', (1 or N, 16, 12).
        rows: The rows of the problem.
        u: (N, 4).
        multipliers: Of all rows, (16N + 2K,).
        states: Overwritten, (N+1, 12).
        force: Overwritten, (N+1, 12).
        gradient: Result, (4N,).
        scratch: Overwritten, (>= 3, 12).

    Returns:
        Its largest entry over 1 + the largest entry of its terms R_i u_i, B_i' y_{i+1} and S (u_i - u_{i-1}).
    """
    R, R_rate = qp.R, weight_of_changes(qp)
    N, m = u.shape
    nv = N * m
    _roll_out(qp.c, qp.x_0, transposed, u, states)
    _pull_of_rows(rows, multipliers, 4 * nv, force)
    _pull_of_states(qp, states, force, gradient, scratch)
    scale, worst = 1.0, 0.0
    for i in range(N):
        own_weight = R[i if R.shape[0] > 1 else 0]
        for a in range(m):
            k = m * i + a
            own = 0.0
            for b in range(m):
                own += own_weight[a, b] * u[i, b]
            scale = max(scale, 1.0 + abs(own), 1.0 + abs(gradient[k]))
            if R_rate.shape[0] > 0:
                before, after = _pull_of_changes(R_rate, qp.u_last, u, i, a)
                scale = max(scale, 1.0 + abs(before), 1.0 + abs(after))
                own += before - after
            value = own + gradient[k] - multipliers[k] + multipliers[nv + k]
            value -= multipliers[2 * nv + k] - multipliers[3 * nv + k]
            if i + 1 < N:
                value += multipliers[2 * nv + k + m] - multipliers[3 * nv + k + m]
            gradient[k] = value
            worst = max(worst, abs(value))
    return worst / scale
