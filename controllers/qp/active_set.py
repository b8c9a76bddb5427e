"""Dual active set of Goldfarb and Idnani (1983), with the multipliers of soft rows kept in [0, weight].

Rows a_p'u >= b_p are numbered: 4N each of u >= lower, u <= upper, rate from below, rate from above; then
the lower sides of the K state rows, then their upper sides. A row is inactive, working (an equality of the
current face) or saturated: violated with its multiplier at the weight, which makes it a constant in the
gradient. So an exact L1 penalty needs no slack variable.

With q working normals N_W the kernels keep J = [J_1 J_2] with J J' = H^-1, J_2'N_W = 0, and the triangular
R with J_1'N_W = R, both stored by columns (J_T[k] is column k). A loop that starts at max(start, 0) tells the
compiler that no index counts from the end: only then is it vectorised.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from quad_envs.compilation.decorators import kernel
from quad_envs.parameters import N_INPUT, Array

from .ocp import IntArray
from .products import add_matvec_transposed
from .recursion import step_plan

ByteArray = NDArray[np.int8]

OPTIMAL, INFEASIBLE, ITERATION_LIMIT, NOT_FINITE, INACCURATE = range(
    5
)  # the members of Status, for compiled code
ROW_TOLERANCE = 1e-9  # in the units of the row
N_VECTORS = 9  # rows of the scratch array `vectors`
INACTIVE, WORKING, SATURATED = range(3)  # states of a row
_DEPENDENT = 1e-22  # |J_2'a|^2 over |J'a|^2 below which a normal lies in the span of the working ones
_NO_DIRECTION = 1e-13  # smallest multiplier direction that counts


class RowData(NamedTuple):
    """All rows of one problem, for compiled code."""

    lower: Array  # (4,), input box
    upper: Array  # (4,)
    rate_step: float  # N per sample
    first_move: Array  # (2, 4), bounds of the rate rows on u_0
    normals: Array  # (H, 12)
    normal: IntArray  # (K,)
    stage: IntArray  # (K,)
    row_lower: Array  # (K,)
    row_upper: Array  # (K,)
    weight: Array  # (K,)
    spans: IntArray  # (K, 2), as left by `row_spans`


@kernel
def row_spans(normals: Array, spans: IntArray) -> None:
    """First and one past the last non-zero entry of each normal: most state rows read one or three states."""
    for h in range(normals.shape[0]):
        start = normals.shape[1]
        stop = 0
        for a in range(normals.shape[1]):
            if normals[h, a] != 0.0:
                start = min(start, a)
                stop = a + 1
        spans[h, 0] = start
        spans[h, 1] = stop


@kernel
def _worst_input_row(u: Array, rows: RowData, state: ByteArray) -> tuple[int, float]:
    """The inactive box or rate row with the most negative slack; (-1, -tolerance) if there is none."""
    N, m = u.shape
    nv = N * m
    lower, upper, first_move, rate_step = rows.lower, rows.upper, rows.first_move, rows.rate_step
    worst = -ROW_TOLERANCE
    row = -1
    for i in range(N):
        for a in range(m):
            k = m * i + a
            value = u[i, a]
            slack = value - lower[a]
            if slack < worst and state[k] == INACTIVE:
                worst, row = slack, k
            slack = upper[a] - value
            if slack < worst and state[nv + k] == INACTIVE:
                worst, row = slack, nv + k
            if i == 0:
                below = value - first_move[0, a]
                above = first_move[1, a] - value
            else:
                below = value - u[i - 1, a] + rate_step
                above = u[i - 1, a] + rate_step - value
            if below < worst and state[2 * nv + k] == INACTIVE:
                worst, row = below, 2 * nv + k
            if above < worst and state[3 * nv + k] == INACTIVE:
                worst, row = above, 3 * nv + k
    return row, worst


@kernel
def _worst_state_row(
    x: Array, rows: RowData, base: int, state: ByteArray, row: int, worst: float
) -> tuple[int, float]:
    """As above among the state rows, where a saturated row that is satisfied counts too; ids from base."""
    normals, normal, stage, spans = rows.normals, rows.normal, rows.stage, rows.spans
    row_lower, row_upper, weight = rows.row_lower, rows.row_upper, rows.weight
    K = normal.shape[0]
    for k in range(K):
        h = normal[k]
        value = 0.0
        for a in range(spans[h, 0], spans[h, 1]):
            value += normals[h, a] * x[stage[k], a]
        for side in range(2):
            slack = value - row_lower[k] if side == 0 else row_upper[k] - value
            p = base + side * K + k
            if state[p] == SATURATED:
                slack = -slack
            if slack < worst and state[p] != WORKING and weight[k] > 0.0:
                worst, row = slack, p
    return row, worst


@kernel
def worst_row(u: Array, x: Array, rows: RowData, state: ByteArray) -> tuple[int, float]:
    """The row to work on next and its slack, or -1 if the plan (u, x) is optimal."""
    row, slack = _worst_input_row(u, rows, state)
    if rows.normal.shape[0] == 0:
        return row, slack
    return _worst_state_row(x, rows, 4 * u.size, state, row, slack)


@kernel
def row_slack(p: int, u: Array, x: Array, rows: RowData) -> float:
    """a_p'u - b_p of any row."""
    m, nv, K = u.shape[1], u.size, rows.normal.shape[0]
    value, bound = 0.0, 0.0
    if p >= 4 * nv:
        k = (p - 4 * nv) % K
        h = rows.normals[rows.normal[k]]
        for a in range(h.shape[0]):
            value += h[a] * x[rows.stage[k], a]
        below = p < 4 * nv + K
        bound = rows.row_lower[k] if below else rows.row_upper[k]
        return float(value - bound) if below else float(bound - value)
    i, a = (p % nv) // m, p % m
    below = (p // nv) % 2 == 0
    value = u[i, a]
    if p < 2 * nv:
        bound = rows.lower[a] if below else rows.upper[a]
    elif i == 0:
        bound = rows.first_move[0, a] if below else rows.first_move[1, a]
    else:
        value -= u[i - 1, a]
        bound = -rows.rate_step if below else rows.rate_step
    return float(value - bound) if below else float(bound - value)


@kernel
def _input_normal(p: int, nv: int, a: Array) -> tuple[int, int]:
    """Normal of a box or rate row into a; returns the range of whole stages outside which it is zero."""
    m = N_INPUT
    k = p % nv
    kind = p // nv
    stop = m * (k // m + 1)
    start = max(stop - m, 0) if kind < 2 else max(stop - 2 * m, 0)
    for j in range(start, stop):
        a[j] = 0.0
    sign = 1.0 if kind % 2 == 0 else -1.0
    a[k] = sign
    if kind >= 2 and k >= m:
        a[k - m] = -sign
    return start, stop


@kernel
def _state_normal(
    h: Array, stage: int, sign: float, A: Array, B: Array, y: Array, A_y: Array, a: Array
) -> int:
    """Normal of the row sign h'x_stage into a: a_i = B_i'y, y <- A_i'y backwards; returns its length."""
    n, m = int(B.shape[1]), int(B.shape[2])
    for b in range(n):
        y[b] = sign * h[b]
    for i in range(stage - 1, -1, -1):
        j = i if A.shape[0] > 1 else 0
        block = a[m * i : m * (i + 1)]
        for b in range(m):
            block[b] = 0.0
        add_matvec_transposed(B[j], y, 1.0, block)
        if i > 0:
            for b in range(n):
                A_y[b] = 0.0
            add_matvec_transposed(A[j], y, 1.0, A_y)
            for b in range(n):
                y[b] = A_y[b]
    return m * stage


@kernel
def load_normal(
    p: int, sign: float, A: Array, B: Array, rows: RowData, nv: int, vectors: Array
) -> tuple[int, int]:
    """The normal of any row, times sign for state rows, into vectors[6]; the range outside which it is 0."""
    a = vectors[6]
    if p < 4 * nv:
        return _input_normal(p, nv, a)
    K = rows.normal.shape[0]
    k = (p - 4 * nv) % K
    side = 1.0 if p < 4 * nv + K else -1.0
    h = rows.normals[rows.normal[k]]
    return 0, _state_normal(h, rows.stage[k], side * sign, A, B, vectors[0, :12], vectors[1, :12], a)


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
def remove_row(
    J_T: Array,
    R_T: Array,
    active: IntArray,
    sign: Array,
    nu: Array,
    cap: Array,
    leaving: int,
    q: int,
) -> None:
    """Takes working row `leaving` out; entry q (the row on its way in) moves to q - 1. R stays triangular."""
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
    J_T: Array,
    R_T: Array,
    a: Array,
    a_start: int,
    a_stop: int,
    slack: float,
    u: Array,
    state: ByteArray,
    active: IntArray,
    vectors: Array,
    q: int,
    iterations: int,
    iteration_limit: int,
) -> tuple[int, int, int]:
    """Brings the row stored as entry q into the working set, or saturates or releases it.

    Returns:
        The new q, the iteration count, and OPTIMAL (done with this row), INFEASIBLE or ITERATION_LIMIT.
    """
    d, z, r, sign, nu, cap = vectors[0], vectors[1], vectors[2], vectors[3], vectors[4], vectors[5]
    while iterations < iteration_limit:
        iterations += 1
        length = project(J_T, a, a_start, a_stop, d)
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
            move_along(u, z, t)
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
        remove_row(J_T, R_T, active, sign, nu, cap, leaving, q)
        q -= 1
    return q, iterations, ITERATION_LIMIT


@kernel
def dual_active_set(
    A: Array,
    B: Array,
    c: Array,
    transposed: Array,
    rows: RowData,
    row: int,
    slack: float,
    q: int,
    iterations: int,
    iteration_limit: int,
    u: Array,
    x: Array,
    J_T: Array,
    R_T: Array,
    active: IntArray,
    state: ByteArray,
    vectors: Array,
) -> tuple[int, int, int]:
    """From the optimum u of a face, at first the unconstrained one, to the constrained one.

    Args:
        A: (1 or N, 12, 12).
        B: (1 or N, 12, 4).
        c: (N, 12).
        transposed: [A_i B_i]', (1 or N, 16, 12).
        rows: The rows of the problem.
        row: The first row to work on, as `worst_row` gives it.
        slack: Its slack.
        q: Number of working rows, 0 at the unconstrained optimum.
        iterations: Steps done before.
        iteration_limit: Largest number of steps, those before included.
        u: Inputs, (N, 4); the optimum of the face on entry, the result on exit.
        x: Its states, (N+1, 12), likewise.
        J_T: Inverse factor of the Hessian by columns, (4N, 4N); destroyed.
        R_T: Overwritten behind its first q columns, (4N, 4N).
        active: The working rows, (4N + 1,).
        state: State of every row, (16N + 2K,).
        vectors: Scratch (N_VECTORS, 4N + 12); 3, 4, 5 are sign, multiplier and cap of the working rows.

    Returns:
        OPTIMAL, INFEASIBLE or ITERATION_LIMIT, the number of steps, and q.
    """
    N = u.shape[0]
    nv = u.size
    K = rows.normal.shape[0]
    base = 4 * nv
    a, sign, nu, cap = vectors[6], vectors[3], vectors[4], vectors[5]
    status = OPTIMAL
    while row >= 0:
        active[q] = row
        nu[q] = 0.0
        sign[q] = -1.0 if state[row] == SATURATED else 1.0
        cap[q] = rows.weight[(row - base) % K] if row >= base else math.inf
        a_start, a_stop = load_normal(row, sign[q], A, B, rows, nv, vectors)
        q, iterations, status = _enter(
            J_T, R_T, a, a_start, a_stop, slack, u, state, active, vectors, q, iterations, iteration_limit
        )
        if status != OPTIMAL:
            break
        if K > 0:
            # Input rows first and state rows only when none is left would save the roll-out here, but takes
            # twice the steps where many state rows are saturated.
            for i in range(N):
                step_plan(transposed, c, i, u, x)
        row, slack = worst_row(u, x, rows, state)
    for i in range(N):
        step_plan(transposed, c, i, u, x)
    return status, iterations, q


@kernel
def collect_multipliers(
    state: ByteArray,
    active: IntArray,
    sign: Array,
    nu: Array,
    cap: Array,
    weight: Array,
    q: int,
    base: int,
    multipliers: Array,
) -> None:
    """Multiplier of every working and saturated row: counted up from 0 or down from the cap, or the cap."""
    K = weight.shape[0]
    for k in range(2 * K):
        if state[base + k] == SATURATED:
            multipliers[base + k] = weight[k % K]
    for i in range(q):
        multipliers[active[i]] = nu[i] if sign[i] > 0.0 else cap[i] - nu[i]
