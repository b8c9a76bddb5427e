"""Riccati equations: the algebraic one by structured doubling, the finite-horizon one stage by stage.

The finite-horizon recursion gives the unconstrained optimum of the OCP-QP (`ocp.py`) and, through its
gains, the inverse factor of the condensed Hessian that the structured solver works with. Kernels take their
scratch memory as arguments; `dare` and `lqr_gain` are the validated functions for use outside loops.
"""

from __future__ import annotations

import math

import numpy as np

from quad_envs._numba import kernel
from quad_envs.names import shown
from quad_envs.parameters import Array

from .linalg import add_matvec_transposed, copy, fill, lu_solve, matmul, symmetrise, transpose

DARE_SCRATCH = 10  # (n, n) matrices of scratch that `solve_dare` needs
RICCATI_SCRATCH = 6  # (n, n) matrices of scratch that the finite-horizon passes need
_DOUBLING_LIMIT = 40  # 2^40 samples: no stabilisable pair needs more
_DARE_TOLERANCE = 1e-12  # of the largest entry of P
_RESIDUAL_TOLERANCE = 1e-8  # of the largest entry of P; stabilisable pairs reach 1e-12
_NEWTON_ABOVE = 1e-10  # likewise: residual of the doubling from which Newton's method goes on
_NEWTON_STEPS = 8


@kernel
def _start_doubling(
    A: Array, B: Array, Q: Array, R: Array, A_k: Array, G: Array, H: Array, scratch: Array
) -> None:
    """A_0 = A, G_0 = B R^-1 B', H_0 = Q."""
    m = B.shape[1]
    R_copy = scratch[0].reshape(-1)[: m * m].reshape(m, m)
    solved = scratch[1, :m]  # R^-1 B'
    copy(R, R_copy)
    transpose(B, solved)
    lu_solve(R_copy, solved)
    matmul(B, solved, G)
    copy(A, A_k)
    copy(Q, H)


@kernel
def _double(A_k: Array, G: Array, H: Array, scratch: Array) -> tuple[float, float]:
    """One doubling in place; returns the largest entries of the increment of H and of H."""
    n = A_k.shape[0]
    W, T, A_T, A_W, W_G = scratch[0], scratch[1], scratch[2], scratch[3], scratch[4]
    both = scratch[5:7].reshape(n, 2 * n)
    matmul(G, H, W)
    for i in range(n):
        W[i, i] += 1.0
        for j in range(n):
            both[i, j] = A_k[i, j]
            both[i, n + j] = G[i, j]
            A_T[j, i] = A_k[i, j]
    lu_solve(W, both)  # W^-1 [A, G]
    for i in range(n):
        for j in range(n):
            A_W[i, j] = both[i, j]
            W_G[i, j] = both[i, n + j]
    matmul(A_k, W_G, T)
    matmul(T, A_T, W)
    matmul(H, A_W, T)
    matmul(A_T, T, W_G)
    matmul(A_k, A_W, T)
    increment = 0.0
    largest = 0.0
    for i in range(n):
        for j in range(n):
            A_k[i, j] = T[i, j]
            G[i, j] += W[i, j]
            H[i, j] += W_G[i, j]
            increment = max(increment, abs(W_G[i, j]))
            largest = max(largest, abs(H[i, j]))
    symmetrise(H)
    return increment, largest


@kernel
def solve_dare(A: Array, B: Array, Q: Array, R: Array, P: Array, scratch: Array) -> int:
    """P = Q + A'P A - A'P B (R + B'P B)^-1 B'P A by structure-preserving doubling (Chu, Fan, Lin 2005).

    `A <- A W^-1 A, G <- G + A W^-1 G A', H <- H + A'H W^-1 A` with W = I + G H; H tends to P.

    Args:
        A: State matrix, (n, n).
        B: Input matrix, (n, m).
        Q: State weight, (n, n), symmetric, positive semidefinite.
        R: Input weight, (m, m), symmetric, positive definite.
        P: Result, (n, n).
        scratch: Overwritten, (DARE_SCRATCH, n, n).

    Returns:
        The number of doublings, or -1 if they did not converge: no stabilising solution, or data not finite.
    """
    A_k, G, H = scratch[7], scratch[8], scratch[9]
    _start_doubling(A, B, Q, R, A_k, G, H, scratch)
    doublings = -1
    for k in range(_DOUBLING_LIMIT):
        increment, largest = _double(A_k, G, H, scratch)
        if not math.isfinite(largest):
            break
        if increment <= _DARE_TOLERANCE * largest:
            doublings = k + 1
            break
    copy(H, P)
    return doublings


