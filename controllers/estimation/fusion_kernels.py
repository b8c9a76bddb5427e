"""Compiled covariance intersection of one vehicle's estimates, see `fusion.py`; no allocation."""

from __future__ import annotations

import math

from controllers.qp.linalg import copy, fill, invert_spd, matvec
from quad_envs.compilation.decorators import Int, kernel
from quad_envs.parameters import Array

from .arguments import BoolArray

CI_WEIGHTS = ("trace", "position-trace", "equal", "determinant", "naive")
_TRACE, _POSITION_TRACE, _EQUAL, _DETERMINANT, _NAIVE = range(len(CI_WEIGHTS))
_GAP = 1e-7  # of log det P^-1, from its optimum
_PASSES = 200


def intersect_scratch(k: int, d: int) -> int:
    """Numbers of scratch that `intersect_kernel` needs for k estimates of d states."""
    return (k + 2) * d * d + k + d


@kernel
def _weighted_sum(w: Array, information: Array, M: Array) -> None:
    """M = sum w_j P_j^-1."""
    d = M.shape[0]
    for i in range(d):
        for j in range(d):
            total = 0.0
            for a in range(w.shape[0]):
                total += w[a] * information[a, i, j]
            M[i, j] = total


@kernel
def _curvature(M_inverse: Array, A: Array, B: Array) -> float:
    """Trace of (M^-1 (A - B))^2: how fast the slope of log det M falls from B towards A."""
    d = A.shape[0]
    total = 0.0
    for i in range(d):
        for j in range(d):
            forth, back = 0.0, 0.0
            for k in range(d):
                forth += M_inverse[i, k] * (A[k, j] - B[k, j])
                back += M_inverse[j, k] * (A[k, i] - B[k, i])
            total += forth * back
    return total


@kernel
def _optimal_weights(w: Array, information: Array, M: Array, M_inverse: Array) -> None:
    """The w of largest det sum w_j P_j^-1, from a w > 0 wherever an estimate takes part.

    Weight goes from the estimate of the smallest slope tr(M^-1 P_j^-1) to that of the largest, by the damped
    Newton step, which raises log det M always. At the optimum no slope exceeds d, and the excess bounds the
    distance from it.
    """
    d = M.shape[0]
    for _ in range(_PASSES):
        _weighted_sum(w, information, M)
        if not invert_spd(M, M_inverse):
            return
        best, worst, largest, smallest = 0, 0, 0.0, math.inf
        for a in range(w.shape[0]):
            slope = 0.0
            for i in range(d):
                for j in range(d):
                    slope += M_inverse[i, j] * information[a, i, j]
            if slope > largest:
                best, largest = a, slope
            if w[a] > 0.0 and slope < smallest:
                worst, smallest = a, slope
        if largest - d < _GAP:
            return
        rise = largest - smallest
        curvature = _curvature(M_inverse, information[best], information[worst])
        step = min(rise / (curvature + rise * math.sqrt(curvature)), w[worst])
        w[best] += step
        w[worst] -= step


@kernel
def _first_weight(P: Array, rule: Int) -> float:
    """Weight of one estimate before all are scaled to sum 1."""
    if rule > _POSITION_TRACE:
        return 1.0
    trace = 0.0
    for i in range(P.shape[0] if rule == _TRACE else min(3, P.shape[0])):
        trace += P[i, i]
    return 1.0 / trace


@kernel
def _all_finite(x: Array) -> bool:
    good = True
    for i in range(x.shape[0]):
        good = good and abs(x[i]) < math.inf
    return good


@kernel
def _weigh(x: Array, P: Array, mask: BoolArray, rule: Int, w: Array, information: Array, T: Array) -> int:
    """Weights and information matrices, both zero for who takes no part; returns how many do."""
    used = 0
    total = 0.0
    for a in range(x.shape[0]):
        w[a] = 0.0
        if mask[a] and _all_finite(x[a]):
            copy(P[a], T)
            if invert_spd(T, information[a]):
                w[a] = _first_weight(P[a], rule)
                total += w[a]
                used += 1
        if w[a] == 0.0:
            fill(information[a], 0.0)
    if rule != _NAIVE and used:
        for a in range(x.shape[0]):
            w[a] /= total
    return used


@kernel
def _combine(x: Array, w: Array, information: Array, P: Array, y: Array, x_out: Array) -> None:
    """x_out = P sum w_j P_j^-1 x_j over who takes part: the x_j of others need not be finite."""
    for i in range(y.shape[0]):
        y[i] = 0.0
    for a in range(x.shape[0]):
        if w[a] > 0.0:
            for i in range(y.shape[0]):
                for j in range(y.shape[0]):
                    y[i] += w[a] * information[a, i, j] * x[a, j]
    matvec(P, y, x_out)


@kernel
def intersect_kernel(
    x: Array, P: Array, mask: BoolArray, rule: Int, x_out: Array, P_out: Array, scratch: Array
) -> int:
    """Covariance intersection of one vehicle's k estimates.

    Args:
        x: Estimates, (k, d).
        P: Covariances, (k, d, d).
        mask: Which are there, (k,).
        rule: Of the weights, see `ci_weights`.
        x_out: Result, (d,).
        P_out: Result, (d, d).
        scratch: Overwritten, (>= intersect_scratch(k, d),).

    Returns:
        How many took part: an estimate that is not finite or whose P is not positive definite does not. With
        0 the results are untouched.
    """
    k, d = x.shape
    information = scratch[: k * d * d].reshape(k, d, d)
    scratch = scratch[k * d * d :]
    M = scratch[: d * d].reshape(d, d)
    T = scratch[d * d : 2 * d * d].reshape(d, d)
    scratch = scratch[2 * d * d :]
    w, y = scratch[:k], scratch[k : k + d]
    used = _weigh(x, P, mask, rule, w, information, T)
    if used == 0:
        return 0
    if rule == _DETERMINANT:
        _optimal_weights(w, information, M, T)
    _weighted_sum(w, information, M)
    if not invert_spd(M, P_out):
        return 0
    _combine(x, w, information, P_out, y, x_out)
    return used
