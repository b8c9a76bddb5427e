"""Exact nonlinear MPC by real-time iteration or SQP to convergence; not in the dissertation.

Multiple shooting: about a guess (X, F) one RK4 step per sample gives A_i, B_i and c_i = phi(X_i, F_i) - A_i
X_i - B_i u_i; the QP's plan is the next guess. The cost is quadratic in a residual e(x); Gauss-Newton leaves
out the second derivatives of e.
"""

from __future__ import annotations

from typing import Any, ClassVar, NamedTuple

from quad_envs.compilation.decorators import entry_of, kernel, threaded_kernel
from quad_envs.compilation.packed import unpacker
from quad_envs.parameters import N_INPUT, N_STATE, Array
from quad_envs.rotations import sincos, wrap_angle_scalar
from quad_envs.tasks import Task

from ..controller import first_non_finite
from ..disturbance import N_DISTURBANCE
from ..fallback import RELAXED
from ..model import RK4_SCRATCH, rk4_sensitivities
from ..qp.linalg import copy, fill
from ..qp.ocp import IntArray
from ..qp.workspace import Workspace
from .kernels import (
    MpcData,
    Scratch,
    begin_row,
    copy_vector,
    end_row,
    left_model,
    solve_within_model,
)
from .mpc import Mpc, Problem
from .options import EXACT_TILT, NmpcOptions, ScoreNmpcOptions, chosen
from .residual import gauss_newton_weight, stage_residual
from .score import (
    ALLOWED,
    COST_FLOOR,
    loses_more,
    restore_guess,
    set_floor,
    stage_loss,
    weigh_stages,
)

CONVERGED = 1e-6  # N, largest change of an input in the last pass
_PITCH_LIMIT = 1.4  # rad, of the states at which the model is linearised
_RK4 = RK4_SCRATCH * (N_STATE + N_INPUT)


@kernel
def load_guess(plan: Array, kept: Array, heading: bool, s: Scratch) -> bool:
    """The previous solution shifted by one sample, or the present state held.

    Nothing depends on where the vehicle is and how it is headed, so the guess moves with its own first state.

    Args:
        plan: Whether a plan is held, then its rotor commands, (1 + 4N,).
        kept: Whether a guess is held, then its states, (1 + 12 (N+1),).
        heading: Whether the frame of the problem turned with the vehicle.
        s: x_0 and offset are read; X and F are the results.

    Returns:
        Whether there was a previous solution.
    """
    N = s.F.shape[0]
    held = kept[0] > 0.0 and plan[0] > 0.0
    old = kept[1:].reshape(N + 1, N_STATE)
    first = old[1]
    turn = first[8] if heading else 0.0
    sine, cosine = sincos(turn)
    yaw = s.x_0[8] - wrap_angle_scalar(s.x_0[8] - first[8]) - first[8]  # a multiple of 2 pi
    if heading:
        yaw = -first[8]
    for i in range(N + 1):
        if held:
            X = old[min(i + 1, N)]
            copy_vector(X, s.X[i])
            x, y = X[0] - first[0], X[1] - first[1]
            s.X[i, 0] = s.x_0[0] + cosine * x + sine * y
            s.X[i, 1] = s.x_0[1] + cosine * y - sine * x
            s.X[i, 2] = s.x_0[2] + X[2] - first[2]
            s.X[i, 8] = X[8] + yaw
        else:
            copy_vector(s.x_0, s.X[i])
    for i in range(N):
        for a in range(N_INPUT):
            s.F[i, a] = plan[1 + N_INPUT * min(i + 1, N - 1) + a] if held else s.offset[a]
    copy_vector(s.x_0, s.X[0])
    return bool(held)


@kernel
def begin_passes(floor: float, plan: Array, kept: Array, heading: bool, s: Scratch) -> None:
    """The guess of the first pass; only about a previous solution are there weights of the score."""
    held = load_guess(plan, kept, heading, s)
    set_floor(floor if held else COST_FLOOR, s)


