"""A weight S = `OcpQp.R_rate` on changes of the input: |u_i - u_{i-1}|_S^2 at i < N, with u_{-1} = u_last.

The recursion of `riccati.py` runs over z = [x; u_prev]. Its input v = u - T u_prev with T = (R + S)^-1 S
leaves no product of input and state in the cost of a stage,

    |u|_R^2 + |u - u_prev|_S^2 = |v|_{R+S}^2 + |u_prev|_{R T}^2,
    z_{i+1} = [A_i, B_i T; 0, T] z_i + [B_i; I] v_i + [c_i; 0].

It gives the unconstrained plan and the factor J of the inverse Hessian in u. Rows, active set and multipliers
work on u and J, whatever the Hessian consists of.
"""

from __future__ import annotations

from typing import NamedTuple

from quad_envs._numba import kernel
from quad_envs.parameters import N_INPUT, N_STATE, Array

from .linalg import copy, fill, lu_solve, matmul, take_blocks
from .riccati import RICCATI_SCRATCH, optimal_plan, riccati_pass

_SIZE = N_STATE + N_INPUT


class RateWorkspace(NamedTuple):
    """The problem over z = [x; u_prev] and its recursion; see `carve_rate`."""

    A: Array  # (1 or N, 16, 16)
    B: Array  # (1 or N, 16, 4)
    c: Array  # (N, 16)
    Q: Array  # (N, 16, 16)
    Q_f: Array  # (16, 16)
    R: Array  # (4, 4), R + S
    T: Array  # (4, 4)
    x_0: Array  # (16,)
    r: Array  # (N+1, 16)
    transposed: Array  # (1 or N, 20, 16)
    K: Array  # (N, 4, 16), gains of v
    K_u: Array  # (N, 4, 16), of u
    A_cl: Array  # (N, 16, 16)
    P_c: Array  # (N, 16)
    v: Array  # (N, 4)
    z: Array  # (N+1, 16)
    wide: Array  # (2, 16, 4N)
    scratch: Array  # (RICCATI_SCRATCH, 16, 16)


def rate_size(horizon: int, n_models: int) -> int:
    """Numbers that `carve_rate` needs."""
    N, M, n, m = horizon, n_models, _SIZE, N_INPUT
    pairs, stages = M * (2 * n + 2 * m) * n, N * (2 * n * n + 2 * m * n + 2 * n + m) + 2 * n * (N + 1)
    return pairs + stages + n * n + 2 * m * m + n + 2 * n * m * N + RICCATI_SCRATCH * n * n


@kernel
def carve_rate(buffer: Array, N: int, M: int) -> RateWorkspace:
    """Views of the buffer: one array is unpacked at a call from Python instead of eighteen."""
    n, m = _SIZE, N_INPUT
    A = take_blocks(buffer, 0, M, n, n)
    i = A.size
    B = take_blocks(buffer, i, M, n, m)
    i += B.size
    transposed = take_blocks(buffer, i, M, n + m, n)
    i += transposed.size
    square = take_blocks(buffer, i, 2 * N + 1, n, n)
    i += square.size
    gains = take_blocks(buffer, i, 2 * N, m, n)
    i += gains.size
    stages = take_blocks(buffer, i, 2, N, n)
    i += stages.size
    points = take_blocks(buffer, i, 2, N + 1, n)
    i += points.size
    small = take_blocks(buffer, i, 2, m, m)
    i += small.size
    v = take_blocks(buffer, i, 1, N, m)[0]
    i += v.size
    x_0 = buffer[i : i + n]
    i += n
    wide = take_blocks(buffer, i, 2, n, m * N)
    i += wide.size
    scratch = take_blocks(buffer, i, RICCATI_SCRATCH, n, n)
    return RateWorkspace(
        A, B, stages[0], square[:N], square[2 * N], small[0], small[1], x_0, points[0], transposed, gains[:N],
        gains[N:], square[N : 2 * N], stages[1], v, points[1], wide, scratch,
    )  # fmt: skip


