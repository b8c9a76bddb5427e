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
from typing import Any

import numpy as np

from quad_envs.compilation.decorators import kernel, separate_kernel
from quad_envs.compilation.packed import pack, viewer
from quad_envs.parameters import N_INPUT, Array

from .active_set import (
    INACCURATE,
    INFEASIBLE,
    NOT_FINITE,
    OPTIMAL,
    Dynamics,
    Face,
    collect_multipliers,
    dual_active_set,
    primal_direction,
    project,
    roll_out,
)
from .linalg import fill
from .ocp import IntArray, OcpQp, StateRows, rate_weight, validate, weight_of_changes
from .products import add_product, negate, transpose
from .rate_weight import carve_rate, rate_pass, rate_plan
from .recursion import Feedback, Regulator, optimal_plan, riccati_pass
from .rows import ROW_TOLERANCE, ByteArray, RowData, row_slack, row_spans, worst_row
from .solution import Multipliers, Solution, Status
from .stationarity import REFINED, STATIONARY, is_mild, lagrangian_gradient
from .working_set import correct, start_from_guess
from .workspace import Workspace, make_workspace

ITERATION_LIMIT = 0  # stands for a limit that grows with the problem, `step_limit`
_STEPS, _STEPS_PER_ROW = 2000, 20  # random problems with horizons up to 60 stay below
_ROW_ERROR = 1e-7  # largest violation of a row that a refined solution may have, as `STATIONARY`


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
def _close_loop(A: Array, B_T: Array, K: Array, minus: Array, A_cl: Array) -> None:
    """A_cl = A - B K, with B' as `riccati_pass` leaves it."""
    negate(K, minus)
    add_product(A, B_T, minus, A_cl)


@kernel
def inverse_factor(
    A: Array,
    B: Array,
    stationary: bool,
    feedback: Feedback,
    K_u: Array,
    J_T: Array,
    wide: Array,
    scratch: Array,
) -> None:
    """J with J J' = H^-1: J_jj = D_j, J_ij = -K_i A_cl_{i-1} .. A_cl_{j+1} B_j D_j below, 0 above.

    Marches the response X_i of x_i to all whitened inputs before stage i: rows i of J left of the diagonal
    are -K_i X_i, and X_{i+1} = [A_cl_i X_i, B_i D_i] with A_cl = A - B K. With one gain J is block Toeplitz:
    the first block column is marched and the others are copies.

    Args:
        A: (1 or N, n, n).
        B: (1 or N, n, 4).
        stationary: Whether the first gain serves all stages.
        feedback: Of `riccati_pass`.
        K_u: Gains of u, (N, 4, n): those of the feedback, but where changes of u have a weight.
        J_T: Result, J by columns, (4N, 4N).
        wide: Overwritten, (2, n, 4N).
        scratch: Overwritten, (2, n, n).
    """
    K, D, A_cl = feedback.K, feedback.D, scratch[0]
    N, m = D.shape[:2]
    n, nv = A.shape[1], m * N
    fill(J_T, 0.0)
    for i in range(N):
        X, X_next = wide[i % 2], wide[1 - i % 2]
        g = 0 if stationary else i
        j = i if B.shape[0] > 1 else 0
        if i == 1 or (i > 1 and not stationary):
            _close_loop(A[j], feedback.transposed[j, n:], K[g], scratch[1], A_cl)
        if i > 0:
            _march(K_u[g], A_cl, X, m if stationary else m * i, J_T, m * i, X_next)
        if i == 0 or not stationary:
            _start_column(B[j], D[g], J_T, m * i, X_next, m * i)
    if stationary:
        for k in range(m, nv):
            start = k - k % m
            for j in range(nv - start):
                J_T[k, start + j] = J_T[k % m, j]


@kernel
def _feedback(pairs: int, ws: Workspace) -> Feedback:
    """What the recursion over x finds, in the memory for it."""
    return Feedback(ws.transposed[:pairs], ws.K, ws.D, ws.P_c)


@kernel
def _regulator(qp: OcpQp) -> Regulator:
    """The problem without constraints."""
    return Regulator(qp.A, qp.B, qp.c, qp.Q, qp.R, qp.Q_f, qp.stationary, qp.x_0, qp.r)


@kernel
def _recursion(qp: OcpQp, ws: Workspace) -> None:
    """The backward pass over matrices, of x or, where changes have a weight, of [x; u_prev]."""
    pairs, n = qp.A.shape[0], qp.A.shape[1]
    if weight_of_changes(qp).shape[0] == 0:
        riccati_pass(_regulator(qp), _feedback(pairs, ws), ws.scratch)
        return
    for j in range(pairs):
        transpose(qp.A[j], ws.transposed[j, :n])
        transpose(qp.B[j], ws.transposed[j, n:])
    rate_pass(qp, carve_rate(ws.rate, qp, ws.D))


