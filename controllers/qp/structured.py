"""The default solver: exact, structured, one compiled call, no tolerance to tune.

1. A Riccati pass gives the unconstrained optimum. If it satisfies every row it is the solution.
2. Otherwise the closed loop of the same recursion gives J with H^-1 = J J', the inverse factor of the
   condensed Hessian: J is the impulse response from whitened inputs to inputs, so neither H nor its Cholesky
   factor is ever formed. The dual active set (`active_set.py`) starts from there, or from a guess of the
   working set (`working_set.py`).
3. The gradient of the Lagrangian is evaluated, refined once if need be, and only a small one is called
   optimal (`stationarity.py`).
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from quad_envs._numba import kernel
from quad_envs.parameters import N_INPUT, N_STATE, Array

from .active_set import (
    INACCURATE,
    INFEASIBLE,
    N_VECTORS,
    NOT_FINITE,
    OPTIMAL,
    ROW_TOLERANCE,
    ByteArray,
    RowData,
    collect_multipliers,
    dual_active_set,
    primal_direction,
    project,
    row_slack,
    row_spans,
    worst_row,
)
from .linalg import fill, transpose
from .ocp import IntArray, OcpQp, rate_weight, validate
from .rate_weight import carve_rate, rate_pass, rate_plan, rate_size
from .riccati import RICCATI_SCRATCH, optimal_plan, riccati_pass, step_plan
from .solution import Multipliers, Solution, Status
from .stationarity import REFINED, STATIONARY, is_mild, lagrangian_gradient
from .working_set import correct, start_from_guess

ITERATION_LIMIT = 0  # stands for a limit that grows with the problem, `step_limit`
_STEPS, _STEPS_PER_ROW = 2000, 20  # random problems with horizons up to 60 stay below
_ROW_ERROR = 1e-7  # largest violation of a row that a refined solution may have, as `STATIONARY`


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
    first_move: Array  # (2, 4), bounds on u_0
    scratch: Array  # (RICCATI_SCRATCH, 12, 12)
    wide: Array  # (2, 12, 4N)
    factors: Array  # (2, 4N, 4N): J and R, by columns
    vectors: Array  # (N_VECTORS, 4N + 12)
    gradient: Array  # (4N,), of the Lagrangian
    force: Array  # (N+1, 12)
    states: Array  # (N+1, 12)
    active: IntArray  # (4N + 1,)
    spans: IntArray  # (K, 2)
    state: ByteArray  # (16N + 2K,), of every row at the end
    guess: ByteArray  # (16N + 2K,), of every row, to start from
    error: Array  # (2,), left after refinement: by how much another would move an input, and gaps of rows
    rate: Array  # of a weight on changes, see `carve_rate`; may be empty


def make_workspace(horizon: int, n_rows: int, n_models: int, weighs_changes: bool = False) -> Workspace:
    """Memory for `solve_structured`.

    Args:
        horizon: N, exactly.
        n_rows: Largest number K of state rows.
        n_models: Number of pairs (A_i, B_i), 1 or N.
        weighs_changes: Whether changes of the input may have a weight.

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
        first_move=np.zeros((2, m)),
        scratch=np.zeros((RICCATI_SCRATCH, n, n)),
        wide=np.zeros((2, n, nv)),
        factors=np.zeros((2, nv, nv)),
        vectors=np.zeros((N_VECTORS, nv + n)),
        gradient=np.zeros(nv),
        force=np.zeros((N + 1, n)),
        states=np.zeros((N + 1, n)),
        active=np.zeros(nv + 1, dtype=np.int64),
        spans=np.zeros((n_rows, 2), dtype=np.int64),
        state=np.zeros(4 * nv + 2 * n_rows, dtype=np.int8),
        guess=np.zeros(4 * nv + 2 * n_rows, dtype=np.int8),
        error=np.zeros(2),
        rate=np.zeros(rate_size(N, n_models) if weighs_changes else 0),
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
def _recursion(
    A: Array,
    B: Array,
    c: Array,
    Q: Array,
    R: Array,
    Q_f: Array,
    stationary: bool,
    x_0: Array,
    r: Array,
    R_rate: Array,
    u_last: Array,
    ws: Workspace,
) -> None:
    """The backward pass over matrices, of x or, where changes have a weight, of [x; u_prev]."""
    transposed, n = ws.transposed[: A.shape[0]], A.shape[1]
    if R_rate.shape[0] == 0:
        riccati_pass(A, B, c, Q, R, Q_f, stationary, transposed, ws.K, ws.D, ws.A_cl, ws.P_c, ws.scratch)
        return
    for j in range(A.shape[0]):
        transpose(A[j], transposed[j, :n])
        transpose(B[j], transposed[j, n:])
    rate = carve_rate(ws.rate, c.shape[0], ws.transposed.shape[0])
    rate_pass(A, B, c, Q, R, Q_f, x_0, u_last, r, R_rate, ws.D, rate)


