"""An MPC that plans for the score on a model that is linear along its plan, as of `lmpc.py` and `sdc.py`.

Weights and step control are those of `score.py`. The guess is the previous plan's inputs, shifted by a sample
and flown from the present state by the model of the pass.
"""

from __future__ import annotations

from quad_envs.compilation.decorators import kernel
from quad_envs.parameters import N_INPUT, N_STATE, Array

from ..fallback import NONE, RELAXED
from ..qp.linalg import copy
from ..qp.workspace import Workspace
from .kernels import MpcData, Scratch, copy_vector, solve_within_model
from .score import ALLOWED, COST_FLOOR, guess_loss, score_loss, set_floor, stage_loss, weigh_stages

_KEPT = 0  # entry of s.square where the terminal weight of the cost waits while stages are weighed


@kernel
def begin_guess(floor: float, memory: Array, s: Scratch) -> None:
    """The guess of the first pass; only about a previous plan are there weights of the score."""
    held = memory[0] > 0.0
    set_floor(floor if held else COST_FLOOR, s)
    for i in range(s.F.shape[0] if held else 0):
        for a in range(N_INPUT):
            s.F[i, a] = memory[1 + N_INPUT * min(i + 1, s.F.shape[0] - 1) + a]


@kernel
def guess_plan(floor: float, u: Array, s: Scratch) -> None:
    """The plan of the pass before, (N, 4), as the guess of the next one."""
    set_floor(floor, s)
    for i in range(s.F.shape[0]):
        for a in range(N_INPUT):
            s.F[i, a] = s.offset[a] + u[i, a]


@kernel
def stage_loss_of(x: Array, r: Array, u: Array, data: MpcData, e: Array) -> float:
    """The stage cost l of a state (12,), its reference and an input (4,); e (12,) is overwritten."""
    for a in range(N_STATE):
        e[a] = x[a] - r[a]
    return stage_loss(e, u, data)


@kernel
def lose_along_guess(A: Array, B: Array, data: MpcData, s: Scratch) -> None:
    """Stage costs of the guess in s.F, flown from x_0 by the pairs (1 or N, 12, 12) and s.c, into s.loss."""
    x, x_next, e, u = s.square[9, 0], s.square[9, 1], s.square[9, 2], s.square[9, 3, :N_INPUT]
    copy_vector(s.x_0, x)
    for i in range(s.F.shape[0]):
        j = i if A.shape[0] > 1 else 0
        for a in range(N_INPUT):
            u[a] = s.F[i, a] - s.offset[a]
        for a in range(N_STATE):
            total = s.c[i, a]
            for b in range(N_STATE):
                total += A[j, a, b] * x[b]
            for b in range(N_INPUT):
                total += B[j, a, b] * u[b]
            x_next[a] = total
        copy_vector(x_next, x)
        s.loss[i] = stage_loss_of(x, s.r[i + 1], u, data, e)


@kernel
def weigh_about_guess(A: Array, B: Array, P: Array, data: MpcData, s: Scratch) -> None:
    """Weights of the score about the guess, into s.Q, s.R and s.P; `refuses_plan` takes s.P back.

    Args:
        A: (1 or N, 12, 12).
        B: (1 or N, 12, 4).
        P: Terminal weight of the cost, (12, 12); may be s.P.
        data: Of the controller.
        s: x_0, offset, c, r, F and floor are read.
    """
    lose_along_guess(A, B, data, s)
    copy(P, s.square[_KEPT])
    copy(P, s.P)
    for i in range(s.Q.shape[0]):
        copy(data.Q[0], s.Q[i])
    weigh_stages(data, s)


@kernel
def refuses_plan(data: MpcData, s: Scratch, x: Array, u: Array) -> bool:
    """Whether a plan made with weights of the score is predicted to lose more than its guess.

    Then the weights of the cost are next. s.P is again that of the cost, whatever the answer.
    """
    copy(s.square[_KEPT], s.P)
    total, e = 0.0, s.square[9, 2]
    for i in range(u.shape[0]):
        total += score_loss(stage_loss_of(x[i + 1], s.r[i + 1], u[i], data, e))
    if total > ALLOWED * u.shape[0] + guess_loss(s):
        set_floor(COST_FLOOR, s)
        return True
    return False


@kernel
def solve_for_objective(
    A: Array, B: Array, P: Array, stationary: bool, has_plan: bool, data: MpcData, s: Scratch, ws: Workspace
) -> tuple[int, int]:
    """`solve_within_model` for what s.floor says: the cost, or the score about the guess in s.F.

    A plan for the score that the step control refuses is made for the cost instead.

    Returns:
        Fallback, the worst of its solves, and their active-set iterations.
    """
    weighed = s.floor[0] < COST_FLOOR
    if weighed:
        weigh_about_guess(A, B, P, data, s)
    worst, iterations = NONE, 0
    while True:
        Q, R, Q_f = data.Q, data.R, P
        if weighed:
            Q, R, Q_f = s.Q, s.R, s.P
        level, count = solve_within_model(
            A, B, Q, R, Q_f, stationary and not weighed, s.r, has_plan, data, s, ws
        )
        worst, iterations = max(worst, level), iterations + count
        if not weighed or level > RELAXED or not refuses_plan(data, s, ws.x, ws.u):
            return worst, iterations
        weighed = False
