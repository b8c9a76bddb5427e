"""The Riccati recursion over a finite horizon, stage by stage, in vector registers.

It gives the unconstrained optimum of the OCP-QP (`ocp.py`) and, through its gains, the inverse factor of the
condensed Hessian that the structured solver works with. The same equations in plain numpy stand in
`tests/recursion_twin.py`. Sizes are multiples of four, with N_INPUT inputs; scratch memory is an argument.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from quad_envs.compilation.decorators import inline_kernel, kernel
from quad_envs.parameters import N_INPUT, Array

from .linalg import copy
from .products import add_matvec_transposed, add_product, negate, product, symmetric_part, transpose

RECURSION_SCRATCH = 5  # (n, n) matrices


class Regulator(NamedTuple):
    """A problem without constraints, as in `OcpQp`; n = 12 states, or 16 where changes have a weight."""

    A: Array  # (1 or N, n, n)
    B: Array  # (1 or N, n, 4)
    c: Array  # (N, n)
    Q: Array  # (1 or N, n, n)
    R: Array  # (1 or N, 4, 4)
    Q_f: Array  # (n, n)
    stationary: bool  # Q_f solves the DARE of the single pair: every stage has the gain of the first
    x_0: Array  # (n,)
    r: Array  # (N+1, n)


class Feedback(NamedTuple):
    """What the backward pass finds, which depends neither on x_0 nor on r: u_i = -K_i x_i - k_i."""

    transposed: Array  # (1 or N, n + 4, n), [A_i B_i]'
    K: Array  # (N, 4, n), gains; with `stationary` only the first is written, likewise of D
    D: Array  # (N, 4, 4), L^-T with S_i = L L' = R + B_i'P_{i+1} B_i, the Hessian of stage i
    P_c: Array  # (N, n), P_{i+1} c_i


@inline_kernel
def _factor_inverse(S: Array, D: Array, D_T: Array) -> None:
    """D = L^-T for S = L L', so that D D' = S^-1, and D'; S is overwritten."""
    for a in range(N_INPUT):
        for b in range(a):
            total = S[a, b]
            for k in range(b):
                total -= S[a, k] * S[b, k]
            S[a, b] = total * D[b, b]
        total = S[a, a]
        for k in range(a):
            total -= S[a, k] * S[a, k]
        D[a, a] = D_T[a, a] = 1.0 / math.sqrt(total)
        for b in range(a):
            total = 0.0
            for k in range(b, a):
                total -= S[a, k] * D[b, k]
            D[b, a] = D_T[a, b] = total * D[a, a]
            D[a, b] = D_T[b, a] = 0.0


@inline_kernel
def stage_gains(P: Array, A: Array, B: Array, R: Array, K: Array, D: Array, scratch: Array) -> None:
    """The optimal feedback u = -K x of one stage with cost to go x'P x / 2, and the factor of its Hessian.

    Args:
        P: Cost to go after the stage, (n, n), symmetric.
        A: State matrix, (n, n).
        B: Input matrix, (n, 4).
        R: Input weight, (4, 4).
        K: Result, S^-1 B'P A with S = R + B'P B, (4, n).
        D: Result, L^-T with S = L L', (4, 4).
        scratch: Overwritten, (4, n, n); afterwards scratch[0] is P A, and the first four rows of scratch[1]
            are D'B'P A.
    """
    n = B.shape[0]
    PA, half, T = scratch[0], scratch[1, :N_INPUT], scratch[2, :N_INPUT]
    PB = scratch[3].reshape(-1)[: n * N_INPUT].reshape(n, N_INPUT)
    small = scratch[2].reshape(-1)[N_INPUT * n :]
    S = small[: N_INPUT * N_INPUT].reshape(N_INPUT, N_INPUT)
    D_T = small[N_INPUT * N_INPUT : 2 * N_INPUT * N_INPUT].reshape(N_INPUT, N_INPUT)
    product(P, B, PB)
    add_product(R, B, PB, S)
    _factor_inverse(S, D, D_T)
    product(P, A, PA)
    product(B, PA, T)
    product(D, T, half)
    product(D_T, half, K)


@inline_kernel
def _step_cost_to_go(
    A: Array, Q: Array, PA: Array, half: Array, minus: Array, total: Array, P: Array
) -> None:
    """P = Q + A'P A - half'half, symmetric by construction; half = D'B'P A, PA = P A."""
    negate(half, minus)
    add_product(Q, A, PA, total)
    add_product(total, half, minus, total)
    symmetric_part(total, P)