@kernel
def _all_finite(values: Array) -> bool:
    bad = 0
    for i in range(values.shape[0]):
        for j in range(values.shape[1]):
            bad |= 0 if abs(values[i, j]) < math.inf else 1
    return bad == 0


@kernel
def step_limit(iteration_limit: int, horizon: int, n_rows: int) -> int:
    """Largest number of active-set steps: as asked, or growing with the rows of the problem if 0.

    The limit counts steps, not time: a step takes at most a fixed number of operations, and what is decided
    must not depend on how busy the machine is.
    """
    if iteration_limit > 0:
        return iteration_limit
    return _STEPS + _STEPS_PER_ROW * (4 * N_INPUT * horizon + 2 * n_rows)


@kernel
def _has_hard_rows(rows: RowData) -> bool:
    for k in range(rows.weight.shape[0]):
        if rows.weight[k] == math.inf:
            return True
    return False


@kernel
def _clear(values: Array | ByteArray, n: int) -> None:
    for k in range(n):
        values[k] = 0


@kernel
def _largest_gap(rows: RowData, q: int, ws: Workspace) -> float:
    """How far a working row is from equality, over 1 + the largest input; in states summed anew."""
    largest, gap = 1.0, 0.0
    for k in range(ws.u.shape[0]):
        for a in range(N_INPUT):
            largest = max(largest, 1.0 + abs(ws.u[k, a]))
    for i in range(q):
        gap = max(gap, abs(row_slack(ws.active[i], ws.u, ws.states, rows)))
    return gap / largest


@kernel
def _finish(
    A: Array,
    B: Array,
    c: Array,
    Q: Array,
    R: Array,
    Q_f: Array,
    x_0: Array,
    r: Array,
    R_rate: Array,
    u_last: Array,
    rows: RowData,
    q: int,
    ws: Workspace,
) -> int:
    """Multipliers, and OPTIMAL or INACCURATE for the face reached: refined once if it is not stationary."""
    u, x = ws.u, ws.x
    sign, nu, cap = ws.vectors[3], ws.vectors[4], ws.vectors[5]
    n_rows = 4 * u.size + 2 * rows.normal.shape[0]
    transposed = ws.transposed[: A.shape[0]]
    relative, gap = math.inf, math.inf
    for attempt in range(2):
        if attempt == 1:
            correct(rows, ws.gradient, u, x, ws.factors[0], ws.factors[1], ws.active, ws.vectors, q)
            for i in range(u.shape[0]):
                step_plan(transposed, c, i, u, x)
        _clear(ws.multipliers, n_rows)
        collect_multipliers(ws.state, ws.active, sign, nu, cap, rows.weight, q, 4 * u.size, ws.multipliers)
        relative = lagrangian_gradient(
            A, B, c, Q, R, Q_f, x_0, r, R_rate, u_last, transposed, rows, u, ws.multipliers, ws.states,
            ws.force, ws.gradient, ws.scratch[1],
        )  # fmt: skip
        gap = _largest_gap(rows, q, ws)
        if attempt == 0 and relative <= REFINED and gap <= ROW_TOLERANCE:
            return OPTIMAL
    _, slack = worst_row(u, x, rows, ws.state)
    project(ws.factors[0], ws.gradient, 0, u.size, ws.vectors[0])
    primal_direction(ws.factors[0], ws.vectors[0], q, ws.vectors[1])
    ws.error[0], ws.error[1] = 0.0, max(gap, -slack)
    for k in range(u.size):
        ws.error[0] = max(ws.error[0], abs(ws.vectors[1, k]))
    return OPTIMAL if relative <= STATIONARY and ws.error[1] <= _ROW_ERROR else INACCURATE


