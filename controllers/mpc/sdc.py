"""SDC-NMPC: MPC on the state-dependent-coefficient model of chapter 4, Eqs. (4.8) to (4.11)."""

from __future__ import annotations

from typing import Any, NamedTuple

from quad_envs.compilation.decorators import entry_of, kernel, threaded_kernel
from quad_envs.compilation.packed import unpacker
from quad_envs.parameters import N_STATE, Array
from quad_envs.tasks import Task

from ..controller import first_non_finite
from ..fallback import RELAXED
from ..model import sdc_matrix, zero_order_hold
from ..qp.linalg import copy
from ..qp.ocp import IntArray
from ..qp.riccati import solve_dare
from ..qp.workspace import Workspace
from .equilibrium import hold_equilibrium
from .kernels import (
    FROZEN_SPAN,
    MpcData,
    Scratch,
    begin_row,
    copy_vector,
    end_row,
    left_model,
)
from .linear_score import begin_guess, guess_plan, refuses_plan, solve_for_objective, weigh_about_guess
from .mpc import Mpc, Problem
from .options import SdcOptions, chosen
from .present_axes import pair_in_present_axes, stop_turning
from .score import COST_FLOOR

_TILT_LIMIT = 1.4  # rad, of roll and pitch of the states at which the model is taken again


@kernel
def hold_heading(r: Array, x: Array, A_c: Array, dt: float, c: Array) -> None:
    """Add to c (12,) what keeps V_B from turning with the heading of the reference: Omega_ref x V_B.

    The model turns V_B with the predicted rates, but moves the position by the V_B of the present axes, in
    which v_ref stands, too: a vehicle that flies straight while its heading turns would seem to fly a curve.
    Counting the planned turn out leaves V_B in axes that do not turn. Exact for alpha = 1.

    Args:
        r: Reference of the stage, (12,), with Omega_ref.
        x: State at which the model was taken, (12,).
        A_c: That model, (12, 12).
        dt: Control period, s.
        c: Affine term, (12,), changed in place.
    """
    p, q, w = r[9], r[10], r[11]
    if p == 0.0 and q == 0.0 and w == 0.0:
        return
    g0, g1, g2 = q * x[5] - w * x[4], w * x[3] - p * x[5], p * x[4] - q * x[3]
    c[3], c[4], c[5] = c[3] + dt * g0, c[4] + dt * g1, c[5] + dt * g2
    for a in range(3):
        c[a] += 0.5 * dt * dt * (A_c[a, 3] * g0 + A_c[a, 4] * g1 + A_c[a, 5] * g2)


@kernel
def freeze_model(alpha: float, present: bool, sdre_weight: bool, data: MpcData, s: Scratch) -> bool:
    """The pair at x_0 for the whole horizon, and the terminal weight.

    Returns:
        Whether the terminal weight solves the Riccati equation of the pair.
    """
    sdc_matrix(s.x_0, alpha, data.coefficients, s.A_c)
    if present:
        stop_turning(s.A_c)
    zero_order_hold(s.A_c, data.B_c, data.dt, s.A[0], s.B[0], s.square)
    copy_vector(s.x_0, s.points[0])
    hold_equilibrium(s.A[:1], s.B[:1], data.fade < 1.0, s.stages, s.c)
    for i in range(0 if present else s.c.shape[0]):
        hold_heading(s.r[i], s.x_0, s.A_c, data.dt, s.c[i])
    if sdre_weight and solve_dare(s.A[0], s.B[0], data.Q[0], data.R[0], s.P, s.square) > 0:
        return True
    copy(data.P, s.P)
    return False


@kernel
def relinearise(u: Array, alpha: float, present: bool, data: MpcData, s: Scratch) -> None:
    """The N pairs met along x_{i+1} = A(x_i) x_i + B(x_i) u_i + c_i under the plan u; memoryless."""
    x, x_next = s.square[3, 0], s.square[3, 1]
    R, work = s.square[8, :3], s.square[8, 3:9]
    B_c = s.square[9].reshape(-1)[: data.B_c.size].reshape(data.B_c.shape)
    copy(data.B_c, B_c)
    sdc_matrix(s.x_0, alpha, data.coefficients, s.A_c)
    for a in range(3):
        copy_vector(s.A_c[a, 3:6], R[a, :3])
    copy_vector(s.x_0, x)
    for i in range(u.shape[0]):
        copy_vector(x, s.points[i])
        yaw = x[8]
        if not present:
            x[8] -= s.r[i, 8] - s.r[0, 8]  # velocities do not turn with the heading of the reference
        sdc_matrix(x, alpha, data.coefficients, s.A_c)
        if present:
            pair_in_present_axes(R, data.B_c, s.A_c, B_c, work)
        x[8] = yaw
        zero_order_hold(s.A_c, B_c, data.dt, s.A[i], s.B[i], s.square)
        k = slice(i, i + 1)
        hold_equilibrium(s.A[k], s.B[k], data.fade < 1.0, s.stages[k], s.c[k])
        if not present:
            hold_heading(s.r[i], x, s.A_c, data.dt, s.c[i])
        for a in range(N_STATE):
            total = s.c[i, a]
            for b in range(N_STATE):
                total += s.A[i, a, b] * x[b]
            for b in range(u.shape[1]):
                total += s.B[i, a, b] * u[i, b]
            x_next[a] = total
        copy_vector(x_next, x)
        x[6] = min(max(x[6], -_TILT_LIMIT), _TILT_LIMIT)
        x[7] = min(max(x[7], -_TILT_LIMIT), _TILT_LIMIT)


