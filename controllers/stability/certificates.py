"""Certificates of chapter 9: what of the stability theory of MPC can be computed, and how closely it holds.

With u = -K x near the goal, D = (A - B K)'Q_f (A - B K) - Q_f + Q + K'R K decides: where D <= 0, Eq. (9.6),
the optimal cost of the next sample is at most that of this one less the stage cost, Eqs. (9.7) to (9.10), as
long as model, limits and reference are those of the plan. Sets in which the limits stay inactive are in
`invariant.py`. None of this proves that a vehicle is stable whose matrices change from sample to sample.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import scipy.linalg
from numpy.typing import ArrayLike

from quad_envs.arguments.names import shown
from quad_envs.parameters import Array

from ..qp import Solution, Status, StructuredSolver
from ..qp.ocp import OcpQp

TOLERANCE = 1e-9  # of the largest entry of Q_f: rounding in its Riccati equation


class Decrease(NamedTuple):
    """The terminal inequality (9.6): whether D <= 0."""

    eigenvalues: Array  # (n,), of D, ascending
    tolerance: float  # up to which an eigenvalue counts as zero

    @property
    def margin(self) -> float:
        """Minus the largest eigenvalue of D; zero where Q_f and K solve one Riccati equation."""
        return -float(self.eigenvalues[-1])

    @property
    def holds(self) -> bool:
        """Whether D <= 0 but for rounding."""
        return self.margin >= -self.tolerance


class TerminalRows(NamedTuple):
    """What the terminal law leaves of the limits just behind the plan; negative: they are violated."""

    inputs: float  # N, smallest distance of -K (x_N - r_N) to the rotor limits, Eq. (9.17)
    outputs: float  # SI, smallest distance of the state after it to the state limits, Eq. (9.18); inf: none


def _matrix(name: str, value: ArrayLike, shape: tuple[int, int]) -> Array:
    array = np.asarray(value, dtype=np.float64)
    if array.shape != shape:
        raise ValueError(f"{name} must have shape {shape}, got {array.shape}")
    if not np.isfinite(array).all():
        raise ValueError(f"{name} must be finite, got {shown(array)}")
    return array


def _checked(
    A: ArrayLike, B: ArrayLike, K: ArrayLike, Q_f: ArrayLike, Q: ArrayLike, R: ArrayLike
) -> tuple[Array, ...]:
    """All matrices as finite arrays of matching shapes, the weights symmetric."""
    B = np.asarray(B, dtype=np.float64)
    if B.ndim != 2:
        raise ValueError(f"B must have shape (n, m), got {B.shape}")
    n, m = B.shape
    shapes = {"A": (n, n), "B": (n, m), "K": (m, n), "Q_f": (n, n), "Q": (n, n), "R": (m, m)}
    values = zip(shapes.items(), (A, B, K, Q_f, Q, R), strict=True)
    found = tuple(_matrix(name, value, shape) for (name, shape), value in values)
    for name, value in zip(("Q_f", "Q", "R"), found[3:], strict=True):
        if not np.allclose(value, value.T, rtol=1e-9, atol=1e-9 * float(np.abs(value).max())):
            raise ValueError(f"{name} must be symmetric; use ({name} + {name}.T) / 2")
    return found


def terminal_decrease(
    A: ArrayLike, B: ArrayLike, K: ArrayLike, Q_f: ArrayLike, Q: ArrayLike, R: ArrayLike
) -> Decrease:
    """Eigenvalues of D = (A - B K)'Q_f (A - B K) - Q_f + Q + K'R K, Eq. (9.6) = (9.28).

    Args:
        A: State matrix, (n, n).
        B: Input matrix, (n, m).
        K: Gain of the terminal law u = -K x, (m, n).
        Q_f: Terminal weight, (n, n).
        Q: State weight, (n, n).
        R: Input weight, (m, m).

    Raises:
        ValueError: If a shape is wrong, an entry is not finite, or a weight is not symmetric.
    """
    A, B, K, Q_f, Q, R = _checked(A, B, K, Q_f, Q, R)
    A_K = A - B @ K
    D = A_K.T @ Q_f @ A_K - Q_f + Q + K.T @ R @ K
    eigenvalues = np.asarray(np.linalg.eigvalsh(0.5 * (D + D.T)), dtype=np.float64)
    return Decrease(eigenvalues, TOLERANCE * float(np.abs(Q_f).max()))


def best_gain(A: ArrayLike, B: ArrayLike, Q_f: ArrayLike, R: ArrayLike) -> Array:
    """The K whose D is smallest, in the order of matrices: if not this one, none satisfies (9.6).

    D(K) = D(K*) + (K - K*)'(R + B'Q_f B)(K - K*) with K* = (R + B'Q_f B)^-1 B'Q_f A.

    Args:
        A: State matrix, (n, n).
        B: Input matrix, (n, m).
        Q_f: Terminal weight, (n, n).
        R: Input weight, (m, m).

    Returns:
        (m, n).
    """
    A, B, Q_f = (np.asarray(value, dtype=np.float64) for value in (A, B, Q_f))
    return np.asarray(np.linalg.solve(np.asarray(R) + B.T @ Q_f @ B, B.T @ Q_f @ A), dtype=np.float64)


def linear_matrix_inequality(
    A: ArrayLike, B: ArrayLike, K: ArrayLike, Q_f: ArrayLike, Q: ArrayLike, R: ArrayLike
) -> Array:
    """The matrix of Eq. (9.16), (2 n + n + m, same): positive semidefinite exactly where (9.6) holds.

    Deviation:
        The last zero and identity blocks are n x m and m x m, not n x n as printed.

    Args:
        A: State matrix, (n, n).
        B: Input matrix, (n, m).
        K: Gain of the terminal law u = -K x, (m, n).
        Q_f: Terminal weight, (n, n), positive definite.
        Q: State weight, (n, n), positive semidefinite.
        R: Input weight, (m, m), positive definite.

    Raises:
        ValueError: As `terminal_decrease`, or if Q_f is not positive definite.
    """
    A, B, K, Q_f, Q, R = _checked(A, B, K, Q_f, Q, R)
    n, m = B.shape
    smallest = float(np.linalg.eigvalsh(Q_f)[0])
    if smallest <= 0.0:
        raise ValueError(f"Q_f must be positive definite, its smallest eigenvalue is {smallest}")
    Y = np.linalg.inv(Q_f)
    Y = 0.5 * (Y + Y.T)
    left = np.vstack(
        [(A - B @ K) @ Y, np.real(scipy.linalg.sqrtm(Q)) @ Y, np.real(scipy.linalg.sqrtm(R)) @ K @ Y]
    )
    right = scipy.linalg.block_diag(Y, np.eye(n), np.eye(m))
    return np.block([[Y, left.T], [left, right]])


def solve_problem(qp: OcpQp, solver: StructuredSolver, *, hard: bool = False) -> Solution | None:
    """The plan of a problem, also of one of horizon zero; None where there is none.

    Args:
        qp: The problem; with horizon zero the plan is the present state alone.
        solver: Its workspace is used.
        hard: Whether soft state rows count as hard: the feasibility that Eqs. (9.15) and (9.27) ask for.
    """
    if len(qp.c) == 0:
        return Solution(Status.OPTIMAL, np.zeros((0, len(qp.lower))), qp.x_0[None].copy(), None, 0)  # type: ignore[arg-type]
    if hard:
        qp = qp._replace(rows=qp.rows._replace(weight=np.full(len(qp.rows.weight), np.inf)))
    solution = solver.solve(qp)
    return solution if solution.status == Status.OPTIMAL else None


def plan_cost(qp: OcpQp, u: Array, x: Array) -> float:
    """Cost of a plan, Eq. (9.1), without the factor 1/2: its optimum is the value function, gamma of (9.14).

    Args:
        qp: The problem.
        u: Inputs, (N, m).
        x: States, (N+1, n).
    """
    N = len(u)
    e = x - qp.r
    Q, R = (np.broadcast_to(weight, (N, *weight.shape[1:])) for weight in (qp.Q, qp.R))
    cost = np.einsum("ia,iab,ib", e[:N], Q, e[:N]) + np.einsum("ia,iab,ib", u, R, u) + e[N] @ qp.Q_f @ e[N]
    if qp.R_rate is not None:
        change = np.diff(u, axis=0, prepend=qp.u_last[None])
        cost += np.einsum("ia,ab,ib", change, qp.R_rate, change)
    rows = qp.rows
    if len(rows.weight):
        z = np.einsum("ka,ka->k", rows.normals[rows.normal], x[rows.stage])
        beyond = np.maximum(np.maximum(rows.lower - z, z - rows.upper), 0.0)
        soft = np.isfinite(rows.weight)
        cost += 2.0 * float(rows.weight[soft] @ beyond[soft])
    return float(cost)


def stage_cost(qp: OcpQp, u: Array) -> float:
    """|x_0 - r_0|_Q^2 + |u|_R^2 of the first sample of a problem."""
    e = qp.x_0 - qp.r[0]
    return float(e @ qp.Q[0] @ e + u @ qp.R[0] @ u)


def predicted_state(qp: OcpQp, u: Array) -> Array:
    """A_0 x_0 + B_0 u + c_0, (n,)."""
    x = qp.A[0] @ qp.x_0 + qp.B[0] @ u
    return np.asarray(x + qp.c[0] if len(qp.c) else x)


def terminal_rows(qp: OcpQp, x_N: Array, K: Array) -> TerminalRows:
    """Whether the terminal law keeps the limits at the first step behind the plan, Eqs. (9.17), (9.18).

    Deviation:
        The law is u = -K (x - r); the printed rows have the other sign, which matters where the box of the
        inputs is not symmetric. One step is no recursive feasibility: that takes an invariant set.

    Args:
        qp: The problem.
        x_N: Last state of its plan, (n,).
        K: Terminal gain, (m, n).
    """
    u = -K @ (x_N - qp.r[-1])
    inputs = float(np.minimum(u - qp.lower, qp.upper - u).min())
    rows = qp.rows
    last = rows.stage == len(qp.c)
    if not last.any():
        return TerminalRows(inputs, np.inf)
    x = qp.A[-1] @ x_N + qp.B[-1] @ u + qp.c[-1]
    z = rows.normals[rows.normal[last]] @ x
    return TerminalRows(inputs, float(np.minimum(z - rows.lower[last], rows.upper[last] - z).min()))
