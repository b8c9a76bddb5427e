"""OSQP behind the common interface: one persistent sparse workspace, checked at both ends.

Variables z = [u_0, x_1, u_1, x_2, .., u_{N-1}, x_N, s]; s are the slacks of the soft rows. Rows: dynamics
12N, box 4N, rate 4N, state rows from below and from above, s >= 0. Blocks are stored full, zeros included,
so that new data fit the pattern of the first set-up and `update` suffices.

Five facts make the checks necessary. An `update` with crossing bounds is refused with a print and the old
data are solved. A vector of wrong length is accepted in silence. After "infeasible" the result is filled
with a large finite number: only the status tells. A set-up whose matrix rounding leaves without a factor
raises. An `update` with one prints, and leaves a workspace that solves nothing any more.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import osqp
import scipy.sparse as sparse

from quad_envs.arguments.checks import require_whole
from quad_envs.parameters import N_INPUT, N_STATE, Array

from .ocp import IntArray, OcpQp, first_move_bounds, validate
from .solution import MOST_ITERATIONS, Multipliers, Solution, Status, residuals

_SOLVED, _INACCURATE, _INFEASIBLE = 1, 2, (3, 4)
_NO_BOUND = 1e30  # OSQP's infinity
_INACCURATE_TOLERANCE = 1e-3  # residuals up to which "solved inaccurate" is accepted
_STAGE = N_INPUT + N_STATE


class _Pattern(NamedTuple):
    """A sparse matrix as coordinates in the order in which its values are produced."""

    row: IntArray
    column: IntArray
    shape: tuple[int, int]

    def compile(self, values: Array) -> tuple[Any, IntArray]:
        """The CSC matrix, and the order in which it stores the values."""
        order = np.lexsort((self.row, self.column))
        matrix = sparse.csc_matrix(self.shape)
        matrix.data = values[order]
        matrix.indices = self.row[order].astype(np.int32)
        counts = np.bincount(self.column, minlength=self.shape[1])
        matrix.indptr = np.concatenate([[0], np.cumsum(counts)]).astype(np.int32)
        return matrix, order


def _block(row: int, column: int, height: int, width: int) -> tuple[IntArray, IntArray]:
    rows, columns = np.indices((height, width))
    return (rows + row).ravel(), (columns + column).ravel()


def _diagonal(row: int, column: int, size: int) -> tuple[IntArray, IntArray]:
    k = np.arange(size)
    return row + k, column + k


def _join(parts: list[tuple[IntArray, IntArray]], shape: tuple[int, int]) -> _Pattern:
    rows, columns = zip(*parts, strict=True)
    return _Pattern(np.concatenate(rows), np.concatenate(columns), shape)


def _input(i: int) -> int:
    """Column of u_i."""
    return _STAGE * i


def _state(i: int) -> int:
    """Column of x_i, i = 1..N."""
    return _STAGE * (i - 1) + N_INPUT


def _constraint_pattern(N: int, stage: IntArray, soft: IntArray) -> _Pattern:
    """Coordinates of the constraint matrix; `_constraint_values` yields its values in the same order."""
    n, m, K, n_soft = N_STATE, N_INPUT, len(stage), len(soft)
    parts = [_diagonal(n * i, _state(i + 1), n) for i in range(N)]
    parts += [_block(n * i, _input(i), n, m) for i in range(N)]
    parts += [_block(n * i, _state(i), n, n) for i in range(1, N)]
    box, rate = n * N, (n + m) * N
    parts += [_diagonal(box + m * i, _input(i), m) for i in range(N)]
    parts += [_diagonal(rate + m * i, _input(i), m) for i in range(N)]
    parts += [_diagonal(rate + m * i, _input(i - 1), m) for i in range(1, N)]
    below = (n + 2 * m) * N
    above, slack, first = below + K, below + 2 * K, _STAGE * N
    k = np.arange(K)
    columns = (_STAGE * (stage - 1) + m)[:, None] + np.arange(n)
    parts += [(np.repeat(start + k, n), columns.ravel()) for start in (below, above)]
    # One slack serves both sides of a soft row, which cannot be violated at once.
    parts += [(start + soft, first + np.arange(n_soft)) for start in (below, above)]
    parts += [_diagonal(slack, first, n_soft)]
    return _join(parts, (slack + n_soft, first + n_soft))


def _constraint_values(qp: OcpQp, n_soft: int) -> Array:
    N, m = len(qp.c), N_INPUT
    A = np.broadcast_to(qp.A, (N, N_STATE, N_STATE))
    B = np.broadcast_to(qp.B, (N, N_STATE, m))
    normals = qp.rows.normals[qp.rows.normal].ravel()
    ones = np.ones(n_soft)
    return np.concatenate(
        [
            np.ones(N_STATE * N),
            -B.ravel(),
            -A[1:].ravel(),
            np.ones(2 * m * N),
            -np.ones(m * (N - 1)),
            normals,
            normals,
            ones,
            -ones,
            ones,
        ]
    )


def _cost_pattern(N: int, n_soft: int, weighs_changes: bool) -> _Pattern:
    """Upper triangle of blkdiag(R, Q_1, R, Q_2, .., R, Q_f, 0), and the blocks of u_i and u_{i+1}."""
    size = _STAGE * N + n_soft
    parts = []
    for i in range(N):
        for start, width in ((_input(i), N_INPUT), (_state(i + 1), N_STATE)):
            row, column = np.triu_indices(width)
            parts.append((row + start, column + start))
    if weighs_changes:
        parts += [_block(_input(i), _input(i + 1), N_INPUT, N_INPUT) for i in range(N - 1)]
    return _join(parts, (size, size))


def _state_weights(qp: OcpQp) -> Array:
    """Weights of x_1 .. x_N, (N, 12, 12)."""
    N = len(qp.c)
    Q = np.broadcast_to(qp.Q, (N, N_STATE, N_STATE))
    return np.concatenate([Q[1:], qp.Q_f[None]])


def _cost_values(qp: OcpQp) -> Array:
    R = np.broadcast_to(qp.R, (len(qp.c), N_INPUT, N_INPUT))
    W = _state_weights(qp)[(slice(None), *np.triu_indices(N_STATE))]
    inputs = R[(slice(None), *np.triu_indices(N_INPUT))]
    if qp.R_rate is None:
        return np.concatenate([inputs, W], axis=1).ravel()
    changes = np.r_[np.full(len(W) - 1, 2.0), 1.0]  # that u_i is part of
    inputs = inputs + changes[:, None] * qp.R_rate[np.triu_indices(N_INPUT)]
    between = np.tile(-qp.R_rate.ravel(), len(W) - 1)
    return np.concatenate([np.concatenate([inputs, W], axis=1).ravel(), between])


def _linear_cost(qp: OcpQp, soft: IntArray) -> Array:
    pull = -np.einsum("iab,ib->ia", _state_weights(qp), qp.r[1:])
    stages = np.concatenate([np.zeros((len(qp.c), N_INPUT)), pull], axis=1)
    if qp.R_rate is not None:
        stages[0, :N_INPUT] -= qp.R_rate @ qp.u_last
    return np.concatenate([stages.ravel(), qp.rows.weight[soft]])


def _bounds(qp: OcpQp, n_soft: int) -> tuple[Array, Array]:
    """Lower and upper bounds of all rows, infinity as OSQP writes it."""
    N, K = len(qp.c), len(qp.rows.normal)
    drift = qp.c.copy()
    drift[0] += qp.A[0] @ qp.x_0
    first_lower, first_upper = first_move_bounds(qp)
    steps = np.full(N_INPUT * (N - 1), qp.rate_step)
    none = np.full(K, np.inf)
    lower = [drift.ravel(), np.tile(qp.lower, N), first_lower, -steps, qp.rows.lower, -none, np.zeros(n_soft)]
    upper = [drift.ravel(), np.tile(qp.upper, N), first_upper, steps, none, qp.rows.upper, none[:n_soft]]
    return (
        np.clip(np.concatenate(lower), -_NO_BOUND, _NO_BOUND),
        np.clip(np.concatenate(upper), -_NO_BOUND, _NO_BOUND),
    )


class _Problem:
    """An OSQP object for one structure, and the orders in which it wants its data."""

    def __init__(self, qp: OcpQp, settings: dict[str, Any]) -> None:
        self.soft = np.flatnonzero(np.isfinite(qp.rows.weight))
        self.stage = qp.rows.stage.copy()
        N = len(qp.c)
        self.weighs_changes = qp.R_rate is not None
        cost = _cost_pattern(N, len(self.soft), self.weighs_changes)
        constraints = _constraint_pattern(N, self.stage, self.soft)
        P, self.cost_order = cost.compile(_cost_values(qp))
        A, self.constraint_order = constraints.compile(_constraint_values(qp, len(self.soft)))
        lower, upper = _bounds(qp, len(self.soft))
        self.solver = osqp.OSQP()
        self.solver.setup(P, _linear_cost(qp, self.soft), A, lower, upper, verbose=False, **settings)

    def fits(self, qp: OcpQp, horizon: int) -> bool:
        """Whether the new problem has the structure of this one."""
        return (
            len(qp.c) == horizon
            and (qp.R_rate is not None) == self.weighs_changes
            and np.array_equal(qp.rows.stage, self.stage)
            and np.array_equal(np.flatnonzero(np.isfinite(qp.rows.weight)), self.soft)
        )

    def update(self, qp: OcpQp) -> None:
        """New numbers into the old structure."""
        lower, upper = _bounds(qp, len(self.soft))
        q, cost = _linear_cost(qp, self.soft), _cost_values(qp)
        constraints = _constraint_values(qp, len(self.soft))
        assert len(cost) == len(self.cost_order)
        assert len(constraints) == len(self.constraint_order)
        assert (lower <= upper).all()
        self.solver.update(
            Px=cost[self.cost_order], Ax=constraints[self.constraint_order], q=q, l=lower, u=upper
        )


class OsqpSolver:
    """Backend over OSQP with a workspace and warm start that persist from solve to solve.

    Args:
        eps: Absolute and relative tolerance; 1e-5 gives inputs to 3e-4 N, OSQP's own 1e-3 to 0.1 N.
        max_iter: Iteration limit.
        polishing: Whether OSQP tries to solve the active rows exactly at the end.
        persistent: Whether the workspace serves the next solve too. If not, each result depends on its own
            problem alone; otherwise scaling, step size and start come from those before, within `eps`.
    """

    def __init__(
        self, eps: float = 1e-5, max_iter: int = 20000, polishing: bool = False, persistent: bool = True
    ) -> None:
        if not eps > 0.0:
            raise ValueError(f"eps must be > 0, got {eps}")
        require_whole("max_iter", max_iter, 1, MOST_ITERATIONS)
        self.settings: dict[str, Any] = {
            "eps_abs": eps,
            "eps_rel": eps,
            "max_iter": max_iter,
            "polishing": polishing,
        }
        self.persistent = persistent
        self._problem: _Problem | None = None
        self._horizon = 0

    def solve(self, qp: OcpQp) -> Solution:
        """Solve one problem.

        Raises:
            ValueError: If the problem is not well formed (`validate`).
        """
        validate(qp)
        kept, self._problem = self._problem, None  # kept again below: what has failed may stay wrong
        try:
            if kept is not None and kept.fits(qp, self._horizon):
                kept.update(qp)
                problem = kept
            else:
                problem = _Problem(qp, self.settings)
        except osqp.OSQPException:
            return _failed(qp, Status.INACCURATE, 0)
        solution = _read(qp, problem.solver.solve(raise_error=False))
        if self.persistent and solution.status == Status.OPTIMAL:
            self._problem, self._horizon = problem, len(qp.c)
        return solution

    def __getstate__(self) -> dict[str, Any]:
        """The settings alone: the OSQP object does not pickle and is built again on the first solve."""
        return {**self.__dict__, "_problem": None, "_horizon": 0}


def _read(qp: OcpQp, result: Any) -> Solution:
    """OSQP's result in the project's terms; its x means nothing unless the status says so."""
    N, K, n, m = len(qp.c), len(qp.rows.normal), N_STATE, N_INPUT
    code, iterations = int(result.info.status_val), int(result.info.iter)
    if code not in (_SOLVED, _INACCURATE):
        status = Status.INFEASIBLE if code in _INFEASIBLE else Status.ITERATION_LIMIT
        return _failed(qp, status, iterations)
    z, y = np.asarray(result.x), np.asarray(result.y)
    if not (np.isfinite(z).all() and np.isfinite(y).all()):
        return _failed(qp, Status.NOT_FINITE, iterations)
    stages = z[: _STAGE * N].reshape(N, _STAGE)
    edges = np.cumsum([n * N, m * N, m * N, K, K])
    _, box, rate, below, above, _ = np.split(y, edges)
    box, rate = box.reshape(N, m), rate.reshape(N, m)
    multipliers = Multipliers(*(np.maximum(side, 0.0) for side in (-box, box, -rate, rate, -below, above)))
    solution = Solution(
        Status.OPTIMAL, stages[:, :m].copy(), np.vstack([qp.x_0, stages[:, m:]]), multipliers, iterations
    )
    if code == _INACCURATE and max(residuals(qp, solution)) > _INACCURATE_TOLERANCE:
        return solution._replace(status=Status.ITERATION_LIMIT)
    return solution


def _failed(qp: OcpQp, status: Status, iterations: int) -> Solution:
    """A solution without numbers."""
    N, K = len(qp.c), len(qp.rows.normal)
    inputs = [np.full((N, N_INPUT), np.nan) for _ in range(5)]
    rows = [np.full(K, np.nan) for _ in range(2)]
    states = np.full((N + 1, N_STATE), np.nan)
    return Solution(status, inputs[0], states, Multipliers(*inputs[1:], *rows), iterations)
