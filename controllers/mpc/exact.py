"""Exact nonlinear MPC by real-time iteration or SQP to convergence; not in the dissertation.

Multiple shooting: about a guess (X, F) one RK4 step per sample gives A_i, B_i and c_i = phi(X_i, F_i) - A_i
X_i - B_i u_i; the QP's plan is the next guess. The cost is quadratic in a residual e(x); Gauss-Newton leaves
out the second derivatives of e.
"""

from __future__ import annotations

from typing import Annotated, Any, NamedTuple

from quad_envs._numba import entry_of, kernel
from quad_envs.parameters import N_INPUT, N_STATE, Array
from quad_envs.rotations import sincos, wrap_angle_scalar
from quad_envs.tasks import Task

from ..controller import first_non_finite
from ..fallback import RELAXED
from ..model import RK4_SCRATCH, rk4_sensitivities, rotated_derivatives
from ..packed import unpacker
from ..qp.linalg import copy, fill
from ..qp.ocp import IntArray
from ..qp.workspace import Workspace
from .kernels import (
    MpcData,
    Scratch,
    begin_row,
    carve,
    copy_vector,
    end_row,
    left_model,
    solve_within_model,
)
from .mpc import Mpc, Problem
from .options import EXACT_TILT, NmpcOptions, chosen

CONVERGED = 1e-6  # N, largest change of an input in the last pass
_PITCH_LIMIT = 1.4  # rad, of the states at which the model is linearised
_RK4 = RK4_SCRATCH * (N_STATE + N_INPUT)


