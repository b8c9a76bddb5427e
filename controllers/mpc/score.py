"""An MPC that plans for the score: stage weights of a majorising tangent, and the control of its steps.

A step earns 1 / (1 + l) and so loses f(l) = l / (1 + l) of the score. f is concave: its tangent at the guess,
of slope w = 1 / (1 + l)^2, lies above it, and the quadratic program with the stages weighed by w_i minimises
a bound of what the plan loses (iteratively reweighted least squares, majorise and minimise).
"""

from __future__ import annotations

from quad_envs.compilation.decorators import kernel
from quad_envs.parameters import N_INPUT, N_STATE, Array

from ..qp.linalg import copy
from .kernels import MpcData, Scratch
from .residual import stage_residual

COST_FLOOR = 1.0  # of the weights: all are equal, which is the quadratic cost
# By how much of the score, per stage, a plan may be predicted to lose more than a guess of another state.
# Gusts, and the shift by a sample, do less to a guess.
ALLOWED = 0.05
# Entries of `Scratch.weighing`.
_FLOOR = 0  # least weight of a stage over the largest one
_SOFT = 1  # factor that the weights of the rows have now


@kernel
def stage_loss(e: Array, u: Array, data: MpcData) -> float:
    """The stage cost l = |e|_Q^2 + |u|_R^2 of an error (12,) and an input (4,)."""
    Q, R, total = data.Q[0], data.R, 0.0
    for a in range(N_STATE):
        row = 0.0
        for b in range(N_STATE):
            row += Q[a, b] * e[b]
        total += e[a] * row
    for a in range(N_INPUT):
        row = 0.0
        for b in range(N_INPUT):
            row += R[a, b] * u[b]
        total += u[a] * row
    return total


@kernel
def score_loss(loss: float) -> float:
    """f(l) = l / (1 + l), what a step of stage cost l loses of the score."""
    return loss / (1.0 + loss)


@kernel
def tangent_weight(loss: float) -> float:
    """f'(l) = 1 / (1 + l)^2."""
    return 1.0 / ((1.0 + loss) * (1.0 + loss))


@kernel
def predicted_loss(inertial: bool, data: MpcData, s: Scratch, x: Array, u: Array) -> float:
    """What a plan (N+1, 12), (N, 4) is predicted to lose of the score, summed over its stages."""
    D, e = s.square[9, 2:8, :3], s.square[9, 8]
    total = 0.0
    for i in range(u.shape[0]):
        stage_residual(inertial, data.heading, x[i + 1], s.r[i + 1], e, D)
        total += score_loss(stage_loss(e, u[i], data))
    return total


@kernel
def _scale(factor: float, M: Array) -> None:
    for a in range(M.shape[0]):
        for b in range(M.shape[1]):
            M[a, b] *= factor


@kernel
def weigh_stages(data: MpcData, s: Scratch) -> None:
    """Weigh the stages of a problem made by `exact.linearise_cost` with the slopes of f at the guess.

    The solver has one R for all stages, and that keeps the weight of the first one: the others have theirs
    over that. x_N has that of its stage. No weight is less than the floor times the largest one; a floor of 1
    leaves the quadratic cost. Soft rows keep their weight over the heaviest stage.
    """
    N, floor = s.loss.shape[0], s.weighing[_FLOOR]
    soft = 1.0
    if floor < COST_FLOOR:
        heaviest = 0.0
        for i in range(N):
            heaviest = max(heaviest, tangent_weight(s.loss[i]))
        least = floor * heaviest
        first = max(tangent_weight(s.loss[0]), least)
        for i in range(1, N):
            _scale(max(tangent_weight(s.loss[i - 1]), least) / first, s.Q[i])
        _scale(max(tangent_weight(s.loss[N - 1]), least) / first, s.P)
        soft = heaviest / first
    if soft != s.weighing[_SOFT]:
        for k in range(s.weight.shape[0]):
            s.weight[k] *= soft / s.weighing[_SOFT]
        s.weighing[_SOFT] = soft


@kernel
def begin_weighing(floor: float, s: Scratch) -> None:
    """The floor of the first pass of a decision, whose rows have the weights of the task."""
    s.weighing[_FLOOR], s.weighing[_SOFT] = floor, 1.0


@kernel
def set_floor(floor: float, s: Scratch) -> None:
    """The floor of the next pass."""
    s.weighing[_FLOOR] = floor


@kernel
def loses_more(allowed: float, inertial: bool, data: MpcData, s: Scratch, x: Array, u: Array) -> bool:
    """Whether a plan made with weights of the score is predicted to lose `allowed` more than its guess."""
    if s.weighing[_FLOOR] >= COST_FLOOR:
        return False
    before = allowed * s.loss.shape[0]
    for i in range(s.loss.shape[0]):
        before += score_loss(s.loss[i])
    return bool(predicted_loss(inertial, data, s, x, u) > before)


@kernel
def restore_guess(s: Scratch, u: Array, x: Array) -> None:
    """The guess as the plan, again."""
    copy(s.X, x)
    for i in range(u.shape[0]):
        for a in range(N_INPUT):
            u[i, a] = s.F[i, a] - s.offset[a]
