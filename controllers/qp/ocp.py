"""The OCP-QP as data: the one quadratic program that every MPC of the project solves.

With u = F - u_T, over u_0 .. u_{N-1} and with x_0 given:

    minimise    1/2 [ sum_{i<N} |x_i - r_i|^2_Q_i + |u_i|^2_R_i + |u_i - u_{i-1}|^2_S  +  |x_N - r_N|^2_Qf ]
                + sum_k weight_k s_k
    subject to  x_{i+1} = A_i x_i + B_i u_i + c_i
                lower <= u_i <= upper
                |u_i - u_{i-1}| <= rate_step,  u_{-1} = u_last
                lower_k - s_k <= h_k' x_{j_k} <= upper_k + s_k,  s_k >= 0  (0 where weight_k is infinite)

Controllers differ in how they make (A_i, B_i, c_i); solvers (`solvers/`) take the result. The input part is
always feasible: if the box moved away from u_last, the first rate step reaches at least its nearest face.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from quad_envs.arguments.names import shown
from quad_envs.compilation.decorators import kernel
from quad_envs.parameters import N_INPUT, N_STATE, Array

IntArray = NDArray[np.int64]


class StateRows(NamedTuple):
    """Two-sided rows lower_k <= h_k' x_{stage_k} <= upper_k, where h_k = normals[normal_k]."""

    normals: Array  # (H, 12), distinct normals; H <= K
    normal: IntArray  # (K,), index into normals
    stage: IntArray  # (K,), 1..N
    lower: Array  # (K,), -inf for none
    upper: Array  # (K,), inf for none
    weight: Array  # (K,), exact L1 penalty per unit of the row; inf: the row is hard


class OcpQp(NamedTuple):
    """The problem over a horizon N, equations in the module docstring. Arrays are C-contiguous float64."""

    A: Array  # (1 or N, 12, 12)
    B: Array  # (1 or N, 12, 4)
    c: Array  # (N, 12)
    Q: Array  # (1 or N, 12, 12), stages 0..N-1
    R: Array  # (1 or N, 4, 4); N of them beside R_rate want N pairs and N weights of the state, too
    Q_f: Array  # (12, 12)
    stationary: bool  # Q_f solves the DARE of the single (A, B) and Q: one gain serves all without R_rate
    x_0: Array  # (12,)
    r: Array  # (N+1, 12)
    lower: Array  # (4,), N
    upper: Array  # (4,), N
    rate_step: float  # N per sample, inf for no limit
    u_last: Array  # (4,), N, the last applied input
    rows: StateRows
    R_rate: Array | None = None  # (4, 4), S of the changes u_i - u_{i-1}, u_{-1} = u_last; None: none


class Condensed(NamedTuple):
    """The problem in the inputs alone: 1/2 u'H u + g'u, x_i = S_i u + f_i."""

    H: Array  # (4N, 4N)
    g: Array  # (4N,)
    S: Array  # (N+1, 12, 4N)
    f: Array  # (N+1, 12)


def no_rows() -> StateRows:
    """No state rows."""
    return StateRows(
        normals=np.zeros((0, N_STATE)),
        normal=np.zeros(0, dtype=np.int64),
        stage=np.zeros(0, dtype=np.int64),
        lower=np.zeros(0),
        upper=np.zeros(0),
        weight=np.zeros(0),
    )


def output_rows(normals: Array, lower: Array, upper: Array, weight: Array | float, horizon: int) -> StateRows:
    """The same two-sided limits on outputs z = normals x at every stage 1..N, Eq. (3.10).

    Args:
        normals: Output matrix, (H, 12).
        lower: Lower limits, (H,), -inf for none.
        upper: Upper limits, (H,), inf for none.
        weight: Penalty per unit of output, (H,) or one number; inf makes a row hard.
        horizon: N.

    Returns:
        K = H N rows, stage by stage.

    Raises:
        ValueError: If the shapes do not match.
    """
    normals = np.ascontiguousarray(normals, dtype=np.float64)
    if normals.ndim != 2 or normals.shape[1] != N_STATE:
        raise ValueError(f"normals must have shape (H, {N_STATE}), one row per output, got {normals.shape}")
    H = normals.shape[0]
    columns = []
    for name, value in (("lower", lower), ("upper", upper), ("weight", weight)):
        column = np.asarray(value, dtype=np.float64)
        if column.shape not in ((H,), ()):
            raise ValueError(f"{name} must have one entry per row of normals, ({H},), got {column.shape}")
        columns.append(np.tile(np.broadcast_to(column, (H,)), horizon))
    return StateRows(
        normals=normals,
        normal=np.tile(np.arange(H, dtype=np.int64), horizon),
        stage=np.repeat(np.arange(1, horizon + 1, dtype=np.int64), H),
        lower=columns[0],
        upper=columns[1],
        weight=columns[2],
    )