@kernel
def _solve_rows(
    A: Array,
    B: Array,
    c: Array,
    Q: Array,
    R: Array,
    Q_f: Array,
    stationary: bool,
    x_0: Array,
    r: Array,
    R_rate: Array,
    u_last: Array,
    rows: RowData,
    warm: bool,
    iterations: int,
    iteration_limit: int,
    ws: Workspace,
) -> tuple[int, int]:
    """From the unconstrained optimum in ws to the constrained one; with `warm` by way of ws.guess."""
    u, x, transposed = ws.u, ws.x, ws.transposed[: A.shape[0]]
    J_T, R_T = ws.factors[0], ws.factors[1]
    if R_rate.shape[0] > 0:
        rate = carve_rate(ws.rate, c.shape[0], ws.transposed.shape[0])
        inverse_factor(rate.K_u, ws.D, rate.A_cl, rate.B[: B.shape[0]], False, J_T, rate.wide)
    else:
        inverse_factor(ws.K, ws.D, ws.A_cl, B, stationary, J_T, ws.wide)
    q = 0
    ws.error[0] = math.inf
    _clear(ws.state, 4 * u.size + 2 * rows.normal.shape[0])
    if warm:
        guess = ws.guess[: 4 * u.size + 2 * rows.normal.shape[0]]
        q, changes = start_from_guess(
            A, B, c, transposed, rows, guess, u, x, J_T, R_T, ws.active, ws.state, ws.force, ws.vectors
        )
        iterations += changes
    row, slack = worst_row(u, x, rows, ws.state)
    status, iterations, q = dual_active_set(
        A, B, c, transposed, rows, row, slack, q, iterations, iteration_limit,
        u, x, J_T, R_T, ws.active, ws.state, ws.vectors,
    )  # fmt: skip
    if not (_all_finite(u) and _all_finite(x)):
        return NOT_FINITE, iterations
    finished = _finish(A, B, c, Q, R, Q_f, x_0, r, R_rate, u_last, rows, q, ws)
    if status != OPTIMAL:
        ws.error[0] = math.inf
        return status, iterations
    return finished, iterations


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
    R_rate: Array,
    iteration_limit: int,
    warm: bool,
    ws: Workspace,
) -> tuple[int, int]:
    """Solve one OCP-QP, data as in `OcpQp` and `StateRows`. Nothing is allocated and nothing is validated.

    Arrays are passed one by one because that unpacks twice as fast as a NamedTuple. Compiled loops may call
    it, with one workspace per thread. A warm start that ends without an optimum is done again cold, and a
    cold one that accuracy let down once more from the working set that it reached.

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
        R_rate: (4, 4), or (0, 4) where changes have no weight. With one, `stationary` is not read.
        iteration_limit: As in `step_limit`.
        warm: Whether ws.guess[: 16N + 2K] holds a guess of the state of every row to start from.
        ws: From `make_workspace` for this N, at least K rows and at least this many pairs; ws.u, ws.x,
            ws.multipliers[: 16N + 2K] and ws.state[: 16N + 2K] receive the result.

    Returns:
        Status as an integer, and the number of active-set steps: changes of the unconstrained plan's or the
        guessed working set, 0 if the Riccati plan satisfies every row.
    """
    N, K = c.shape[0], normal.shape[0]
    if (
        ws.u.shape[0] != N
        or ws.spans.shape[0] < max(K, normals.shape[0])
        or ws.transposed.shape[0] < A.shape[0]
        or (ws.rate.size == 0 and R_rate.shape[0] > 0)
    ):
        raise ValueError(
            "the workspace does not fit the problem: make it with its horizon, rows, pairs and weights"
        )
    u, x, n_rows = ws.u, ws.x, 4 * N_INPUT * N + 2 * K
    transposed = ws.transposed[: A.shape[0]]
    _clear(ws.multipliers, n_rows)
    _clear(ws.state, n_rows)
    _recursion(A, B, c, Q, R, Q_f, stationary, x_0, r, R_rate, u_last, ws)
    first_move = ws.first_move
    for a in range(N_INPUT):
        first_move[0, a] = min(u_last[a] - rate_step, upper[a])
        first_move[1, a] = max(u_last[a] + rate_step, lower[a])
    row_spans(normals, ws.spans)
    rows = RowData(
        lower, upper, rate_step, first_move,
        normals, normal, stage, row_lower, row_upper, weight, ws.spans,
    )  # fmt: skip
    last = u_last[0] + u_last[1] + u_last[2] + u_last[3]
    finite = abs(last) < math.inf and _all_finite(r)
    limit = step_limit(iteration_limit, N, K)
    status, iterations = NOT_FINITE, 0
    for attempt in range(3):
        if R_rate.shape[0] > 0:
            rate = carve_rate(ws.rate, N, ws.transposed.shape[0])
            rate_plan(A.shape[0], Q.shape[0], ws.D, rate, u, x)
        else:
            optimal_plan(
                B, c, Q, Q_f, x_0, r, stationary, transposed, ws.K, ws.D, ws.A_cl, ws.P_c, u, x, ws.scratch
            )
        if not (finite and _all_finite(u) and _all_finite(x)):
            return NOT_FINITE, iterations
        if attempt == 0 and worst_row(u, x, rows, ws.state)[0] < 0:
            if R_rate.shape[0] == 0 and is_mild(A, R, Q_f, N, ws.scratch[1]):
                return OPTIMAL, 0
            relative = lagrangian_gradient(
                A,
                B,
                c,
                Q,
                R,
                Q_f,
                x_0,
                r,
                R_rate,
                u_last,
                transposed,
                rows,
                u,
                ws.multipliers,
                ws.states,
                ws.force,
                ws.gradient,
                ws.scratch[1],
            )
            if relative <= STATIONARY:
                return OPTIMAL, 0
        # A warm start gets half of the steps, so that a cold one is left.
        steps = (iterations + limit + 1) // 2 if warm and attempt == 0 else limit
        status, iterations = _solve_rows(
            A, B, c, Q, R, Q_f, stationary, x_0, r, R_rate, u_last, rows, warm, iterations, steps, ws
        )
        if status == OPTIMAL or iterations >= limit:
            break
        hard = status == INFEASIBLE and _has_hard_rows(rows)
        if hard or (attempt > 0 and warm):
            break
        warm = not (warm and attempt == 0)
        if warm:
            for k in range(n_rows):
                ws.guess[k] = ws.state[k]
    if status == INFEASIBLE and not _has_hard_rows(rows):
        status = INACCURATE  # box, rate and soft rows cannot contradict each other
    return status, iterations


