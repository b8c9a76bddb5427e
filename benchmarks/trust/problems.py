"""Random OCP-QPs of the families of `benchmarks.solver`, beside DAQP where it can solve them."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import count

import numpy as np

from controllers.qp import Status
from controllers.qp.ocp import condense, first_move_bounds
from quad_envs.parameters import Array

from ..condensed import solve_daqp
from ..solver import FAMILIES, Judged, is_soft, judge
from .found import Found

_AT_ONCE = len(FAMILIES) * 5
_RESIDUAL = 1e-6  # what the solver allows itself is 1e-8; the rest is for sums in another order
_DENSE = 15  # samples; the condensed matrix of more is not worth its round-off
_SCALED = ("plain", "hard rows", "no freedom", "rate 0", "starts outside", "parallel rows", "equality rows")
_ACCURATE = 1e-8
_DAQP = {"primal_tol": 1e-10, "dual_tol": 1e-10}
_OUTSIDE = 1e-9  # N, by which a command may leave its box


def problems(seed: int) -> Iterator[Found]:
    """Problems without end; the watched number is the largest difference from DAQP."""
    for k in count():
        for one in judge(_AT_ONCE, 1_000_003 * seed + k):
            wrong = _false(one)
            difference = 0.0
            if not wrong and one.family in _SCALED and len(one.qp.c) <= _DENSE:
                wrong, difference = _beside(one)
            yield Found(1, (f"{one.family}, N = {len(one.qp.c)}: {wrong}",) if wrong else (), difference)


def _false(one: Judged) -> str:
    """What is said of a problem and is not so."""
    solution, qp = one.solution, one.qp
    if solution.status == Status.INFEASIBLE:
        return "said to be infeasible, with soft rows alone" if is_soft(qp) else ""
    if solution.status not in (Status.OPTIMAL, Status.INACCURATE):
        return f"status {solution.status.name}"
    if solution.status == Status.INACCURATE:
        return ""
    if not (np.isfinite(solution.u).all() and np.isfinite(solution.x).all()):
        return "the solution is not finite"
    if one.stationarity >= _RESIDUAL or one.primal >= _RESIDUAL:
        return f"residuals {one.stationarity:.1e}, {one.primal:.1e}"
    low, high = np.minimum(qp.lower, qp.upper) - _OUTSIDE, qp.upper + _OUTSIDE
    first = first_move_bounds(qp)
    low, high = np.minimum(low, first[0]), np.maximum(high, first[1])
    return "" if ((solution.u >= low) & (solution.u <= high)).all() else "a command is outside its box"


def _beside(one: Judged) -> tuple[str, float]:
    """What DAQP says otherwise, and by how much the commands differ; nothing of problems with soft rows."""
    qp, solution = one.qp, one.solution
    if np.isfinite(qp.rows.weight).any():
        return "", 0.0
    theirs, _, flag, _ = solve_daqp(qp, **_DAQP)
    if solution.status == Status.INACCURATE or flag not in (1, -1):
        return "", 0.0
    if (flag == 1) != (solution.status == Status.OPTIMAL):
        return f"DAQP has flag {flag}, this solver status {solution.status.name}", 0.0
    if flag != 1:
        return "", 0.0
    H, g, _, _ = condense(qp)
    costs = [_cost(H, g, u.ravel()) for u in (solution.u, theirs)]
    difference = float(np.abs(solution.u - theirs).max() / (1.0 + np.abs(theirs).max()))
    dearer = (costs[0] - costs[1]) / (1.0 + abs(costs[1]))
    if difference > _ACCURATE and dearer > _ACCURATE:
        return f"differs from DAQP by {difference:.1e}, and is {dearer:.1e} dearer", difference
    return "", difference


def _cost(H: Array, g: Array, u: Array) -> float:
    return float(0.5 * u @ H @ u + g @ u)
