"""Predictive safety filter: the command nearest to a wanted one from which the limits can be kept.

One QP per sample, posed as exact NMPC poses its own: about the shifted plan, with the limits as hard rows.
Stage 1, which no other input reaches than u_0, weighs w |u_0 - u_wanted|^2; all else weighs as in the MPC.
The linear part is such that without limits u_0 = u_wanted: what moves the command is what limits cost. After
Wabersich, Zeilinger, "A predictive safety filter for learning-based control of constrained nonlinear
dynamical systems", Automatica 129 (2021), with the terminal weight of the MPC for a terminal set.

Rotors that lag by 1 / lambda_F are taken for rotors that answer after that time: the plan begins at the state
to which the present forces bring the vehicle by then.
"""

from __future__ import annotations

import math
from typing import Any, ClassVar, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from quad_envs.arguments.names import shown
from quad_envs.compilation.decorators import entry_of, kernel
from quad_envs.compilation.packed import unpacker
from quad_envs.limits import LIMITS
from quad_envs.parameters import N_INPUT, N_STATE, Array
from quad_envs.tasks import Task

from ..controller import Decision, all_finite, as_rows, first_non_finite, raise_non_finite
from ..fallback import RELAXED, limit_command
from ..model import RK4_SCRATCH, rk4_sensitivities
from ..qp.linalg import invert_spd, matmul, matvec, transpose
from ..qp.ocp import IntArray
from ..qp.recursion import Feedback, Regulator, optimal_plan, riccati_pass
from ..qp.workspace import Workspace
from .exact import CONVERGED, ExactNmpc, keep_guess, linearise_cost, linearise_model, load_guess, take_step
from .kernels import MpcData, Scratch, begin_row, copy_vector, end_row, left_model, solve_within_model
from .options import NmpcOptions, SafetyOptions

KEPT = 5e-3  # N, difference of a rotor's command up to which it counts as the wanted one, and becomes it
MARGIN_STAGES = 4  # over which the margin grows to all of it: what one sample takes back the next one had
_RK4 = RK4_SCRATCH * (N_STATE + N_INPUT)


class Correction(NamedTuple):
    """What a filter makes of commands."""

    decision: Decision
    change: Array  # (n,), N, largest of a rotor, of what was wanted within rate and box; nan: nothing was


def grow_margin(data: MpcData, margin: float) -> MpcData:
    """The rows of the task's limits with margin k / MARGIN_STAGES at stage k, all of it from there on."""
    own = slice(data.own_rows)
    less = margin * (1.0 - np.minimum(1.0, data.stage[own] / MARGIN_STAGES))
    lower, upper = data.lower.copy(), data.upper.copy()
    lower[own] -= less
    upper[own] += less
    return data._replace(lower=lower, upper=upper)


@kernel
def run_on(plant: Array, delay: float, data: MpcData, s: Scratch) -> None:
    """x_0 becomes the state after `delay`, s, under the rotor forces of the plant (16,)."""
    x_next, scratch = s.square[9, 1], s.square.reshape(-1)[:_RK4].reshape(RK4_SCRATCH, N_STATE + N_INPUT)
    rk4_sensitivities(
        s.x_0, plant[N_STATE:], s.d, data.coefficients, data.B_c, delay, x_next, s.A[0], s.B[0], scratch
    )
    copy_vector(x_next, s.x_0)


@kernel
def draw_first_input(wanted: Array, weight: float, s: Scratch) -> None:
    """Stage 1 weighs |u_0 - wanted|^2: with B_0 of full rank, u_0 = B_0^+ (x_1 - A_0 x_0 - c_0).

    Args:
        wanted: Rotor commands, (4,), N.
        weight: 1/N^2.
        s: The problem; Q_1 and the reference of stage 1 are the results.
    """
    B, work = s.B[0], s.square[9].reshape(-1)
    m, n = N_INPUT, N_STATE
    gram, inverse = work[: m * m].reshape(m, m), work[m * m : 2 * m * m].reshape(m, m)
    B_T, pseudo = s.square[8, :m], s.square[8, m : 2 * m]
    transpose(B, B_T)
    matmul(B_T, B, gram)
    invert_spd(gram, inverse)
    matmul(inverse, B_T, pseudo)
    for i in range(n):
        for j in range(n):
            total = 0.0
            for a in range(m):
                total += pseudo[a, i] * pseudo[a, j]
            s.Q[1, i, j] = weight * total
    r = s.target[1]
    matvec(s.A[0], s.x_0, r)
    for i in range(n):
        r[i] += s.c[0, i]
        for a in range(m):
            r[i] += B[i, a] * (wanted[a] - s.offset[a])


