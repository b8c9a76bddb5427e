"""State-dependent pairs whose velocity stands in the axes of the present attitude, which do not turn.

Along a plan V_B turns with the predicted body rates, but neither the R_BI' of a frozen pair, which moves the
position, nor v_ref, with which V_B is compared, turn with it: a vehicle that rolls in a climb seems to drift,
the farther the longer the horizon. With R_0 the present R_BI, w = R_0 R_BI(Theta)' V_B, which is V_B now, has
no such terms:

    p' = R_0' w,    w' = R_0 R_BI(Theta)' (V_B' + Omega x V_B)
"""

from __future__ import annotations

from quad_envs.compilation.decorators import kernel
from quad_envs.parameters import Array
from quad_envs.rotations import sincos

from ..model import rotated_derivatives
from ..qp.linalg import copy
from ..qp.ocp import IntArray


@kernel
def stop_turning(A_c: Array) -> None:
    """Take -Omega x V_B out of a matrix of `sdc_matrix` with alpha = 1, in place: the present pair of w."""
    for a in range(3, 6):
        for b in range(9, 12):
            A_c[a, b] = 0.0


@kernel
def body_outputs(
    plant: Array, level: bool, normal: IntArray, normals: Array, lower: Array, upper: Array
) -> None:
    """Limits on V_B as limits on a velocity that does not turn, and on the attitude, in place.

    To the first order V_B = w + G (Theta - Theta_k), where G is the derivative of R_BI(Theta) v at the
    present attitude, or in `level` axes at hover: the same velocity has other components in tilted axes.

    Args:
        plant: Measured, (16,).
        level: Whether the velocity stands in level axes, v, instead of w = R_0 v.
        normal: Output of each row, (K,).
        normals: Outputs, (H, 12).
        lower: Bounds, (K,).
        upper: Bounds, (K,).
    """
    sf, cf = sincos(plant[6])
    st, ct = sincos(plant[7])
    u, under = plant[3], sf * plant[4] + cf * plant[5]
    v0, v1, v2 = ct * u + st * under, cf * plant[4] - sf * plant[5], ct * under - st * u
    phi, theta = plant[6], plant[7]
    if level:
        phi, theta, sf, cf, st, ct = 0.0, 0.0, 0.0, 1.0, 0.0, 1.0
    G = rotated_derivatives(sf, cf, st, ct, 0.0, 1.0, v0, v1, v2)
    for h in range(normals.shape[0]):
        n = normals[h]
        a, b, c = n[3], n[4], n[5]
        if a == 0.0 and b == 0.0 and c == 0.0:
            continue
        g0, g1, g2 = (
            a * G[0] + b * G[3] + c * G[6],
            a * G[1] + b * G[4] + c * G[7],
            a * G[2] + b * G[5] + c * G[8],
        )
        n[6], n[7], n[8] = n[6] + g0, n[7] + g1, n[8] + g2
        shift = g0 * phi + g1 * theta
        for k in range(normal.shape[0]):
            if normal[k] == h:
                lower[k] += shift
                upper[k] += shift


@kernel
def pair_in_present_axes(R: Array, B_c: Array, A_c: Array, B_w: Array, work: Array) -> None:
    """The pair of w at another attitude: rows of p' and w' of what `sdc_matrix` with alpha = 1 made there.

    Args:
        R: R_0', in the first columns of (3, 12).
        B_c: Input matrix of V_B, (12, 4).
        A_c: (12, 12), in place.
        B_w: Result, input matrix of w, (12, 4).
        work: Overwritten, (6, 12).
    """
    turn, gravity = work[:3], work[3:]
    stop_turning(A_c)
    copy(B_c, B_w)
    for a in range(3):
        for b in range(3):
            turn[a, b] = 0.0  # R_0 R_BI(Theta)'
            for k in range(3):
                turn[a, b] += R[k, a] * A_c[k, 3 + b]
    for a in range(3):
        for b in range(3):
            gravity[a, b] = 0.0
            for k in range(3):
                gravity[a, b] += turn[a, k] * A_c[3 + k, 6 + b]
    for a in range(3):
        for b in range(3):
            A_c[a, 3 + b] = R[a, b]
            A_c[3 + a, 6 + b] = gravity[a, b]
        for b in range(B_c.shape[1]):
            B_w[3 + a, b] = 0.0
            for k in range(3):
                B_w[3 + a, b] += turn[a, k] * B_c[3 + k, b]
