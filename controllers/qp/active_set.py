"""Dual active set of Goldfarb and Idnani (1983), with the multipliers of soft rows kept in [0, weight].

The rows are those of `rows.py`. A saturated one is a constant in the gradient, so an exact L1 penalty needs
no slack variable.

With q working normals N_W the kernels keep J = [J_1 J_2] with J J' = H^-1, J_2'N_W = 0, and the triangular
R with J_1'N_W = R, both stored by columns (J_T[k] is column k). A loop that starts at max(start, 0) tells the
compiler that no index counts from the end: only then is it vectorised.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from quad_envs.compilation.decorators import kernel
from quad_envs.parameters import Array

from .ocp import IntArray
from .recursion import step_plan
from .rows import INACTIVE, SATURATED, WORKING, ByteArray, RowData, load_normal, worst_row

OPTIMAL, INFEASIBLE, ITERATION_LIMIT, NOT_FINITE, INACCURATE = range(
    5
)  # the members of Status, for compiled code
N_VECTORS = 9  # rows of the scratch array `vectors`
_DEPENDENT = 1e-22  # |J_2'a|^2 over |J'a|^2 below which a normal lies in the span of the working ones
_NO_DIRECTION = 1e-13  # smallest multiplier direction that counts


class Dynamics(NamedTuple):
    """x_{i+1} = A_i x_i + B_i u_i + c_i."""

    A: Array  # (1 or N, 12, 12)
    B: Array  # (1 or N, 12, 4)
    c: Array  # (N, 12)
    transposed: Array  # (1 or N, 16, 12), [A_i B_i]'


class Face(NamedTuple):
    """A plan, the rows that hold it, and the factors; all changed in place."""

    u: Array  # (N, 4)
    x: Array  # (N+1, 12)
    J_T: Array  # (4N, 4N), inverse factor of the Hessian by columns, rotated by the working rows
    R_T: Array  # (4N, 4N), its first q columns count
    active: IntArray  # (4N + 1,), the working rows
    state: ByteArray  # (16N + 2K,), of every row
    vectors: Array  # (N_VECTORS, 4N + 12), scratch; 3, 4, 5 are sign, multiplier and cap of the working rows


@kernel
def roll_out(model: Dynamics, u: Array, x: Array) -> None:
    """The states of a plan, from x[0] on."""
    for i in range(u.shape[0]):
        step_plan(model.transposed, model.c, i, u, x)


@kernel
def project(J_T: Array, a: Array, start: int, stop: int, d: Array) -> float:
    """Writes d = J'a, returns |d|^2; a is zero outside start..stop. Four columns at once, to overlap sums."""
    total = 0.0
    for k in range(0, J_T.shape[0], 4):
        s0, s1, s2, s3 = 0.0, 0.0, 0.0, 0.0
        for j in range(max(start, 0), stop):
            value = a[j]
            s0 += J_T[k, j] * value
            s1 += J_T[k + 1, j] * value
            s2 += J_T[k + 2, j] * value
            s3 += J_T[k + 3, j] * value
        d[k], d[k + 1], d[k + 2], d[k + 3] = s0, s1, s2, s3
        total += (s0 * s0 + s1 * s1) + (s2 * s2 + s3 * s3)
    return total


@kernel
def primal_direction(J_T: Array, d: Array, q: int, z: Array) -> float:
    """Writes z = J_2 d_2, returns |d_2|^2."""
    nv = J_T.shape[0]
    zeta = 0.0
    for j in range(nv):
        z[j] = 0.0
    for k in range(q, nv):
        factor = d[k]
        if factor != 0.0:
            zeta += factor * factor
            for j in range(nv):
                z[j] += factor * J_T[k, j]
    return zeta


@kernel
def solve_triangle(R_T: Array, d: Array, q: int, r: Array) -> None:
    """Writes r = R^-1 d_1, by columns."""
    for i in range(q):
        r[i] = d[i]
    for i in range(q - 1, -1, -1):
        r[i] /= R_T[i, i]
        factor = r[i]
        for j in range(i):
            r[j] -= factor * R_T[i, j]


