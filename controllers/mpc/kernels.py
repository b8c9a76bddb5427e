"""One sample of an MPC in compiled form: what comes before the solve, the fallbacks, and what comes after it.

The flavours (`lmpc.py`, `sdc.py`, `exact.py`) add how the pairs (A_i, B_i) and affine terms c_i are made.

Memory of one vehicle: whether a plan is held, the plan's rotor commands (N x 4), the solver's working set
(N), then, with `reject_disturbance`, the estimator's ESTIMATOR_SIZE numbers, then what the flavour keeps.
"""

from __future__ import annotations

import math
from typing import Annotated, NamedTuple

import numpy as np

from quad_envs.compilation.decorators import kernel
from quad_envs.parameters import HOVER_FORCE, N_INPUT, N_STATE, Array
from quad_envs.rotations import sincos

from ..disturbance import ESTIMATOR_SCRATCH, N_DISTURBANCE, feed_forward, remember, update_estimate
from ..fallback import CLIPPED_SDRE, HOVER, NONE, PREVIOUS_PLAN, RELAXED, RELAXED_WEIGHT, limit_command
from ..frame import add_rotor_lag, level_velocity, set_references, set_state, turn_rows
from ..qp.active_set import INACCURATE, INFEASIBLE, OPTIMAL
from ..qp.linalg import copy
from ..qp.ocp import IntArray, OcpQp, StateRows
from ..qp.riccati import DARE_SCRATCH
from ..qp.structured import solve_qp
from ..qp.working_set import pack_working_set, unpack_working_set
from ..qp.workspace import Workspace
from .equilibrium import EQUILIBRIUM, spread_equilibrium
from .present_axes import body_outputs

MEMORY_STAGE = N_INPUT + 1  # numbers that a plan and its working set take per stage
FROZEN_SPAN = 0.5  # rad, of roll, pitch or yaw, for which the pair taken at a state still serves
_ROOM = 1e-3  # rad beyond, which a solver may leave of an active row
_CLOSE = 1e-4  # of the largest force, and of a row: below what a model knows, above what round-off leaves


class MpcData(NamedTuple):
    """Constants of one controller, for compiled code."""

    coefficients: Annotated[Array, "N_COEFFICIENTS"]
    B_c: Annotated[Array, "12, 4"]
    Q: Annotated[Array, "1, 12, 12"]
    R: Annotated[Array, "1, 4, 4"]
    R_rate: Annotated[Array, "4 or 0, 4"]  # 0 for none
    P: Annotated[Array, "12, 12"]  # weight of x_N: solves the Riccati equation of the hover pair
    normals: Annotated[Array, "H, 12"]  # outputs with limits
    axis: Annotated[IntArray, "H"]  # 0..2 where the output is that coordinate of the position, else -1
    normal: Annotated[IntArray, "K"]
    stage: Annotated[IntArray, "K"]
    lower: Annotated[Array, "K"]
    upper: Annotated[Array, "K"]
    weight: Annotated[Array, "K"]
    dt: float
    force_max: Annotated[Array, "4"]  # N
    rate_step: float
    lag: float  # of slow rotors, s, see `frame.rotor_lag`
    gain: Annotated[Array, "6"]  # of the disturbance estimator, 0 for none
    fade: float  # factor of its estimate from stage to stage, 1: it stays
    heading: bool  # whether the problem is posed at the present position and heading
    attitude: bool  # whether v_ref is turned into the present body axes
    level: bool  # whether the model's velocity stands in level axes, as v_ref, instead of in body axes
    present: bool  # whether it stands in those of the present attitude, which do not turn along a plan
    kinematics: bool  # whether the model turns body rates into Euler rates at the present attitude
    iteration_limit: int
    plan_bound: Annotated[Array, "12"]  # magnitude of a state where the plan's own rows begin, inf: none
    own_outputs: int  # outputs and rows of the task's limits, which stand first
    own_rows: int
    model_tilt: float  # rad, roll and pitch up to which the model holds
    first_angle: int  # of the state, of those that may not leave the point of the model: 6 (all) or 8 (yaw)