@kernel
def riccati_pass(problem: Regulator, feedback: Feedback, scratch: Array) -> None:
    """Backward pass over matrices; scratch is (RECURSION_SCRATCH, n, n)."""
    A, B, c, Q, R = problem.A, problem.B, problem.c, problem.Q, problem.R
    transposed, K, D, P_c = feedback.transposed, feedback.K, feedback.D, feedback.P_c
    N, n = c.shape
    P, work = scratch[0], scratch[1:]
    copy(problem.Q_f, P)
    for j in range(A.shape[0]):
        transpose(A[j], transposed[j, :n])
        transpose(B[j], transposed[j, n:])
    if problem.stationary:
        stage_gains(P, A[0], B[0], R[0], K[0], D[0], work)
    for i in range(N - 1, -1, -1):
        for a in range(n):
            P_c[i, a] = 0.0
        add_matvec_transposed(P, c[i], 1.0, P_c[i])
        if not problem.stationary:
            j = i if A.shape[0] > 1 else 0
            stage_gains(P, A[j], B[j], R[i if R.shape[0] > 1 else 0], K[i], D[i], work)
            if i > 0:
                Q_i = Q[i if Q.shape[0] > 1 else 0]
                _step_cost_to_go(A[j], Q_i, work[0], work[1, :N_INPUT], work[2, :N_INPUT], work[3], P)


@kernel
def _feed_forward(D: Array, t: Array, k: Array) -> None:
    """K = -D D't, the part of the optimal input that does not depend on the state; t = B'y becomes D't."""
    for a in range(N_INPUT - 1, -1, -1):
        total = 0.0
        for b in range(a + 1):
            total += D[b, a] * t[b]
        t[a] = total
    for a in range(N_INPUT):
        k[a] = 0.0
        for b in range(a, N_INPUT):
            k[a] -= D[a, b] * t[b]


@kernel
def optimal_plan(problem: Regulator, feedback: Feedback, u: Array, x: Array, scratch: Array) -> None:
    """The unconstrained optimum: backward pass over vectors, then roll-out.

    With y = s_{i+1} + P_{i+1} c_i and t = B_i'y: `k_i = S_i^-1 t`, `s_i = A_i'y - K_i't - Q_i r_i`,
    `u_i = -K_i x_i - k_i`.

    Args:
        problem: The problem.
        feedback: What `riccati_pass` found.
        u: Result, inputs, (N, 4).
        x: Result, states, (N+1, n).
        scratch: Overwritten, (>= 3, n).
    """
    A, B, c, Q, r = problem.A, problem.B, problem.c, problem.Q, problem.r
    K, D, P_c = feedback.K, feedback.D, feedback.P_c
    N, n = c.shape
    s, y, t = scratch[0], scratch[1], scratch[2, :N_INPUT]
    for a in range(n):
        s[a] = 0.0
        x[0, a] = problem.x_0[a]
    add_matvec_transposed(problem.Q_f, r[N], -1.0, s)
    for i in range(N - 1, -1, -1):
        j = i if B.shape[0] > 1 else 0
        g = 0 if problem.stationary else i
        for a in range(n):
            y[a] = s[a] + P_c[i, a]
            s[a] = 0.0
        for a in range(N_INPUT):
            t[a] = 0.0
        add_matvec_transposed(B[j], y, 1.0, t)
        if i > 0:
            add_matvec_transposed(A[j], y, 1.0, s)
            add_matvec_transposed(K[g], t, -1.0, s)
            add_matvec_transposed(Q[i if Q.shape[0] > 1 else 0], r[i], -1.0, s)
        _feed_forward(D[g], t, u[i])
    for i in range(N):
        g = 0 if problem.stationary else i
        for a in range(N_INPUT):
            total = 0.0
            for b in range(n):
                total += K[g, a, b] * x[i, b]
            u[i, a] -= total
        step_plan(feedback.transposed, c, i, u, x)


@kernel
def step_plan(transposed: Array, c: Array, i: int, u: Array, x: Array) -> None:
    """x_{i+1} = A_i x_i + B_i u_i + c_i, with [A_i B_i]' as `riccati_pass` leaves it."""
    j = i if transposed.shape[0] > 1 else 0
    n = x.shape[1]
    for a in range(n):
        x[i + 1, a] = c[i, a]
    add_matvec_transposed(transposed[j, :n], x[i], 1.0, x[i + 1])
    add_matvec_transposed(transposed[j, n:], u[i], 1.0, x[i + 1])