@kernel
def _factor_inverse(S: Array, D: Array) -> None:
    """D = L^-T for S = L L', so that D D' = S^-1; L replaces the lower half of S, D is upper triangular."""
    m = D.shape[0]
    for a in range(m):
        for b in range(a + 1):
            total = S[a, b]
            for k in range(b):
                total -= S[a, k] * S[b, k]
            S[a, b] = math.sqrt(total) if a == b else total / S[b, b]
    for a in range(m):
        for b in range(m):
            D[a, b] = 0.0
    for a in range(m):
        D[a, a] = 1.0 / S[a, a]
        for b in range(a):
            total = 0.0
            for k in range(b, a):
                total -= S[a, k] * D[b, k]
            D[b, a] = total / S[a, a]


@kernel
def stage_gains(
    P: Array, A: Array, B: Array, R: Array, K: Array, D: Array, A_cl: Array, scratch: Array
) -> None:
    """The optimal feedback of one stage with cost to go x'P x / 2, and the factor of its Hessian.

    Args:
        P: Cost to go after the stage, (n, n).
        A: State matrix, (n, n).
        B: Input matrix, (n, m).
        R: Input weight, (m, m).
        K: Result, S^-1 B'P A with S = R + B'P B, (m, n).
        D: Result, L^-T with S = L L', (m, m).
        A_cl: Result, A - B K, (n, n).
        scratch: Overwritten, (5, n, n); afterwards scratch[1] is P A and the first m rows of
            scratch[3] are D'B'P A.
    """
    n, m = B.shape
    S, PA, BT, half = scratch[0], scratch[1], scratch[2, :m], scratch[3, :m]
    PB = scratch[4]
    matmul(P, A, PA)
    matmul(P, B, PB)
    transpose(B, BT)
    for a in range(m):
        for b in range(a + 1):
            total = R[a, b]
            for k in range(n):
                total += BT[a, k] * PB[k, b]
            S[a, b] = total
    _factor_inverse(S, D)
    T = scratch[4, :m]  # B'P A; P B is no longer needed
    matmul(BT, PA, T)
    for a in range(m):
        for b in range(n):
            half[a, b] = 0.0
        for k in range(a + 1):
            for b in range(n):
                half[a, b] += D[k, a] * T[k, b]
    matmul(D, half, K)
    matmul(B, K, A_cl)
    for a in range(n):
        for b in range(n):
            A_cl[a, b] = A[a, b] - A_cl[a, b]


@kernel
def _step_cost_to_go(P: Array, A_T: Array, Q: Array, PA: Array, half: Array, product: Array) -> None:
    """P <- Q + A'P A - half' half, symmetric by construction, in place; half = D'B'P A, PA = P A."""
    n = P.shape[0]
    matmul(A_T, PA, product)
    for k in range(half.shape[0]):
        for a in range(n):
            factor = half[k, a]
            for b in range(n):
                product[a, b] -= factor * half[k, b]
    for a in range(n):
        for b in range(a + 1):
            value = Q[a, b] + 0.5 * (product[a, b] + product[b, a])
            P[a, b] = value
            P[b, a] = value


@kernel
def riccati_pass(
    A: Array,
    B: Array,
    c: Array,
    Q: Array,
    R: Array,
    Q_f: Array,
    stationary: bool,
    transposed: Array,
    K: Array,
    D: Array,
    A_cl: Array,
    P_c: Array,
    scratch: Array,
) -> None:
    """Backward pass over matrices: everything of the recursion that does not depend on x_0 and r.

    Args:
        A: State matrices, (1 or N, n, n).
        B: Input matrices, (1 or N, n, m).
        c: Affine terms, (N, n).
        Q: State weights of the stages 0..N-1, (1 or N, n, n).
        R: Input weight, (m, m).
        Q_f: Weight of x_N, (n, n).
        stationary: Whether Q_f solves the DARE of the single pair: then every stage has the same gain.
        transposed: Result, [A_i B_i]' per pair, (1 or N, n + m, n).
        K: Result, gains, (N, m, n); with `stationary` only K[0] is written, likewise D and A_cl.
        D: Result, inverse Cholesky factors, (N, m, m).
        A_cl: Result, closed loops, (N, n, n).
        P_c: Result, P_{i+1} c_i, (N, n).
        scratch: Overwritten, (RICCATI_SCRATCH, n, n).
    """
    N, n = c.shape
    P, work = scratch[0], scratch[1:]
    copy(Q_f, P)
    fill(P_c, 0.0)
    for j in range(A.shape[0]):
        transpose(A[j], transposed[j, :n])
        transpose(B[j], transposed[j, n:])
    if stationary:
        stage_gains(P, A[0], B[0], R, K[0], D[0], A_cl[0], work)
        for i in range(N):
            add_matvec_transposed(P, c[i], 1.0, P_c[i])
        return
    for i in range(N - 1, -1, -1):
        j = i if A.shape[0] > 1 else 0
        add_matvec_transposed(P, c[i], 1.0, P_c[i])
        stage_gains(P, A[j], B[j], R, K[i], D[i], A_cl[i], work)
        if i > 0:
            Q_i = Q[i if Q.shape[0] > 1 else 0]
            _step_cost_to_go(P, transposed[j, :n], Q_i, work[1], work[3, : K.shape[1]], work[4])