@kernel
def _plan(qp: OcpQp, ws: Workspace) -> None:
    """The unconstrained optimum into ws.u and ws.x, after `_recursion`."""
    if weight_of_changes(qp).shape[0] == 0:
        optimal_plan(_regulator(qp), _feedback(qp.A.shape[0], ws), ws.u, ws.x, ws.scratch[0])
    else:
        rate_plan(carve_rate(ws.rate, qp, ws.D), ws.u, ws.x)


@kernel
def _factor(qp: OcpQp, ws: Workspace) -> None:
    """J into ws.factors[0], after `_recursion`."""
    J_T = ws.factors[0]
    if weight_of_changes(qp).shape[0] == 0:
        found = _feedback(qp.A.shape[0], ws)
        inverse_factor(qp.A, qp.B, qp.stationary, found, found.K, J_T, ws.wide, ws.scratch)
    else:
        w = carve_rate(ws.rate, qp, ws.D)
        inverse_factor(w.problem.A, w.problem.B, False, w.feedback, w.K_u, J_T, w.wide, w.scratch)


@kernel
def _stationarity(qp: OcpQp, rows: RowData, ws: Workspace) -> float:
    """Relative stationarity of ws.u with ws.multipliers; the gradient of the Lagrangian into ws.gradient."""
    transposed = ws.transposed[: qp.A.shape[0]]
    return float(
        lagrangian_gradient(
            qp, transposed, rows, ws.u, ws.multipliers, ws.states, ws.force, ws.gradient, ws.scratch[1]
        )
    )


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
def _dynamics(qp: OcpQp, ws: Workspace) -> Dynamics:
    """After `_recursion`."""
    return Dynamics(qp.A, qp.B, qp.c, ws.transposed[: qp.A.shape[0]])


@kernel
def _face(ws: Workspace) -> Face:
    return Face(ws.u, ws.x, ws.factors[0], ws.factors[1], ws.active, ws.state, ws.vectors)


@kernel
def _finish(qp: OcpQp, rows: RowData, q: int, ws: Workspace) -> int:
    """Multipliers, and OPTIMAL or INACCURATE for the face reached: refined once if it is not stationary."""
    u, x, face = ws.u, ws.x, _face(ws)
    relative, gap = math.inf, math.inf
    for attempt in range(2):
        if attempt == 1:
            correct(rows, ws.gradient, face, q)
            roll_out(_dynamics(qp, ws), u, x)
        collect_multipliers(face, rows.weight, q, ws.multipliers)
        relative = _stationarity(qp, rows, ws)
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
    qp: OcpQp, rows: RowData, warm: bool, iterations: int, iteration_limit: int, ws: Workspace
) -> tuple[int, int]:
    """From the unconstrained optimum in ws to the constrained one; with `warm` by way of ws.guess."""
    model, face = _dynamics(qp, ws), _face(ws)
    n_rows = 4 * ws.u.size + 2 * rows.normal.shape[0]
    _factor(qp, ws)
    q = 0
    ws.error[0] = math.inf
    _clear(ws.state, n_rows)
    if warm:
        q, changes = start_from_guess(model, rows, ws.guess[:n_rows], face, ws.force)
        iterations += changes
    row, slack = worst_row(ws.u, ws.x, rows, ws.state)
    status, iterations, q = dual_active_set(model, rows, face, row, slack, q, iterations, iteration_limit)
    if not (_all_finite(ws.u) and _all_finite(ws.x)):
        return NOT_FINITE, iterations
    finished = _finish(qp, rows, q, ws)
    if status != OPTIMAL:
        ws.error[0] = math.inf
        return status, iterations
    return finished, iterations


@kernel
def _row_data(qp: OcpQp, ws: Workspace) -> RowData:
    """All rows of the problem, for the active set."""
    first_move = ws.first_move
    for a in range(N_INPUT):
        first_move[0, a] = min(qp.u_last[a] - qp.rate_step, qp.upper[a])
        first_move[1, a] = max(qp.u_last[a] + qp.rate_step, qp.lower[a])
    rows = qp.rows
    row_spans(rows.normals, ws.spans)
    return RowData(
        qp.lower, qp.upper, qp.rate_step, first_move,
        rows.normals, rows.normal, rows.stage, rows.lower, rows.upper, rows.weight, ws.spans,
    )  # fmt: skip


@kernel
def _is_optimal(qp: OcpQp, rows: RowData, ws: Workspace) -> bool:
    """Whether the unconstrained plan in ws satisfies every row, and round-off has not spoiled it."""
    if worst_row(ws.u, ws.x, rows, ws.state)[0] >= 0:
        return False
    if weight_of_changes(qp).shape[0] == 0 and is_mild(qp.A, qp.R, qp.Q_f, qp.c.shape[0], ws.scratch[1]):
        return True
    return bool(_stationarity(qp, rows, ws) <= STATIONARY)


