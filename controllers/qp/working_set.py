"""A guessed working set as the start of the dual active set, and one as numbers that travel in memory.

Any guess will do. Saturated rows are constants in the gradient. The working rows enter as equalities; a row
whose multiplier is then negative leaves, one whose multiplier exceeds its weight becomes saturated, until
all lie in [0, weight]: that is a state which the method could have reached by itself, and it goes on from
there to the same optimum.

In memory one number holds one stage: DIGITS digits to base 5, for box and rate of the four inputs and the
first state rows of the next stage. 0 is inactive; 1, 2 working at the lower, upper side; 3, 4 saturated.
"""

from __future__ import annotations

import math

import numpy as np

from quad_envs.compilation.decorators import kernel
from quad_envs.parameters import N_INPUT, Array

from .active_set import (
    Dynamics,
    Face,
    append_row,
    inactive_after,
    move_along,
    primal_direction,
    project,
    remove_row,
    roll_out,
    solve_triangle,
    solve_triangle_transposed,
)
from .linalg import fill
from .ocp import IntArray
from .products import add_matvec_transposed
from .rows import SATURATED, WORKING, ByteArray, RowData, load_normal, row_slack

BASE = 5
DIGITS = 22  # 5^22 is the last power of 5 that a float64 counts up to exactly
_STATE_DIGITS = DIGITS - 2 * N_INPUT
_WORDS = float(BASE**DIGITS)
_POWERS = float(BASE) ** np.arange(DIGITS)
_DEPENDENT = 1e-12  # as in `active_set`, for rows that may as well wait


@kernel
def _digit(state: ByteArray, below: int, above: int) -> int:
    """The state of the two sides of a row as one digit."""
    for code in (WORKING, SATURATED):
        if state[below] == code:
            return 2 * code - 1
        if state[above] == code:
            return 2 * code
    return 0


@kernel
def _set_digit(digit: int, guess: ByteArray, below: int, above: int) -> None:
    """Inverse of `_digit`; `guess` is zero before."""
    if digit > 0:
        guess[below if digit % 2 == 1 else above] = WORKING if digit <= 2 else SATURATED


@kernel
def pack_working_set(state: ByteArray, stage: IntArray, counts: IntArray, words: Array) -> None:
    """The states of all rows as one number per stage.

    Args:
        state: (16N + 2K,), as the solver leaves it.
        stage: Of each state row, (K,).
        counts: Overwritten, at least (N,).
        words: Result, (N,).
    """
    N, K = words.shape[0], stage.shape[0]
    nv = N_INPUT * N
    for k in range(2 * N_INPUT):
        for i in range(N):
            j = N_INPUT * i + k % N_INPUT + (0 if k < N_INPUT else 2 * nv)
            digit = _digit(state, j, nv + j)
            words[i] = (0.0 if k == 0 else words[i]) + _POWERS[k] * digit
    for i in range(N):
        counts[i] = 0
    for k in range(K):
        i = stage[k] - 1
        if counts[i] < _STATE_DIGITS:
            digit = _digit(state, 4 * nv + k, 4 * nv + K + k)
            words[i] += _POWERS[2 * N_INPUT + counts[i]] * digit
            counts[i] += 1