class Scratch(NamedTuple):
    """One sample's problem and the memory to make it."""

    x_0: Annotated[Array, "12"]
    trim: Annotated[Array, "12"]  # equilibrium under the disturbance, of what is left of it at the plan's end
    offset: Annotated[Array, "4"]  # equilibrium rotor forces; u = F - offset
    lower: Annotated[Array, "4"]  # of u
    upper: Annotated[Array, "4"]
    u_last: Annotated[Array, "4"]
    d: Annotated[Array, "6"]  # disturbance in the axes of the problem
    estimate: Annotated[Array, "6"]  # of what is not revealed
    fading: Annotated[Array, "6"]  # the same in the axes of the problem
    stages: Annotated[Array, "N, EQUILIBRIUM"]  # equilibrium of each stage, see `equilibrium`
    r: Annotated[Array, "N+1, 12"]
    c: Annotated[Array, "N, 12"]
    A: Annotated[Array, "1 or N, 12, 12"]
    B: Annotated[Array, "1 or N, 12, 4"]
    normals: Annotated[Array, "H, 12"]
    row_lower: Annotated[Array, "K"]
    row_upper: Annotated[Array, "K"]
    weight: Annotated[Array, "K"]
    A_c: Annotated[Array, "12, 12"]
    P: Annotated[Array, "12, 12"]
    square: Annotated[Array, "DARE_SCRATCH, 12, 12"]
    work: Annotated[Array, "ESTIMATOR_SCRATCH"]
    working: Annotated[Array, "N"]  # working set of the solver, one number per stage
    Q: Annotated[Array, "M, 12, 12"]  # stage weights; M = N where a guess is kept, else 0
    R: Annotated[Array, "M, 4, 4"]  # those of the inputs
    target: Annotated[Array, "M+1, 12"]  # references that go with them
    X: Annotated[Array, "M+1, 12"]  # guess of the states
    F: Annotated[Array, "M, 4"]  # and of the rotor forces
    points: Annotated[Array, "1 or N, 12"]  # states at which the pairs were taken; hover: zeros
    loss: Annotated[Array, "M"]  # stage costs l(x_{i+1}, u_i) of the guess
    floor: Annotated[Array, "1"]  # least weight of a stage in the next pass, see `score.weigh_stages`


def make_scratch(N: int, pairs: int, H: int, K: int, M: int) -> Scratch:
    """Memory for samples with a horizon N, so many pairs, H normals, K rows and a guess of M stages."""
    n, m, e = N_STATE, N_INPUT, N_DISTURBANCE
    shapes: dict[str, tuple[int, ...]] = {
        "x_0": (n,), "trim": (n,), "offset": (m,), "lower": (m,), "upper": (m,), "u_last": (m,),
        "d": (e,), "estimate": (e,), "fading": (e,), "stages": (N, EQUILIBRIUM), "r": (N + 1, n), "c": (N, n),
        "A": (pairs, n, n), "B": (pairs, n, m),
        "normals": (H, n), "row_lower": (K,), "row_upper": (K,), "weight": (K,), "A_c": (n, n), "P": (n, n),
        "square": (DARE_SCRATCH, n, n), "work": (ESTIMATOR_SCRATCH,), "working": (N,), "Q": (M, n, n),
        "R": (M, m, m), "target": (M + 1, n), "X": (M + 1, n), "F": (M, m), "points": (pairs, n),
        "loss": (M,), "floor": (1,),
    }  # fmt: skip
    return Scratch(**{name: np.zeros(shape) for name, shape in shapes.items()})


@kernel
def copy_vector(x: Array, out: Array) -> None:
    """As `linalg.copy`, for vectors."""
    for i in range(out.shape[0]):
        out[i] = x[i]


