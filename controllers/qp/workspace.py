"""The memory of the structured solver, made once for a horizon and used for every problem of it."""

from __future__ import annotations

from typing import Annotated, NamedTuple

import numpy as np

from quad_envs.parameters import N_INPUT, N_STATE, Array

from .active_set import N_VECTORS
from .ocp import IntArray
from .rate_weight import rate_size
from .recursion import RECURSION_SCRATCH
from .rows import ByteArray


class Workspace(NamedTuple):
    """Memory of `solve_qp` for one horizon; the first three fields hold its results."""

    u: Annotated[Array, "N, 4"]
    x: Annotated[Array, "N+1, 12"]
    multipliers: Annotated[Array, "16N + 2K"]  # lower, upper of box, of rate, of rows
    transposed: Annotated[Array, "1 or N, 16, 12"]  # [A_i B_i]'
    K: Annotated[Array, "N, 4, 12"]  # gains
    D: Annotated[Array, "N, 4, 4"]  # inverse Cholesky factors
    P_c: Annotated[Array, "N, 12"]
    first_move: Annotated[Array, "2, 4"]  # bounds on u_0
    scratch: Annotated[Array, "RECURSION_SCRATCH, 12, 12"]
    wide: Annotated[Array, "2, 12, 4N"]
    factors: Annotated[Array, "2, 4N, 4N"]  # J and R, by columns
    vectors: Annotated[Array, "N_VECTORS, 4N + 12"]
    gradient: Annotated[Array, "4N"]  # of the Lagrangian
    force: Annotated[Array, "N+1, 12"]
    states: Annotated[Array, "N+1, 12"]
    active: Annotated[IntArray, "4N + 1"]
    spans: Annotated[IntArray, "K, 2"]
    state: Annotated[ByteArray, "16N + 2K"]  # of every row at the end
    guess: Annotated[ByteArray, "16N + 2K"]  # of every row, to start from
    error: Annotated[Array, "2"]  # left after refinement: how far another would move an input; gaps of rows
    dear: Annotated[Array, "N, 4, 4"]  # another weight of the inputs
    rate: Annotated[Array, "numbers"]  # of a weight on changes, see `carve_rate`; may be empty


def make_workspace(horizon: int, n_rows: int, n_models: int, weighs_changes: bool = False) -> Workspace:
    """Memory for `solve_qp`.

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
        P_c=np.zeros((N, n)),
        first_move=np.zeros((2, m)),
        scratch=np.zeros((RECURSION_SCRATCH, n, n)),
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
        dear=np.zeros((N, m, m)),
        rate=np.zeros(rate_size(N, n_models) if weighs_changes else 0),
    )
