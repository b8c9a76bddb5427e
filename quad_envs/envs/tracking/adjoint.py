"""The tracking task as a differentiable function: its step and reward, and their adjoints, for many flights.

For policy gradients through the dynamics. The forward pass is the environments' own kernel; the backward pass
is `quad_envs.envs.shared.adjoint` for the motion and `reward_vjp` here for the reward.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...compilation.decorators import kernel
from ...constraints import TOLERANCE
from ...parameters import N_STATE, Array
from ...reward import stage_cost_kernel
from ...rotations import sincos, wrap_angle_scalar
from ..shared.adjoint import SCRATCH_ROWS, step_vjp_kernel
from ..shared.task_vector import (
    ACTION_MAX,
    DT,
    FIRST,
    HOVER,
    LOWER,
    N_LIMITS,
    SCALE,
    STOP,
    SUBSTEPS,
    UPPER,
    WEIGHT_Q,
    WEIGHT_R,
)


@kernel
def stage_cost_vjp(
    x: Array, row: Array, command: Array, hover: float, Q: Array, R: Array, bar_x: Array, bar_command: Array
) -> None:
    """Gradient of the stage cost, `reward.stage_cost_kernel`, with respect to x (12,) and command (4,)."""
    sf, cf = sincos(x[6])
    st, ct = sincos(x[7])
    ss, cs = sincos(x[8])
    forward, right, vz = cs * row[3] + ss * row[4], cs * row[4] - ss * row[3], row[5]
    down = st * forward + ct * vz
    e3 = Q[3] * (x[3] - (ct * forward - st * vz))
    e4 = Q[4] * (x[4] - (sf * down + cf * right))
    e5 = Q[5] * (x[5] - (cf * down - sf * right))
    for i in range(3):
        bar_x[i] = 2.0 * Q[i] * (x[i] - row[i])
    bar_x[3], bar_x[4], bar_x[5] = 2.0 * e3, 2.0 * e4, 2.0 * e5
    # The reference velocity in body axes turns with the attitude.
    bar_x[6] = 2.0 * (Q[6] * x[6] - e4 * (cf * down - sf * right) + e5 * (sf * down + cf * right))
    slope = ct * forward - st * vz  # of `down` with the pitch
    bar_x[7] = 2.0 * (Q[7] * x[7] + e3 * down - (e4 * sf + e5 * cf) * slope)
    turn = -e3 * ct * right - e4 * (sf * st * right - cf * forward) - e5 * (cf * st * right + sf * forward)
    # So do the body rates of a heading that turns.
    e9 = Q[9] * (x[9] + st * row[8])
    e10, e11 = Q[10] * (x[10] - sf * ct * row[8]), Q[11] * (x[11] - cf * ct * row[8])
    bar_x[9], bar_x[10], bar_x[11] = 2.0 * e9, 2.0 * e10, 2.0 * e11
    bar_x[6] += 2.0 * row[8] * ct * (e11 * sf - e10 * cf)
    bar_x[7] += 2.0 * row[8] * (e9 * ct + st * (e10 * sf + e11 * cf))
    bar_x[8] = 2.0 * (Q[8] * wrap_angle_scalar(x[8] - np.arctan2(row[6], row[7])) + turn)
    for i in range(4):
        bar_command[i] = 2.0 * R[i] * (command[i] - hover)


@kernel
def violation_vjp(
    x: Array,
    command: Array,
    previous: Array,
    task: Array,
    bar_x: Array,
    bar_command: Array,
    bar_previous: Array,
) -> float:
    """The cost of `kernel.violation_cost`, and its gradient written over the arguments."""
    for i in range(12):
        bar_x[i] = 0.0
    for i in range(4):
        bar_command[i], bar_previous[i] = 0.0, 0.0
    cost = 0.0
    for k in range(int(task[N_LIMITS])):
        worst, side, value = 0, 1.0, -np.inf
        for i in range(int(task[FIRST + k]), int(task[STOP + k])):
            y = x[i] if i < N_STATE else command[i - N_STATE] - previous[i - N_STATE]
            below, above = task[LOWER + i] - y, y - task[UPPER + i]
            if max(below, above) > value:
                worst, side, value = i, 1.0 if above >= below else -1.0, max(below, above)
        if value > TOLERANCE:
            cost += value / task[SCALE + k]
            slope = side / task[SCALE + k]
            if worst < N_STATE:
                bar_x[worst] += slope
            else:
                bar_command[worst - N_STATE] += slope
                bar_previous[worst - N_STATE] -= slope
    return cost


@kernel
def reward_vjp(
    x: Array,
    reference: Array,
    command: Array,
    previous: Array,
    task: Array,
    bar: float,
    bar_cost: float,
    bar_x: Array,
    bar_command: Array,
    bar_previous: Array,
    work: Array,
) -> float:
    """The bounded reward (1 - v) / (1 + l) of a vehicle that flies, and bar times its gradient.

    The reward does not change with a violation above its scale, where v = 1; the cost in `info`, the same
    sum before it is cut off, does.

    Args:
        x: State after the step, (>= 12,).
        reference: Row of the time after the step, (9,).
        command: Rotor commands of the step, (4,), N.
        previous: Of the step before, (4,), N.
        task: Task vector of `kernel`.
        bar: Sensitivity to the reward.
        bar_cost: Sensitivity to the violation cost.
        bar_x: Result, (12,).
        bar_command: Result, (4,).
        bar_previous: Result, (4,).
        work: Scratch, (20,).

    Returns:
        The reward.
    """
    loss = stage_cost_kernel(x, reference, command, task[HOVER], task[WEIGHT_Q], task[WEIGHT_R])
    cost_x, cost_command = work[:12], work[12:16]
    cost = violation_vjp(x, command, previous, task, bar_x, bar_command, bar_previous)
    stage_cost_vjp(x, reference, command, task[HOVER], task[WEIGHT_Q], task[WEIGHT_R], cost_x, cost_command)
    reward = (1.0 - min(1.0, cost)) / (1.0 + loss)
    along_v = bar_cost - (bar / (1.0 + loss) if cost < 1.0 else 0.0)
    along_l = -bar * reward / (1.0 + loss)
    for i in range(12):
        bar_x[i] = along_v * bar_x[i] + along_l * cost_x[i]
    for i in range(4):
        bar_command[i] = along_v * bar_command[i] + along_l * cost_command[i]
        bar_previous[i] *= along_v
    return reward


class TrackingRecord(NamedTuple):
    """One step of n flights, as far as its adjoint needs it."""

    plants: Array  # (n, 16), before
    commands: Array  # (n, 4), N
    previous: Array  # (n, 4), N, commands of the step before
    after: Array  # (n, 16), afterwards, before any reset
    references: Array  # (n, N_TABLE), of the time afterwards
    crashed: NDArray[np.bool_]  # (n,), flights that ended in a crash: their reward is 0 and leads nowhere
    force_max: Array  # (n, 4), N
    coefficients: Array  # (n, N_COEFFICIENTS)
    disturbances: Array  # (n, 2 substeps + 1, 6), at its stage times


@kernel
def tracking_vjp_rows(
    record: TrackingRecord,
    task: Array,
    bars: Array,
    bar_rewards: Array,
    bar_cost: float,
    bar_plants: Array,
    bar_commands: Array,
    bar_previous: Array,
    scratch: Array,
) -> None:
    """Adjoint of one step of n flights: of the plant afterwards and of the reward.

    Args:
        record: Of the step.
        task: Task vector.
        bars: Sensitivity to the plants afterwards, (n, 16).
        bar_rewards: Sensitivity to the rewards, (n,).
        bar_cost: Sensitivity to the violation cost of each flight.
        bar_plants: Result, (n, 16).
        bar_commands: Result, (n, 4).
        bar_previous: Result, (n, 4).
        scratch: (SCRATCH_ROWS + 4, 16).
    """
    substeps = int(task[SUBSTEPS])
    h = task[DT] / substeps
    work, total, direct = scratch[SCRATCH_ROWS : SCRATCH_ROWS + 2].reshape(-1), scratch[-2], scratch[-1]
    plants, commands, previous = record.plants, record.commands, record.previous
    for j in range(plants.shape[0]):
        if record.crashed[j]:
            for i in range(16):
                bar_plants[j, i] = 0.0
            for i in range(4):
                bar_commands[j, i], bar_previous[j, i] = 0.0, 0.0
            continue
        reward_vjp(
            record.after[j], record.references[j], commands[j], previous[j], task, bar_rewards[j], bar_cost,
            total, direct, bar_previous[j], work,
        )  # fmt: skip
        for i in range(12):
            total[i] += bars[j, i]
        for i in range(12, 16):
            total[i] = bars[j, i]
        step_vjp_kernel(
            plants[j], commands[j], record.force_max[j], record.coefficients[j], substeps, h,
            record.disturbances[j], total, bar_plants[j], bar_commands[j], scratch,
        )  # fmt: skip
        for i in range(4):
            bar_commands[j, i] += direct[i]


@kernel
def action_slopes(actions: NDArray[np.floating], task: Array, out: Array) -> None:
    """Derivative of the rotor commands by the actions (n, 4), N; 0 outside the box."""
    for j in range(actions.shape[0]):
        for i in range(4):
            a = actions[j, i]
            out[j, i] = 0.0
            if -1.0 <= a <= 1.0:
                out[j, i] = task[HOVER] if a < 0.0 else task[ACTION_MAX][i] - task[HOVER]