@kernel
def begin_row(
    plant: Array,
    window: Array,
    last: Array,
    revealed: Array,
    memory: Array,
    which: IntArray | None,
    data: MpcData,
    s: Scratch,
) -> None:
    """One sample's problem but for the model: disturbance, equilibrium, state, reference, bounds, rows.

    Without an estimator `which` is None, and its code is not even compiled; else zeros, (1,).
    """
    N = s.c.shape[0]
    working = memory[1 + N_INPUT * N : 1 + MEMORY_STAGE * N]
    for i in range(N):
        s.working[i] = working[min(i + 1, N - 1)]
    for i in range(N_DISTURBANCE):
        s.estimate[i] = 0.0
    if which is not None:
        kept = memory[1 + MEMORY_STAGE * N :]
        update_estimate(
            plant, kept, data.gain, data.coefficients, data.dt, data.force_max, s.estimate, s.work
        )
    for i in range(N_DISTURBANCE):
        s.d[i] = revealed[i] + s.estimate[i]
    feed_forward(s.d, plant[8], data.coefficients, data.force_max, s.offset, s.trim)
    copy_vector(s.estimate, s.fading)
    if data.heading:
        sine, cosine = sincos(plant[8])
        s.d[3], s.d[4] = cosine * s.d[3] + sine * s.d[4], cosine * s.d[4] - sine * s.d[3]
        x, y = s.fading[3], s.fading[4]
        s.fading[3], s.fading[4] = cosine * x + sine * y, cosine * y - sine * x
    set_state(plant, data.heading, s.x_0)
    add_rotor_lag(plant, s.offset, data.B_c, data.lag, s.x_0)
    spread_equilibrium(
        revealed, s.estimate, data.fade, plant[8], data.coefficients, data.force_max, s.offset, s.trim,
        s.stages, s.square[0],
    )  # fmt: skip
    if data.level:
        level_velocity(s.x_0)
    set_references(plant, window, s.trim, data.heading, data.attitude, data.kinematics, N + 1, data.dt, s.r)
    for a in range(N_INPUT):
        s.lower[a] = -s.offset[a]
        s.upper[a] = data.force_max[a] - s.offset[a]
        s.u_last[a] = last[a] - s.offset[a]
    copy(data.normals, s.normals)
    copy_vector(data.lower, s.row_lower)
    copy_vector(data.upper, s.row_upper)
    copy_vector(data.weight, s.weight)
    if data.heading:
        turn_rows(plant, data.axis, data.normal, s.normals, s.row_lower, s.row_upper)
    if data.level or data.present:
        body_outputs(plant, data.level, data.normal, s.normals, s.row_lower, s.row_upper)


@kernel
def _widen(lower: Array, upper: Array) -> None:
    """No bounds."""
    for k in range(lower.shape[0]):
        lower[k] = -math.inf
        upper[k] = math.inf


@kernel
def _is_close(error: Array, force_max: Array) -> bool:
    """Whether a plan that is optimal but for round-off may be flown; see `Workspace.error`."""
    return bool(error[0] <= _CLOSE * force_max[0] and error[1] <= _CLOSE)


@kernel
def solve_row(
    A: Array,
    B: Array,
    Q: Array,
    R: Array,
    Q_f: Array,
    stationary: bool,
    r: Array,
    has_plan: bool,
    H: int,
    K: int,
    data: MpcData,
    s: Scratch,
    ws: Workspace,
) -> tuple[int, int]:
    """Solve; hard rows that contradict each other become soft; failing that, without a plan, no constraints.

    Only the first H normals and K rows count: where their number differs from vehicle to vehicle, the others
    are left out. The solver starts from the working set in s.working and leaves its own there.

    Returns:
        Fallback (PREVIOUS_PLAN and HOVER leave no plan in ws.u), and active-set iterations.
    """
    level = NONE
    iterations = 0
    rate_step = data.rate_step
    stage, n_rows = data.stage[:K], 4 * ws.u.size + 2 * K
    rows = StateRows(s.normals[:H], data.normal[:K], stage, s.row_lower[:K], s.row_upper[:K], s.weight[:K])
    warm = unpack_working_set(s.working, stage, ws.active, ws.guess[:n_rows])
    for i in range(s.working.shape[0]):
        s.working[i] = 0.0
    while True:
        qp = OcpQp(
            A, B, s.c, Q, R, Q_f, stationary, s.x_0, r, s.lower, s.upper, rate_step, s.u_last, rows,
            data.R_rate,
        )  # fmt: skip
        status, count = solve_qp(qp, data.iteration_limit, warm, ws)
        iterations += count
        close = status == INACCURATE and _is_close(ws.error, data.force_max)
        if status == OPTIMAL or close:
            if warm or iterations > 0:
                pack_working_set(ws.state[:n_rows], stage, ws.active, s.working)
            return level, iterations
        if level == CLIPPED_SDRE:
            return HOVER, iterations
        if level == NONE and status == INFEASIBLE:
            level = RELAXED
            for k in range(s.weight.shape[0]):
                s.weight[k] = min(s.weight[k], RELAXED_WEIGHT)
        elif has_plan:
            return PREVIOUS_PLAN, iterations
        else:
            level = CLIPPED_SDRE
            warm = False
            rate_step = math.inf
            _widen(s.lower, s.upper)
            _widen(s.row_lower, s.row_upper)


