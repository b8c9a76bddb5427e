"""Fusion of estimates of the same target whose errors are correlated in an unknown way, and of a reference.

**Covariance intersection** of k estimates (section 6.2 names it and prints no equations):
P^-1 = sum w_j P_j^-1, x = P sum w_j P_j^-1 x_j, w >= 0, sum w = 1. The result is consistent if its inputs
are, whatever they have in common; with all w_j = 1 ("naive") what they share counts twice, and a team that
feeds the result back diverges.

**`fuse_point`** is Eq. (7.2): the point of the formation and the slot beside the target, weighted by how well
the target is known.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from controllers.linalg import copy, fill, invert_spd, matvec
from quad_envs._numba import Int, inline_kernel, kernel
from quad_envs.names import unknown_name
from quad_envs.parameters import Array

from .arguments import BoolArray, IntArray, as_floats, as_mask

CI_WEIGHTS = ("trace", "position-trace", "equal", "determinant", "naive")
_TRACE, _POSITION_TRACE, _EQUAL, _DETERMINANT, _NAIVE = range(len(CI_WEIGHTS))
_GAP = 1e-7  # of log det P^-1, from its optimum
_PASSES = 200


class Fused(NamedTuple):
    """Fused estimates."""

    x: Array  # (n, d)
    P: Array  # (n, d, d)
    used: IntArray  # (n,), estimates that took part


def ci_weights(weights: str) -> int:
    """The code of a rule for the weights, as `intersect_kernel` takes it.

    Raises:
        ValueError: If there is no such rule.
    """
    if weights not in CI_WEIGHTS:
        raise ValueError(unknown_name("weights", weights, CI_WEIGHTS))
    return CI_WEIGHTS.index(weights)


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


@kernel
def _intersect_rows(
    x: Array, P: Array, mask: BoolArray, rule: Int, x_out: Array, P_out: Array, used: IntArray, scratch: Array
) -> None:
    for i in range(x.shape[0]):
        used[i] = intersect_kernel(x[i], P[i], mask[i], rule, x_out[i], P_out[i], scratch)


def covariance_intersection(
    x: ArrayLike, P: ArrayLike, mask: ArrayLike | None = None, weights: str = "trace"
) -> Fused:
    """Fuse k estimates per vehicle, all of them from before any fusion of this step.

    Args:
        x: Estimates, the own one among them, (n, k, d).
        P: Covariances, (n, k, d, d).
        mask: Which are there, (n, k), bool; None: all.
        weights: "trace" (w_j ~ 1 / tr P_j), "position-trace" (of its first 3 x 3 block, for states of unlike
            scale), "equal", "determinant" (smallest det P), or "naive" (all 1, for study).

    Returns:
        Fused estimates. One that is not finite or whose P is not positive definite takes no part.

    Raises:
        ValueError: If a shape or a name is wrong, or a vehicle has nothing to fuse.
    """
    rule = ci_weights(weights)
    estimates = as_floats("x", x, (None, None, None), finite=False)
    n, k, d = estimates.shape
    covariances = as_floats("P", P, (n, k, d, d), finite=False)
    present = as_mask("mask", mask, (n, k))
    x_out, P_out, used = np.empty((n, d)), np.empty((n, d, d)), np.zeros(n, dtype=np.int64)
    scratch = np.empty(intersect_scratch(k, d))
    _intersect_rows(estimates, covariances, present, rule, x_out, P_out, used, scratch)
    if (used == 0).any():
        row = int(np.argmin(used))
        raise ValueError(
            f"vehicle {row} has no estimate to fuse: none is present, finite and positive definite"
        )
    return Fused(x_out, P_out, used)


@inline_kernel
def _solve_spd_3(
    P: Array, ridge: float, b_0: float, b_1: float, b_2: float
) -> tuple[float, float, float, bool]:
    """Solution of (P + ridge I) y = b by L D L', and whether the matrix is positive definite."""
    d_0 = P[0, 0] + ridge
    l_10 = P[1, 0] / d_0
    l_20 = P[2, 0] / d_0
    d_1 = P[1, 1] + ridge - l_10 * P[1, 0]
    e_21 = P[2, 1] - l_10 * P[2, 0]
    l_21 = e_21 / d_1
    d_2 = P[2, 2] + ridge - l_20 * P[2, 0] - l_21 * e_21
    z_1 = b_1 - l_10 * b_0
    z_2 = b_2 - l_20 * b_0 - l_21 * z_1
    y_2 = z_2 / d_2
    y_1 = z_1 / d_1 - l_21 * y_2
    y_0 = b_0 / d_0 - l_10 * y_1 - l_20 * y_2
    return y_0, y_1, y_2, d_0 > 0.0 and d_1 > 0.0 and d_2 > 0.0


