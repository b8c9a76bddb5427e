"""One closed-loop flight, and at each of its samples what chapter 9 asks of the problem that was solved."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from controllers.qp import StructuredSolver
from controllers.qp.ocp import OcpQp
from controllers.qp.riccati import lqr_gain
from controllers.stability.certificates import (
    best_gain,
    plan_cost,
    predicted_state,
    solve_problem,
    stage_cost,
    terminal_decrease,
    terminal_rows,
)
from quad_envs.parameters import POSITION, Array
from quad_envs.rotations import wrap_angle

_MOVING = 1e-9  # largest gap between r_{i+1} and the model's answer to r_i at rest; rounding
_YAW = 8


class Sample(NamedTuple):
    """What was posed and solved at one sample of a flight."""

    qp: OcpQp
    cost: float  # gamma, the value function; nan where the problem has no solution
    end: Array  # (12,), last state of the plan
    gain: Array  # (4, 12), terminal gain: the one with the smallest D
    u: Array  # (4,), what was flown, F - F_trim, N


class Trace(NamedTuple):
    """Numbers along a flight of T samples, (T,) unless said; nan where there is none."""

    dt: float  # s
    states: Array  # (T+1, 16)
    value: Array  # V_k, the optimal cost
    stage: Array  # l_k, the stage cost
    model: Array  # V of the state that the model of sample k predicts, in the problem of sample k
    plant: Array  # V of the state that came, in the problem of sample k
    following: Array  # V_{k+1}, in the problem of sample k + 1; the last entry is nan
    moving: Array  # 1 where the reference of the plan is no equilibrium of the model, else 0
    decrease: Array  # largest eigenvalue of D with the terminal weight and the gain that suits it best
    riccati_gain: Array  # the same with the gain of the Riccati equation at x_k, as printed
    riccati_weight: Array  # the same with that equation's P(x_k) as terminal weight, too
    tolerance: Array  # up to which these count as zero
    inputs: Array  # N, distance of the terminal law to the rotor limits, (9.17) = (9.29)
    outputs: Array  # SI, distance of the state after it to the state limits, (9.18) = (9.30)
    feasible: Array  # 1 where all limits can be kept over the plan, (9.15) = (9.27), else 0
    end_level: Array  # (x_N - r_N)'Q_f(x_N - r_N)
    departure: Array  # N, largest difference between the flown command and the plan's first
    crashed: bool


def fly(policy: Any, env: Any, seed: int) -> Trace:
    """Fly one episode and examine every sample.

    Args:
        policy: A ControllerPolicy whose controller has `problem`.
        env: The environment, whose observation looks one sample further than the plan.
        seed: Of the environment.
    """
    controller, solver, plain = policy.controller, StructuredSolver(), env.unwrapped
    observation, info = env.reset(seed=seed)
    state: Any = None
    rows: list[dict[str, float]] = []
    states = [plain.state]
    before: tuple[Sample, OcpQp] | None = None
    done = False
    while not done:
        arguments = _arguments(plain.task, observation)
        memory = np.zeros(controller.memory_size) if state is None else state.memory[0]
        action, state = policy.predict(observation[None], state)
        command = _command(plain.task, action[0])
        sample = _sample(controller, solver, arguments, memory, command)
        if before is not None:
            rows[-1] |= _descent(*before, sample, states, solver)
        observation, _, terminated, truncated, info = env.step(action[0])
        states.append(plain.state)
        plant, window, *others = arguments
        shifted = controller.problem(plant, window[1:], *others, memory)
        before = sample, shifted._replace(u_last=sample.u)
        rows.append(_examine(sample, solver))
        done = terminated or truncated
    columns = {name: np.array([row.get(name, np.nan) for row in rows]) for name in Trace._fields[2:-1]}
    return Trace(plain.task.dt, np.array(states), **columns, crashed=bool(info["crashed"]))


def _arguments(task: Any, observation: Any) -> tuple[Array, Array, Array, Array]:
    """What the policy's controller is told: plant, window, last command, disturbance."""
    view = task.layout.decode(observation)
    plant = np.concatenate([view.position, view.V_B, view.Theta, view.Omega, view.F])
    window = np.array(view.preview)
    window[:, POSITION] += view.position
    return plant, window, np.array(view.last_command), np.concatenate([view.torque, view.force])