@kernel
def _feed_forward(B: Array, D: Array, y: Array, k: Array, t: Array) -> None:
    """Writes k = -D D' B' y, the part of the optimal input that does not depend on the state."""
    m = D.shape[0]
    for a in range(m):
        t[a] = 0.0
        k[a] = 0.0
    add_matvec_transposed(B, y, 1.0, t)
    for a in range(m - 1, -1, -1):
        total = 0.0
        for b in range(a + 1):
            total += D[b, a] * t[b]
        t[a] = total
    for a in range(m):
        for b in range(a, m):
            k[a] -= D[a, b] * t[b]


@kernel
def optimal_plan(
    B: Array,
    c: Array,
    Q: Array,
    Q_f: Array,
    x_0: Array,
    r: Array,
    stationary: bool,
    transposed: Array,
    K: Array,
    D: Array,
    A_cl: Array,
    P_c: Array,
    u: Array,
    x: Array,
    scratch: Array,
) -> None:
    """The unconstrained optimum: backward pass over vectors, then roll-out.

    With y = s_{i+1} + P_{i+1} c_i: `k_i = S_i^-1 B_i'y`, `s_i = A_cl_i'y - Q r_i`, `u_i = -K_i x_i - k_i`.

    Args:
        B: Input matrices, (1 or N, n, m).
        c: Affine terms, (N, n).
        Q: State weights of the stages 0..N-1, (1 or N, n, n).
        Q_f: Weight of x_N, (n, n).
        x_0: Initial state, (n,).
        r: References, (N+1, n).
        stationary: As in `riccati_pass`, whose results follow: transposed, K, D, A_cl, P_c.
        transposed: (1 or N, n + m, n).
        K: (N, m, n).
        D: (N, m, m).
        A_cl: (N, n, n).
        P_c: (N, n).
        u: Result, inputs, (N, m).
        x: Result, states, (N+1, n).
        scratch: Overwritten, (RICCATI_SCRATCH, n, n).
    """
    N, n = c.shape
    s, y, t = scratch[0, 0], scratch[0, 1], scratch[0, 2]
    for a in range(n):
        s[a] = 0.0
        x[0, a] = x_0[a]
    add_matvec_transposed(Q_f, r[N], -1.0, s)
    for i in range(N - 1, -1, -1):
        j = i if B.shape[0] > 1 else 0
        g = 0 if stationary else i
        for a in range(n):
            y[a] = s[a] + P_c[i, a]
            s[a] = 0.0
        _feed_forward(B[j], D[g], y, u[i], t)
        if i > 0:
            add_matvec_transposed(A_cl[g], y, 1.0, s)
            add_matvec_transposed(Q[i if Q.shape[0] > 1 else 0], r[i], -1.0, s)
    for i in range(N):
        g = 0 if stationary else i
        for a in range(u.shape[1]):
            total = 0.0
            for b in range(n):
                total += K[g, a, b] * x[i, b]
            u[i, a] -= total
        step_plan(transposed, c, i, u, x)


@kernel
def step_plan(transposed: Array, c: Array, i: int, u: Array, x: Array) -> None:
    """x_{i+1} = A_i x_i + B_i u_i + c_i, with [A_i B_i]' as `riccati_pass` leaves it."""
    j = i if transposed.shape[0] > 1 else 0
    n = x.shape[1]
    for a in range(n):
        x[i + 1, a] = c[i, a]
    add_matvec_transposed(transposed[j, :n], x[i], 1.0, x[i + 1])
    add_matvec_transposed(transposed[j, n:], u[i], 1.0, x[i + 1])


def _square(name: str, value: Array, n: int) -> Array:
    """`value` as a contiguous (n, n) array, or a ValueError that names it."""
    array = np.ascontiguousarray(value, dtype=np.float64)
    if array.shape != (n, n):
        raise ValueError(f"{name} must have shape ({n}, {n}) to match B, got {array.shape}")
    return array