class StructuredSolver:
    """Backend over `solve_structured`: validates, keeps a workspace, copies the result out.

    Args:
        iteration_limit: Largest number of active-set steps per problem; 0 for one that grows with it.
    """

    def __init__(self, iteration_limit: int = ITERATION_LIMIT) -> None:
        if iteration_limit < 0:
            raise ValueError(
                f"iteration_limit must be at least 1, or 0 to grow with the problem, got {iteration_limit}"
            )
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
        ws = self._fitting_workspace(N, K, len(qp.A), qp.R_rate is not None)
        status, iterations = solve_structured(
            *qp[:-4], float(qp.rate_step), qp.u_last, *rows, rate_weight(qp), self.iteration_limit, False, ws
        )
        nv = N_INPUT * N
        edges = [nv, 2 * nv, 3 * nv, 4 * nv, 4 * nv + K]
        parts = np.split(ws.multipliers[: 4 * nv + 2 * K].copy(), edges)
        box_and_rate = [part.reshape(N, N_INPUT) for part in parts[:4]]
        multipliers = Multipliers(*box_and_rate, *parts[4:])
        return Solution(Status(status), ws.u.copy(), ws.x.copy(), multipliers, iterations)

    def _fitting_workspace(self, horizon: int, n_rows: int, n_models: int, weighs_changes: bool) -> Workspace:
        """The kept workspace if the problem fits into it, else a larger one."""
        ws = self._workspace
        if ws is not None and len(ws.u) == horizon:
            fits = len(ws.spans) >= n_rows and len(ws.transposed) >= n_models
            if fits and (ws.rate.size > 0 or not weighs_changes):
                return ws
            n_rows, n_models = max(n_rows, len(ws.spans)), max(n_models, len(ws.transposed))
            weighs_changes = weighs_changes or ws.rate.size > 0
        self._workspace = make_workspace(horizon, n_rows, n_models, weighs_changes)
        return self._workspace

    def __getstate__(self) -> dict[str, Any]:
        """The options alone: a workspace is scratch memory."""
        return {"iteration_limit": self.iteration_limit, "_workspace": None}
