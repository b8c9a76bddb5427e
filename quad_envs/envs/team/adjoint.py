"""The step, the rewards and the observations of a team as differentiable functions, by their adjoints.

For policy gradients through the dynamics of many teams: sensitivities pass from a vehicle to those that hear
it, sense it, or are scored beside it. The forward pass is the environments' own kernel. Given and not
differentiated are: who is heard, sensed and nearest, the age of a message, measurements of a target,
disturbances and the noise of sensors.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...compilation.decorators import inline_kernel, kernel
from ...compilation.packed import IntArray
from ...constraints import TOLERANCE
from ...lanes import N_PLANT
from ...observations.team import N_COMM, N_PLAN_STAGE, N_SENSED
from ...observations.tracking import N_OWN, N_REFERENCE
from ...parameters import N_INPUT, N_STATE, Array
from ...reward import stage_cost_kernel
from ...rotations import sincos
from ..shared.adjoint import STAGE_ROWS, forget_saturated, roll_back, roll_out
from ..shared.task_vector import (
    DT,
    HOVER,
    PREVIEW,
    SEES_DISTURBANCE,
    SEES_POSITION,
    SUBSTEPS,
    WEIGHT_Q,
    WEIGHT_R,
)
from ..tracking.adjoint import stage_cost_vjp, violation_vjp
from .exchange import (
    FAR,
    FORMATION_WEIGHT,
    HAS_LEADER,
    N_MOTION,
    N_VALUES,
    PLAN_STAGES,
    SCALES,
    SENSED_SLOTS,
    SEPARATION,
    Tables,
    motion,
    sense,
)

_NOBODY = -1
_VEHICLE_ROWS = 3  # of scratch: gradients of stage cost and violation, and by the commands

Bools = NDArray[np.bool_]


class TeamRecord(NamedTuple):
    """One step of n vehicles in teams, as far as its adjoint needs it; rows are of before the step."""

    plants: Array  # (n, 16)
    previous: Array  # (n, 4), N, commands of the step before
    commands: Array  # (n, 4), N, of this step
    after: Array  # (n, 16), plants afterwards
    wanted: Array  # (n, N_TABLE), where each should be after it
    steps: IntArray  # (n,), control step of the episode
    ages: IntArray  # (n, K), control steps since the message in each comm slot was sent; -1: nothing valid
    flew: Bools  # (n,), who took part
    crashed: Bools  # (n,), who crashed in it: its reward is 0 and leads nowhere
    force_max: Array  # (n, 4), N
    coefficients: Array  # (n, N_COEFFICIENTS)
    disturbances: Array  # (n, 2 substeps + 1, 6), at its stage times


class TeamScratch(NamedTuple):
    """Memory of the adjoint, for one team; `team_scratch` makes it."""

    past: Array  # (N, substeps + 1, 16), plants at the ends of substeps
    bars: Array  # (N, substeps + 1, 16), what their sensitivity gains there
    stages: Array  # (STAGE_ROWS, 16)
    work: Array  # (_VEHICLE_ROWS, 16)
    motions: Array  # (N, N_MOTION)
    places: Array  # (3, N)
    squares: Array  # (N,)
    key: Array  # (K_s,)
    near: Array  # (K_s,)


def team_scratch(vehicles: int, substeps: int, sensed: int) -> TeamScratch:
    """Scratch for teams of some vehicles with some sensed slots."""
    return TeamScratch(
        np.zeros((vehicles, substeps + 1, N_PLANT)),
        np.zeros((vehicles, substeps + 1, N_PLANT)),
        np.zeros((STAGE_ROWS, N_PLANT)),
        np.zeros((_VEHICLE_ROWS, N_PLANT)),
        np.zeros((vehicles, N_MOTION)),
        np.zeros((3, vehicles)),
        np.zeros(vehicles),
        np.zeros(sensed),
        np.zeros(sensed),
    )


@kernel
def motion_vjp(x: Array, bar: Array, bar_x: Array) -> None:
    """Adjoint of `exchange.motion` of a plant (16,): adds to bar_x what bar (10,) makes of it."""
    sf, cf = sincos(x[6])
    st, ct = sincos(x[7])
    ss, cs = sincos(x[8])
    down, right = sf * x[4] + cf * x[5], cf * x[4] - sf * x[5]
    forward = ct * x[3] + st * down
    ahead, beside = cs * bar[3] + ss * bar[4], cs * bar[4] - ss * bar[3]  # sensitivities to forward, right
    below = st * ahead + ct * bar[5]  # to down
    for i in range(3):
        bar_x[i] += bar[i]
    bar_x[3] += ct * ahead - st * bar[5]
    bar_x[4] += sf * below + cf * beside
    bar_x[5] += cf * below - sf * beside
    bar_x[6] += bar[6] + below * right - beside * down
    bar_x[7] += bar[7] + ahead * (ct * down - st * x[3]) - bar[5] * forward
    bar_x[8] += bar[8] * cs - bar[9] * ss + bar[4] * (cs * forward - ss * right)
    bar_x[8] -= bar[3] * (ss * forward + cs * right)


@inline_kernel
def _nearest(i: int, first: int, flew: Bools, past: Array) -> tuple[int, int, float]:
    """Who came nearest to vehicle i, at the end of which substep, and how near; -1 if nobody flies."""
    other, at, least = _NOBODY, 0, math.inf
    for j in range(past.shape[0]):
        if j == i or not flew[first + j]:
            continue
        for s in range(1, past.shape[1]):
            a, b = past[i, s], past[j, s]
            square = (a[0] - b[0]) ** 2 + (a[1] - b[1]) ** 2 + (a[2] - b[2]) ** 2
            if square < least:
                other, at, least = j, s, square
    return other, at, math.sqrt(least)


@kernel
def _formation(
    i: int, k: int, first: int, flew: Bools, tables: Tables, past: Array, weight: float, bars: Array
) -> float:
    """Formation error of vehicle i, see `scores`; adds `weight` times its gradient to the last bars."""
    last, total, count = past.shape[1] - 1, 0.0, 0
    graph = tables.weights[tables.schedule[min(k, tables.schedule.shape[0] - 1)], i]
    for s in range(graph.shape[0]):
        if graph[s] > 0.0 and flew[first + tables.neighbours[i, s]]:
            count += 1
    for s in range(graph.shape[0]):
        j = tables.neighbours[i, s]
        if graph[s] > 0.0 and flew[first + j]:
            for c in range(3):
                off = past[i, last, c] - past[j, last, c] - tables.offsets[i, s, c]
                total += off * off
                bars[i, last, c] += 2.0 * weight * off / count
                bars[j, last, c] -= 2.0 * weight * off / count
    return total / count if count > 0 else 0.0


@inline_kernel
def _distance_vjp(p: Array, q: Array, slope: float, bar_p: Array, bar_q: Array) -> None:
    """Add what slope = sensitivity / |p - q| makes of two places."""
    for c in range(3):
        bar_p[c] += slope * (p[c] - q[c])
        bar_q[c] -= slope * (p[c] - q[c])


@kernel
def judge_vehicle_vjp(
    i: int,
    first: int,
    record: TeamRecord,
    tables: Tables,
    task: Array,
    team: Array,
    kept: float,
    bar: float,
    bar_cost: float,
    bar_command: Array,
    bar_previous: Array,
    scratch: TeamScratch,
) -> float:
    """The bounded reward of a vehicle that flies, as in `scores.judge_team`, and bar times its gradient.

    The cost is the sum of scaled violations, in which the distance between vehicles counts below `kept`.

    Args:
        i: Vehicle of the team.
        first: First vehicle of the team.
        record: Of the step; it and the next four as in `advance_teams_vjp`.
        tables: The tables.
        task: Task vector.
        team: Team vector.
        kept: m.
        bar: Sensitivity to the reward.
        bar_cost: Sensitivity to the cost.
        bar_command: Result, (4,).
        bar_previous: Result, (4,).
        scratch: `past` of the team; adds to its `bars`.
    """
    k, last = record.steps[first + i] + 1, scratch.past.shape[1] - 1
    command, previous, row = record.commands[first + i], record.previous[first + i], record.wanted[first + i]
    past, bars, x = scratch.past, scratch.bars, scratch.past[i, last]
    cost_x, limit_x, cost_u = scratch.work[0], scratch.work[1], scratch.work[2, :N_INPUT]
    Q, R, weight = task[WEIGHT_Q], task[WEIGHT_R], team[FORMATION_WEIGHT]
    loss = stage_cost_kernel(x, row, command, task[HOVER], Q, R)
    loss += weight * _formation(i, k, first, record.flew, tables, past, 0.0, bars)
    cost = violation_vjp(x, command, previous, task, limit_x, bar_command, bar_previous)
    other, at, distance = _nearest(i, first, record.flew, past)
    scale = team[SCALES + int(team[N_VALUES]) - 1]
    if team[SEPARATION] - distance > TOLERANCE:
        cost += (team[SEPARATION] - distance) / scale
    reward = (1.0 - min(1.0, cost)) / (1.0 + loss)
    along_loss = -bar * reward / (1.0 + loss)
    along_violation = -bar / (1.0 + loss) if cost < 1.0 else 0.0
    along_limits = along_violation + bar_cost
    stage_cost_vjp(x, row, command, task[HOVER], Q, R, cost_x, cost_u)
    for c in range(N_STATE):
        bars[i, last, c] += along_limits * limit_x[c] + along_loss * cost_x[c]
    for c in range(N_INPUT):
        bar_command[c] = along_limits * bar_command[c] + along_loss * cost_u[c]
        bar_previous[c] *= along_limits
    _formation(i, k, first, record.flew, tables, past, along_loss * weight, bars)
    too_near, nearer = team[SEPARATION] - distance > TOLERANCE, kept - distance > TOLERANCE
    along = -(along_violation * too_near + bar_cost * nearer) / scale  # the distance
    if along != 0.0 and distance > 0.0:
        _distance_vjp(past[i, at], past[other, at], along / distance, bars[i, at], bars[other, at])
    return float(reward)


@kernel
def advance_teams_vjp(
    record: TeamRecord,
    tables: Tables,
    task: Array,
    team: Array,
    kept: float,
    bars: Array,
    bar_rewards: Array,
    bar_cost: float,
    bar_plants: Array,
    bar_commands: Array,
    bar_previous: Array,
    scratch: TeamScratch,
) -> None:
    """Adjoint of one step of all teams: of the plants afterwards, the rewards and the costs.

    Args:
        record: Of the step.
        tables: The tables.
        task: Task vector.
        team: Team vector.
        kept: m, distance between vehicles below which the cost counts it.
        bars: Sensitivity to the plants afterwards, (n, 16).
        bar_rewards: Sensitivity to the rewards, (n,).
        bar_cost: Sensitivity to the cost of each vehicle.
        bar_plants: Result, (n, 16).
        bar_commands: Result, (n, 4).
        bar_previous: Result, (n, 4).
        scratch: Of `team_scratch`.
    """
    n, substeps = tables.neighbours.shape[0], int(task[SUBSTEPS])
    h = task[DT] / substeps
    bar_plants[:], bar_commands[:], bar_previous[:] = 0.0, 0.0, 0.0
    for first in range(0, bars.shape[0], n):
        scratch.bars[:] = 0.0
        for i in range(n):
            r = first + i
            if record.flew[r]:
                roll_out(
                    record.plants[r], record.commands[r], record.force_max[r], record.coefficients[r],
                    substeps, h, record.disturbances[r], scratch.past[i], scratch.stages,
                )  # fmt: skip
                for k in range(record.after.shape[1]):
                    scratch.past[i, substeps, k] = record.after[r, k]
        for i in range(n):
            r = first + i
            if record.flew[r] and not record.crashed[r]:
                judge_vehicle_vjp(
                    i, first, record, tables, task, team, kept, bar_rewards[r], bar_cost,
                    bar_commands[r], bar_previous[r], scratch,
                )  # fmt: skip
        for i in range(n):
            if record.flew[first + i]:
                _fly_back(first + i, i, record, substeps, h, bars, bar_plants, bar_commands, scratch)


@kernel
def _fly_back(
    r: int,
    i: int,
    record: TeamRecord,
    substeps: int,
    h: float,
    bars: Array,
    bar_plants: Array,
    bar_commands: Array,
    scratch: TeamScratch,
) -> None:
    """Take the sensitivity of row r, vehicle i of its team, back over the control period."""
    bar, direct = bar_plants[r], scratch.work[0]
    for c in range(N_INPUT):
        direct[c] = bar_commands[r, c]  # of the rewards; a saturated command has its cost still
        bar_commands[r, c] = 0.0
    for c in range(N_PLANT):
        bar[c] = bars[r, c]
    for s in range(substeps - 1, -1, -1):
        for c in range(N_PLANT):
            bar[c] += scratch.bars[i, s + 1, c]
        roll_back(
            scratch.past[i, s], record.commands[r], record.force_max[r], record.coefficients[r], h,
            record.disturbances[r, 2 * s : 2 * s + 3], bar, bar_commands[r], scratch.stages,
        )  # fmt: skip
    forget_saturated(record.commands[r], record.force_max[r], bar_commands[r])
    for c in range(N_INPUT):
        bar_commands[r, c] += direct[c]


@kernel
def observe_teams_vjp(
    record: TeamRecord,
    t: int,
    tables: Tables,
    task: Array,
    team: Array,
    bars: Array,
    owed: Array,
    bar_plants: Array,
    bar_commands: Array,
    scratch: TeamScratch,
) -> None:
    """Adjoint of the observations from which all teams decided a step, `exchange.observe_agent`.

    A message that was sent before the window began is given.

    Args:
        record: Of the step.
        t: Which step of the window it is.
        tables: The tables.
        task: Task vector.
        team: Team vector.
        bars: Sensitivity to the observations, (n, layout.size).
        owed: Sensitivity to the motions of each step of the window, (T, n, N_MOTION); steps after t are
            done, those up to t gain.
        bar_plants: Result, (n, 16).
        bar_commands: Result: sensitivity to the last commands, (n, 4).
        scratch: Of `team_scratch`.
    """
    n = tables.neighbours.shape[0]
    for first in range(0, bars.shape[0], n):
        for i in range(n):
            x, flies = record.plants[first + i], record.flew[first + i]
            motion(x, sincos(x[6]) + sincos(x[7]) + sincos(x[8]), scratch.motions[i])
            for c in range(3):
                scratch.places[c, i] = x[c] if flies else FAR
        for i in range(n):
            r = first + i
            for c in range(N_PLANT):
                bar_plants[r, c] = 0.0
            for c in range(N_INPUT):
                bar_commands[r, c] = 0.0
            if record.flew[r]:
                at = _own_vjp(r, i == 0 and team[HAS_LEADER] > 0.0, record, task, bars[r], bar_plants[r])
                for c in range(N_INPUT):
                    bar_commands[r, c] = bars[r, N_OWN - N_INPUT + c]
                at = _messages_vjp(i, first, t, record, tables, team, bars[r], at, owed)
                _sensed_vjp(i, first, team, bars[r], at, owed[t], scratch)
        for i in range(n):
            if record.flew[first + i]:
                motion_vjp(record.plants[first + i], owed[t, first + i], bar_plants[first + i])


@inline_kernel
def _own_vjp(r: int, leads: bool, record: TeamRecord, task: Array, bar: Array, bar_x: Array) -> int:
    """Of the own block, the position and the preview; returns where the comm slots begin."""
    ss, cs = sincos(record.plants[r, 8])
    for c in range(5):
        bar_x[3 + c] += bar[c]
    bar_x[8] += bar[5] * cs - bar[6] * ss
    for c in range(7):
        bar_x[9 + c] += bar[7 + c]
    at = N_OWN
    if task[SEES_POSITION] > 0.0:
        for c in range(3):
            bar_x[c] += bar[at + c]
        at += 3
    if task[SEES_DISTURBANCE] > 0.0:
        at += 6
    at += 1  # the role
    for _ in range(int(task[PREVIEW]) + 1):
        if leads:
            for c in range(3):
                bar_x[c] -= bar[at + c]
        at += N_REFERENCE
    return at


@inline_kernel
def _messages_vjp(
    i: int,
    first: int,
    t: int,
    record: TeamRecord,
    tables: Tables,
    team: Array,
    bar: Array,
    at: int,
    owed: Array,
) -> int:
    """Of the comm slots: to the own motion now and the senders' motions then; returns where slots end."""
    size = N_COMM + N_PLAN_STAGE * int(team[PLAN_STAGES])
    for s in range(record.ages.shape[1]):
        age = record.ages[first + i, s]
        if age >= 0:
            for c in range(6):
                owed[t, first + i, c] -= bar[at + 2 + c]
            if age <= t:
                sender = owed[t - age, first + tables.neighbours[i, s]]
                for c in range(N_MOTION):
                    sender[c] += bar[at + 2 + c]
        at += size
    return at


@inline_kernel
def _sensed_vjp(
    i: int, first: int, team: Array, bar: Array, at: int, owed: Array, scratch: TeamScratch
) -> None:
    """Of the sensed slots: to the motions of the two vehicles now."""
    count = sense(i, scratch.motions, scratch.places, scratch.squares, team, scratch.key, scratch.near)
    for s in range(min(count, int(team[SENSED_SLOTS]))):
        other = first + int(scratch.near[s])
        for c in range(6):
            owed[other, c] += bar[at + 1 + c]
            owed[first + i, c] -= bar[at + 1 + c]
        at += N_SENSED