@kernel
def load_guess(plan: Array, kept: Array, heading: bool, s: Scratch) -> None:
    """The previous solution shifted by one sample, or the present state held.

    Nothing depends on where the vehicle is and how it is headed, so the guess moves with its own first state.

    Args:
        plan: Whether a plan is held, then its rotor commands, (1 + 4N,).
        kept: Whether a guess is held, then its states, (1 + 12 (N+1),).
        heading: Whether the frame of the problem turned with the vehicle.
        s: x_0 and offset are read; X and F are the results.
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


@kernel
def linearise_model(data: MpcData, s: Scratch) -> None:
    """A_i, B_i and c_i about the guess."""
    point, x_next = s.square[9, 0], s.square[9, 1]
    scratch = s.square.reshape(-1)[:_RK4].reshape(RK4_SCRATCH, N_STATE + N_INPUT)
    for i in range(s.F.shape[0]):
        copy_vector(s.X[i], point)
        point[7] = min(max(point[7], -_PITCH_LIMIT), _PITCH_LIMIT)
        copy_vector(point, s.points[i])
        rk4_sensitivities(
            point, s.F[i], s.d, data.coefficients, data.B_c, data.dt, x_next, s.A[i], s.B[i], scratch
        )
        for a in range(N_STATE):
            total = x_next[a]
            for b in range(N_STATE):
                total -= s.A[i, a, b] * point[b]
            for b in range(N_INPUT):
                total -= s.B[i, a, b] * (s.F[i, b] - s.offset[b])
            s.c[i, a] = total


@kernel
def velocity_residual(Theta: Array, v_ref: Array, D: Array) -> tuple[float, float, float]:
    """R_BI(Theta) v_ref, and its derivative by Theta.

    Args:
        Theta: Roll, pitch, yaw, (3,).
        v_ref: In the axes from which yaw counts, (3,).
        D: Result, (3, 3).
    """
    sf, cf = sincos(Theta[0])
    st, ct = sincos(Theta[1])
    ss, cs = sincos(Theta[2])
    G = rotated_derivatives(sf, cf, st, ct, ss, cs, v_ref[0], v_ref[1], v_ref[2])
    for a in range(3):
        D[0, a], D[1, a], D[2, a] = G[a], G[3 + a], G[6 + a]
    forward = cs * v_ref[0] + ss * v_ref[1]
    side = cs * v_ref[1] - ss * v_ref[0]
    down = st * forward + ct * v_ref[2]
    return ct * forward - st * v_ref[2], sf * down + cf * side, cf * down - sf * side


@kernel
def rates_residual(Theta: Array, psi_dot: float, D: Array) -> tuple[float, float, float]:
    """Omega_ref = E(Theta) [0, 0, psi_dot], and its derivative by Theta.

    Args:
        Theta: Roll, pitch, yaw, (3,).
        psi_dot: Rate of the heading, rad/s.
        D: Result, (3, 3).
    """
    sf, cf = sincos(Theta[0])
    st, ct = sincos(Theta[1])
    D[0, 0], D[1, 0], D[2, 0] = 0.0, psi_dot * cf * ct, -psi_dot * sf * ct
    D[0, 1], D[1, 1], D[2, 1] = -psi_dot * ct, -psi_dot * sf * st, -psi_dot * cf * st
    D[0, 2], D[1, 2], D[2, 2] = 0.0, 0.0, 0.0
    return -psi_dot * st, psi_dot * sf * ct, psi_dot * cf * ct


@kernel
def gauss_newton_weight(Q: Array, D: Array, out: Array) -> None:
    """E'Q E for E = I but for the blocks (V_B, Theta) and (Omega, Theta) = -D; derivative of the residual.

    Args:
        Q: (12, 12), symmetric.
        D: (6, 3), or (3, 3) of V_B alone.
        out: Result, (12, 12).
    """
    n = N_STATE
    copy(Q, out)
    for i in range(n):
        for a in range(3):
            for k in range(D.shape[0]):
                out[i, 6 + a] -= Q[i, 3 + k if k < 3 else 6 + k] * D[k, a]
    for a in range(3):
        for j in range(n):
            total = 0.0
            for k in range(D.shape[0]):
                total += D[k, a] * out[3 + k if k < 3 else 6 + k, j]
            out[6 + a, j] -= total


@kernel
def linearise_cost(inertial: bool, data: MpcData, s: Scratch) -> None:
    """Stage weights Q_i = E_i'Q E_i and references X_i - E_i^-1 e(X_i) about the guess.

    The residual is that of the reward, e = [p - p_ref; V_B - R_BI(Theta) v_ref; Theta - Theta_ref; Omega -
    E(Theta) [0, 0, psi_dot] with the yaw error wrapped; without `inertial`, v_ref is not turned.
    """
    N = s.F.shape[0]
    D = s.square[9, 2:8, :3]
    fill(D, 0.0)
    for i in range(N + 1):
        r, X = s.target[i], s.X[i]
        copy_vector(s.r[i], r)
        if data.heading:
            r[8] = X[8] - wrap_angle_scalar(X[8] - r[8])
        if inertial:
            v = velocity_residual(X[6:9], s.r[i, 3:6], D)
            for k in range(3):
                r[3 + k] = v[k]
                for a in range(3):
                    r[3 + k] -= D[k, a] * (X[6 + a] - r[6 + a])
        blocks = D[:3]
        if s.r[i, 11] != 0.0:  # psi_dot: the heading turns
            blocks = D
            rates = rates_residual(X[6:9], s.r[i, 11], D[3:])
            for k in range(3):
                r[9 + k] = rates[k]
                for a in range(3):
                    r[9 + k] -= D[3 + k, a] * (X[6 + a] - r[6 + a])
        if i < N:
            gauss_newton_weight(data.Q[0], blocks, s.Q[i])
        else:
            gauss_newton_weight(data.P, blocks, s.P)


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
    keep_from: int  # where the guess begins in memory
    data: MpcData
    buffer: Annotated[Array, "numbers"]
    ws: Workspace


_unpack = unpacker(_Call)


@kernel
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
    passes, inertial, keep_from, data, buffer, ws = _unpack(words)
    N = ws.u.shape[0]
    bad = first_non_finite(plants, windows, lasts, disturbances, memories, N + 1)
    if bad >= 0:
        return bad
    H, K = data.normals.shape[0], data.normal.shape[0]
    s = carve(buffer, N, N, H, K, N)
    for j in range(plants.shape[0]):
        begin_row(plants[j], windows[j], lasts[j], disturbances[j], memories[j], which, data, s)
        load_guess(memories[j], memories[j, keep_from:], data.heading, s)
        worst, iterations = 0, 0
        for _ in range(passes):
            linearise_model(data, s)
            linearise_cost(inertial, data, s)
            has_plan = memories[j, 0] > 0.0
            level, count = solve_within_model(s.A, s.B, s.Q, s.P, False, s.target, has_plan, data, s, ws)
            worst, iterations = max(worst, level), iterations + count
            if level > RELAXED or take_step(ws.u, ws.x, s) < CONVERGED:
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

    options_type = NmpcOptions
    options: NmpcOptions
    _kernel = staticmethod(entry_of(_decide_rows))

    def __init__(self, task: Task, options: NmpcOptions | None = None, **changes: Any) -> None:
        options = chosen(NmpcOptions, options, changes)
        super().__init__(task, options, "heading", many_pairs=True, guess=True)
        self._data = self._data._replace(model_tilt=EXACT_TILT)
        self.passes = int(options.passes)
        self._inertial = options.velocity_error == "inertial"

    def _call(self, buffer: Array, ws: Workspace) -> _Call:
        return _Call(self.passes, self._inertial, self._keep_from, self._data, buffer, ws)

    def _pose(self, number: int, memory: Array, s: Scratch, ws: Workspace) -> Problem:
        if number == 0:
            load_guess(memory, memory[self._keep_from :], self._data.heading, s)
        linearise_model(self._data, s)
        linearise_cost(self._inertial, self._data, s)
        return Problem(s.A, s.B, s.Q, s.P, False, s.target)

    def _accept(self, number: int, s: Scratch, ws: Workspace) -> bool:
        return take_step(ws.u, ws.x, s) < CONVERGED or number == self.passes - 1

    def _keep(self, level: int, kept: Array, s: Scratch) -> None:
        keep_guess(level <= RELAXED, s.X, kept[self._keep_from :])
