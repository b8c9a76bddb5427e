"""How the vehicles of a team are judged after a step: stage cost, violations, crashes, rewards."""

from __future__ import annotations

import math

from ...compilation.decorators import Int, inline_kernel, kernel, lane_kernel
from ...constraints import TOLERANCE
from ...dynamics import sincos_in_lanes
from ...lanes import (
    ALIVE,
    CAUSE,
    COMMAND,
    COST,
    CRASHED,
    FINITE,
    FORMATION,
    LANES,
    LEFT,
    NEAREST,
    PHI,
    PLANT,
    PSI,
    REWARD,
    SINES,
    SLOT_ERROR,
    STAGE_COST,
    STEP,
    TERMINATED,
    TERMS,
    THETA,
    TRUNCATED,
    VALUES,
    VIOLATED,
    VIOLATIONS,
    WANTED,
    four,
    move_lane,
    put_four,
    put_six,
    six,
    twelve,
)
from ...plant import Array
from ...references.table_row import COSINE, N_TABLE
from ...tasks import CRASH_CAUSES, LOSS_PARTS
from ..shared.task_vector import EPISODE_STEPS, HOVER, QUADRATIC, TILT_OF_CRASH
from ..tracking.kernel import compare, score, stage_cost_in_lanes, weights
from .exchange import (
    ARENA,
    CRASH_DISTANCE,
    FORMATION_WEIGHT,
    HAS_LEADER,
    N_VALUES,
    REFERENCE,
    SCALES,
    SEPARATION,
    TARGET,
    WHOLE_TEAM,
    Tables,
)

N_LOSS = len(LOSS_PARTS)
_DISTANCE, _TILT, _ARENA, _NOT_FINITE = (
    float(CRASH_CAUSES.index(name)) for name in ("distance", "tilt", "arena", "not finite")
)


@lane_kernel
def _weigh(w: Array, task: Array, team: Array) -> None:
    """Stage cost in parts, distance to the slot, and why a vehicle crashed."""
    hover, steep = task[HOVER], task[TILT_OF_CRASH]
    weight, arena, near = team[FORMATION_WEIGHT], team[ARENA], team[CRASH_DISTANCE]
    Q, R = weights(task)
    for j in range(LANES):
        sines = sincos_in_lanes(w[PHI + j]) + sincos_in_lanes(w[THETA + j]) + sincos_in_lanes(w[PSI + j])
        put_six(w, SINES + j, sines)
        x, u = twelve(w, PLANT + j), four(w, COMMAND + j)
        wanted = six(w, WANTED + j) + four(w, WANTED + 6 * LANES + j)
        position, velocity, attitude, rates, effort = stage_cost_in_lanes(x, sines, wanted, u, hover, Q, R)
        put_four(w, TERMS + j, (position, velocity, attitude, rates))
        w[TERMS + 4 * LANES + j] = effort
        formation = weight * w[FORMATION + j]
        w[FORMATION + j] = formation
        w[STAGE_COST + j] = formation + position + velocity + attitude + rates + effort
        off = (x[0] - wanted[0]) ** 2 + (x[1] - wanted[1]) ** 2 + (x[2] - wanted[2]) ** 2
        w[SLOT_ERROR + j] = math.sqrt(off)
        nearest = min(w[NEAREST + j], 2.0 * arena)  # where nobody else flies
        finite = w[FINITE + j] > 0.0
        cause = 0.0 if finite else _NOT_FINITE
        cause = _ARENA if x[0] * x[0] + x[1] * x[1] + x[2] * x[2] > arena * arena else cause
        cause = _TILT if max(abs(x[6]), abs(x[7])) >= steep else cause
        w[CAUSE + j] = _DISTANCE if (nearest < near) & finite else cause
        w[NEAREST + j] = nearest if finite else math.nan


@lane_kernel
def _reward(w: Array, task: Array, team: Array) -> None:
    """Violations, the distance between vehicles among them, and rewards of a block that was weighed."""
    compare(w, task)
    last = int(team[N_VALUES]) - 1
    kind = task[QUADRATIC], task[EPISODE_STEPS]
    for j in range(LANES):
        w[VALUES + last * LANES + j] = team[SEPARATION] - w[NEAREST + j]
    for k in range(last + 1):
        scale = team[SCALES + k]
        for j in range(LANES):
            value = w[VALUES + k * LANES + j]
            w[VIOLATIONS + k * LANES + j] = value / scale if value > TOLERANCE else 0.0
    for j in range(LANES):
        w[COST + j] += w[VIOLATIONS + last * LANES + j]
        score(w, j, w[STAGE_COST + j], w[CAUSE + j], kind)