@kernel
def unpack_working_set(words: Array, stage: IntArray, counts: IntArray, guess: ByteArray) -> bool:
    """Inverse of `pack_working_set`; a number that it cannot have written counts as zero.

    Args:
        words: (N,); overwritten.
        stage: (K,).
        counts: Overwritten, at least (N,).
        guess: Result, (16N + 2K,).

    Returns:
        Whether any row is working or saturated.
    """
    N, K = words.shape[0], stage.shape[0]
    nv = N_INPUT * N
    held = False
    for i in range(N):
        if not 0.0 <= words[i] < _WORDS:
            words[i] = 0.0
        held = held or words[i] > 0.0
    if not held:
        return False
    for p in range(4 * nv + 2 * K):
        guess[p] = 0
    for i in range(N):
        word = int(words[i])
        for k in range(2 * N_INPUT):
            j = N_INPUT * i + k % N_INPUT + (0 if k < N_INPUT else 2 * nv)
            _set_digit(word % BASE, guess, j, nv + j)
            word //= BASE
        words[i] = float(word)
        counts[i] = 0
    for k in range(K):
        i = stage[k] - 1
        if counts[i] < _STATE_DIGITS:
            word = int(words[i])
            _set_digit(word % BASE, guess, 4 * nv + k, 4 * nv + K + k)
            words[i] = float(word // BASE)
            counts[i] += 1
    return True


@kernel
def _saturate(model: Dynamics, rows: RowData, guess: ByteArray, face: Face, force: Array) -> None:
    """Moves u to the optimum under the constant pull of the saturated rows of the guess."""
    A, B, u, J_T = model.A, model.B, face.u, face.J_T
    N, K = u.shape[0], rows.normal.shape[0]
    base = 4 * u.size
    found = False
    fill(force, 0.0)
    for k in range(2 * K):
        weight = rows.weight[k % K]
        if guess[base + k] == SATURATED and 0.0 < weight < math.inf:
            found = True
            face.state[base + k] = SATURATED
            factor = weight if k < K else -weight
            h = rows.normals[rows.normal[k % K]]
            for a in range(h.shape[0]):
                force[rows.stage[k % K], a] += factor * h[a]
    if not found:
        return
    a, d, z = face.vectors[6], face.vectors[0], face.vectors[1]
    for i in range(N - 1, -1, -1):
        j = i if A.shape[0] > 1 else 0
        block = a[N_INPUT * i : N_INPUT * (i + 1)]
        for b in range(N_INPUT):
            block[b] = 0.0
        add_matvec_transposed(B[j], force[i + 1], 1.0, block)
        add_matvec_transposed(A[j], force[i + 1], 1.0, force[i])
    project(J_T, a, 0, u.size, d)
    primal_direction(J_T, d, 0, z)
    move_along(u, z, 1.0)
    roll_out(model, u, face.x)


@kernel
def _enter_working(model: Dynamics, rows: RowData, guess: ByteArray, face: Face) -> int:
    """The independent working rows of the guess become equalities; returns their number."""
    u, J_T, vectors = face.u, face.J_T, face.vectors
    d, sign, cap, a, gap = vectors[0], vectors[3], vectors[5], vectors[6], vectors[7]
    nv = u.size
    q = 0
    for p in range(guess.shape[0]):
        if guess[p] != WORKING or q == nv:
            continue
        slack = row_slack(p, u, face.x, rows)
        weight = rows.weight[(p - 4 * nv) % rows.weight.shape[0]] if p >= 4 * nv else math.inf
        if not (abs(slack) < math.inf and weight > 0.0):
            continue
        start, stop = load_normal(p, 1.0, model.A, model.B, rows, nv, vectors)
        length = project(J_T, a, start, stop, d)
        zeta = 0.0
        for k in range(q, nv):
            zeta += d[k] * d[k]
        if not zeta > _DEPENDENT * length:
            continue
        append_row(J_T, face.R_T, d, q)
        face.active[q], sign[q], cap[q], gap[q] = p, 1.0, weight, -slack
        face.state[p] = WORKING
        q += 1
    return q


@kernel
def _worst_multiplier(nu: Array, cap: Array, q: int) -> int:
    """The working row whose multiplier is farthest outside [0, weight], or -1."""
    worst, leaving = 0.0, -1
    for i in range(q):
        outside = max(-nu[i], nu[i] - cap[i])
        if outside > worst:
            worst, leaving = outside, i
    return leaving


@kernel
def start_from_guess(
    model: Dynamics, rows: RowData, guess: ByteArray, face: Face, force: Array
) -> tuple[int, int]:
    """From the unconstrained optimum to the optimum of the face that is left of the guess.

    Args:
        model: The dynamics.
        rows: The rows of the problem.
        guess: State of every row, (16N + 2K,).
        face: The unconstrained optimum on entry, with every row inactive.
        force: Overwritten, (N+1, 12).

    Returns:
        The number of working rows, and how many rows left on the way.
    """
    u, J_T, R_T, vectors = face.u, face.J_T, face.R_T, face.vectors
    z, nu, cap, gap, y = vectors[1], vectors[4], vectors[5], vectors[7], vectors[8]
    _saturate(model, rows, guess, face, force)
    q = _enter_working(model, rows, guess, face)
    changes = 0
    while True:
        solve_triangle_transposed(R_T, gap, q, y)
        solve_triangle(R_T, y, q, nu)
        leaving = _worst_multiplier(nu, cap, q)
        if leaving < 0:
            break
        changes += 1
        at_cap = nu[leaving] > 0.0
        face.state[face.active[leaving]] = inactive_after(at_cap)
        if at_cap:  # its pull is constant from now on
            for i in range(q):
                total = 0.0
                for k in range(min(i, leaving) + 1):
                    total += R_T[i, k] * R_T[leaving, k]
                gap[i] -= cap[leaving] * total
            _add_columns(J_T, R_T[leaving], leaving + 1, z)
            move_along(u, z, cap[leaving])
        remove_row(face, leaving, q)
        for i in range(leaving, q - 1):
            gap[i] = gap[i + 1]
        q -= 1
    _add_columns(J_T, y, q, z)
    move_along(u, z, 1.0)
    roll_out(model, u, face.x)
    return q, changes


@kernel
def _add_columns(J_T: Array, factors: Array, count: int, z: Array) -> None:
    """Writes z = J_1 factors, over the first columns."""
    nv = J_T.shape[0]
    for j in range(nv):
        z[j] = 0.0
    for k in range(count):
        factor = factors[k]
        for j in range(nv):
            z[j] += factor * J_T[k, j]


@kernel
def _put_on_bounds(rows: RowData, face: Face, q: int) -> None:
    """Inputs that are held at a bound of the box get its very value."""
    nv = face.u.size
    for i in range(q):
        p = face.active[i]
        if p < 2 * nv:
            k, a = (p % nv) // N_INPUT, p % N_INPUT
            face.u[k, a] = rows.lower[a] if p < nv else rows.upper[a]


@kernel
def correct(rows: RowData, gradient: Array, face: Face, q: int) -> None:
    """One step of iterative refinement on the face: inputs and multipliers against what is left of both.

    With g the gradient of the Lagrangian, d = J'g and gaps s of the working rows: `y = R^-T s`,
    `u += J_1 y - J_2 d_2`, `nu += R^-1 (d_1 + y)`, kept in [0, weight]. Inputs at a bound
    of the box are then put there exactly; what that does to other rows is for the caller to see.

    Args:
        rows: The rows of the problem.
        gradient: Of the Lagrangian, (4N,).
        face: Its plan and multipliers are corrected; its states stay those of before.
        q: Number of working rows.
    """
    u, J_T, R_T, vectors = face.u, face.J_T, face.R_T, face.vectors
    d, z, r, sign, nu, cap = vectors[0], vectors[1], vectors[2], vectors[3], vectors[4], vectors[5]
    gap, y = vectors[7], vectors[8]
    project(J_T, gradient, 0, u.size, d)
    primal_direction(J_T, d, q, z)
    move_along(u, z, -1.0)
    for i in range(q):
        gap[i] = -sign[i] * row_slack(face.active[i], u, face.x, rows)
    solve_triangle_transposed(R_T, gap, q, y)
    _add_columns(J_T, y, q, z)
    move_along(u, z, 1.0)
    _put_on_bounds(rows, face, q)
    for i in range(q):
        y[i] += d[i]
    solve_triangle(R_T, y, q, r)
    for i in range(q):
        nu[i] = min(max(nu[i] + r[i], 0.0), cap[i])
