"""J with H^-1 = J J', inverse factor of the condensed Hessian: the impulse response of the closed loop."""

from __future__ import annotations

from quad_envs.compilation.decorators import kernel
from quad_envs.parameters import Array

from .linalg import fill
from .products import add_product, negate
from .recursion import Feedback


@kernel
def _start_column(B: Array, D: Array, J_T: Array, w: int, response: Array, column: int) -> None:
    """The diagonal block D of J at column w, and the response B D of the next state at the given column."""
    n, m = B.shape
    for b in range(m):
        for a in range(m):
            J_T[w + b, w + a] = D[a, b]
        for a in range(n):
            total = 0.0
            for k in range(b + 1):  # D is upper triangular
                total += B[a, k] * D[k, b]
            response[a, column + b] = total


@kernel
def _march(K: Array, A_cl: Array, X: Array, width: int, J_T: Array, w: int, X_next: Array) -> None:
    """One stage: rows w.. of J, -K X, below the first columns, and X_next = A_cl X, over `width` columns."""
    row = X_next[0]  # scratch until X_next is made
    for a in range(K.shape[0]):
        for k in range(width):
            row[k] = 0.0
        for b in range(K.shape[1]):
            factor = K[a, b]
            for k in range(width):
                row[k] -= factor * X[b, k]
        for k in range(width):
            J_T[k, w + a] = row[k]
    for a in range(A_cl.shape[0]):
        for k in range(width):
            X_next[a, k] = 0.0
        for b in range(A_cl.shape[1]):
            factor = A_cl[a, b]
            for k in range(width):
                X_next[a, k] += factor * X[b, k]


@kernel
def _close_loop(A: Array, B_T: Array, K: Array, minus: Array, A_cl: Array) -> None:
    """A_cl = A - B K, with B' as `riccati_pass` leaves it."""
    negate(K, minus)
    add_product(A, B_T, minus, A_cl)


@kernel
def inverse_factor(
    A: Array,
    B: Array,
    stationary: bool,
    feedback: Feedback,
    K_u: Array,
    J_T: Array,
    wide: Array,
    scratch: Array,
) -> None:
    """J with J J' = H^-1: J_jj = D_j, J_ij = -K_i A_cl_{i-1} .. A_cl_{j+1} B_j D_j below, 0 above.

    Marches the response X_i of x_i to all whitened inputs before stage i: rows i of J left of the diagonal
    are -K_i X_i, and X_{i+1} = [A_cl_i X_i, B_i D_i] with A_cl = A - B K. With one gain J is block Toeplitz:
    the first block column is marched and the others are copies.

    Args:
        A: (1 or N, n, n).
        B: (1 or N, n, 4).
        stationary: Whether the first gain serves all stages.
        feedback: Of `riccati_pass`.
        K_u: Gains of u, (N, 4, n): those of the feedback, but where changes of u have a weight.
        J_T: Result, J by columns, (4N, 4N).
        wide: Overwritten, (2, n, 4N).
        scratch: Overwritten, (2, n, n).
    """
    K, D, A_cl = feedback.K, feedback.D, scratch[0]
    N, m = D.shape[:2]
    n, nv = A.shape[1], m * N
    fill(J_T, 0.0)
    for i in range(N):
        X, X_next = wide[i % 2], wide[1 - i % 2]
        g = 0 if stationary else i
        j = i if B.shape[0] > 1 else 0
        if i == 1 or (i > 1 and not stationary):
            _close_loop(A[j], feedback.transposed[j, n:], K[g], scratch[1], A_cl)
        if i > 0:
            _march(K_u[g], A_cl, X, m if stationary else m * i, J_T, m * i, X_next)
        if i == 0 or not stationary:
            _start_column(B[j], D[g], J_T, m * i, X_next, m * i)
    if stationary:
        for k in range(m, nv):
            start = k - k % m
            for j in range(nv - start):
                J_T[k, start + j] = J_T[k % m, j]
