"""The OCP-QP as a dense program in its inputs, and DAQP on it."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from controllers.qp.ocp import OcpQp, condense, first_move_bounds
from quad_envs.parameters import N_INPUT, Array

_NONE = 1e30  # DAQP's infinity


class DenseProgram(NamedTuple):
    """1/2 u'H u + g'u, the box's bounds first and then those of the rows A u; x_i = S_i u + f_i."""

    H: Array  # (4N, 4N)
    g: Array  # (4N,)
    A: Array  # (4N + K, 4N), changes of the inputs, then state rows
    lower: Array  # (8N + K,)
    upper: Array  # (8N + K,)
    S: Array  # (N+1, 12, 4N)
    f: Array  # (N+1, 12)


class DenseAnswer(NamedTuple):
    """What DAQP found."""

    u: Array  # (N, 4)
    x: Array  # (N+1, 12)
    flag: int  # 1: optimal, -1: infeasible
    iterations: int


def dense_program(qp: OcpQp) -> DenseProgram:
    """The states eliminated; all state rows are hard."""
    H, g, S, f = condense(qp)
    moves, rows = len(g), qp.rows
    first_lower, first_upper = first_move_bounds(qp)
    steps = np.full(moves - N_INPUT, qp.rate_step)
    normals = rows.normals[rows.normal]
    offset = np.einsum("kn,kn->k", normals, f[rows.stage])
    values = np.einsum("kn,knv->kv", normals, S[rows.stage])
    A = np.vstack([np.eye(moves) - np.eye(moves, k=-N_INPUT), values])
    lower = np.r_[np.tile(qp.lower, moves // N_INPUT), first_lower, -steps, rows.lower - offset]
    upper = np.r_[np.tile(qp.upper, moves // N_INPUT), first_upper, steps, rows.upper - offset]
    return DenseProgram(H, g, A, np.clip(lower, -_NONE, _NONE), np.clip(upper, -_NONE, _NONE), S, f)


def solve_daqp(qp: OcpQp, **tolerances: Any) -> DenseAnswer:
    """DAQP on the dense program; `primal_tol`, `dual_tol` and the like are its own options."""
    import daqp

    dense = dense_program(qp)
    sense = np.zeros(len(dense.lower), dtype=np.int32)
    u, _, flag, info = daqp.solve(dense.H, dense.g, dense.A, dense.upper, dense.lower, sense, **tolerances)
    u = u[: len(dense.g)]
    x = np.einsum("ijk,k->ij", dense.S, u) + dense.f
    return DenseAnswer(u.reshape(-1, N_INPUT), x, int(flag), int(info["iterations"]))