def concatenate_rows(*rows: StateRows) -> StateRows:
    """All rows of the arguments, in order."""
    if not rows:
        return no_rows()
    offsets = np.cumsum([0, *(len(part.normals) for part in rows[:-1])])
    return StateRows(
        normals=np.concatenate([part.normals for part in rows]),
        normal=np.concatenate([part.normal + offset for part, offset in zip(rows, offsets, strict=True)]),
        stage=np.concatenate([part.stage for part in rows]),
        lower=np.concatenate([part.lower for part in rows]),
        upper=np.concatenate([part.upper for part in rows]),
        weight=np.concatenate([part.weight for part in rows]),
    )


def first_move_bounds(qp: OcpQp) -> tuple[Array, Array]:
    """Bounds of the rate rows on u_0: u_last -+ rate_step, widened to the box if that moved away."""
    return (
        np.minimum(qp.u_last - qp.rate_step, qp.upper),
        np.maximum(qp.u_last + qp.rate_step, qp.lower),
    )


def rate_weight(qp: OcpQp) -> Array:
    """`qp.R_rate` as compiled code takes it: (0, 4) for none."""
    return np.zeros((0, N_INPUT)) if qp.R_rate is None else qp.R_rate


@kernel
def weight_of_changes(qp: OcpQp) -> Array:
    """R_rate of a problem in compiled code, where it is an array: (0, 4) where changes have no weight."""
    return qp.R_rate  # type: ignore[return-value]


def condense(qp: OcpQp) -> Condensed:
    """Eliminate the states: S_{i+1} = A_i S_i + [0 .. B_i .. 0], f_{i+1} = A_i f_i + c_i, f_0 = x_0.

    For dense backends and tests; the structured solver never forms H.
    """
    N = len(qp.c)
    nv = N_INPUT * N
    S = np.zeros((N + 1, N_STATE, nv))
    f = np.empty((N + 1, N_STATE))
    f[0] = qp.x_0
    for i in range(N):
        j = i if len(qp.A) > 1 else 0
        S[i + 1] = qp.A[j] @ S[i]
        S[i + 1, :, N_INPUT * i : N_INPUT * (i + 1)] += qp.B[j]
        f[i + 1] = qp.A[j] @ f[i] + qp.c[i]
    H, g = np.zeros((nv, nv)), np.zeros(nv)
    for i, R in enumerate(np.broadcast_to(qp.R, (N, N_INPUT, N_INPUT))):
        H[N_INPUT * i : N_INPUT * (i + 1), N_INPUT * i : N_INPUT * (i + 1)] = R
    if qp.R_rate is not None:
        change = np.eye(N) - np.eye(N, k=-1)
        H += np.kron(change.T @ change, qp.R_rate)
        g[:N_INPUT] -= qp.R_rate @ qp.u_last
    for i in range(1, N + 1):
        W = qp.Q_f if i == N else qp.Q[i if len(qp.Q) > 1 else 0]
        H += S[i].T @ W @ S[i]
        g += S[i].T @ W @ (f[i] - qp.r[i])
    return Condensed(H, g, S, f)


def _require_array(
    name: str, value: Array, shapes: tuple[tuple[int, ...], ...], infinite: bool = False
) -> None:
    """Shape, type, layout, and no NaN (nor infinity, unless that means "no limit")."""
    if not isinstance(value, np.ndarray) or value.dtype != np.float64:
        kind = value.dtype if isinstance(value, np.ndarray) else type(value).__name__
        raise ValueError(f"{name} must be a float64 array, got {kind}; use np.asarray(value, dtype=float)")
    if value.shape not in shapes:
        raise ValueError(f"{name} must have shape {' or '.join(map(str, shapes))}, got {value.shape}")
    if not value.flags.c_contiguous:
        raise ValueError(f"{name} must be C-contiguous, use np.ascontiguousarray; strides {value.strides}")
    bad = np.isnan(value) if infinite else ~np.isfinite(value)
    if bad.any():
        where = tuple(int(k) for k in np.argwhere(bad)[0])
        allowed = "free of NaN" if infinite else "finite"
        raise ValueError(f"{name} must be {allowed}, got {value[where]} at {where}")


def _require_ordered(name: str, lower: Array, upper: Array) -> None:
    if (lower > upper).any():
        k = int(np.argmax(lower > upper))
        raise ValueError(
            f"{name} needs lower <= upper, got [{lower[k]}, {upper[k]}] at {k}; exchange or widen the limits"
        )
    if (lower == np.inf).any() or (upper == -np.inf).any():
        raise ValueError(f"{name} needs lower < inf and upper > -inf; got {lower} and {upper}")


