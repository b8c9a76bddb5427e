"""What a solver returns, and the one yardstick by which every solver is judged."""

from __future__ import annotations

from enum import IntEnum
from typing import NamedTuple, Protocol

import numpy as np

from quad_envs.parameters import N_INPUT, Array

from .ocp import OcpQp, first_move_bounds

MOST_ITERATIONS = 10**9  # that a limit may allow; solvers count in 32 bits


class Status(IntEnum):
    """How a solve ended. Only OPTIMAL comes with a plan that may be flown."""

    OPTIMAL = 0
    INFEASIBLE = 1  # hard rows contradict each other
    ITERATION_LIMIT = 2
    NOT_FINITE = 3  # the data or the result hold NaN or infinity
    INACCURATE = 4  # round-off leaves a relative stationarity, or a row's relative violation, above 1e-6


class Multipliers(NamedTuple):
    """Multipliers of all rows, in [0, weight]: the gradient of the cost is the sum of lambda times normal."""

    box_lower: Array  # (N, 4), u >= lower
    box_upper: Array  # (N, 4), u <= upper
    rate_lower: Array  # (N, 4), u_i - u_{i-1} >= -rate_step
    rate_upper: Array  # (N, 4)
    row_lower: Array  # (K,)
    row_upper: Array  # (K,)


class Solution(NamedTuple):
    """Result of one solve. With a status other than OPTIMAL the plan is whatever was reached, or NaN."""

    status: Status
    u: Array  # (N, 4), inputs F - u_T, N
    x: Array  # (N+1, 12)
    multipliers: Multipliers
    iterations: int


class Residuals(NamedTuple):
    """How far a solution is from the optimality conditions; all zero at the optimum."""

    stationarity: (
        float  # gradient of the Lagrangian over 1 + (the cost's at u = 0 or the rows' pull), largest
    )
    primal: float  # largest violation of a hard row, and largest gap in the dynamics
    multiplier_bounds: float  # how far multipliers leave [0, weight], scaled as stationarity
    complementarity: float  # largest |lambda - clip(lambda - slack, 0, weight)|


class Backend(Protocol):
    """A solver of the OCP-QP."""

    def solve(self, qp: OcpQp) -> Solution:
        """Solve one problem; failure is a status, not an exception."""


def residuals(qp: OcpQp, solution: Solution) -> Residuals:
    """Optimality residuals, from the problem alone: no backend's own word is taken."""
    u, multipliers = solution.u, solution.multipliers
    states = _roll_out(qp, u)
    rows = qp.rows
    slacks = _slacks(qp, u, states)
    hard_inputs = np.full_like(u, np.inf)
    weights = (hard_inputs,) * 4 + (rows.weight,) * 2
    pull = multipliers.row_lower - multipliers.row_upper
    gradient = _gradient(qp, u, states, pull)
    no_pull = np.zeros_like(pull)
    pulled = float(np.abs(gradient - _gradient(qp, u, states, no_pull)).max())
    gradient -= multipliers.box_lower - multipliers.box_upper
    rate = multipliers.rate_lower - multipliers.rate_upper
    gradient -= rate
    gradient[:-1] += rate[1:]
    zero = np.zeros_like(u)
    scale = 1.0 + max(pulled, float(np.abs(_gradient(qp, zero, _roll_out(qp, zero), no_pull)).max()))
    primal = float(np.abs(solution.x - states).max())
    bounds = 0.0
    complementarity = 0.0
    for value, weight, slack in zip(multipliers, weights, slacks, strict=True):
        hard = np.isinf(weight)
        primal = max(primal, float(-slack[hard].min(initial=0.0)))
        bounds = max(bounds, float(-value.min(initial=0.0)), float((value - weight).max(initial=0.0)))
        natural = np.abs(value - np.clip(value - slack, 0.0, weight))
        complementarity = max(complementarity, float(natural.max(initial=0.0)))
    return Residuals(float(np.abs(gradient).max()) / scale, primal, bounds / scale, complementarity)


def _roll_out(qp: OcpQp, u: Array) -> Array:
    """States of the plan u, (N+1, 12)."""
    x = np.empty((len(u) + 1, len(qp.x_0)))
    x[0] = qp.x_0
    for i in range(len(u)):
        j = i if len(qp.A) > 1 else 0
        x[i + 1] = qp.A[j] @ x[i] + qp.B[j] @ u[i] + qp.c[i]
    return x


def _gradient(qp: OcpQp, u: Array, x: Array, pull: Array) -> Array:
    """Gradient in u of cost - sum_k pull_k h_k' x_{j_k}, by the adjoint recursion, (N, 4)."""
    N = len(u)
    force = np.zeros_like(x)
    np.add.at(force, qp.rows.stage, pull[:, None] * qp.rows.normals[qp.rows.normal])
    costate = qp.Q_f @ (x[N] - qp.r[N]) - force[N]
    gradient = np.empty((N, N_INPUT))
    for i in range(N - 1, -1, -1):
        j = i if len(qp.A) > 1 else 0
        gradient[i] = qp.R[i if len(qp.R) > 1 else 0] @ u[i] + qp.B[j].T @ costate
        if qp.R_rate is not None:
            gradient[i] += qp.R_rate @ (u[i] - (u[i - 1] if i else qp.u_last))
            if i + 1 < N:
                gradient[i] -= qp.R_rate @ (u[i + 1] - u[i])
        costate = qp.Q[i if len(qp.Q) > 1 else 0] @ (x[i] - qp.r[i]) + qp.A[j].T @ costate - force[i]
    return gradient


def _slacks(qp: OcpQp, u: Array, x: Array) -> Multipliers:
    """Distance to each bound, negative where it is violated, laid out as the multipliers."""
    first_lower, first_upper = first_move_bounds(qp)
    move = np.diff(u, axis=0)
    rows = qp.rows
    value = np.einsum("kn,kn->k", rows.normals[rows.normal], x[rows.stage])
    return Multipliers(
        box_lower=u - qp.lower,
        box_upper=qp.upper - u,
        rate_lower=np.vstack([u[:1] - first_lower, move + qp.rate_step]),
        rate_upper=np.vstack([first_upper - u[:1], qp.rate_step - move]),
        row_lower=value - rows.lower,
        row_upper=rows.upper - value,
    )