@inline_kernel
def fuse_point(
    r_f: Array, w_f: Array, P_f: float, r_t: Array, v_t: Array, P_t: Array, r: Array, w: Array
) -> bool:
    """Eq. (7.2) for one vehicle and stage, compiled twin of `fuse_reference`.

    It is evaluated as r_f + P_f (P_f I + P_t)^-1 (r_t - r_f): one positive definite system, which gives the
    slot for P_t = 0 and tends to the formation as P_t grows; neither covariance is inverted.

    Args:
        r_f: Formation point, (3,), m.
        w_f: Its velocity, (3,), m/s.
        P_f: Weight of the formation, m^2, > 0.
        r_t: Slot beside the target, r^ + n dt v^ + delta_it, (3,), m.
        v_t: Velocity of the target, (3,), m/s.
        P_t: Position covariance of the estimate, (3, 3), m^2.
        r: Result, (3,); may be r_f.
        w: Result, (3,); may be w_f.

    Returns:
        Whether the target took part; where P_f I + P_t is not positive definite, r_f and w_f are copied.
    """
    a, b, c, good = _solve_spd_3(P_t, P_f, r_t[0] - r_f[0], r_t[1] - r_f[1], r_t[2] - r_f[2])
    e, f, g, _ = _solve_spd_3(P_t, P_f, v_t[0] - w_f[0], v_t[1] - w_f[1], v_t[2] - w_f[2])
    r[0], r[1], r[2] = r_f[0], r_f[1], r_f[2]
    w[0], w[1], w[2] = w_f[0], w_f[1], w_f[2]
    if good:
        r[0] += P_f * a
        r[1] += P_f * b
        r[2] += P_f * c
        w[0] += P_f * e
        w[1] += P_f * f
        w[2] += P_f * g
    return good


def fuse_reference(
    r_f: ArrayLike, w_f: ArrayLike, P_f: float, r_t: ArrayLike, v_t: ArrayLike, P_t: ArrayLike
) -> tuple[Array, Array]:
    """Reference between formation and target, Eq. (7.2), readable twin of `fuse_point`.

    With M = (P_f^-1 + P_t^-1)^-1: r = M (P_f^-1 r_f + P_t^-1 r_t), w = M (P_f^-1 w_f + P_t^-1 v_t).

    Args:
        r_f: Formation points, (..., 3), m.
        w_f: Their velocities, (..., 3), m/s.
        P_f: Weight of the formation, m^2: an estimate of that variance per axis counts as much.
        r_t: Slots beside the target, r^ + n dt v^ + delta_it, (..., 3), m.
        v_t: Velocities of the target, (..., 3), m/s.
        P_t: Position covariances of the estimates, (..., 3, 3), m^2.

    Returns:
        r (..., 3) and w (..., 3).

    Deviation: (7.2) prints the estimate beside all 12 states and leaves the target frozen over the horizon;
    here positions and velocities, and the caller extrapolates r_t.
    """
    r, w, P = np.asarray(r_f, float), np.asarray(w_f, float), np.asarray(P_t, float)
    change = np.stack([np.asarray(r_t) - r, np.asarray(v_t) - w], axis=-1)
    gain = P_f * np.linalg.solve(P + P_f * np.eye(3), change)
    return r + gain[..., 0], w + gain[..., 1]