def _command(task: Any, action: Any) -> Array:
    """Rotor forces of an action, (4,), N."""
    from quad_envs.constraints import forces_from_actions

    return forces_from_actions(action, task.hover_force, task.force_max)


def _sample(
    controller: Any, solver: StructuredSolver, arguments: Any, memory: Array, command: Array
) -> Sample:
    qp = controller.problem(*arguments, memory)
    solution = solve_problem(qp, solver)
    cost, end = np.nan, np.full(len(qp.x_0), np.nan)
    if solution is not None:
        cost, end = plan_cost(qp, solution.u, solution.x), solution.x[-1]
    return Sample(qp, cost, end, best_gain(qp.A[-1], qp.B[-1], qp.Q_f, qp.R[-1]), command + qp.lower)


def _examine(sample: Sample, solver: StructuredSolver) -> dict[str, float]:
    """What one sample says by itself."""
    qp, K = sample.qp, sample.gain
    A, B, Q, R = qp.A[-1], qp.B[-1], qp.Q[-1], qp.R[-1]
    decrease = terminal_decrease(A, B, K, qp.Q_f, Q, R)
    try:
        K_x, P_x = lqr_gain(A, B, Q, R)
        largest = [-terminal_decrease(A, B, K_x, weight, Q, R).margin for weight in (qp.Q_f, P_x)]
    except ValueError:  # no stabilising solution at this state: the figure has a gap there
        largest = [np.nan, np.nan]
    rows = terminal_rows(qp, sample.end, K)
    e = sample.end - qp.r[-1]
    hard = solve_problem(qp, solver, hard=True)
    plan = solve_problem(qp, solver)
    return {
        "value": sample.cost,
        "stage": stage_cost(qp, sample.u),
        "moving": float(_moves(qp)),
        "decrease": -decrease.margin,
        "riccati_gain": largest[0],
        "riccati_weight": largest[1],
        "tolerance": decrease.tolerance,
        "inputs": rows.inputs,
        "outputs": rows.outputs,
        "feasible": float(hard is not None),
        "end_level": float(e @ qp.Q_f @ e),
        "departure": float(np.abs(sample.u - plan.u[0]).max()) if plan is not None and len(plan.u) else 0.0,
    }


def _moves(qp: OcpQp) -> bool:
    """Whether the reference of the plan is anything but a set-point in equilibrium."""
    c = qp.c[-1] if len(qp.c) else np.zeros(len(qp.x_0))
    rest = qp.A[-1] @ qp.r[0] + c - qp.r[0]
    return bool(np.abs(qp.r - qp.r[0]).max() > _MOVING or np.abs(rest).max() > _MOVING)


def _descent(
    sample: Sample, shifted: OcpQp, following: Sample, states: list[Array], solver: StructuredSolver
) -> dict[str, float]:
    """Cost of the next sample: as the model has it, from where the plant is, and as it is posed there."""
    qp = sample.qp
    came = np.array(states[-1][: len(qp.x_0)])
    turned = _in_frame(qp, states[-2], came)
    found = {"following": following.cost}
    for name, x in (("model", predicted_state(qp, sample.u)), ("plant", turned)):
        posed = shifted._replace(x_0=np.ascontiguousarray(x))
        solution = solve_problem(posed, solver)
        found[name] = np.nan if solution is None else plan_cost(posed, solution.u, solution.x)
    return found


def _in_frame(qp: OcpQp, before: Array, after: Array) -> Array:
    """The state that came, in the frame in which the problem of the sample before was posed."""
    turn = before[_YAW] - qp.x_0[_YAW]  # the present yaw in the heading frame, else zero
    sine, cosine = np.sin(turn), np.cos(turn)
    moved = after[POSITION] - before[POSITION]
    x = after.copy()
    x[POSITION] = qp.x_0[POSITION] + [
        cosine * moved[0] + sine * moved[1],
        cosine * moved[1] - sine * moved[0],
        moved[2],
    ]
    x[_YAW] = qp.x_0[_YAW] + wrap_angle(after[_YAW] - before[_YAW])
    return x