@kernel
def balance(wanted: Array, weight: float, data: MpcData, s: Scratch, ws: Workspace) -> None:
    """Move the reference of stage 1 so that, without limits, u_0 = wanted against the pull of later stages.

    The unconstrained optimum u_0* is affine in what it is drawn to, with slope weight D_0 D_0', where D_0
    D_0' is the inverse Hessian in u_0: the draw goes (D_0 D_0')^-1 (wanted - u_0*) / weight further.

    Args:
        wanted: Rotor commands, (4,), N.
        weight: 1/N^2, as in `draw_first_input`.
        data: Constants.
        s: The problem; the reference of stage 1 is the result.
        ws: Overwritten.
    """
    problem = Regulator(s.A, s.B, s.c, s.Q, data.R, s.P, False, s.x_0, s.target)
    feedback = Feedback(ws.transposed, ws.K, ws.D, ws.P_c)
    riccati_pass(problem, feedback, ws.scratch)
    optimal_plan(problem, feedback, ws.u, ws.x, ws.scratch[0])
    D, e = ws.D[0], s.square[9, 0]  # D is upper triangular
    for a in range(N_INPUT):
        e[a] = wanted[a] - s.offset[a] - ws.u[0, a]
    for a in range(N_INPUT - 1, -1, -1):
        for b in range(a + 1, N_INPUT):
            e[a] -= D[a, b] * e[b]
        e[a] /= D[a, a]
    for a in range(N_INPUT):
        for b in range(a):
            e[a] -= D[b, a] * e[b]
        e[a] /= D[a, a]
    for i in range(N_STATE):
        for a in range(N_INPUT):
            s.target[1, i] += s.B[0, i, a] * e[a] / weight


@kernel
def largest_change(command: Array, wanted: Array) -> float:
    """Of a rotor, N."""
    change = 0.0
    for a in range(N_INPUT):
        change = max(change, abs(command[a] - wanted[a]))
    return change


@kernel
def keep_wanted(wanted: Array, s: Scratch, ws: Workspace) -> None:
    """The first input of the plan becomes the wanted command where it is that but for KEPT."""
    F = s.square[9, 0]
    for a in range(N_INPUT):
        F[a] = s.offset[a] + ws.u[0, a]
    if largest_change(F, wanted) <= KEPT:
        for a in range(N_INPUT):
            ws.u[0, a] = wanted[a] - s.offset[a]


class _Call(NamedTuple):
    """What a correction takes beside its rows."""

    passes: int
    inertial: bool  # as of `linearise_cost`
    keep_from: int  # where the guess begins in memory
    weight: float  # 1/N^2, as of `draw_first_input`
    delay: float  # s, as of `run_on`
    data: MpcData
    s: Scratch
    ws: Workspace


_unpack = unpacker(_Call)


@kernel
def _filter_rows(
    plants: Array,
    windows: Array,
    lasts: Array,
    disturbances: Array,
    memories: Array,
    wanted: Array,
    commands: Array,
    kept: Array,
    report: IntArray,
    changes: Array,
    which: IntArray | None,
    words: IntArray,
) -> int:
    """One correction per row; -1, or the code of the first argument that is not finite."""
    passes, inertial, keep_from, weight, delay, data, s, ws = _unpack(words)
    N = ws.u.shape[0]
    bad = first_non_finite(plants, windows, lasts, disturbances, memories, N + 1)
    if bad >= 0:
        return bad
    for j in range(plants.shape[0]):
        begin_row(plants[j], windows[j], lasts[j], disturbances[j], memories[j], which, data, s)
        run_on(plants[j], delay, data, s)
        load_guess(memories[j], memories[j, keep_from:], data.heading, s)
        has_plan, told = memories[j, 0] > 0.0, all_finite(wanted[j])
        if told:
            limit_command(wanted[j], lasts[j], data.rate_step, data.force_max, wanted[j])
        worst, iterations = 0, 0
        for _ in range(passes):
            linearise_model(data, s)
            linearise_cost(inertial, data, s)
            if told:
                draw_first_input(wanted[j], weight, s)
                balance(wanted[j], weight, data, s, ws)
            level, count = solve_within_model(
                s.A, s.B, s.Q, data.R, s.P, False, s.target, has_plan, data, s, ws
            )
            worst, iterations = max(worst, level), iterations + count
            if level > RELAXED or take_step(ws.u, ws.x, s) < CONVERGED:
                break
        if told and worst <= RELAXED:
            keep_wanted(wanted[j], s, ws)
        end_row(worst, plants[j], lasts[j], disturbances[j], memories[j], data, s, ws.u, commands[j], kept[j])
        keep_guess(worst <= RELAXED, s.X, kept[j, keep_from:])
        changes[j] = largest_change(commands[j], wanted[j]) if told else math.nan
        left = left_model(worst, s.x_0, ws.x, s.points, data.model_tilt, data.first_angle)
        report[0, j], report[1, j], report[2, j] = worst, iterations, left
    return bad