def dare(A: Array, B: Array, Q: Array, R: Array) -> Array:
    """Stabilising solution P of the discrete algebraic Riccati equation.

    Args:
        A: State matrix, (n, n).
        B: Input matrix, (n, m), m <= n.
        Q: State weight, (n, n), symmetric, positive semidefinite.
        R: Input weight, (m, m), symmetric, positive definite.

    Returns:
        P, (n, n), symmetric.

    Raises:
        ValueError: If a shape is wrong, an entry is not finite, a weight is not symmetric, R is not positive
            definite, or no stabilising solution exists.
    """
    B = np.ascontiguousarray(B, dtype=np.float64)
    if B.ndim != 2 or not 1 <= B.shape[1] <= B.shape[0]:
        raise ValueError(f"B must have shape (n, m) with 1 <= m <= n, got {B.shape}")
    n, m = B.shape
    A, Q, R = _square("A", A, n), _square("Q", Q, n), _square("R", R, m)
    for name, value in (("A", A), ("B", B), ("Q", Q), ("R", R)):
        if not np.isfinite(value).all():
            raise ValueError(f"{name} must be finite, got {shown(value)}")
    for name, value in (("Q", Q), ("R", R)):
        if not np.allclose(value, value.T, rtol=1e-12, atol=1e-12 * float(np.abs(value).max())):
            raise ValueError(f"{name} must be symmetric, use ({name} + {name}.T) / 2; got {shown(value)}")
    smallest = float(np.linalg.eigvalsh(R)[0])
    if smallest <= 0.0:
        raise ValueError(f"R must be positive definite, its smallest eigenvalue is {smallest}")
    P = np.empty((n, n))
    doublings = solve_dare(A, B, Q, R, P, np.empty((DARE_SCRATCH, n, n)))
    if doublings > 0:
        P = _improve(A, B, Q, R, P)
    tolerance = _RESIDUAL_TOLERANCE * max(1.0, float(np.abs(P).max()))
    if doublings < 0 or not _dare_residual(A, B, Q, R, P) <= tolerance:
        moduli = np.abs(np.linalg.eigvals(A))
        raise ValueError(
            "the Riccati equation has no stabilising solution: every unstable or marginal mode of A must be "
            f"controllable from B and seen by Q; the eigenvalues of A have moduli {moduli}"
        )
    return P


def _improve(A: Array, B: Array, Q: Array, R: Array, P: Array) -> Array:
    """Newton's method (Kleinman 1968) from a P that doubling could not find exactly: weights far apart.

    The next P is the cost of the gain of this one, `X = Q + K'R K + A_cl'X A_cl`, summed by doubling: all
    terms are positive semidefinite, so that nothing cancels, however small R is beside B'P B.
    """
    best = _dare_residual(A, B, Q, R, P)
    for _ in range(_NEWTON_STEPS):
        if best <= _NEWTON_ABOVE * np.abs(P).max():
            break
        K = np.linalg.solve(R + B.T @ P @ B, B.T @ P @ A)
        X, F = Q + K.T @ R @ K, A - B @ K
        for _ in range(_DOUBLING_LIMIT):
            term = F.T @ X @ F
            if not np.isfinite(term).all():
                return P
            X, F = X + term, F @ F
            if np.abs(term).max() <= 1e-16 * np.abs(X).max():
                break
        X = 0.5 * (X + X.T)
        residual = _dare_residual(A, B, Q, R, X)
        if not residual < best:
            break
        P, best = X, residual
    return P


def _dare_residual(A: Array, B: Array, Q: Array, R: Array, P: Array) -> float:
    """Largest entry of Q + A'P(A - B K) - P."""
    K = np.linalg.solve(R + B.T @ P @ B, B.T @ P @ A)
    return float(np.abs(Q + A.T @ P @ (A - B @ K) - P).max())


def lqr_gain(A: Array, B: Array, Q: Array, R: Array) -> tuple[Array, Array]:
    """Infinite-horizon LQR: u = -K x minimises sum x'Q x + u'R u.

    Args:
        A: State matrix, (n, n).
        B: Input matrix, (n, m).
        Q: State weight, (n, n).
        R: Input weight, (m, m).

    Returns:
        K, (m, n), and P, (n, n), the solution of the Riccati equation.

    Raises:
        ValueError: As `dare`.
    """
    P = dare(A, B, Q, R)
    K = np.asarray(np.linalg.solve(R + B.T @ P @ B, B.T @ P @ A), dtype=np.float64)
    return K, P
