"""The compiled step of the tracking task: actions in, observations and rewards out, for any number of rows.

Each vehicle is one row of a float64 array. The single environment is a batch of one row, so that both
environments are the same computation by construction; blocks of LANES rows only let the integrator's loops
vectorise.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..._numba import inline_kernel, kernel
from ...constraints import TOLERANCE, force_from_action
from ...dynamics import LANES, SCRATCH_ROWS, advance, load_vehicle, store_vehicle
from ...limits import LIMITS, N_OUTPUT
from ...observations.tracking import N_OWN, encode_own, encode_preview
from ...parameters import N_COEFFICIENTS, N_STATE, Array
from ...reward import stage_cost_kernel
from ...tasks import CRASH_CAUSES, Task, TeamTask
from ..shared.vehicle_options import CRASH_TILT

# Entries of a vehicle's row.
PLANT = slice(0, 16)  # [p, V_B, Theta, Omega, F]
COMMAND = slice(16, 20)  # last rotor commands, N
COEFFICIENTS = slice(20, 20 + N_COEFFICIENTS)  # of the true vehicle
FORCE_MAX = slice(36, 40)  # rotor saturation of the true vehicle, N
REWARD, STAGE_COST, COST, EPISODE_COST, VIOLATED, CRASHED, TRUNCATED, CLIPPED, STEP = range(40, 49)
VALUES = 49  # constraint values, one per named row
MOST_VALUES = len(LIMITS) + 1  # a team's last one is the distance between vehicles
CAUSE = VALUES + MOST_VALUES  # why it crashed, index in `tasks.CRASH_CAUSES`
ROW_SIZE = CAUSE + 1
SCORES = slice(REWARD, ROW_SIZE)  # from the reward to the cause
SCRATCH_SIZE = SCRATCH_ROWS * LANES + 4 * LANES + 16  # integrator, previous commands, one measured plant

# Entries of the task vector.
DT, SUBSTEPS, HOVER, EPISODE_STEPS, PREVIEW, QUADRATIC, LOST = range(7)
SEES_POSITION, SEES_DISTURBANCE, TILT_OF_CRASH, N_LIMITS = range(7, 11)  # the last: how many are set
ACTION_MAX = slice(11, 15)  # force of action +1, N
WEIGHT_Q = slice(15, 27)
WEIGHT_R = slice(27, 31)
# The limits: the box of every output y = [x, u - u_previous], then of each limit that is set its entries.
LOWER = 31
UPPER = LOWER + N_OUTPUT
FIRST = UPPER + N_OUTPUT  # first output of each
STOP = FIRST + len(LIMITS)  # behind its last output
SCALE = STOP + len(LIMITS)  # violation that costs the whole reward of a step
TASK_SIZE = SCALE + len(LIMITS)

_BY_TILT, _NOT_FINITE, _BY_LOSS = map(CRASH_CAUSES.index, ("tilt", "not finite", "lost"))
BLOCK_FROM = 8  # rows from which a block of lanes is faster than one row at a time


def task_vector(task: Task | TeamTask, substeps: int, lost_distance: float) -> Array:
    """The task in the form that the kernels read."""
    limits = task.limits
    chosen = limits.chosen()
    vector = np.zeros(TASK_SIZE)
    vector[:LOWER] = np.array(
        [
            task.dt,
            substeps,
            task.hover_force,
            task.episode_steps,
            task.layout.preview,
            task.reward == "quadratic",
            lost_distance,
            task.layout.position,
            task.layout.disturbance,
            CRASH_TILT,
            len(chosen),
            *task.force_max,
            *task.weights.Q,
            *task.weights.R,
        ],
        dtype=np.float64,
    )
    vector[LOWER:UPPER], vector[UPPER:FIRST] = limits.output_box(task.dt)
    for k, limit in enumerate(chosen):
        vector[FIRST + k], vector[STOP + k] = limit.outputs.start, limit.outputs.stop
        vector[SCALE + k] = limits.scale(limit, task.dt)
    return vector


@inline_kernel
def output(row: Array, previous: Array, i: int) -> float:
    """Entry i of y = [x, u - u_previous]."""
    return float(row[i] if i < N_STATE else row[COMMAND][i - N_STATE] - previous[i - N_STATE])


@kernel
def violation_cost(row: Array, previous: Array, task: Array) -> float:
    """Sum of hinge / scale over the limits, `constraints.constraint_values` compiled; records each."""
    cost = 0.0
    for k in range(int(task[N_LIMITS])):
        outside = -np.inf
        for i in range(int(task[FIRST + k]), int(task[STOP + k])):
            y = output(row, previous, i)
            outside = max(outside, max(task[LOWER + i] - y, y - task[UPPER + i]))
        row[VALUES + k] = outside
        cost += outside / task[SCALE + k] if outside > TOLERANCE else 0.0
    return cost


@inline_kernel
def score(row: Array, stage_cost: float, cost: float, crashed: bool, task: Array) -> None:
    """Reward of a step, see `quad_envs.reward`, and what belongs to it."""
    v = min(1.0, cost)
    if task[QUADRATIC] > 0.0:
        row[REWARD] = -stage_cost - v
    else:
        row[REWARD] = 0.0 if crashed else (1.0 - v) / (1.0 + stage_cost)
    row[STAGE_COST] = stage_cost
    row[COST] = cost
    row[VIOLATED] = 1.0 if cost > 0.0 else 0.0
    row[CRASHED] = 1.0 if crashed else 0.0
    row[TRUNCATED] = 1.0 if row[STEP] >= task[EPISODE_STEPS] and not crashed else 0.0


@kernel
def _judge(row: Array, reference: Array, previous: Array, finite: bool, task: Array) -> None:
    """Stage cost, violation, crash and reward of a row after its step; `reference` is of the new time."""
    off = 0.0
    for i in range(3):
        off += (row[i] - reference[i]) ** 2
    row[CAUSE] = 0.0
    if not finite:
        row[CAUSE] = _NOT_FINITE
    elif max(abs(row[6]), abs(row[7])) >= task[TILT_OF_CRASH]:
        row[CAUSE] = _BY_TILT
    elif off > task[LOST] * task[LOST]:
        row[CAUSE] = _BY_LOSS
    stage_cost = stage_cost_kernel(row, reference, row[COMMAND], task[HOVER], task[WEIGHT_Q], task[WEIGHT_R])
    score(row, stage_cost, violation_cost(row, previous, task), row[CAUSE] > 0.0, task)


@inline_kernel
def measure_plant(row: Array, noise: Array, measured: Array) -> None:
    """The plant of a row as its own sensors see it.

    Args:
        row: The vehicle.
        noise: Its measurement errors, (n_steps, 12); no steps for none.
        measured: Result, (16,).
    """
    for i in range(16):
        measured[i] = row[i]
    if noise.shape[0] > 0:
        k = min(int(row[STEP]), noise.shape[0] - 1)
        for i in range(12):
            measured[i] += noise[k, i]


@inline_kernel
def encode_vehicle(
    row: Array, measured: Array, disturbance: Array, task: Array, out: NDArray[np.float32]
) -> int:
    """Write own, position and disturbance of an observation; returns where they end."""
    encode_own(out, measured, row[COMMAND])
    start = N_OWN
    if task[SEES_POSITION] > 0.0:
        for i in range(3):
            out[start + i] = measured[i]
        start += 3
    if task[SEES_DISTURBANCE] > 0.0:
        k = int(row[STEP])
        for i in range(6):
            out[start + i] = 0.0
        if 0 < disturbance.shape[0] and k < disturbance.shape[0]:
            for i in range(6):
                out[start + i] = disturbance[k, disturbance.shape[1] // 2, i]
        start += 6
    return start


@kernel
def observe(
    row: Array,
    reference: Array,
    disturbance: Array,
    noise: Array,
    task: Array,
    measured: Array,
    out: NDArray[np.float32],
) -> None:
    """Write the observation of a row.

    Args:
        row: The vehicle.
        reference: Its reference table, (n_steps, 9).
        disturbance: Its disturbance table, (n_steps, n_nodes, 6).
        noise: Its measurement errors, (n_steps, 12); no steps for none.
        task: Task vector.
        measured: Scratch, (16,).
        out: (layout.size,) float32.
    """
    measure_plant(row, noise, measured)
    start = encode_vehicle(row, measured, disturbance, task, out)
    stages = int(task[PREVIEW]) + 1
    encode_preview(out, start, reference, min(int(row[STEP]), reference.shape[0] - stages), stages, measured)


@inline_kernel
def apply_action(row: Array, actions: NDArray[np.floating], task: Array) -> None:
    """Take an action over into the row; entries outside [-1, 1] are clipped and counted."""
    for i in range(4):
        action = float(actions[i])
        if action < -1.0 or action > 1.0:
            row[CLIPPED] += 1.0
            action = min(max(action, -1.0), 1.0)
        row[COMMAND][i] = force_from_action(action, task[HOVER], task[ACTION_MAX][i])


@kernel
def step_rows(
    rows: Array,
    references: Array,
    disturbances: Array,
    noises: Array,
    which: NDArray[np.int64],
    flat_actions: NDArray[np.floating],
    task: Array,
    scratch: Array,
    steps: NDArray[np.int64],
    flat_out: NDArray[np.float32],
) -> int:
    """One control period of every row.

    Args:
        rows: (n, ROW_SIZE), modified in place.
        references: Tables (n_tables, n_steps, 9).
        disturbances: Tables (n_tables, n_steps, 2 substeps + 1, 6); no steps for none.
        noises: Tables (n_tables, n_steps, 12); no steps for none.
        which: Reference, disturbance and noise table of each row, (3, n) int64.
        flat_actions: (4 n,).
        task: Task vector.
        scratch: (SCRATCH_SIZE,).
        steps: Scratch, (n,) int64.
        flat_out: Observations, (n layout.size,) float32.

    Returns:
        -1, or the flat index of the first non-finite action; then nothing was changed.
    """
    n = rows.shape[0]
    actions = flat_actions.reshape(n, 4)
    out = flat_out.reshape(n, flat_out.size // n)
    for i in range(n):
        for a in range(4):
            if not np.isfinite(actions[i, a]):
                return 4 * i + a
    substeps = int(task[SUBSTEPS])
    h = task[DT] / substeps
    stride = np.int64(LANES) if n >= BLOCK_FROM else np.int64(1)
    measured = scratch[scratch.size - 16 :]
    previous = scratch[scratch.size - 16 - 4 * LANES : scratch.size - 16].reshape(LANES, 4)
    for first in range(0, n, stride):
        lanes = min(stride, n - first)
        for j in range(lanes):
            row = rows[first + j]
            for a in range(4):
                previous[j, a] = row[COMMAND][a]
            apply_action(row, actions[first + j], task)
            steps[first + j] = int(row[STEP])
            load_vehicle(scratch, j, stride, row, row[COMMAND], row[FORCE_MAX], row[COEFFICIENTS], h)
        advance(scratch, stride, lanes, 0, substeps, h, disturbances, which[1, first:], steps[first:])
        for j in range(lanes):
            i = first + j
            row = rows[i]
            finite = store_vehicle(scratch, j, stride, row)
            row[STEP] += 1.0
            reference = references[which[0, i]]
            k = min(int(row[STEP]), reference.shape[0] - 1)
            _judge(row, reference[k], previous[j], finite, task)
            row[EPISODE_COST] += row[COST]
            observe(row, reference, disturbances[which[1, i]], noises[which[2, i]], task, measured, out[i])
    return -1


@kernel
def begin_row(rows: Array, i: int, reference: Array, task: Array) -> None:
    """Stage cost and constraint values of row i after a reset, with no command change yet."""
    row = rows[i]
    _judge(row, reference[0], row[COMMAND], True, task)


@kernel
def observe_row(
    rows: Array,
    i: int,
    references: Array,
    disturbances: Array,
    noises: Array,
    which: NDArray[np.int64],
    task: Array,
    scratch: Array,
    out: NDArray[np.float32],
) -> None:
    """Observation of row i as it stands."""
    measured = scratch[scratch.size - 16 :]
    observe(
        rows[i], references[which[0, i]], disturbances[which[1, i]], noises[which[2, i]], task, measured, out
    )
