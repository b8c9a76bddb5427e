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
_LIGHTEST = 1e-300  # where all stage costs of a guess are too large for their slopes


@kernel
def stage_loss(e: Array, u: Array, data: MpcData) -> float:
    """The stage cost l = |e|_Q^2 + |u|_R^2 of an error (12,) and an input (4,)."""
    Q, R, total = data.Q[0], data.R[0], 0.0
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

    Only ratios of weights matter, so that the heaviest stage has 1 and soft rows keep their weight beside it.
    No weight is less than the floor; a floor of 1 leaves the quadratic cost. x_N has that of its stage.
    """
    N, floor = s.loss.shape[0], s.floor[0]
    heaviest = _LIGHTEST
    for i in range(N):
        heaviest = max(heaviest, tangent_weight(s.loss[i]))
    for i in range(N):
        copy(data.R[0], s.R[i])
        if floor < COST_FLOOR:
            weight = max(tangent_weight(s.loss[i]) / heaviest, floor)
            _scale(weight, s.R[i])
            _scale(weight, s.Q[i + 1] if i + 1 < N else s.P)


@kernel
def set_floor(floor: float, s: Scratch) -> None:
    """The floor of the next pass of a decision."""
    s.floor[0] = floor


@kernel
def guess_loss(s: Scratch) -> float:
    """What the guess is predicted to lose of the score, summed over its stages."""
    total = 0.0
    for i in range(s.loss.shape[0]):
        total += score_loss(s.loss[i])
    return total


@kernel
def loses_more(allowed: float, inertial: bool, data: MpcData, s: Scratch, x: Array, u: Array) -> bool:
    """Whether a plan made with weights of the score is predicted to lose `allowed` more than its guess."""
    if s.floor[0] >= COST_FLOOR:
        return False
    before = allowed * s.loss.shape[0] + guess_loss(s)
    return bool(predicted_loss(inertial, data, s, x, u) > before)


@kernel
def restore_guess(s: Scratch, u: Array, x: Array) -> None:
    """The guess as the plan, again."""
    copy(s.X, x)
    for i in range(u.shape[0]):
        for a in range(N_INPUT):
            u[i, a] = s.F[i, a] - s.offset[a]
