"""The default solver: exact, structured, one compiled call, no tolerance to tune.

1. A Riccati pass gives the unconstrained optimum. If it satisfies every row it is the solution.
2. Otherwise the closed loop of the same recursion gives J with H^-1 = J J', the inverse factor of the
   condensed Hessian: J is the impulse response from whitened inputs to inputs, so neither H nor its Cholesky
   factor is ever formed. The dual active set (`active_set.py`) starts from there.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from quad_envs._numba import kernel
from quad_envs.parameters import N_INPUT, N_STATE, Array

from ..linalg import fill
from ..ocp import IntArray, OcpQp, validate
from ..riccati import RICCATI_SCRATCH, optimal_plan, riccati_pass
from .active_set import (
    N_VECTORS,
    NOT_FINITE,
    OPTIMAL,
    ByteArray,
    dual_active_set,
    row_spans,
    worst_row,
)
from .solution import Multipliers, Solution, Status

ITERATION_LIMIT = 2000  # the largest number seen on random problems is 740


class Workspace(NamedTuple):
    """Memory of `solve_structured` for one horizon; the first three fields hold its results."""

    u: Array  # (N, 4)
    x: Array  # (N+1, 12)
    multipliers: Array  # (16N + 2K,): box lower, box upper, rate lower, rate upper, rows lower, rows upper
    transposed: Array  # (1 or N, 16, 12), [A_i B_i]'
    K: Array  # (N, 4, 12), gains
    D: Array  # (N, 4, 4), inverse Cholesky factors
    A_cl: Array  # (N, 12, 12), closed loops
    P_c: Array  # (N, 12)
    scratch: Array  # (RICCATI_SCRATCH, 12, 12)
    wide: Array  # (2, 12, 4N)
    factors: Array  # (2, 4N, 4N): J and R, by columns
    vectors: Array  # (N_VECTORS, 4N + 12)
    active: IntArray  # (4N + 1,)
    spans: IntArray  # (K, 2)
    state: ByteArray  # (16N + 2K,)


def make_workspace(horizon: int, n_rows: int, n_models: int) -> Workspace:
    """Memory for `solve_structured`.

    Args:
        horizon: N, exactly.
        n_rows: Largest number K of state rows.
        n_models: Number of pairs (A_i, B_i), 1 or N.

    Raises:
        ValueError: If a size is out of range.
    """
    if horizon < 1 or n_rows < 0 or n_models not in (1, horizon):
        raise ValueError(
            f"a workspace needs horizon >= 1, n_rows >= 0 and n_models 1 or {horizon}, "
            f"got {horizon}, {n_rows}, {n_models}"
        )
    N, n, m = horizon, N_STATE, N_INPUT
    nv = N * m
    return Workspace(
        u=np.zeros((N, m)),
        x=np.zeros((N + 1, n)),
        multipliers=np.zeros(4 * nv + 2 * n_rows),
        transposed=np.zeros((n_models, n + m, n)),
        K=np.zeros((N, m, n)),
        D=np.zeros((N, m, m)),
        A_cl=np.zeros((N, n, n)),
        P_c=np.zeros((N, n)),
        scratch=np.zeros((RICCATI_SCRATCH, n, n)),
        wide=np.zeros((2, n, nv)),
        factors=np.zeros((2, nv, nv)),
        vectors=np.zeros((N_VECTORS, nv + n)),
        active=np.zeros(nv + 1, dtype=np.int64),
        spans=np.zeros((n_rows, 2), dtype=np.int64),
        state=np.zeros(4 * nv + 2 * n_rows, dtype=np.int8),
    )


@kernel
def _start_column(B: Array, D: Array, J_T: Array, w: int, response: Array, column: int) -> None:
    """The diagonal block D of J at column w, and the response B D of the next state at the given column."""
    n, m = B.shape
    for b in range(m):
        for a in range(m):
            J_T[w + b, w + a] = D[a, b]
        for a in range(n):
            total = 0.0
            for k in range(b + 1):  # D is upper triangular
                total += B[a, k] * D[k, b]
            response[a, column + b] = total


@kernel
def _march(K: Array, A_cl: Array, X: Array, width: int, J_T: Array, w: int, X_next: Array) -> None:
    """One stage: rows w.. of J, -K X, below the first columns, and X_next = A_cl X, over `width` columns."""
    row = X_next[0]  # scratch until X_next is made
    for a in range(K.shape[0]):
        for k in range(width):
            row[k] = 0.0
        for b in range(K.shape[1]):
            factor = K[a, b]
            for k in range(width):
                row[k] -= factor * X[b, k]
        for k in range(width):
            J_T[k, w + a] = row[k]
    for a in range(A_cl.shape[0]):
        for k in range(width):
            X_next[a, k] = 0.0
        for b in range(A_cl.shape[1]):
            factor = A_cl[a, b]
            for k in range(width):
                X_next[a, k] += factor * X[b, k]


@kernel
def inverse_factor(
    K: Array, D: Array, A_cl: Array, B: Array, stationary: bool, J_T: Array, wide: Array
) -> None:
    """J with J J' = H^-1: J_jj = D_j, J_ij = -K_i A_cl_{i-1} .. A_cl_{j+1} B_j D_j below, 0 above.

    Marches the response X_i of x_i to all whitened inputs before stage i: rows i of J left of the diagonal
    are -K_i X_i, and X_{i+1} = [A_cl_i X_i, B_i D_i]. With one gain J is block Toeplitz: the first block
    column is marched and the others are copies.

    Args:
        K: Gains, (N, 4, 12).
        D: Inverse Cholesky factors, (N, 4, 4).
        A_cl: Closed loops, (N, 12, 12).
        B: (1 or N, 12, 4).
        stationary: Whether the first gain serves all stages.
        J_T: Result, J by columns, (4N, 4N).
        wide: Overwritten, (2, 12, 4N).
    """
    N, m = D.shape[:2]
    nv = m * N
    fill(J_T, 0.0)
    for i in range(N):
        X, X_next = wide[i % 2], wide[1 - i % 2]
        g = 0 if stationary else i
        if i > 0:
            _march(K[g], A_cl[g], X, m if stationary else m * i, J_T, m * i, X_next)
        if i == 0 or not stationary:
            _start_column(B[i if B.shape[0] > 1 else 0], D[g], J_T, m * i, X_next, m * i)
    if stationary:
        for k in range(m, nv):
            start = k - k % m
            for j in range(nv - start):
                J_T[k, start + j] = J_T[k % m, j]


@kernel
def _all_finite(values: Array) -> bool:
    bad = 0
    for i in range(values.shape[0]):
        for j in range(values.shape[1]):
            bad |= 0 if abs(values[i, j]) < math.inf else 1
    return bad == 0


@kernel
def solve_structured(
    A: Array,
    B: Array,
    c: Array,
    Q: Array,
    R: Array,
    Q_f: Array,
    stationary: bool,
    x_0: Array,
    r: Array,
    lower: Array,
    upper: Array,
    rate_step: float,
    u_last: Array,
    normals: Array,
    normal: IntArray,
    stage: IntArray,
    row_lower: Array,
    row_upper: Array,
    weight: Array,
    iteration_limit: int,
    ws: Workspace,
) -> tuple[int, int]:
    """Solve one OCP-QP, data as in `OcpQp` and `StateRows`. Nothing is allocated and nothing is validated.

    Arrays are passed one by one because that unpacks twice as fast as a NamedTuple. Compiled loops may call
    it, with one workspace per thread.

    Args:
        A: (1 or N, 12, 12).
        B: (1 or N, 12, 4).
        c: (N, 12).
        Q: (1 or N, 12, 12).
        R: (4, 4).
        Q_f: (12, 12).
        stationary: Whether Q_f solves the DARE of the single pair.
        x_0: (12,).
        r: (N+1, 12).
        lower: (4,).
        upper: (4,).
        rate_step: N per sample, inf for no limit.
        u_last: (4,).
        normals: (H, 12), H <= K.
        normal: (K,).
        stage: (K,).
        row_lower: (K,).
        row_upper: (K,).
        weight: (K,).
        iteration_limit: Largest number of active-set steps, ITERATION_LIMIT unless time is scarce.
        ws: From `make_workspace` for this N, at least K rows and at least this many pairs; ws.u, ws.x and
            ws.multipliers[: 16N + 2K] receive the result.

    Returns:
        Status as an integer, and the number of active-set steps: 0 if the Riccati plan satisfies every row.
    """
    N, K = c.shape[0], normal.shape[0]
    if (
        ws.u.shape[0] != N
        or ws.spans.shape[0] < max(K, normals.shape[0])
        or ws.transposed.shape[0] < A.shape[0]
    ):
        raise ValueError("the workspace does not fit the problem: make it with its horizon, rows and pairs")
    u, x, n_rows = ws.u, ws.x, 4 * N_INPUT * N + 2 * K
    transposed = ws.transposed[: A.shape[0]]
    for k in range(n_rows):
        ws.multipliers[k] = 0.0
        ws.state[k] = 0
    riccati_pass(A, B, c, Q, R, Q_f, stationary, transposed, ws.K, ws.D, ws.A_cl, ws.P_c, ws.scratch)
    optimal_plan(B, c, Q, Q_f, x_0, r, stationary, transposed, ws.K, ws.D, ws.A_cl, ws.P_c, u, x, ws.scratch)
    last = u_last[0] + u_last[1] + u_last[2] + u_last[3]
    if not (abs(last) < math.inf and _all_finite(r) and _all_finite(u) and _all_finite(x)):
        return NOT_FINITE, 0
    first_move = ws.scratch[0, :2, :N_INPUT]
    for a in range(N_INPUT):
        first_move[0, a] = min(u_last[a] - rate_step, upper[a])
        first_move[1, a] = max(u_last[a] + rate_step, lower[a])
    row_spans(normals, ws.spans)
    row, slack = worst_row(
        u, x, lower, upper, rate_step, first_move,
        normals, normal, stage, row_lower, row_upper, weight, ws.spans, ws.state,
    )  # fmt: skip
    if row < 0:
        return OPTIMAL, 0
    J_T = ws.factors[0]
    inverse_factor(ws.K, ws.D, ws.A_cl, B, stationary, J_T, ws.wide)
    status, iterations = dual_active_set(
        A, B, c, transposed, lower, upper, rate_step, first_move,
        normals, normal, stage, row_lower, row_upper, weight, row, slack, iteration_limit,
        u, x, ws.multipliers, J_T, ws.factors[1], ws.active, ws.spans, ws.state, ws.vectors,
    )  # fmt: skip
    if not (_all_finite(u) and _all_finite(x)):
        return NOT_FINITE, iterations
    return status, iterations


class StructuredSolver:
    """Backend over `solve_structured`: validates, keeps a workspace, copies the result out.

    Args:
        iteration_limit: Largest number of active-set steps per problem.
    """

    def __init__(self, iteration_limit: int = ITERATION_LIMIT) -> None:
        if iteration_limit < 1:
            raise ValueError(f"iteration_limit must be at least 1, got {iteration_limit}")
        self.iteration_limit = iteration_limit
        self._workspace: Workspace | None = None

    def solve(self, qp: OcpQp) -> Solution:
        """Solve one problem.

        Raises:
            ValueError: If the problem is not well formed (`validate`).
        """
        validate(qp)
        rows = qp.rows
        N, K = len(qp.c), len(rows.normal)
        ws = self._fitting_workspace(N, K, len(qp.A))
        status, iterations = solve_structured(
            *qp[:-3], float(qp.rate_step), qp.u_last, *rows, self.iteration_limit, ws
        )
        nv = N_INPUT * N
        edges = [nv, 2 * nv, 3 * nv, 4 * nv, 4 * nv + K]
        parts = np.split(ws.multipliers[: 4 * nv + 2 * K].copy(), edges)
        box_and_rate = [part.reshape(N, N_INPUT) for part in parts[:4]]
        multipliers = Multipliers(*box_and_rate, *parts[4:])
        return Solution(Status(status), ws.u.copy(), ws.x.copy(), multipliers, iterations)

    def _fitting_workspace(self, horizon: int, n_rows: int, n_models: int) -> Workspace:
        """The kept workspace if the problem fits into it, else a larger one."""
        ws = self._workspace
        if ws is None or len(ws.u) != horizon or len(ws.spans) < n_rows or len(ws.transposed) < n_models:
            if ws is not None and len(ws.u) == horizon:
                n_rows, n_models = max(n_rows, len(ws.spans)), max(n_models, len(ws.transposed))
            ws = make_workspace(horizon, n_rows, n_models)
            self._workspace = ws
        return ws

    def __getstate__(self) -> dict[str, Any]:
        """The options alone: a workspace is scratch memory."""
        return {"iteration_limit": self.iteration_limit, "_workspace": None}