@kernel
def leaves_bound(x: Array, bound: Array) -> bool:
    """Whether roll, pitch or a body rate of a plan (N+1, 12) is larger than its bound (12,)."""
    for i in range(1, x.shape[0]):
        for a in (6, 7, 9, 10, 11):
            if abs(x[i, a]) > bound[a]:
                return True
    return False


@kernel
def solve_within_model(
    A: Array,
    B: Array,
    Q: Array,
    R: Array,
    Q_f: Array,
    stationary: bool,
    r: Array,
    has_plan: bool,
    data: MpcData,
    s: Scratch,
    ws: Workspace,
) -> tuple[int, int]:
    """`solve_row` with the task's rows; where the plan leaves what its model holds for, with its own, too.

    Most plans never come near: to leave those rows out at first costs them nothing.
    """
    H, K = data.own_outputs, data.own_rows
    level, iterations = solve_row(A, B, Q, R, Q_f, stationary, r, has_plan, H, K, data, s, ws)
    if level <= RELAXED and leaves_bound(ws.x, data.plan_bound):
        H, K = data.normals.shape[0], data.normal.shape[0]
        again, count = solve_row(A, B, Q, R, Q_f, stationary, r, has_plan, H, K, data, s, ws)
        level, iterations = max(level, again), iterations + count
    return level, iterations


@kernel
def left_model(level: int, x_0: Array, x: Array, points: Array, model_tilt: float, first_angle: int) -> bool:
    """Whether the state or the plan of a decision is where the model does not hold.

    That is: roll or pitch beyond `model_tilt`, or (stages 1 to N) an Euler angle more than FROZEN_SPAN from
    the state at which the pair of the stage was taken. Without a plan of its own (PREVIOUS_PLAN, HOVER) a
    decision has its state alone.

    Args:
        level: Fallback.
        x_0: State, (12,).
        x: Plan, (N+1, 12).
        points: Where the pairs were taken, (1 or N, 12).
        model_tilt: rad.
        first_angle: First of the states that are compared with those points, 6, or 8 for yaw alone.
    """
    tilt, span = model_tilt + _ROOM, FROZEN_SPAN + _ROOM
    if abs(x_0[6]) > tilt or abs(x_0[7]) > tilt:
        return True
    if level == PREVIOUS_PLAN or level == HOVER:
        return False
    for i in range(1, x.shape[0]):
        if abs(x[i, 6]) > tilt or abs(x[i, 7]) > tilt:
            return True
        point = points[min(i, points.shape[0] - 1)]
        for a in range(first_angle, 9):
            if abs(x[i, a] - point[a]) > span:
                return True
    return False


@kernel
def end_row(
    level: int,
    plant: Array,
    last: Array,
    revealed: Array,
    memory: Array,
    data: MpcData,
    s: Scratch,
    u: Array,
    command: Array,
    kept: Array,
) -> None:
    """The command of one decision, and its memory."""
    N = u.shape[0]
    plan, old = kept[1 : 1 + N_INPUT * N], memory[1 : 1 + N_INPUT * N]
    for i in range(N):
        for a in range(N_INPUT):
            k = N_INPUT * i + a
            if level == PREVIOUS_PLAN:
                plan[k] = old[min(k + N_INPUT, N_INPUT * (N - 1) + a)]
            elif level == HOVER:
                plan[k] = data.coefficients[HOVER_FORCE]
            else:
                plan[k] = s.offset[a] + u[i, a]
        kept[1 + N_INPUT * N + i] = s.working[i]
    kept[0] = 1.0 if level <= PREVIOUS_PLAN else 0.0
    limit_command(plan, last, data.rate_step, data.force_max, command)  # also what a backend leaves over
    if data.gain[0] > 0.0:
        remember(plant, command, revealed, s.estimate, kept[1 + MEMORY_STAGE * N :])
