"""One sample of the MPC of a team in compiled form; `cooperative_mpc.py` says what it is."""

from __future__ import annotations

from typing import Annotated, NamedTuple

from quad_envs.compilation.decorators import entry_of, kernel
from quad_envs.compilation.packed import unpacker
from quad_envs.observations.team import N_PLAN_STAGE, N_SENSED
from quad_envs.observations.tracking import N_REFERENCE
from quad_envs.parameters import N_STATE, Array
from quad_envs.rotations import sincos

from ..controller import all_finite
from ..fallback import HOVER, PREVIOUS_PLAN
from ..model import sdc_matrix, zero_order_hold
from ..mpc.equilibrium import hold_equilibrium
from ..mpc.kernels import (
    MpcData,
    Scratch,
    begin_row,
    copy_vector,
    end_row,
    left_model,
    solve_row,
)
from ..qp.linalg import copy
from ..qp.ocp import IntArray
from ..qp.workspace import Workspace
from .collision import COLLISION_SCRATCH, AvoidanceData, separation_rows
from .consensus_kernels import ConsensusData, consensus_row, inertial_velocity, turn_to_inertial

Team = tuple[Array, ...]  # the arguments of a decision in the order of NAMES, each (n, numbers)
NAMES = (
    "plant", "last_command", "leader", "preview", "comm", "sensed", "estimate_r", "estimate_v", "estimate_P",
    "slot", "disturbance", "memory",
)  # fmt: skip
_PLANT, _LAST, _LEADER, _PREVIEW, _COMM, _SENSED, _R, _V, _P, _SLOT, _DISTURBANCE, _MEMORY = range(12)


class RowLayout(NamedTuple):
    """What the kernels take besides the options of the parts."""

    alpha: float
    turning: float  # alpha, or 0 where positions are predicted as the dissertation does
    stage_weight: bool  # Q_f = Q
    limits: int  # outputs with limits; the normals of the separation rows follow
    limit_rows: int
    slot_normals: int  # normals and rows of one vehicle to keep away from
    slot_rows: int
    message: int  # numbers in a comm slot


@kernel
def level_weight(x_0: Array, P: Array, out: Array) -> None:
    """T'P T with T = blkdiag(I, R', I, I), R = R_BI(phi, theta, 0): P compares velocities in the level frame.

    Args:
        x_0: State in the heading frame, (12,).
        P: (12, 12), belongs to hover, where body and level axes are one.
        out: Result, (12, 12).
    """
    sf, cf = sincos(x_0[6])
    st, ct = sincos(x_0[7])
    copy(P, out)
    for k in range(N_STATE):
        u, v, w = out[3, k], out[4, k], out[5, k]
        down = st * u + ct * w
        out[3, k], out[4, k], out[5, k] = ct * u - st * w, sf * down + cf * v, cf * down - sf * v
    for k in range(N_STATE):
        u, v, w = out[k, 3], out[k, 4], out[k, 5]
        down = st * u + ct * w
        out[k, 3], out[k, 4], out[k, 5] = ct * u - st * w, sf * down + cf * v, cf * down - sf * v


@kernel
def turning_velocity(x_0: Array, alpha: float, D: Array) -> None:
    """D (3, 3), alpha times the derivative of the inertial velocity R_BI(Theta)' V_B by Theta, at psi = 0.

    The model turns V_B with the predicted attitude (the share alpha of -Omega x V_B reads predicted rates),
    but takes it back with the present R_BI': a climbing vehicle that rolls would seem to move sideways, away
    from the side to which its thrust will push it. D (Theta - Theta_k) undoes that.
    """
    sf, cf = sincos(x_0[6])
    st, ct = sincos(x_0[7])
    u, v, w = x_0[3], x_0[4], x_0[5]
    side, under = cf * v - sf * w, sf * v + cf * w  # of R_x(phi)' V_B
    forward = ct * u + st * under
    D[0, 0], D[1, 0], D[2, 0] = alpha * st * side, -alpha * under, alpha * ct * side
    D[0, 1], D[1, 1], D[2, 1] = alpha * (ct * under - st * u), 0.0, -alpha * forward
    D[0, 2], D[1, 2], D[2, 2] = -alpha * side, alpha * forward, 0.0


@kernel
def hold_attitude(x_0: Array, D: Array, dt: float, c: Array) -> None:
    """Complete c (N, 12) where p' has D Theta: its rate is D (Theta - Theta_k), also about the equilibrium.

    dt times the rate is exact, because no state's rate depends on the position.
    """
    for a in range(3):
        rate = 0.0
        for b in range(3):
            rate -= D[a, b] * x_0[6 + b]
        for i in range(c.shape[0]):
            c[i, a] += dt * rate


@kernel
def first_non_finite_row(team: Team) -> int:
    """-1 if every number is finite, else len(team) row + index of the argument."""
    for j in range(team[0].shape[0]):
        for k in range(len(team)):
            if not all_finite(team[k][j]):
                return len(team) * j + k
    return -1


