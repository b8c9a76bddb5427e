"""The Kalman update with a dense measurement matrix, on which every filter here rests."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from controllers.qp.linalg import cholesky, matmul, solve_lower, solve_lower_transposed, symmetrise
from quad_envs.compilation.decorators import kernel
from quad_envs.parameters import Array

from .arguments import BoolArray, as_floats


class KalmanUpdate(NamedTuple):
    """States after an update."""

    x: Array  # (n, d)
    P: Array  # (n, d, d)
    nis: Array  # (n,), nu' S^-1 nu; 0 where refused
    accepted: BoolArray  # (n,); False: S is not positive definite, and x, P are as they were


def kalman_scratch(d: int, m: int) -> int:
    """Numbers of scratch that an update of d states with m rows needs."""
    return m * m + 2 * m * d + m + 2 * d * d


@kernel
def _joseph(P: Array, K_T: Array, H: Array, R: Array, R_K: Array, A: Array, T: Array) -> None:
    """P <- (I - K H) P (I - K H)' + K R K', symmetrised; K_T (m, d) is K', the rest is scratch."""
    d = P.shape[0]
    m = H.shape[0]
    for i in range(d):
        for j in range(d):
            A[i, j] = 1.0 if i == j else 0.0
    for a in range(m):
        for i in range(d):
            gain = K_T[a, i]
            for j in range(d):
                A[i, j] -= gain * H[a, j]
    matmul(A, P, T)
    for i in range(d):
        for j in range(d):
            total = 0.0
            for k in range(d):
                total += T[i, k] * A[j, k]
            P[i, j] = total
    matmul(R, K_T, R_K)
    for a in range(m):
        for i in range(d):
            gain = K_T[a, i]
            for j in range(d):
                P[i, j] += gain * R_K[a, j]
    symmetrise(P)


@kernel
def kalman_update_kernel(
    x: Array, P: Array, nu: Array, H: Array, R: Array, scratch: Array
) -> tuple[float, int]:
    """Update in place: x <- x + K nu and P in the Joseph form, with S = H P H' + R and K = P H' S^-1.

    Args:
        x: State, (d,).
        P: Covariance, (d, d), symmetric.
        nu: Innovation z - h(x), (m,).
        H: Derivative of h, (m, d).
        R: Covariance of the noise, (m, m), symmetric.
        scratch: Overwritten, (>= kalman_scratch(d, m),).

    Returns:
        nu' S^-1 nu and -1; or 0 and the first row at which S is not positive definite: x, P are untouched.
    """
    d = x.shape[0]
    m = nu.shape[0]
    S = scratch[: m * m].reshape(m, m)
    i = m * m
    K_T = scratch[i : i + m * d].reshape(m, d)
    i += m * d
    R_K = scratch[i : i + m * d].reshape(m, d)
    i += m * d
    e = scratch[i : i + m].reshape(m, 1)
    i += m
    A = scratch[i : i + d * d].reshape(d, d)
    T = scratch[i + d * d : i + 2 * d * d].reshape(d, d)
    matmul(H, P, K_T)
    for a in range(m):
        e[a, 0] = nu[a]
        for b in range(a + 1):
            total = R[a, b]
            for j in range(d):
                total += H[a, j] * K_T[b, j]
            S[a, b] = total
    failed = cholesky(S)
    if failed >= 0:
        return 0.0, failed
    solve_lower(S, e)
    solve_lower(S, K_T)  # L^-1 H P
    nis = 0.0
    for a in range(m):
        nis += e[a, 0] * e[a, 0]
        for j in range(d):
            x[j] += K_T[a, j] * e[a, 0]
    solve_lower_transposed(S, K_T)
    _joseph(P, K_T, H, R, R_K, A, T)
    return nis, -1


@kernel
def _update_rows(
    x: Array, P: Array, nu: Array, H: Array, R: Array, nis: Array, failed: Array, scratch: Array
) -> None:
    for i in range(x.shape[0]):
        nis[i], failed[i] = kalman_update_kernel(x[i], P[i], nu[i], H[i], R[i], scratch)


def kalman_update(x: ArrayLike, P: ArrayLike, nu: ArrayLike, H: ArrayLike, R: ArrayLike) -> KalmanUpdate:
    """Kalman update with given innovation, derivative and noise; h is linear or linearised elsewhere.

    A trilaterated position r with covariance C enters with H = [I 0], nu = r - x[:3], R = C.

    Args:
        x: States, (n, d).
        P: Covariances, (n, d, d).
        nu: Innovations z - h(x), (n, m).
        H: Derivatives of h, (n, m, d).
        R: Covariances of the noise, (n, m, m).

    Returns:
        New states; the arguments are left alone.

    Raises:
        ValueError: If a shape is wrong or a number is not finite.

    Deviation: Eq. (6.4) prints K = P H' (H P H')^-1. Without R in it the covariance collapses and the filter
    diverges.
    """
    state = as_floats("x", x, (None, None)).copy()
    n, d = state.shape
    covariance = as_floats("P", P, (n, d, d)).copy()
    innovation = as_floats("nu", nu, (n, None))
    m = innovation.shape[1]
    derivative, noise = as_floats("H", H, (n, m, d)), as_floats("R", R, (n, m, m))
    nis, failed = np.zeros(n), np.full(n, -1.0)
    if m:
        scratch = np.empty(kalman_scratch(d, m))
        _update_rows(state, covariance, innovation, derivative, noise, nis, failed, scratch)
    return KalmanUpdate(state, covariance, nis, failed < 0.0)
