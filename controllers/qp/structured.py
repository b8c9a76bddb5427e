"""The default solver: exact, structured, one compiled call, no tolerance to tune.

1. A Riccati pass gives the unconstrained optimum. If it satisfies every row it is the solution.
2. Otherwise the closed loop of the same recursion gives J with H^-1 = J J', the inverse factor of the
   condensed Hessian: J is the impulse response from whitened inputs to inputs, so neither H nor its Cholesky
   factor is ever formed. The dual active set (`active_set.py`) starts from there, or from a guess of the
   working set (`working_set.py`).
3. The gradient of the Lagrangian is evaluated, the plan refined if need be, and only what is stationary and
   within its rows is called optimal (`stationarity.py`).
4. Where that takes very many steps, inputs are made dear at first, and cheaper from one solve to the next.
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
from .active_set import ITERATION_LIMIT as OUT_OF_STEPS
from .inverse_factor import inverse_factor
from .ocp import IntArray, OcpQp, StateRows, rate_weight, validate, weight_of_changes
from .products import transpose
from .rate_weight import carve_rate, rate_pass, rate_plan
from .recursion import Feedback, Regulator, optimal_plan, riccati_pass
from .rows import ROW_TOLERANCE, ByteArray, RowData, row_slack, row_spans, worst_input_row, worst_row
from .solution import Multipliers, Solution, Status
from .stationarity import REFINED, STATIONARY, is_mild, lagrangian_gradient
from .working_set import correct, start_from_guess
from .workspace import Workspace, make_workspace

ITERATION_LIMIT = 0  # stands for a limit that grows with the problem, `step_limit`
_STEPS, _STEPS_PER_ROW = 2000, 20  # random problems with horizons up to 60 stay below
_ROW_ERROR = 1e-7  # largest violation of a state row that a refined solution may have, as `STATIONARY`
_REFINEMENTS = 3  # of the plan on one face
_ROUNDS = 3  # of active set and refinement, after which no command may be outside its rows
_DIRECT = 4  # one step in so many comes before inputs are made dear
_LEVELS, _LEVEL = (
    7,
    100.0,
)  # weights of dear inputs: R times 1e12 at first, each a hundredth of the one before


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
def _gaps(rows: RowData, q: int, ws: Workspace) -> tuple[float, float]:
    """How far working rows are from equality: those of inputs; those of states, over 1 + the largest input.

    States are those that were summed anew.
    """
    largest, of_inputs, of_states = 1.0, 0.0, 0.0
    for k in range(ws.u.shape[0]):
        for a in range(N_INPUT):
            largest = max(largest, 1.0 + abs(ws.u[k, a]))
    for i in range(q):
        gap = abs(row_slack(ws.active[i], ws.u, ws.states, rows))
        if ws.active[i] < 4 * ws.u.size:
            of_inputs = max(of_inputs, gap)
        else:
            of_states = max(of_states, gap)
    return of_inputs, of_states / largest


@kernel
def _dynamics(qp: OcpQp, ws: Workspace) -> Dynamics:
    """After `_recursion`."""
    return Dynamics(qp.A, qp.B, qp.c, ws.transposed[: qp.A.shape[0]])


@kernel
def _face(ws: Workspace) -> Face:
    return Face(ws.u, ws.x, ws.factors[0], ws.factors[1], ws.active, ws.state, ws.vectors)


@kernel
def _largest_step(q: int, ws: Workspace) -> float:
    """How far another refinement on the face would move an input."""
    d, z = ws.vectors[0], ws.vectors[1]
    project(ws.factors[0], ws.gradient, 0, ws.u.size, d)
    primal_direction(ws.factors[0], d, q, z)
    largest = 0.0
    for k in range(ws.u.size):
        largest = max(largest, abs(z[k]))
    return largest


@kernel
def _finish(qp: OcpQp, rows: RowData, q: int, stationary: float, ws: Workspace) -> int:
    """Multipliers, and OPTIMAL or INACCURATE for the face reached: refined where it is not stationary.

    Refinement on the face may carry an input over a row that is not working.
    """
    face, before = _face(ws), math.inf
    for attempt in range(1 + _REFINEMENTS):
        if attempt > 0:
            correct(rows, ws.gradient, face, q)
            roll_out(_dynamics(qp, ws), ws.u, ws.x)
        collect_multipliers(face, rows.weight, q, ws.multipliers)
        relative = _stationarity(qp, rows, ws)
        of_inputs, of_states = _gaps(rows, q, ws)
        if attempt == 0:
            if relative <= REFINED and max(of_inputs, of_states) <= ROW_TOLERANCE:
                return OPTIMAL
            continue
        _, slack = worst_row(ws.u, ws.x, rows, ws.state)
        ws.error[0], ws.error[1] = _largest_step(q, ws), max(of_inputs, max(of_states, -slack))
        if relative <= stationary and of_inputs <= ROW_TOLERANCE and ws.error[1] <= _ROW_ERROR:
            return OPTIMAL
        if not relative < 0.5 * before:
            break
        before = relative
    return INACCURATE


@kernel
def _solve_rows(
    qp: OcpQp, rows: RowData, own: bool, warm: bool, iterations: int, iteration_limit: int, ws: Workspace
) -> tuple[int, int]:
    """From the unconstrained optimum in ws, after `_factor`, to the constrained one; `warm`: by ws.guess.

    If both are not qp's `own`, but of other weights, the plan on the face that they lead to is refined to be
    qp's. From there the active set cannot go on.
    """
    model, face = _dynamics(qp, ws), _face(ws)
    n_rows = 4 * ws.u.size + 2 * rows.normal.shape[0]
    q = 0
    ws.error[0] = math.inf
    _clear(ws.state, n_rows)
    if warm:
        q, changes = start_from_guess(model, rows, ws.guess[:n_rows], face, ws.force)
        iterations += changes
    row, slack = worst_row(ws.u, ws.x, rows, ws.state)
    status, finished = OPTIMAL, OPTIMAL
    for _ in range(_ROUNDS if own else 1):
        status, iterations, q = dual_active_set(model, rows, face, row, slack, q, iterations, iteration_limit)
        if not (_all_finite(ws.u) and _all_finite(ws.x)):
            return NOT_FINITE, iterations
        finished = _finish(qp, rows, q, STATIONARY if own else REFINED, ws)
        row, slack = worst_input_row(ws.u, rows, ws.state)
        if status != OPTIMAL or row < 0:
            break
    if status != OPTIMAL:
        ws.error[0] = math.inf
        return status, iterations
    return (finished if row < 0 else INACCURATE), iterations


@kernel
def _with_dear_inputs(qp: OcpQp, factor: float, ws: Workspace) -> OcpQp:
    """The problem with `factor` times the weight of its inputs."""
    R = ws.dear[: qp.R.shape[0]]
    for i in range(R.shape[0]):
        for a in range(N_INPUT):
            for b in range(N_INPUT):
                R[i, a, b] = factor * qp.R[i, a, b]
    return OcpQp(
        qp.A, qp.B, qp.c, qp.Q, R, qp.Q_f, False, qp.x_0, qp.r, qp.lower, qp.upper, qp.rate_step, qp.u_last,
        qp.rows, qp.R_rate,
    )  # fmt: skip


@kernel
def solve_by_dear_inputs(
    qp: OcpQp, rows: RowData, iterations: int, iteration_limit: int, ws: Workspace
) -> tuple[int, int]:
    """By way of problems whose inputs are dearer, each from the working set of the one before.

    Dear inputs keep the unconstrained plan near its rows, and from one weight to the next few rows change.
    The face of each is tried for the problem itself, whose own matrices may be too ill-conditioned for that.
    """
    n_rows = 4 * ws.u.size + 2 * rows.normal.shape[0]
    status = INACCURATE
    for level in range(_LEVELS - 1, -1, -1):
        dear = _with_dear_inputs(qp, _LEVEL**level, ws)
        _recursion(dear, ws)
        _plan(dear, ws)
        if not (_all_finite(ws.u) and _all_finite(ws.x)):
            return NOT_FINITE, iterations
        _factor(dear, ws)
        warm = level < _LEVELS - 1
        status, iterations = _solve_rows(qp, rows, level == 0, warm, iterations, iteration_limit, ws)
        infeasible = status == INFEASIBLE and _has_hard_rows(rows)
        if infeasible or not (status == INACCURATE or status == INFEASIBLE):
            break
        _keep_as_guess(n_rows, ws)
    return status, iterations


@kernel
def _keep_as_guess(n_rows: int, ws: Workspace) -> None:
    """The next warm start begins from the states that rows have now."""
    for k in range(n_rows):
        ws.guess[k] = ws.state[k]


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


@kernel
def _require_fit(qp: OcpQp, ws: Workspace) -> None:
    if (
        ws.u.shape[0] != qp.c.shape[0]
        or ws.spans.shape[0] < max(qp.rows.normal.shape[0], qp.rows.normals.shape[0])
        or ws.transposed.shape[0] < qp.A.shape[0]
        or (ws.rate.size == 0 and weight_of_changes(qp).shape[0] > 0)
    ):
        raise ValueError(
            "the workspace does not fit the problem: make it with its horizon, rows, pairs and weights"
        )


@separate_kernel
def solve_qp(qp: OcpQp, iteration_limit: int, warm: bool, ws: Workspace) -> tuple[int, int]:
    """Solve one OCP-QP, whose R_rate is an array: (0, 4) where changes have no weight.

    Nothing is allocated and nothing is validated. Compiled loops may call it, with one workspace per thread.
    A warm start that ends without an optimum is done again cold, and a cold one that accuracy let down once
    more from the working set that it reached. Where no limit is asked for, a quarter of the steps goes into
    that; the others are for the way by dear inputs.

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
    _require_fit(qp, ws)
    N, K = qp.c.shape[0], qp.rows.normal.shape[0]
    n_rows = 4 * N_INPUT * N + 2 * K
    _clear(ws.multipliers, n_rows)
    _clear(ws.state, n_rows)
    _recursion(qp, ws)
    rows = _row_data(qp, ws)
    last = qp.u_last[0] + qp.u_last[1] + qp.u_last[2] + qp.u_last[3]
    finite = abs(last) < math.inf and _all_finite(qp.r)
    limit = step_limit(iteration_limit, N, K)
    direct = limit if iteration_limit > 0 else limit // _DIRECT
    status, iterations = NOT_FINITE, 0
    for attempt in range(3):
        _plan(qp, ws)
        if not (finite and _all_finite(ws.u) and _all_finite(ws.x)):
            return NOT_FINITE, iterations
        if attempt == 0 and _is_optimal(qp, rows, ws):
            return OPTIMAL, 0
        # A warm start gets half of the steps, so that a cold one is left.
        steps = (iterations + direct + 1) // 2 if warm and attempt == 0 else direct
        _factor(qp, ws)
        status, iterations = _solve_rows(qp, rows, True, warm, iterations, steps, ws)
        if status == OPTIMAL or iterations >= direct:
            break
        hard = status == INFEASIBLE and _has_hard_rows(rows)
        if hard or (attempt > 0 and warm):
            break
        warm = not (warm and attempt == 0)
        if warm:
            _keep_as_guess(n_rows, ws)
    if status == OUT_OF_STEPS and iterations < limit:
        status, iterations = solve_by_dear_inputs(qp, rows, iterations, limit, ws)
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
        iteration_limit: Largest number of active-set steps per problem; 0 for one that grows with it, three
            quarters of which are for the way by dear inputs.
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