@kernel
def pose_row(
    team: Team,
    j: int,
    which: IntArray | None,
    consensus: ConsensusData,
    avoidance: AvoidanceData,
    layout: RowLayout,
    data: MpcData,
    s: Scratch,
    work: Array,
) -> tuple[int, int]:
    """The problem of vehicle j into s; how many normals and rows count."""
    N = s.c.shape[0]
    plant, memory = team[_PLANT][j], team[_MEMORY][j]
    window = work[: N_REFERENCE * (N + 1)].reshape(N + 1, N_REFERENCE)
    attitude = work[window.size : window.size + 2 * (N + 1)].reshape(N + 1, 2)
    free = work[window.size + attitude.size :]
    preview = team[_PREVIEW][j].reshape(team[_PREVIEW].shape[1] // N_REFERENCE, N_REFERENCE)
    comm = team[_COMM][j].reshape(team[_COMM].shape[1] // layout.message, layout.message)
    sensed = team[_SENSED][j].reshape(team[_SENSED].shape[1] // N_SENSED, N_SENSED)
    leads = team[_LEADER][j, 0] > 0.0
    r, velocity, P, slot = team[_R][j], team[_V][j], team[_P][j], team[_SLOT][j]
    consensus_row(plant, leads, preview, comm, r, velocity, P, slot, consensus, window, attitude, free)
    for n in range(N + 1):
        for a in range(3):
            window[n, a] += plant[a]
    begin_row(plant, window, team[_LAST][j], team[_DISTURBANCE][j], memory, which, data, s)
    for n in range(N + 1):
        for a in range(2):
            s.r[n, 6 + a] += attitude[n, a]
    D = free[9 + COLLISION_SCRATCH : 18 + COLLISION_SCRATCH].reshape(3, 3)
    turning_velocity(s.x_0, layout.turning, D)
    sdc_matrix(s.x_0, layout.alpha, data.coefficients, s.A_c)
    for a in range(3):
        for b in range(3):
            s.A_c[a, 6 + b] += D[a, b]
    zero_order_hold(s.A_c, data.B_c, data.dt, s.A[0], s.B[0], s.square)
    copy_vector(s.x_0, s.points[0])
    hold_equilibrium(s.A, s.B, data.fade < 1.0, s.stages, s.c)
    hold_attitude(s.x_0, D, data.dt, s.c)
    if layout.stage_weight:
        copy(data.Q[0], s.P)
    else:
        level_weight(s.x_0, data.P, s.P)
    plan = memory[memory.shape[0] - N_PLAN_STAGE * N :]
    v, other, rest = free[:3], free[3:9], free[9:]
    v[0], v[1], v[2] = inertial_velocity(plant)
    used = separation_rows(
        plant, v, comm, sensed, plan if memory[0] > 0.0 else plan[:0], N, avoidance, D,
        s.normals[layout.limits :], s.row_lower[layout.limit_rows :], other, rest,
    )  # fmt: skip
    return layout.limits + layout.slot_normals * used, layout.limit_rows + layout.slot_rows * used


@kernel
def _write_plan(level: int, plant: Array, x: Array, old: Array, dt: float, plan: Array) -> None:
    """Positions and velocities of the states x, or of the plan of the sample before, (6 N,); both flat.

    The prediction turns velocities with the present attitude, as the model does.
    """
    N, m = x.shape[0] - 1, N_PLAN_STAGE
    ss, cs = sincos(plant[8])
    for i in range(N):
        if level == HOVER:
            for a in range(m):
                plan[m * i + a] = 0.0
        elif level == PREVIOUS_PLAN:
            k = min(i + 1, N - 1)
            for a in range(3):
                plan[m * i + 3 + a] = old[m * k + 3 + a]
                plan[m * i + a] = old[m * k + a] - old[a] + (i + 1 - k) * dt * old[m * k + 3 + a]
        else:
            X, Y = x[i + 1, 0], x[i + 1, 1]
            plan[m * i], plan[m * i + 1], plan[m * i + 2] = cs * X - ss * Y, ss * X + cs * Y, x[i + 1, 2]
            v = turn_to_inertial(x[i + 1, 3:6], plant)
            plan[m * i + 3], plan[m * i + 4], plan[m * i + 5] = v


class TeamCall(NamedTuple):
    """What a decision takes beside its rows."""

    consensus: ConsensusData
    avoidance: AvoidanceData
    layout: RowLayout
    data: MpcData
    s: Scratch
    work: Annotated[Array, "numbers"]  # of `pose_row`
    ws: Workspace


_unpack = unpacker(TeamCall)


@kernel
def _decide_team(
    team: Team,
    commands: Array,
    kept: Array,
    report: IntArray,
    which: IntArray | None,
    words: IntArray,
) -> int:
    """One decision per vehicle; -1, or the code of the first argument that is not finite."""
    consensus, avoidance, layout, data, s, work, ws = _unpack(words)
    bad = first_non_finite_row(team)
    if bad >= 0:
        return bad
    N = ws.u.shape[0]
    for j in range(commands.shape[0]):
        H, K = pose_row(team, j, which, consensus, avoidance, layout, data, s, work)
        plant, memory = team[_PLANT][j], team[_MEMORY][j]
        level, iterations = solve_row(
            s.A, s.B, data.Q, data.R, s.P, False, s.r, memory[0] > 0.0, H, K, data, s, ws
        )
        end_row(
            level, plant, team[_LAST][j], team[_DISTURBANCE][j], memory, data, s, ws.u, commands[j], kept[j]
        )
        start = kept.shape[1] - N_PLAN_STAGE * N
        _write_plan(level, plant, ws.x, memory[start:], data.dt, kept[j, start:])
        left = left_model(level, s.x_0, ws.x, s.points, data.model_tilt, data.first_angle)
        report[0, j], report[1, j], report[2, j] = level, iterations, left
    return bad


decide_team = entry_of(_decide_team)
