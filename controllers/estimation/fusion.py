"""Fusion of estimates of the same target whose errors are correlated in an unknown way, and of a reference.

**Covariance intersection** of k estimates (section 6.2 names it and prints no equations):
P^-1 = sum w_j P_j^-1, x = P sum w_j P_j^-1 x_j, w >= 0, sum w = 1. The result is consistent if its inputs
are, whatever they have in common; with all w_j = 1 ("naive") what they share counts twice, and a team that
feeds the result back diverges.

**`fuse_point`** is Eq. (7.2): the point of the formation and the slot beside the target, weighted by how well
the target is known.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from quad_envs.arguments.names import unknown_name
from quad_envs.compilation.decorators import Int, inline_kernel, kernel
from quad_envs.parameters import Array

from .arguments import BoolArray, IntArray, as_floats, as_mask
from .fusion_kernels import CI_WEIGHTS, intersect_kernel, intersect_scratch


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
