"""The compiled step of the multi-agent tasks: actions in, observations and rewards out, for many teams.

A vehicle is a row as in `kernel`, a team is N rows in succession. The single environment is a batch of one
team, so that it and the batched form are the same computation.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from ..._numba import Int, inline_kernel, kernel
from ...dynamics import LANES, SCRATCH_ROWS, advance, load_vehicle, store_vehicle
from ...observations.team import N_PLAN_STAGE
from ...parameters import Array
from ...turning import N_TABLE
from ..tracking.kernel import (
    BLOCK_FROM,
    CLIPPED,
    COEFFICIENTS,
    COMMAND,
    DT,
    EPISODE_COST,
    FORCE_MAX,
    STEP,
    SUBSTEPS,
    apply_action,
    measure_plant,
)
from .exchange import (
    ALIVE,
    DISTURBANCE,
    DRAW,
    HEARD,
    LEFT,
    MEASUREMENT,
    MEASURES,
    N_MOTION,
    NEAREST,
    NOISE,
    ON_RAILS,
    PLAN,
    REFERENCE,
    SENSED_SLOTS,
    SENSOR_ROWS,
    TARGET,
    WEIGHT,
    IntArray,
    Tables,
    hear,
    measure_target,
    motion,
    observe_agent,
    sense,
)
from .scores import judge_estimate, judge_team

PLAN_SCALE = 5.0  # m, and m/s: of the plan in an action, relative to the sender
ESTIMATE_REACH = 20.0  # m: of an estimated position in an action, relative to the vehicle
ESTIMATE_SPEED = 5.0  # m/s: of an estimated velocity in an action


def scratch_size(vehicles: int, sensed: int) -> int:
    """Numbers that `step_teams` and `begin_team` need as scratch."""
    room = max(vehicles, LANES)
    integrator = -(-room // LANES) * SCRATCH_ROWS * LANES
    return 8 * room + N_TABLE + max(integrator, (16 + 2 * N_MOTION) * vehicles + 2 * sensed)


@kernel
def nearest_pairs(x: Array, y: Array, z: Array, nearest: Array) -> None:
    """Take the squared distances within a team into the smallest ones so far; all arguments (N,)."""
    for i in range(x.shape[0]):
        xi, yi, zi = x[i], y[i], z[i]
        x[i] = math.inf  # no vehicle is near itself; without a branch, so that the loop vectorises
        for j in range(x.shape[0]):
            dx, dy, dz = x[j] - xi, y[j] - yi, z[j] - zi
            nearest[j] = min(dx * dx + dy * dy + dz * dz, nearest[j])
        x[i] = xi


@kernel
def _gather(rows: Array, first: int, count: int, w: Array, stride: Int, places: Array) -> None:
    """Positions of the loaded vehicles into places (3, count); those that crashed are far from everybody."""
    size = SCRATCH_ROWS * stride
    for i in range(count):
        block, lane = i // stride, i % stride
        alive = rows[first + i, ALIVE] > 0.0
        for c in range(3):
            places[c, i] = w[block * size + c * stride + lane] if alive else 1e9 * (i + 1)


@kernel
def _fly(
    rows: Array, first: int, count: int, tables: Tables, task: Array, w: Array, places: Array, steps: IntArray
) -> None:
    """Integrate rows first..first+count-1, which are whole teams, over a control period.

    Notes the smallest distance at the substep ends in NEAREST; a state that is not finite is not stored, and
    NEAREST is nan then.
    """
    n = tables.neighbours.shape[0]
    substeps = int(task[SUBSTEPS])
    h = task[DT] / substeps
    stride = np.int64(LANES) if count >= BLOCK_FROM else np.int64(1)
    size = SCRATCH_ROWS * stride
    for i in range(count):
        row = rows[first + i]
        steps[i] = int(row[STEP])
        places[3, i] = math.inf
        block = w[(i // stride) * size : (i // stride + 1) * size]
        load_vehicle(block, i % stride, stride, row, row[COMMAND], row[FORCE_MAX], row[COEFFICIENTS], h)
    for s in range(substeps):
        for b in range(0, count, stride):
            block = w[(b // stride) * size : (b // stride + 1) * size]
            lanes = min(int(stride), count - b)
            which = tables.which[DISTURBANCE, first + b :]
            advance(block, stride, lanes, s, s + 1, h, tables.disturbances, which, steps[b:])
        _gather(rows, first, count, w, stride, places)
        for t in range(0, count, n):
            nearest_pairs(
                places[0, t : t + n], places[1, t : t + n], places[2, t : t + n], places[3, t : t + n]
            )
    for i in range(count):
        row = rows[first + i]
        row[STEP] += 1.0
        if row[ALIVE] > 0.0:
            block = w[(i // stride) * size : (i // stride + 1) * size]
            finite = store_vehicle(block, i % stride, stride, row)
            row[NEAREST] = math.sqrt(places[3, i]) if finite else math.nan


@kernel
def _inform_team(
    rows: Array,
    first: int,
    messages: Array,
    history: Array,
    tables: Tables,
    task: Array,
    team: Array,
    scratch: Array,
    out: NDArray[np.float32],
) -> None:
    """Measurements, messages and observations of a team at its present step.

    Args:
        rows: All vehicles.
        first: Row of the team's first one.
        messages: What each vehicle of the team heard, (N, K, HEAD + C).
        history: Contents of the team's last steps, (depth, N, C).
        tables: The tables.
        task: Task vector.
        team: Team vector.
        scratch: (36 N + 2 K_s,).
        out: Observations of the team, (N, layout.size) float32.
    """
    n, sensed = tables.neighbours.shape[0], int(team[SENSED_SLOTS])
    seen = scratch[: 16 * n].reshape(n, 16)
    motions = scratch[16 * n : 26 * n].reshape(n, N_MOTION)
    told = scratch[26 * n : 36 * n].reshape(n, N_MOTION)
    key = scratch[36 * n : 36 * n + sensed]
    near = scratch[36 * n + sensed : 36 * n + 2 * sensed]
    k = int(rows[first, STEP])
    now = history[k % history.shape[0]]
    reference = tables.references[tables.which[REFERENCE, first]]
    target, draws = tables.targets[tables.which[TARGET, first]], tables.draws[tables.which[DRAW, first]]
    for i in range(n):
        row = rows[first + i]
        measure_plant(row, tables.noises[tables.which[NOISE, first + i]], seen[i])
        motion(row, motions[i])
        motion(seen[i], told[i])
        for c in range(N_MOTION):
            now[i, c] = told[i, c]
        if team[SENSOR_ROWS] > 0.0:
            aim = target[min(k, target.shape[0] - 1)]
            measure_target(motions[i], aim, draws, k, i, row[MEASURES], team, now[i, MEASUREMENT:])
    for i in range(n):
        row = rows[first + i]
        if row[LEFT] == 0.0:  # who crashes in this step still sees where
            hear(k, i, rows, first, history, tables, team, messages[i])
            count = sense(i, rows, first, motions, team, key, near)
            observe_agent(
                i, row, seen[i], told[i], now[i, MEASUREMENT:], messages[i], motions, tables.offsets[i],
                reference, tables.disturbances[tables.which[DISTURBANCE, first + i]], count, near,
                task, team, out[i],
            )  # fmt: skip
        else:
            row[HEARD] = 0.0
            for c in range(out.shape[1]):
                out[i, c] = 0.0


@inline_kernel
def _plan_of_action(own: Array, action: NDArray[np.floating], content: Array) -> None:
    """The plan in the tail of an action, absolute, into the content of the coming message."""
    for c in range(action.shape[0] - 4):
        part = c % N_PLAN_STAGE
        at = own[part] if part < 3 else 0.0
        content[PLAN + c] = at + PLAN_SCALE * min(max(float(action[4 + c]), -1.0), 1.0)


@kernel
def _ride(
    rows: Array, first: int, tables: Tables, actions: NDArray[np.floating], task: Array, estimate: Array
) -> None:
    """A step of vehicles on rails, which fly straight on; their actions are estimates of the target now."""
    target = tables.targets[tables.which[TARGET, first]]
    for i in range(tables.neighbours.shape[0]):
        row = rows[first + i]
        for c in range(3):
            estimate[c] = row[c] + ESTIMATE_REACH * min(max(float(actions[first + i, c]), -1.0), 1.0)
            estimate[3 + c] = ESTIMATE_SPEED * min(max(float(actions[first + i, 3 + c]), -1.0), 1.0)
        k = min(int(row[STEP]), target.shape[0] - 1)
        row[STEP] += 1.0
        judge_estimate(row, target[k], estimate, task)
        for c in range(3):
            row[c] += task[DT] * row[3 + c]  # level and at heading 0, so that V_B is the inertial velocity


@kernel
def _count_clipped(row: Array, action: NDArray[np.floating], start: int) -> None:
    """Count the entries of an action outside [-1, 1] from `start` on."""
    for a in range(start, action.shape[0]):
        if abs(action[a]) > 1.0:
            row[CLIPPED] += 1.0


@kernel
def step_teams(
    rows: Array,
    messages: Array,
    history: Array,
    weights: Array,
    neighbours: IntArray,
    schedule: IntArray,
    offsets: Array,
    which: IntArray,
    references: Array,
    disturbances: Array,
    noises: Array,
    targets: Array,
    draws: Array,
    flat_actions: NDArray[np.floating],
    task: Array,
    team: Array,
    scratch: Array,
    steps: IntArray,
    flat_out: NDArray[np.float32],
) -> int:
    """One control period of every team.

    Args:
        rows: (n, TEAM_ROW_SIZE), modified in place; a team is N rows.
        messages: What each vehicle heard, (n, K, HEAD + C), modified in place.
        history: Contents of the last steps, (teams, depth, N, C), modified in place.
        weights: See `Tables`, as what follows.
        neighbours: See `Tables`.
        schedule: See `Tables`.
        offsets: See `Tables`.
        which: See `Tables`.
        references: See `Tables`.
        disturbances: See `Tables`.
        noises: See `Tables`.
        targets: See `Tables`.
        draws: See `Tables`.
        flat_actions: (n action_size,).
        task: Task vector.
        team: Team vector.
        scratch: (scratch_size,).
        steps: Scratch, (>= max(N, LANES),) int64.
        flat_out: Observations, (n layout.size,) float32.

    Returns:
        -1, or the flat index of the first non-finite action; then nothing was changed.
    """
    tables = Tables(
        weights, neighbours, schedule, offsets, which, references, disturbances, noises, targets, draws
    )
    rows_in_all, n = rows.shape[0], neighbours.shape[0]
    actions = flat_actions.reshape(rows_in_all, flat_actions.size // rows_in_all)
    out = flat_out.reshape(rows_in_all, flat_out.size // rows_in_all)
    for a in range(flat_actions.size):
        if not np.isfinite(flat_actions[a]):
            return a
    room = max(n, LANES)
    previous = scratch[: 4 * room].reshape(room, 4)
    places = scratch[4 * room : 8 * room].reshape(4, room)
    wanted = scratch[8 * room : 8 * room + N_TABLE]
    rest = scratch[8 * room + N_TABLE :]
    on_rails = team[ON_RAILS] > 0.0
    group = max(1, LANES // n) * n  # rows of as many teams as fit into a block of lanes
    for first in range(0, rows_in_all, group):
        count = min(group, rows_in_all - first)
        if not on_rails:
            for i in range(count):
                row, action = rows[first + i], actions[first + i]
                for a in range(4):
                    previous[i, a] = row[COMMAND][a]
                apply_action(row, action, task)
                _count_clipped(row, action, 4)
                past = history[(first + i) // n]
                _plan_of_action(row, action, past[(int(row[STEP]) + 1) % past.shape[0], (first + i) % n])
            _fly(rows, first, count, tables, task, rest, places, steps)
        for begin in range(first, first + count, n):
            if on_rails:
                for i in range(begin, begin + n):
                    _count_clipped(rows[i], actions[i], 0)
                _ride(rows, begin, tables, actions, task, wanted)
            else:
                judge_team(rows, begin, tables, previous[begin - first :], wanted, task, team)
            _inform_team(
                rows, begin, messages[begin : begin + n], history[begin // n], tables, task, team,
                rest, out[begin : begin + n],
            )  # fmt: skip
    return -1


@kernel
def begin_team(
    begin: int,
    rows: Array,
    messages: Array,
    history: Array,
    weights: Array,
    neighbours: IntArray,
    schedule: IntArray,
    offsets: Array,
    which: IntArray,
    references: Array,
    disturbances: Array,
    noises: Array,
    targets: Array,
    draws: Array,
    task: Array,
    team: Array,
    scratch: Array,
    out: NDArray[np.float32],
) -> None:
    """Scores and observations of the team at rows begin.. after a reset; other arguments as in `step_teams`.

    Until a vehicle has sent a plan, its neighbours are told that it goes on at its velocity.
    """
    tables = Tables(
        weights, neighbours, schedule, offsets, which, references, disturbances, noises, targets, draws
    )
    n = neighbours.shape[0]
    room = max(n, LANES)
    places, wanted = scratch[4 * room : 8 * room].reshape(4, room), scratch[8 * room : 8 * room + N_TABLE]
    rest = scratch[8 * room + N_TABLE :]
    past = history[begin // n]
    for i in range(n):
        row = rows[begin + i]
        row[ALIVE] = 1.0
        places[0, i], places[1, i], places[2, i], places[3, i] = row[0], row[1], row[2], math.inf
        for s in range(messages.shape[1]):
            messages[begin + i, s, WEIGHT] = 0.0
        motion(row, past[0, i])
        for c in range(past.shape[2] - PLAN):
            q, part = c // N_PLAN_STAGE, c % N_PLAN_STAGE
            ahead = q * task[DT] * past[0, i, 3 + part] if part < 3 else 0.0
            past[0, i, PLAN + c] = past[0, i, part] + ahead
    nearest_pairs(places[0, :n], places[1, :n], places[2, :n], places[3, :n])
    for i in range(n):
        rows[begin + i, NEAREST] = math.sqrt(places[3, i])
    if team[ON_RAILS] == 0.0:
        for i in range(n):
            for a in range(4):
                scratch[4 * i + a] = rows[begin + i, COMMAND][a]
        judge_team(rows, begin, tables, scratch[: 4 * n].reshape(n, 4), wanted, task, team)
        for i in range(n):
            rows[begin + i, EPISODE_COST] = 0.0
    _inform_team(rows, begin, messages[begin : begin + n], past, tables, task, team, rest, out)
