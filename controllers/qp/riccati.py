"""The algebraic Riccati equation by structured doubling.

Kernels take their scratch memory as arguments; `dare` and `lqr_gain` are the validated functions for use
outside loops. The recursion over a finite horizon is `recursion.py`.
"""

from __future__ import annotations

import math

import numpy as np

from quad_envs.arguments.names import shown
from quad_envs.compilation.decorators import kernel
from quad_envs.parameters import Array

from .linalg import copy, lu_solve, matmul, symmetrise, transpose

DARE_SCRATCH = 10  # (n, n) matrices of scratch that `solve_dare` needs
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