@kernel
def linearise_model(data: MpcData, s: Scratch) -> None:
    """A_i, B_i and c_i about the guess, under what is left of the disturbance at each stage."""
    point, x_next, d = s.square[9, 0], s.square[9, 1], s.square[9, 2, :N_DISTURBANCE]
    left = 1.0
    scratch = s.square.reshape(-1)[:_RK4].reshape(RK4_SCRATCH, N_STATE + N_INPUT)
    for i in range(s.F.shape[0]):
        copy_vector(s.X[i], point)
        point[7] = min(max(point[7], -_PITCH_LIMIT), _PITCH_LIMIT)
        copy_vector(point, s.points[i])
        for a in range(N_DISTURBANCE):
            d[a] = s.d[a] - (1.0 - left) * s.fading[a]
        left *= data.fade
        rk4_sensitivities(
            point, s.F[i], d, data.coefficients, data.B_c, data.dt, x_next, s.A[i], s.B[i], scratch
        )
        for a in range(N_STATE):
            total = x_next[a]
            for b in range(N_STATE):
                total -= s.A[i, a, b] * point[b]
            for b in range(N_INPUT):
                total -= s.B[i, a, b] * (s.F[i, b] - s.offset[b])
            s.c[i, a] = total


@kernel
def linearise_cost(inertial: bool, data: MpcData, s: Scratch) -> None:
    """Stage weights Q_i = E_i'Q E_i and references X_i - E_i^-1 e(X_i) about the guess, and its stage costs.

    The residual is that of the reward, see `stage_residual`; without `inertial`, v_ref is not turned.
    """
    N = s.F.shape[0]
    D, e, u = s.square[9, 2:8, :3], s.square[9, 8], s.square[9, 9, :N_INPUT]
    fill(D, 0.0)
    for i in range(N + 1):
        r, X = s.target[i], s.X[i]
        rows = stage_residual(inertial, data.heading, X, s.r[i], e, D)
        blocks = D[:rows]
        for a in range(N_STATE):
            r[a] = X[a] - e[a]
        for k in range(rows):
            for a in range(3):
                r[3 + k if k < 3 else 6 + k] -= D[k, a] * e[6 + a]
        if i < N:
            gauss_newton_weight(data.Q[0], blocks, s.Q[i])
        else:
            gauss_newton_weight(data.P, blocks, s.P)
        if i > 0:
            for a in range(N_INPUT):
                u[a] = s.F[i - 1, a] - s.offset[a]
            s.loss[i - 1] = stage_loss(e, u, data)


@kernel
def take_step(u: Array, x: Array, s: Scratch) -> float:
    """The plan becomes the guess; returns the largest change of an input, N."""
    change = 0.0
    for i in range(u.shape[0]):
        for a in range(N_INPUT):
            F = s.offset[a] + u[i, a]
            change = max(change, abs(F - s.F[i, a]))
            s.F[i, a] = F
    copy(x, s.X)
    return change


@kernel
def accept_plan(
    number: int, passes: int, floor: float, inertial: bool, data: MpcData, s: Scratch, ws: Workspace
) -> bool:
    """Take the plan of pass `number` from ws, unless the step control refuses it.

    A plan that is predicted to lose more of the score than its guess shows that the tangent does not hold so
    far. In the first pass the guess belongs to another state, and the next pass has the weights of the cost;
    later on the plan of the pass before is the result.

    Returns:
        Whether it was the last pass.
    """
    if loses_more(ALLOWED if number == 0 else 0.0, inertial, data, s, ws.x, ws.u):
        if number == 0:
            set_floor(COST_FLOOR, s)
            return False
        restore_guess(s, ws.u, ws.x)
        return True
    set_floor(floor, s)
    return bool(take_step(ws.u, ws.x, s) < CONVERGED or number >= passes - 1)


@kernel
def keep_guess(valid: bool, X: Array, kept: Array) -> None:
    """Write the guess to memory; after a failure the next sample starts afresh."""
    for k in range(kept.shape[0]):
        kept[k] = 0.0
    if valid:
        kept[0] = 1.0
        copy(X, kept[1:].reshape(X.shape))


class _Call(NamedTuple):
    """What a decision takes beside its rows."""

    passes: int
    inertial: bool  # as of `linearise_cost`
    floor: float  # of the stage weights, see `score.weigh_stages`
    keep_from: int  # where the guess begins in memory
    data: MpcData
    s: Scratch
    ws: Workspace


