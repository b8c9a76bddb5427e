"""Small dense kernels: hand loops, which beat BLAS and LAPACK calls on 12 x 12 matrices.

All arrays are C-contiguous float64; results go into arguments that the caller allocated, which must not
alias the inputs unless the docstring says so. The innermost loop runs along the contiguous index, so that
LLVM vectorises it. A result may be larger than needed: only its leading block is written.
"""

from __future__ import annotations

import math

from quad_envs.compilation.decorators import kernel
from quad_envs.parameters import Array


@kernel
def matmul(A: Array, B: Array, out: Array) -> None:
    """The product A B of A (n, k) and B (k, m) into out (n, m)."""
    n, inner = A.shape
    m = B.shape[1]
    for i in range(n):
        for j in range(m):
            out[i, j] = 0.0
        for k in range(inner):
            factor = A[i, k]
            for j in range(m):
                out[i, j] += factor * B[k, j]


@kernel
def matvec(A: Array, x: Array, out: Array) -> None:
    """The product A x of A (n, k) and x (k,) into out (n,)."""
    for i in range(A.shape[0]):
        total = 0.0
        for j in range(A.shape[1]):
            total += A[i, j] * x[j]
        out[i] = total


@kernel
def take(buffer: Array, start: int, rows: int, columns: int) -> Array:
    """The next matrix of a buffer, a view: many arrays travel as one, which is unpacked once."""
    return buffer[start : start + rows * columns].reshape(rows, columns)


@kernel
def take_blocks(buffer: Array, start: int, blocks: int, rows: int, columns: int) -> Array:
    """As `take`, for several matrices of one shape."""
    return buffer[start : start + blocks * rows * columns].reshape(blocks, rows, columns)


@kernel
def copy(A: Array, out: Array) -> None:
    """A (n, m) into out. A slice assignment would compile four times as long."""
    for i in range(A.shape[0]):
        for j in range(A.shape[1]):
            out[i, j] = A[i, j]


@kernel
def fill(out: Array, value: float) -> None:
    """The value into every entry of out (n, m)."""
    for i in range(out.shape[0]):
        for j in range(out.shape[1]):
            out[i, j] = value


@kernel
def transpose(A: Array, out: Array) -> None:
    """The transpose of A (n, m) into out (m, n)."""
    for i in range(A.shape[0]):
        for j in range(A.shape[1]):
            out[j, i] = A[i, j]


@kernel
def symmetrise(A: Array) -> None:
    """A becomes (A + A') / 2, in place."""
    for i in range(A.shape[0]):
        for j in range(i):
            mean = 0.5 * (A[i, j] + A[j, i])
            A[i, j] = mean
            A[j, i] = mean


@kernel
def _eliminate_column(A: Array, X: Array, k: int) -> None:
    """One column of the elimination: largest pivot to row k, then zeros below it, the same done to X."""
    n = A.shape[0]
    m = X.shape[1]
    pivot = k
    for i in range(k + 1, n):
        if abs(A[i, k]) > abs(A[pivot, k]):
            pivot = i
    if pivot != k:
        for j in range(k, n):
            A[k, j], A[pivot, j] = A[pivot, j], A[k, j]
        for j in range(m):
            X[k, j], X[pivot, j] = X[pivot, j], X[k, j]
    inverse = 1.0 / A[k, k]
    for i in range(k + 1, n):
        factor = A[i, k] * inverse
        if factor != 0.0:
            for j in range(k + 1, n):
                A[i, j] -= factor * A[k, j]
            for j in range(m):
                X[i, j] -= factor * X[k, j]


@kernel
def lu_solve(A: Array, X: Array) -> None:
    """Solve A Y = X in place by Gaussian elimination with partial pivoting.

    Args:
        A: Matrix, (n, n); destroyed.
        X: Right-hand sides on entry, solution on exit, (n, m). A singular A leaves infinities or NaN in it.
    """
    n = A.shape[0]
    m = X.shape[1]
    for k in range(n):
        _eliminate_column(A, X, k)
    for k in range(n - 1, -1, -1):
        inverse = 1.0 / A[k, k]
        for j in range(m):
            X[k, j] *= inverse
        for i in range(k):
            factor = A[i, k]
            for j in range(m):
                X[i, j] -= factor * X[k, j]


@kernel
def cholesky(A: Array) -> int:
    """The lower factor L of A = L L' into the lower triangle of A (n, n); the rest of A is left alone.

    Returns:
        -1, or the first row whose pivot is not positive: A is not positive definite, or not finite there.
    """
    for i in range(A.shape[0]):
        for j in range(i):
            total = A[i, j]
            for k in range(j):
                total -= A[i, k] * A[j, k]
            A[i, j] = total / A[j, j]
        pivot = A[i, i]
        for k in range(i):
            pivot -= A[i, k] * A[i, k]
        if not 0.0 < pivot < math.inf:  # false for NaN, too
            return i
        A[i, i] = math.sqrt(pivot)
    return -1


@kernel
def solve_lower(L: Array, X: Array) -> None:
    """Solve L Y = X in place for the lower triangle of L (n, n) and X (n, m)."""
    for i in range(L.shape[0]):
        for k in range(i):
            factor = L[i, k]
            for j in range(X.shape[1]):
                X[i, j] -= factor * X[k, j]
        inverse = 1.0 / L[i, i]
        for j in range(X.shape[1]):
            X[i, j] *= inverse


@kernel
def solve_lower_transposed(L: Array, X: Array) -> None:
    """Solve L' Y = X in place for the lower triangle of L (n, n) and X (n, m)."""
    for i in range(L.shape[0] - 1, -1, -1):
        for k in range(i + 1, L.shape[0]):
            factor = L[k, i]
            for j in range(X.shape[1]):
                X[i, j] -= factor * X[k, j]
        inverse = 1.0 / L[i, i]
        for j in range(X.shape[1]):
            X[i, j] *= inverse


@kernel
def invert_spd(A: Array, inverse: Array) -> bool:
    """The inverse of a symmetric positive definite A (n, n), for where the inverse itself is the result.

    Args:
        A: Overwritten by its factor.
        inverse: Result, (n, n); untouched where A is not positive definite.

    Returns:
        Whether A is positive definite.
    """
    if cholesky(A) >= 0:
        return False
    n = A.shape[0]
    for i in range(n):
        for j in range(n):
            inverse[i, j] = 1.0 if i == j else 0.0
    solve_lower(A, inverse)
    solve_lower_transposed(A, inverse)
    symmetrise(inverse)
    return True