@kernel
def solve_triangle_transposed(R_T: Array, s: Array, q: int, y: Array) -> None:
    """Writes y = R^-T s."""
    for i in range(q):
        total = s[i]
        for k in range(i):
            total -= R_T[i, k] * y[k]
        y[i] = total / R_T[i, i]


@kernel
def inactive_after(saturates: bool) -> int:
    """The state of a row that leaves the working set."""
    return SATURATED if saturates else INACTIVE


@kernel
def _first_to_leave(nu: Array, r: Array, cap: Array, q: int) -> tuple[float, int, bool]:
    """Longest step nu - t r in [0, cap]: its length, the row that stops it, whether that is at its cap."""
    longest = math.inf
    leaving = -1
    at_cap = False
    for i in range(q):
        if r[i] > _NO_DIRECTION:
            t = nu[i] / r[i]
            if t < longest:
                longest, leaving, at_cap = t, i, False
        elif r[i] < -_NO_DIRECTION:
            t = (cap[i] - nu[i]) / (-r[i])
            if t < longest:
                longest, leaving, at_cap = t, i, True
    return longest, leaving, at_cap


@kernel
def append_row(J_T: Array, R_T: Array, d: Array, q: int) -> None:
    """Adds the row with d = J'a to the working set: rotations leave one entry in d_2, which extends R.

    A reflection would need fewer operations but fill J; rotations of neighbours keep most of its zeros, and
    with them those of d.
    """
    nv = J_T.shape[0]
    for k in range(nv - 1, q, -1):
        g = d[k]
        if g != 0.0:
            f = d[k - 1]
            length = math.sqrt(f * f + g * g)
            d[k - 1] = length
            _rotate(J_T[k - 1], J_T[k], f / length, g / length)
    for i in range(q + 1):
        R_T[q, i] = d[i]


@kernel
def _rotate(v: Array, w: Array, cos: float, sin: float) -> None:
    """(v, w) becomes (cos v + sin w, cos w - sin v)."""
    for j in range(v.shape[0]):
        f, g = v[j], w[j]
        v[j] = cos * f + sin * g
        w[j] = cos * g - sin * f


@kernel
def remove_row(face: Face, leaving: int, q: int) -> None:
    """Takes working row `leaving` out; entry q (the row on its way in) moves to q - 1. R stays triangular."""
    J_T, R_T, active, vectors = face.J_T, face.R_T, face.active, face.vectors
    sign, nu, cap = vectors[3], vectors[4], vectors[5]
    for j in range(leaving, q):
        active[j], sign[j], nu[j], cap[j] = active[j + 1], sign[j + 1], nu[j + 1], cap[j + 1]
    for j in range(leaving, q - 1):
        for i in range(j + 2):
            R_T[j, i] = R_T[j + 1, i]
    for k in range(leaving, q - 1):
        f, g = R_T[k, k], R_T[k, k + 1]
        length = math.sqrt(f * f + g * g)
        if length == 0.0:
            continue
        cos, sin = f / length, g / length
        for j in range(k, q - 1):
            f, g = R_T[j, k], R_T[j, k + 1]
            R_T[j, k] = cos * f + sin * g
            R_T[j, k + 1] = cos * g - sin * f
        _rotate(J_T[k], J_T[k + 1], cos, sin)


@kernel
def move_along(u: Array, z: Array, t: float) -> None:
    """Adds t z to u."""
    m = u.shape[1]
    for i in range(u.shape[0]):
        for a in range(m):
            u[i, a] += t * z[m * i + a]


