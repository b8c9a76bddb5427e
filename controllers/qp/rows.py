"""The rows of a problem for compiled code: how far a plan is from each, and their normals in u.

Rows a_p'u >= b_p are numbered: 4N each of u >= lower, u <= upper, rate from below, rate from above; then
the lower sides of the K state rows, then their upper sides. A row is inactive, working (an equality of the
current face) or saturated: violated with its multiplier at the weight.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from quad_envs.compilation.decorators import kernel
from quad_envs.parameters import N_INPUT, Array

from .ocp import IntArray
from .products import add_matvec_transposed

ByteArray = NDArray[np.int8]

ROW_TOLERANCE = 1e-9  # in the units of the row
INACTIVE, WORKING, SATURATED = range(3)  # states of a row


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
def worst_input_row(u: Array, rows: RowData, state: ByteArray) -> tuple[int, float]:
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
    row, slack = worst_input_row(u, rows, state)
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
