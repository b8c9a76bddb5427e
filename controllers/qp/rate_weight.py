"""A weight S = `OcpQp.R_rate` on changes of the input: |u_i - u_{i-1}|_S^2 at i < N, with u_{-1} = u_last.

The recursion of `recursion.py` runs over z = [x; u_prev]. Its input v = u - T u_prev with T = (R + S)^-1 S
leaves no product of input and state in the cost of a stage,

    |u|_R^2 + |u - u_prev|_S^2 = |v|_{R+S}^2 + |u_prev|_{R T}^2,
    z_{i+1} = [A_i, B_i T; 0, T] z_i + [B_i; I] v_i + [c_i; 0].

It gives the unconstrained plan and the factor J of the inverse Hessian in u. Rows, active set and multipliers
work on u and J, whatever the Hessian consists of.
"""

from __future__ import annotations

from typing import NamedTuple

from quad_envs.compilation.decorators import kernel
from quad_envs.parameters import N_INPUT, N_STATE, Array

from .linalg import copy, fill, lu_solve, matmul, take_blocks
from .ocp import OcpQp, weight_of_changes
from .recursion import RECURSION_SCRATCH, Feedback, Regulator, optimal_plan, riccati_pass

_SIZE = N_STATE + N_INPUT


class RateWorkspace(NamedTuple):
    """The problem over z = [x; u_prev] and its recursion; see `carve_rate`."""

    problem: Regulator  # of v, n = 16, R + S in the place of R; `stationary` is False
    feedback: Feedback  # of v; its D is that of u, too
    K_u: Array  # (N, 4, 16), gains of u
    T: Array  # (1 or N, 4, 4)
    v: Array  # (N, 4)
    z: Array  # (N+1, 16)
    wide: Array  # (2, 16, 4N)
    scratch: Array  # (RECURSION_SCRATCH, 16, 16)


def rate_size(horizon: int, n_models: int) -> int:
    """Numbers that `carve_rate` needs."""
    N, M, n, m = horizon, n_models, _SIZE, N_INPUT
    pairs, stages = M * (2 * n + 2 * m) * n, N * (n * n + 2 * m * n + 2 * n + m) + 2 * n * (N + 1)
    return pairs + stages + n * n + 2 * M * m * m + n + 2 * n * m * N + RECURSION_SCRATCH * n * n


@kernel
def carve_rate(buffer: Array, qp: OcpQp, D: Array) -> RateWorkspace:
    """Views of the buffer: a call from Python unpacks one array. D, (N, 4, 4), is of v and of u."""
    n, m, N, M, W = _SIZE, N_INPUT, qp.c.shape[0], qp.A.shape[0], qp.Q.shape[0]
    A = take_blocks(buffer, 0, M, n, n)
    i = A.size
    B = take_blocks(buffer, i, M, n, m)
    i += B.size
    transposed = take_blocks(buffer, i, M, n + m, n)
    i += transposed.size
    square = take_blocks(buffer, i, W + 1, n, n)
    i += square.size
    gains = take_blocks(buffer, i, 2 * N, m, n)
    i += gains.size
    stages = take_blocks(buffer, i, 2, N, n)
    i += stages.size
    points = take_blocks(buffer, i, 2, N + 1, n)
    i += points.size
    E = qp.R.shape[0]
    small = take_blocks(buffer, i, 2 * E, m, m)
    i += small.size
    v = take_blocks(buffer, i, 1, N, m)[0]
    i += v.size
    x_0 = buffer[i : i + n]
    i += n
    wide = take_blocks(buffer, i, 2, n, m * N)
    i += wide.size
    scratch = take_blocks(buffer, i, RECURSION_SCRATCH, n, n)
    problem = Regulator(A, B, stages[0], square[:W], small[:E], square[W], False, x_0, points[0])
    feedback = Feedback(transposed, gains[:N], D, stages[1])
    return RateWorkspace(problem, feedback, gains[N:], small[E:], v, points[1], wide, scratch)


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
def rate_pass(qp: OcpQp, w: RateWorkspace) -> None:
    """The problem over z into w, and its backward pass over matrices; R_rate is an array."""
    (N, n), m, z = qp.c.shape, N_INPUT, w.problem
    RT = w.scratch[0].reshape(-1)[: m * m].reshape(m, m)
    stages = w.T.shape[0]
    for i in range(max(qp.A.shape[0], qp.Q.shape[0])):
        if i < stages:
            _weigh_changes(qp.R[i], weight_of_changes(qp), z.R[i], w.T[i], RT)
        if i < qp.A.shape[0]:
            _augment_pair(qp.A[i], qp.B[i], w.T[i if stages > 1 else 0], z.A[i], z.B[i])
        if i >= qp.Q.shape[0]:
            continue
        fill(z.Q[i], 0.0)
        copy(qp.Q[i], z.Q[i])
        for a in range(m):
            for b in range(m):
                z.Q[i, n + a, n + b] = 0.5 * (RT[a, b] + RT[b, a])
    fill(z.Q_f, 0.0)
    copy(qp.Q_f, z.Q_f)
    fill(z.c, 0.0)  # a problem with as many pairs but other weights may have left something here
    fill(z.r, 0.0)
    copy(qp.c, z.c)
    copy(qp.r, z.r)
    for a in range(n):
        z.x_0[a] = qp.x_0[a]
    for a in range(m):
        z.x_0[n + a] = qp.u_last[a]
    riccati_pass(z, w.feedback, w.scratch)
    for i in range(N):
        copy(w.feedback.K[i], w.K_u[i])
        for a in range(m):
            for b in range(m):
                w.K_u[i, a, n + b] -= w.T[i if stages > 1 else 0, a, b]


@kernel
def rate_plan(w: RateWorkspace, u: Array, x: Array) -> None:
    """The unconstrained optimum after `rate_pass`."""
    n, m = x.shape[1], u.shape[1]
    optimal_plan(w.problem, w.feedback, w.v, w.z, w.scratch[0])
    for i in range(x.shape[0]):
        for a in range(n):
            x[i, a] = w.z[i, a]
    for i in range(u.shape[0]):
        for a in range(m):
            u[i, a] = w.z[i + 1, n + a]