@kernel
def spread_pair(pairs: int, s: Scratch) -> None:
    """The first of so many pairs for all of their stages."""
    for i in range(1, pairs):
        copy(s.A[0], s.A[i])
        copy(s.B[0], s.B[i])
        copy_vector(s.points[0], s.points[i])


@kernel
def leaves_pair(x: Array) -> bool:
    """Whether a plan (N+1, 12) rolls, pitches or yaws so far that the pair at its start no longer holds."""
    for i in range(1, x.shape[0]):
        for a in range(6, 9):
            if abs(x[i, a] - x[0, a]) > FROZEN_SPAN:
                return True
    return False


class _Call(NamedTuple):
    """What a decision takes beside its rows."""

    alpha: float
    present: bool  # whether velocities stand in axes of the present attitude
    relinearisations: int  # passes after the first one, at most
    at_need: bool  # whether a further pass is made only where the plan needs it
    sdre_weight: bool  # whether the terminal weight is that of the present pair
    first: int  # pairs of the first pass
    floor: float  # of the stage weights, see `score.weigh_stages`
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
    alpha, present, relinearisations, at_need, sdre_weight, first, floor, data, s, ws = _unpack(words)
    N = ws.u.shape[0]
    bad = first_non_finite(plants, windows, lasts, disturbances, memories, N + 1)
    if bad >= 0:
        return bad
    for j in range(plants.shape[0]):
        begin_row(plants[j], windows[j], lasts[j], disturbances[j], memories[j], which, data, s)
        worst, iterations, pairs = 0, 0, first
        stationary = freeze_model(alpha, present, sdre_weight, data, s) and first == 1
        spread_pair(first, s)
        begin_guess(floor, memories[j], s)
        for k in range(1 + relinearisations):
            if k > 0:
                relinearise(ws.u, alpha, present, data, s)
                guess_plan(floor, ws.u, s)
                stationary, pairs = False, N
            has_plan = memories[j, 0] > 0.0
            level, count = solve_for_objective(
                s.A[:pairs], s.B[:pairs], s.P, stationary, has_plan, data, s, ws
            )
            worst, iterations = max(worst, level), iterations + count
            if level > RELAXED or (at_need and not leaves_pair(ws.x)):
                break
        end_row(worst, plants[j], lasts[j], disturbances[j], memories[j], data, s, ws.u, commands[j], kept[j])
        left = left_model(worst, s.x_0, ws.x, s.points[:pairs], data.model_tilt, data.first_angle)
        report[0, j], report[1, j], report[2, j] = worst, iterations, left
    return bad


class SdcNmpc(Mpc):
    """MPC on x' = A_c(x) x + B_c u, exact for the present state and frozen over the horizon.

    Deviation:
        alpha = 1 by default; 1/2 is the dissertation's factorisation (4.6), under which the present body
        rates stay frozen in the prediction and go on turning V_B: it loses a climbing helix. Frames as in
        `LinearMPC`.

    Args:
        task: What is known of the flight.
        options: See `SdcOptions`; None for the defaults.
        changes: Fields of it, such as horizon=10, which replace those of `options`.

    Raises:
        TypeError: If there is no such option.
        ValueError: If an option is not allowed.
    """

    options_type = SdcOptions
    options: SdcOptions
    _kernel = staticmethod(entry_of(_decide_rows))

    def __init__(self, task: Task, options: SdcOptions | None = None, **changes: Any) -> None:
        options = chosen(SdcOptions, options, changes)
        self.relinearisations = options.further_passes()
        super().__init__(task, options, options.axes(), many_pairs=self.relinearisations > 0, guess=False)
        self._data = self._data._replace(kinematics=True)
        self.alpha = float(options.alpha)
        self._present = self._data.present
        self._at_need = options.at_need
        self._sdre_weight = options.terminal_weight == "sdre"
        self._refused, self._stationary, self._posed, self._taken = False, False, 1, 0  # see `_pose`

    def _call(self, s: Scratch, ws: Workspace) -> _Call:
        return _Call(
            self.alpha,
            self._present,
            self.relinearisations,
            self._at_need,
            sdre_weight=self._sdre_weight,
            first=self._first_pairs,
            floor=self._floor,
            data=self._data,
            s=s,
            ws=ws,
        )

    def _pose(self, number: int, memory: Array, s: Scratch, ws: Workspace) -> Problem:
        data = self._data
        if number == 0:
            self._taken = 0  # passes whose plan was taken
            stationary = freeze_model(self.alpha, self._present, self._sdre_weight, data, s)
            self._stationary = stationary and self._first_pairs == 1
            spread_pair(self._first_pairs, s)
            begin_guess(self._floor, memory, s)
            self._posed = self._first_pairs
        elif not self._refused:
            relinearise(ws.u, self.alpha, self._present, data, s)
            guess_plan(self._floor, ws.u, s)
            self._stationary, self._posed = False, self.horizon
        A, B = s.A[: self._posed], s.B[: self._posed]
        if s.floor[0] < COST_FLOOR:
            weigh_about_guess(A, B, s.P, data, s)
            return Problem(A, B, s.Q, s.R, s.P, False, s.r)
        return Problem(A, B, data.Q, data.R, s.P, self._stationary, s.r)

    def _accept(self, number: int, s: Scratch, ws: Workspace) -> bool:
        self._refused = s.floor[0] < COST_FLOOR and refuses_plan(self._data, s, ws.x, ws.u)
        if self._refused:
            return False
        self._taken += 1
        return self._taken > self.relinearisations or (self._at_need and not leaves_pair(ws.x))