@kernel
def _weigh_changes(R: Array, S: Array, R_sum: Array, T: Array, RT: Array) -> None:
    """R + S, T = (R + S)^-1 S and the symmetric R T; R_sum is overwritten on the way."""
    m = R.shape[0]
    for a in range(m):
        for b in range(m):
            R_sum[a, b] = R[a, b] + S[a, b]
    copy(S, T)
    lu_solve(R_sum, T)
    matmul(R, T, RT)
    for a in range(m):
        for b in range(m):
            R_sum[a, b] = R[a, b] + S[a, b]


@kernel
def _augment_pair(A: Array, B: Array, T: Array, A_z: Array, B_z: Array) -> None:
    """[A, B T; 0, T] and [B; I]."""
    n, m = B.shape
    fill(A_z, 0.0)
    fill(B_z, 0.0)
    copy(A, A_z)
    copy(B, B_z)
    for a in range(n):
        for b in range(m):
            total = 0.0
            for k in range(m):
                total += B[a, k] * T[k, b]
            A_z[a, n + b] = total
    for a in range(m):
        B_z[n + a, a] = 1.0
        for b in range(m):
            A_z[n + a, n + b] = T[a, b]


@kernel
def rate_pass(
    A: Array,
    B: Array,
    c: Array,
    Q: Array,
    R: Array,
    Q_f: Array,
    x_0: Array,
    u_last: Array,
    r: Array,
    S: Array,
    D: Array,
    w: RateWorkspace,
) -> None:
    """The problem over z into w, and its backward pass over matrices; data as of `solve_structured`.

    Args:
        A: (1 or N, 12, 12).
        B: (1 or N, 12, 4).
        c: (N, 12).
        Q: (1 or N, 12, 12).
        R: (4, 4).
        Q_f: (12, 12).
        x_0: (12,).
        u_last: (4,).
        r: (N+1, 12).
        S: Weight of the changes, (4, 4).
        D: Result, inverse Cholesky factors, (N, 4, 4), of v and of u.
        w: Results.
    """
    (N, n), m = c.shape, B.shape[2]
    RT = w.scratch[0].reshape(-1)[: m * m].reshape(m, m)
    _weigh_changes(R, S, w.R, w.T, RT)
    for j in range(A.shape[0]):
        _augment_pair(A[j], B[j], w.T, w.A[j], w.B[j])
    for i in range(Q.shape[0]):
        fill(w.Q[i], 0.0)
        copy(Q[i], w.Q[i])
        for a in range(m):
            for b in range(m):
                w.Q[i, n + a, n + b] = 0.5 * (RT[a, b] + RT[b, a])
    fill(w.Q_f, 0.0)
    copy(Q_f, w.Q_f)
    copy(c, w.c)
    copy(r, w.r)
    for a in range(n):
        w.x_0[a] = x_0[a]
    for a in range(m):
        w.x_0[n + a] = u_last[a]
    riccati_pass(
        w.A[: A.shape[0]], w.B[: A.shape[0]], w.c, w.Q[: Q.shape[0]], w.R, w.Q_f, False,
        w.transposed[: A.shape[0]], w.K, D, w.A_cl, w.P_c, w.scratch,
    )  # fmt: skip
    for i in range(N):
        copy(w.K[i], w.K_u[i])
        for a in range(m):
            for b in range(m):
                w.K_u[i, a, n + b] -= w.T[a, b]


@kernel
def rate_plan(pairs: int, weights: int, D: Array, w: RateWorkspace, u: Array, x: Array) -> None:
    """The unconstrained optimum after `rate_pass`, with the number of its pairs and stage weights."""
    n, m = x.shape[1], u.shape[1]
    optimal_plan(
        w.B[:pairs], w.c, w.Q[:weights], w.Q_f, w.x_0, w.r, False, w.transposed[:pairs], w.K, D, w.A_cl,
        w.P_c, w.v, w.z, w.scratch,
    )  # fmt: skip
    for i in range(x.shape[0]):
        for a in range(n):
            x[i, a] = w.z[i, a]
    for i in range(u.shape[0]):
        for a in range(m):
            u[i, a] = w.z[i + 1, n + a]