@separate_kernel
def solve_qp(qp: OcpQp, iteration_limit: int, warm: bool, ws: Workspace) -> tuple[int, int]:
    """Solve one OCP-QP, whose R_rate is an array: (0, 4) where changes have no weight.

    Nothing is allocated and nothing is validated. Compiled loops may call it, with one workspace per thread.
    A warm start that ends without an optimum is done again cold, and a cold one that accuracy let down once
    more from the working set that it reached.

    Args:
        qp: The problem; `stationary` is not read where changes have a weight.
        iteration_limit: As in `step_limit`.
        warm: Whether ws.guess[: 16N + 2K] holds a guess of the state of every row to start from.
        ws: From `make_workspace` for this N, at least K rows and at least this many pairs; ws.u, ws.x,
            ws.multipliers[: 16N + 2K] and ws.state[: 16N + 2K] receive the result.

    Returns:
        Status as an integer, and the number of active-set steps: changes of the unconstrained plan's or the
        guessed working set, 0 if the Riccati plan satisfies every row.
    """
    N, K = qp.c.shape[0], qp.rows.normal.shape[0]
    if (
        ws.u.shape[0] != N
        or ws.spans.shape[0] < max(K, qp.rows.normals.shape[0])
        or ws.transposed.shape[0] < qp.A.shape[0]
        or (ws.rate.size == 0 and weight_of_changes(qp).shape[0] > 0)
    ):
        raise ValueError(
            "the workspace does not fit the problem: make it with its horizon, rows, pairs and weights"
        )
    n_rows = 4 * N_INPUT * N + 2 * K
    _clear(ws.multipliers, n_rows)
    _clear(ws.state, n_rows)
    _recursion(qp, ws)
    rows = _row_data(qp, ws)
    last = qp.u_last[0] + qp.u_last[1] + qp.u_last[2] + qp.u_last[3]
    finite = abs(last) < math.inf and _all_finite(qp.r)
    limit = step_limit(iteration_limit, N, K)
    status, iterations = NOT_FINITE, 0
    for attempt in range(3):
        _plan(qp, ws)
        if not (finite and _all_finite(ws.u) and _all_finite(ws.x)):
            return NOT_FINITE, iterations
        if attempt == 0 and _is_optimal(qp, rows, ws):
            return OPTIMAL, 0
        # A warm start gets half of the steps, so that a cold one is left.
        steps = (iterations + limit + 1) // 2 if warm and attempt == 0 else limit
        status, iterations = _solve_rows(qp, rows, warm, iterations, steps, ws)
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


_workspace = viewer(Workspace)


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
    words: IntArray,
) -> tuple[int, int]:
    """`solve_qp` for calls from Python: the problem in its fields, and the workspace as packed words."""
    rows = StateRows(normals, normal, stage, row_lower, row_upper, weight)
    qp = OcpQp(A, B, c, Q, R, Q_f, stationary, x_0, r, lower, upper, rate_step, u_last, rows, R_rate)
    return solve_qp(qp, iteration_limit, warm, _workspace(words))


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
        self._memory: tuple[Workspace, IntArray] | None = None  # and its words

    def solve(self, qp: OcpQp) -> Solution:
        """Solve one problem.

        Raises:
            ValueError: If the problem is not well formed (`validate`).
        """
        validate(qp)
        rows = qp.rows
        N, K = len(qp.c), len(rows.normal)
        ws, words = self._fitting_memory(N, K, len(qp.A), qp.R_rate is not None)
        fields = *qp[:-4], float(qp.rate_step), qp.u_last, *rows, rate_weight(qp)
        status, iterations = solve_structured(*fields, self.iteration_limit, False, words)
        nv = N_INPUT * N
        edges = [nv, 2 * nv, 3 * nv, 4 * nv, 4 * nv + K]
        parts = np.split(ws.multipliers[: 4 * nv + 2 * K].copy(), edges)
        box_and_rate = [part.reshape(N, N_INPUT) for part in parts[:4]]
        multipliers = Multipliers(*box_and_rate, *parts[4:])
        return Solution(Status(status), ws.u.copy(), ws.x.copy(), multipliers, iterations)

    def _fitting_memory(
        self, horizon: int, n_rows: int, n_models: int, weighs_changes: bool
    ) -> tuple[Workspace, IntArray]:
        """The kept workspace and its words if the problem fits into it, else a larger one."""
        if self._memory is not None and len(self._memory[0].u) == horizon:
            ws = self._memory[0]
            fits = len(ws.spans) >= n_rows and len(ws.transposed) >= n_models
            if fits and (ws.rate.size > 0 or not weighs_changes):
                return self._memory
            n_rows, n_models = max(n_rows, len(ws.spans)), max(n_models, len(ws.transposed))
            weighs_changes = weighs_changes or ws.rate.size > 0
        ws = make_workspace(horizon, n_rows, n_models, weighs_changes)
        self._memory = ws, pack(ws)
        return self._memory

    def __getstate__(self) -> dict[str, Any]:
        """The options alone: a workspace is scratch memory."""
        return {"iteration_limit": self.iteration_limit, "_memory": None}