@kernel
def _enter(
    face: Face, start: int, stop: int, slack: float, q: int, iterations: int, iteration_limit: int
) -> tuple[int, int, int]:
    """Brings the row stored as entry q into the working set, or saturates or releases it.

    Its normal is in vectors[6], zero outside start..stop.

    Returns:
        The new q, the iteration count, and OPTIMAL (done with this row), INFEASIBLE or ITERATION_LIMIT.
    """
    J_T, R_T, active, state, vectors = face.J_T, face.R_T, face.active, face.state, face.vectors
    d, z, r, sign, nu, cap = vectors[0], vectors[1], vectors[2], vectors[3], vectors[4], vectors[5]
    while iterations < iteration_limit:
        iterations += 1
        length = project(J_T, vectors[6], start, stop, d)
        zeta = primal_direction(J_T, d, q, z)
        solve_triangle(R_T, d, q, r)
        dual, leaving, at_cap = _first_to_leave(nu, r, cap, q)
        full = -slack / zeta if zeta > _DEPENDENT * length else math.inf
        own = cap[q] - nu[q]
        t = min(dual, min(full, own))
        if t == math.inf:
            return q, iterations, INFEASIBLE
        primal = full < math.inf
        for i in range(q):
            nu[i] -= t * r[i]
        nu[q] += t
        if primal:
            move_along(face.u, z, t)
            slack += t * zeta
        if full <= dual and full <= own:
            append_row(J_T, R_T, d, q)
            state[active[q]] = WORKING
            return q + 1, iterations, OPTIMAL
        if own <= dual:
            # The multiplier of a row that came from saturation is counted down from its cap.
            state[active[q]] = inactive_after(sign[q] > 0.0)
            return q, iterations, OPTIMAL
        state[active[leaving]] = inactive_after(at_cap == (sign[leaving] > 0.0))
        remove_row(face, leaving, q)
        q -= 1
    return q, iterations, ITERATION_LIMIT


@kernel
def dual_active_set(
    model: Dynamics,
    rows: RowData,
    face: Face,
    row: int,
    slack: float,
    q: int,
    iterations: int,
    iteration_limit: int,
) -> tuple[int, int, int]:
    """From the optimum of a face, at first the unconstrained one, to the constrained one.

    Args:
        model: The dynamics.
        rows: The rows of the problem.
        face: The optimum of a face with q working rows on entry, the result on exit.
        row: The first row to work on, as `worst_row` gives it.
        slack: Its slack.
        q: Number of working rows, 0 at the unconstrained optimum.
        iterations: Steps done before.
        iteration_limit: Largest number of steps, those before included.

    Returns:
        OPTIMAL, INFEASIBLE or ITERATION_LIMIT, the number of steps, and q.
    """
    u, x, active, state, vectors = face.u, face.x, face.active, face.state, face.vectors
    nv, K = u.size, rows.normal.shape[0]
    base = 4 * nv
    sign, nu, cap = vectors[3], vectors[4], vectors[5]
    status = OPTIMAL
    while row >= 0:
        active[q] = row
        nu[q] = 0.0
        sign[q] = -1.0 if state[row] == SATURATED else 1.0
        cap[q] = rows.weight[(row - base) % K] if row >= base else math.inf
        start, stop = load_normal(row, sign[q], model.A, model.B, rows, nv, vectors)
        q, iterations, status = _enter(face, start, stop, slack, q, iterations, iteration_limit)
        if status != OPTIMAL:
            break
        if K > 0:
            # Input rows first and state rows only when none is left would save the roll-out here, but takes
            # twice the steps where many state rows are saturated.
            roll_out(model, u, x)
        row, slack = worst_row(u, x, rows, state)
    roll_out(model, u, x)
    return status, iterations, q


@kernel
def collect_multipliers(face: Face, weight: Array, q: int, multipliers: Array) -> None:
    """Multiplier of every row: counted up from 0 or down from the cap, the cap of a saturated one, or 0."""
    sign, nu, cap = face.vectors[3], face.vectors[4], face.vectors[5]
    K, base = weight.shape[0], 4 * face.u.size
    for k in range(base + 2 * K):
        multipliers[k] = 0.0
    for k in range(2 * K):
        if face.state[base + k] == SATURATED:
            multipliers[base + k] = weight[k % K]
    for i in range(q):
        multipliers[face.active[i]] = nu[i] if sign[i] > 0.0 else cap[i] - nu[i]