@inline_kernel
def judge_estimate(w: Array, j: Int, target: Array, estimate: Array, task: Array) -> None:
    """Score of an estimate r, v (6,) of the target (6,) made by the vehicle on rails in lane j."""
    position, velocity = 0.0, 0.0
    for i in range(3):
        position += (estimate[i] - target[i]) ** 2
        velocity += (estimate[3 + i] - target[3 + i]) ** 2
    w[TERMS + j], w[TERMS + LANES + j] = position, velocity
    w[SLOT_ERROR + j] = math.sqrt(position)
    w[COST + j] = 0.0
    score(w, j, position + velocity, 0.0, (task[QUADRATIC], task[EPISODE_STEPS]))


@inline_kernel
def _formation_error(k: int, i: int, blocks: Array, tables: Tables) -> float:
    """Mean of |p_i - p_j - delta_ij|^2 over the neighbours j in the present graph; 0 without any."""
    total, count = 0.0, 0
    own, o = blocks[i // LANES], i % LANES
    graph = tables.weights[tables.schedule[min(k, tables.schedule.shape[0] - 1)], i]
    for s in range(graph.shape[0]):
        if graph[s] > 0.0:
            j = tables.neighbours[i, s]
            other, at = blocks[j // LANES], j % LANES
            if other[ALIVE + at] > 0.0:
                count += 1
                for c in range(3):
                    apart = own[PLANT + c * LANES + o] - other[PLANT + c * LANES + at]
                    total += (apart - tables.offsets[i, s, c]) ** 2
    return total / count if count > 0 else 0.0


@inline_kernel
def _want(k: int, i: int, first: int, w: Array, j: Int, tables: Tables, team: Array) -> None:
    """Where vehicle i should be: its slot beside the leader's reference, or beside the target."""
    if team[HAS_LEADER] > 0.0:
        reference = tables.references[tables.which[REFERENCE, first]]
        for c in range(N_TABLE):
            w[WANTED + c * LANES + j] = reference[min(k, reference.shape[0] - 1), c]
    else:
        target = tables.targets[tables.which[TARGET, first]]
        for c in range(6):
            w[WANTED + c * LANES + j] = target[min(k, target.shape[0] - 1), c]
        for c in range(6, N_TABLE):
            w[WANTED + c * LANES + j] = 0.0
        w[WANTED + COSINE * LANES + j] = 1.0
    for c in range(3):
        w[WANTED + c * LANES + j] += tables.offsets[i, tables.offsets.shape[1] - 1, c]


@inline_kernel
def _stay_out(aside: Array, w: Array, j: Int, n_values: int) -> None:
    """A vehicle that left in an earlier step is as it was before it was judged, and nothing counts."""
    move_lane(aside, j, w, j)
    w[REWARD + j], w[STAGE_COST + j], w[COST + j], w[VIOLATED + j], w[LEFT + j] = 0.0, 0.0, 0.0, 0.0, 1.0
    for k in range(N_LOSS + n_values):
        w[TERMS + k * LANES + j] = 0.0


@kernel
def judge_team(blocks: Array, first: int, aside: Array, tables: Tables, task: Array, team: Array) -> None:
    """Judge the vehicles of a team in flight after their step; then who crashed, and with whom.

    Args:
        blocks: Of the team.
        first: Its first vehicle.
        aside: A block for vehicles that left.
        tables: The tables.
        task: Task vector.
        team: Team vector.
    """
    n = tables.neighbours.shape[0]
    k = int(blocks[0, STEP])
    for i in range(n):
        w, j = blocks[i // LANES], i % LANES
        if w[ALIVE + j] > 0.0:
            _want(k, i, first, w, j, tables, team)
            w[FORMATION + j] = _formation_error(k, i, blocks, tables)
    anybody = False
    for b in range(blocks.shape[0]):
        w, lanes = blocks[b], min(LANES, n - b * LANES)
        for j in range(lanes):
            if w[ALIVE + j] == 0.0:
                move_lane(w, j, aside, j)
        _weigh(w, task, team)
        _reward(w, task, team)
        for j in range(lanes):
            if w[ALIVE + j] == 0.0:
                _stay_out(aside, w, j, int(team[N_VALUES]))
            else:
                anybody = anybody or w[CRASHED + j] > 0.0
    for i in range(n):
        w, j = blocks[i // LANES], i % LANES
        if anybody and team[WHOLE_TEAM] > 0.0:
            w[CRASHED + j], w[TERMINATED + j], w[TRUNCATED + j] = 1.0, 1.0, 0.0
            w[REWARD + j] = w[REWARD + j] if task[QUADRATIC] > 0.0 else 0.0
        elif w[CRASHED + j] > 0.0:
            w[TERMINATED + j], w[ALIVE + j] = 1.0, 0.0
