"""How the vehicles of a team are judged after a step: stage cost, violations, crashes, rewards."""

from __future__ import annotations

import math

from ..._numba import inline_kernel, kernel
from ...constraints import TOLERANCE
from ...parameters import Array
from ...reward import stage_cost_parts
from ...tasks import CRASH_CAUSES, LOSS_PARTS
from ...turning import N_TABLE
from ..tracking.kernel import (
    CAUSE,
    COMMAND,
    COST,
    CRASHED,
    EPISODE_COST,
    HOVER,
    QUADRATIC,
    REWARD,
    STAGE_COST,
    STEP,
    TILT_OF_CRASH,
    TRUNCATED,
    VALUES,
    VIOLATED,
    WEIGHT_Q,
    WEIGHT_R,
    score,
    violation_cost,
)
from .exchange import (
    ALIVE,
    ARENA,
    CRASH_DISTANCE,
    FORMATION_WEIGHT,
    HAS_LEADER,
    LEFT,
    N_VALUES,
    NEAREST,
    REFERENCE,
    SCALES,
    SEPARATION,
    SLOT_ERROR,
    TARGET,
    TERMINATED,
    TERMS,
    WHOLE_TEAM,
    Tables,
)

N_LOSS = len(LOSS_PARTS)
_DISTANCE, _TILT, _ARENA, _NOT_FINITE = map(CRASH_CAUSES.index, ("distance", "tilt", "arena", "not finite"))


@kernel
def _judge_flight(
    row: Array, wanted: Array, previous: Array, formation: float, task: Array, team: Array
) -> None:
    """Stage cost, violations, crash and reward of a vehicle after its step.

    Args:
        row: The vehicle.
        wanted: Its slot at the new time: p*, v*, sin and cos of psi_ref, psi_dot, (9,).
        previous: Its rotor commands of the step before, (4,).
        formation: Mean squared error to its neighbours, m^2.
        task: Task vector.
        team: Team vector.
    """
    parts = stage_cost_parts(row, wanted, row[COMMAND], task[HOVER], task[WEIGHT_Q], task[WEIGHT_R])
    row[TERMS], row[TERMS + 1], row[TERMS + 2], row[TERMS + 3], row[TERMS + 4] = parts
    row[TERMS + 5] = team[FORMATION_WEIGHT] * formation
    loss = row[TERMS + 5]
    for i in range(5):
        loss += row[TERMS + i]
    off = (row[0] - wanted[0]) ** 2 + (row[1] - wanted[1]) ** 2 + (row[2] - wanted[2]) ** 2
    row[SLOT_ERROR] = math.sqrt(off)
    from_origin = row[0] * row[0] + row[1] * row[1] + row[2] * row[2]
    if math.isnan(row[NEAREST]):
        row[CAUSE] = _NOT_FINITE
    elif row[NEAREST] > 2.0 * team[ARENA]:
        row[NEAREST] = 2.0 * team[ARENA]  # nobody else flies
    if row[NEAREST] < team[CRASH_DISTANCE]:
        row[CAUSE] = _DISTANCE
    elif max(abs(row[6]), abs(row[7])) >= task[TILT_OF_CRASH]:
        row[CAUSE] = _TILT
    elif from_origin > team[ARENA] * team[ARENA]:
        row[CAUSE] = _ARENA
    cost = violation_cost(row, previous, task)
    last = int(team[N_VALUES]) - 1
    row[VALUES + last] = team[SEPARATION] - row[NEAREST]
    if row[VALUES + last] > TOLERANCE:
        cost += row[VALUES + last] / team[SCALES + last]
    for k in range(last + 1):
        value = row[VALUES + k]
        row[TERMS + N_LOSS + k] = value / team[SCALES + k] if value > TOLERANCE else 0.0
    score(row, loss, cost, row[CAUSE] > 0.0, task)
    row[EPISODE_COST] += cost


@inline_kernel
def judge_estimate(row: Array, target: Array, estimate: Array, task: Array) -> None:
    """Score of an estimate r, v (6,) of the target (6,) made by a vehicle on rails."""
    position, velocity = 0.0, 0.0
    for i in range(3):
        position += (estimate[i] - target[i]) ** 2
        velocity += (estimate[3 + i] - target[3 + i]) ** 2
    row[TERMS], row[TERMS + 1] = position, velocity
    row[SLOT_ERROR] = math.sqrt(position)
    score(row, position + velocity, 0.0, False, task)


@kernel
def _formation_error(k: int, i: int, rows: Array, first: int, tables: Tables) -> float:
    """Mean of |p_i - p_j - delta_ij|^2 over the neighbours j in the present graph; 0 without any."""
    total, count = 0.0, 0
    own = rows[first + i]
    graph = tables.weights[tables.schedule[min(k, tables.schedule.shape[0] - 1)], i]
    for s in range(graph.shape[0]):
        if graph[s] > 0.0:
            other = rows[first + tables.neighbours[i, s]]
            if other[ALIVE] > 0.0:
                count += 1
                for c in range(3):
                    total += (own[c] - other[c] - tables.offsets[i, s, c]) ** 2
    return total / count if count > 0 else 0.0


@inline_kernel
def _want(k: int, i: int, first: int, tables: Tables, team: Array, out: Array) -> None:
    """Where vehicle i should be: its slot beside the leader's reference, or beside the target; (9,)."""
    if team[HAS_LEADER] > 0.0:
        reference = tables.references[tables.which[REFERENCE, first]]
        for c in range(N_TABLE):
            out[c] = reference[min(k, reference.shape[0] - 1), c]
    else:
        target = tables.targets[tables.which[TARGET, first]]
        for c in range(6):
            out[c] = target[min(k, target.shape[0] - 1), c]
        out[6], out[7], out[8] = 0.0, 1.0, 0.0
    for c in range(3):
        out[c] += tables.offsets[i, tables.offsets.shape[1] - 1, c]


@kernel
def judge_team(
    rows: Array, first: int, tables: Tables, previous: Array, wanted: Array, task: Array, team: Array
) -> None:
    """Judge the vehicles of a team in flight after their step; then who crashed, and with whom."""
    n = tables.neighbours.shape[0]
    k = int(rows[first, STEP])
    anybody = False
    for i in range(n):
        row = rows[first + i]
        if row[ALIVE] > 0.0:
            _want(k, i, first, tables, team, wanted)
            _judge_flight(row, wanted, previous[i], _formation_error(k, i, rows, first, tables), task, team)
            anybody = anybody or row[CRASHED] > 0.0
        else:  # it left in an earlier step, and nothing counts any more
            row[REWARD], row[STAGE_COST], row[COST], row[VIOLATED], row[LEFT] = 0.0, 0.0, 0.0, 0.0, 1.0
            for entry in range(TERMS, TERMS + N_LOSS + int(team[N_VALUES])):
                row[entry] = 0.0
    for i in range(n):
        row = rows[first + i]
        if anybody and team[WHOLE_TEAM] > 0.0:
            row[CRASHED], row[TERMINATED], row[TRUNCATED] = 1.0, 1.0, 0.0
            row[REWARD] = row[REWARD] if task[QUADRATIC] > 0.0 else 0.0
        elif row[CRASHED] > 0.0:
            row[TERMINATED], row[ALIVE] = 1.0, 0.0