def _require_symmetric(name: str, value: Array) -> None:
    transposed = np.swapaxes(value, -1, -2)
    if (np.abs(value - transposed) > 1e-9 * np.abs(value).max(initial=0.0)).any():
        raise ValueError(f"{name} must be symmetric; use ({name} + {name}.T) / 2")


def _require_indices(name: str, value: IntArray, count: int, low: int, high: int) -> None:
    if not isinstance(value, np.ndarray) or value.dtype != np.int64 or value.shape != (count,):
        raise ValueError(f"{name} must be int64 of shape ({count},), one entry per row, got {shown(value)}")
    if not value.flags.c_contiguous:
        raise ValueError(f"{name} must be C-contiguous, use np.ascontiguousarray")
    if count and (value.min() < low or value.max() > high):
        raise ValueError(f"{name} must lie in {low}..{high}, got {value.min()}..{value.max()}")


def _validate_rows(rows: StateRows, horizon: int) -> None:
    K = len(rows.lower)
    H = len(rows.normals)
    _require_array("rows.normals", rows.normals, ((H, N_STATE),))
    if H > K:
        raise ValueError(f"rows.normals has {H} normals for {K} rows; remove those that no row uses")
    _require_indices("rows.normal", rows.normal, K, 0, H - 1)
    _require_indices("rows.stage", rows.stage, K, 1, horizon)
    _require_array("rows.lower", rows.lower, ((K,),), infinite=True)
    _require_array("rows.upper", rows.upper, ((K,),), infinite=True)
    _require_array("rows.weight", rows.weight, ((K,),), infinite=True)
    _require_ordered("state row", rows.lower, rows.upper)
    if (rows.weight < 0.0).any():
        raise ValueError(f"rows.weight must be >= 0 (inf for a hard row), got {rows.weight.min()}")


def validate(qp: OcpQp) -> None:
    """Check everything a solver relies on, except that Q, Q_f and R_rate are positive semidefinite.

    Raises:
        ValueError: If a shape, type or layout is wrong, a number is not finite where it must be, bounds
            cross, an index is out of range, a weight is not symmetric, R is not positive definite,
            `stationary` is claimed with more than one pair or weight, or R_rate stands beside an R of each
            stage without a pair and Q of each stage.
    """
    N = len(qp.c)
    if N < 1:
        raise ValueError(f"the horizon must be at least 1 sample, c has shape {qp.c.shape}")
    n, m = N_STATE, N_INPUT
    _require_array("A", qp.A, ((1, n, n), (N, n, n)))
    _require_array("B", qp.B, ((len(qp.A), n, m),))
    _require_array("c", qp.c, ((N, n),))
    _require_array("Q", qp.Q, ((1, n, n), (N, n, n)))
    _require_array("R", qp.R, ((1, m, m), (N, m, m)))
    _require_array("Q_f", qp.Q_f, ((n, n),))
    _require_array("x_0", qp.x_0, ((n,),))
    _require_array("r", qp.r, ((N + 1, n),))
    _require_array("lower", qp.lower, ((m,),), infinite=True)
    _require_array("upper", qp.upper, ((m,),), infinite=True)
    _require_array("u_last", qp.u_last, ((m,),))
    _require_ordered("input box", qp.lower, qp.upper)
    if qp.R_rate is not None:
        _require_array("R_rate", qp.R_rate, ((m, m),))
        _require_symmetric("R_rate", qp.R_rate)
    for name in ("Q", "R", "Q_f"):
        _require_symmetric(name, getattr(qp, name))
    smallest = float(np.linalg.eigvalsh(qp.R).min())
    if smallest <= 0.0:
        raise ValueError(f"R must be positive definite, its smallest eigenvalue is {smallest}; raise it")
    if math.isnan(qp.rate_step) or qp.rate_step < 0.0:
        raise ValueError(f"rate_step must be >= 0 N per sample (inf for no limit), got {qp.rate_step}")
    weights = f"{len(qp.A)} pairs, {len(qp.Q)} Q and {len(qp.R)} R"
    if qp.stationary and max(len(qp.A), len(qp.Q), len(qp.R)) > 1:
        raise ValueError(f"stationary needs one pair (A, B), one Q and one R, got {weights}: set it to False")
    if qp.R_rate is not None and len(qp.R) > 1 and not len(qp.A) == len(qp.Q) == N:
        raise ValueError(f"R_rate and R of each stage need A, B and Q of each stage, got {weights}")
    _validate_rows(qp.rows, N)