_unpack = unpacker(_Call)


@threaded_kernel
def _decide_rows(
    plants: Array,
    windows: Array,
    lasts: Array,
    disturbances: Array,
    memories: Array,
    commands: Array,
    kept: Array,
    report: IntArray,
    which: IntArray | None,
    words: IntArray,
) -> int:
    """One decision per row; -1, or the code of the first argument that is not finite."""
    passes, inertial, floor, keep_from, data, s, ws = _unpack(words)
    N = ws.u.shape[0]
    bad = first_non_finite(plants, windows, lasts, disturbances, memories, N + 1)
    if bad >= 0:
        return bad
    for j in range(plants.shape[0]):
        begin_row(plants[j], windows[j], lasts[j], disturbances[j], memories[j], which, data, s)
        begin_passes(floor, memories[j], memories[j, keep_from:], data.heading, s)
        worst, iterations = 0, 0
        for number in range(1 + passes):  # one more where the step control refuses the first
            linearise_model(data, s)
            linearise_cost(inertial, data, s)
            weigh_stages(data, s)
            has_plan = memories[j, 0] > 0.0
            level, count = solve_within_model(s.A, s.B, s.Q, s.R, s.P, False, s.target, has_plan, data, s, ws)
            worst, iterations = max(worst, level), iterations + count
            if level > RELAXED or accept_plan(number, passes, floor, inertial, data, s, ws):
                break
        end_row(worst, plants[j], lasts[j], disturbances[j], memories[j], data, s, ws.u, commands[j], kept[j])
        keep_guess(worst <= RELAXED, s.X, kept[j, keep_from:])
        left = left_model(worst, s.x_0, ws.x, s.points, data.model_tilt, data.first_angle)
        report[0, j], report[1, j], report[2, j] = worst, iterations, left
    return bad


class ExactNmpc(Mpc):
    """MPC on the exact model (without rotor lag), with the stage cost of the reward.

    Args:
        task: What is known of the flight.
        options: See `NmpcOptions`; None for the defaults.
        changes: Fields of it, such as horizon=10, which replace those of `options`.

    Raises:
        TypeError: If there is no such option.
        ValueError: If an option is not allowed.
    """

    options_type: ClassVar[type[NmpcOptions]] = NmpcOptions
    options: NmpcOptions
    _kernel = staticmethod(entry_of(_decide_rows))

    def __init__(self, task: Task, options: NmpcOptions | None = None, **changes: Any) -> None:
        options = chosen(self.options_type, options, changes)
        super().__init__(task, options, "heading", many_pairs=True, guess=True)
        self._data = self._data._replace(model_tilt=EXACT_TILT)
        self.passes = int(options.passes)
        self._inertial = options.velocity_error == "inertial"

    def _call(self, s: Scratch, ws: Workspace) -> _Call:
        return _Call(self.passes, self._inertial, self._floor, self._keep_from, self._data, s, ws)

    def _pose(self, number: int, memory: Array, s: Scratch, ws: Workspace) -> Problem:
        if number == 0:
            begin_passes(self._floor, memory, memory[self._keep_from :], self._data.heading, s)
        linearise_model(self._data, s)
        linearise_cost(self._inertial, self._data, s)
        weigh_stages(self._data, s)
        return Problem(s.A, s.B, s.Q, s.R, s.P, False, s.target)

    def _accept(self, number: int, s: Scratch, ws: Workspace) -> bool:
        return accept_plan(number, self.passes, self._floor, self._inertial, self._data, s, ws)

    def _keep(self, level: int, kept: Array, s: Scratch) -> None:
        keep_guess(level <= RELAXED, s.X, kept[self._keep_from :])


class ScoreNmpc(ExactNmpc):
    """`ExactNmpc` with objective="score": it plans for the reward instead of the quadratic cost.

    Arguments and errors are those of `ExactNmpc`, its options `ScoreNmpcOptions`.
    """

    options_type: ClassVar[type[NmpcOptions]] = ScoreNmpcOptions