class SafetyFilter(ExactNmpc):
    """Corrects the commands of another controller, or of a network, so that the limits can be kept.

    `filter` corrects; `decide` is the MPC behind it, which takes over where the other has no answer.

    Args:
        task: What is known of the flight.
        options: See `SafetyOptions`; None for the defaults.
        changes: Fields of it, such as margin=0.05, which replace those of `options`.

    Raises:
        TypeError: If there is no such option.
        ValueError: If an option is not allowed, or the task has no limits.
    """

    options_type: ClassVar[type[NmpcOptions]] = SafetyOptions
    options: SafetyOptions
    _filter = staticmethod(entry_of(_filter_rows))

    def __init__(self, task: Task, options: SafetyOptions | None = None, **changes: Any) -> None:
        if not task.limits.chosen():
            raise ValueError(
                f"{task.env_id} has no limits, so that there is nothing to keep: choose some, as "
                f"gymnasium.make({task.env_id!r}, tilt_limit=0.35); there are "
                f"{', '.join(limit.option for limit in LIMITS)}"
            )
        super().__init__(task, options, **changes)
        self._data = grow_margin(self._data._replace(lag=0.0), float(self.options.margin))
        self._delay = 1.0 / float(task.params.rotor_rate)

    def _call(self, s: Scratch, ws: Workspace) -> Any:
        weight = float(self.options.weight)
        return _Call(self.passes, self._inertial, self._keep_from, weight, self._delay, self._data, s, ws)

    def decide(
        self,
        plant: ArrayLike,
        window: ArrayLike,
        last_command: ArrayLike,
        disturbance: ArrayLike,
        memory: ArrayLike,
    ) -> Decision:
        """The command of the MPC behind the filter; see `Controller.decide`."""
        nothing = np.full((len(np.asarray(plant)), N_INPUT), math.nan)
        return self.filter(plant, window, last_command, disturbance, memory, nothing).decision

    def filter(
        self,
        plant: ArrayLike,
        window: ArrayLike,
        last_command: ArrayLike,
        disturbance: ArrayLike,
        memory: ArrayLike,
        wanted: ArrayLike,
    ) -> Correction:
        """One command per vehicle; as `Controller.decide`, with what another wants.

        Args:
            plant: (n, 16).
            window: (n, >= horizon + 1, 8).
            last_command: (n, 4), N.
            disturbance: (n, 6).
            memory: (n, memory_size), of the previous correction.
            wanted: Rotor commands, (n, 4), N; a row that is not finite gets the MPC's own command.

        Raises:
            ValueError: If a shape is wrong, or another number than those of `wanted` is not finite.
        """
        arrays = as_rows(plant, window, last_command, disturbance, memory, self.horizon + 1, self.memory_size)
        n = len(arrays[0])
        asked = np.array(wanted, dtype=np.float64, order="C")
        if asked.shape != (n, N_INPUT):
            raise ValueError(f"wanted must have shape ({n}, {N_INPUT}), N, got {shown(asked.shape)}")
        command, kept = np.empty((n, N_INPUT)), np.empty((n, self.memory_size))
        report, change = np.empty((3, n), np.int64), np.empty(n)
        scratch = self._scratch()
        bad = self._filter(*arrays, asked, command, kept, report, change, scratch.which, scratch.words)
        if bad >= 0:
            raise_non_finite(bad)
        return Correction(Decision(command, kept, *report), change)
