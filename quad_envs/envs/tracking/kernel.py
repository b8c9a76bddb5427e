"""The compiled step of the tracking task: actions in, observations and scores out, four vehicles at a time.

A vehicle is a lane of a block (`quad_envs.lanes`), and one vehicle a block of which three lanes are empty:
single and vector environments are the same computation by construction.
"""

from __future__ import annotations

from typing import Annotated, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...compilation.decorators import Int, fused, inline_kernel, inline_lane_kernel, kernel, lane_kernel
from ...compilation.intrinsics import borrowed, fetch
from ...compilation.packed import IntArray, unpacker
from ...constraints import TOLERANCE, force_from_action
from ...dynamics import arrive, calm_substep, depart, disturbed_substep, load_air, sincos_in_lanes
from ...lanes import (
    ACTION,
    CAUSE,
    CHANGE,
    CLIPPED,
    COMMAND,
    COST,
    CRASHED,
    EPISODE_COST,
    FINITE,
    LANES,
    N_PLANT,
    PHI,
    PLANT,
    PSI,
    REWARD,
    SINES,
    STAGE_COST,
    STEP,
    THETA,
    TRUNCATED,
    VALUES,
    VIOLATED,
    WANTED,
    four,
    move_lane,
    put_four,
    put_six,
    six,
    twelve,
)
from ...observations.tracking import (
    N_OWN,
    Previews,
    encode_disturbance,
    encode_own,
    encode_preview,
    measured,
)
from ...plant import N_INPUT, N_STATE, Array
from ...references.table_row import N_PREVIEW, N_TABLE
from ...reward import stage_cost_parts
from ...tasks import CRASH_CAUSES
from ..shared.actions import first_unsound
from ..shared.draws import Draws, draw_ahead
from ..shared.task_vector import (
    ACTION_MAX,
    DT,
    EPISODE_STEPS,
    FIRST,
    HOVER,
    LOST,
    LOWER,
    N_LIMITS,
    PREVIEW,
    QUADRATIC,
    SCALE,
    SEES_DISTURBANCE,
    SEES_POSITION,
    STOP,
    SUBSTEPS,
    TILT_OF_CRASH,
    UPPER,
    WEIGHT_Q,
    WEIGHT_R,
)

# Rows of what a step tells of n vehicles, (N_TOLD + number of limits, n) float64: the block's rows from
# REWARD to EPISODE_COST, two rows of int64, one of bytes, and the constraint values, (n, number of limits).
COUNTS = 4  # clipped actions, cause of the crash
FLAGS = 6  # crashed, truncated, violated
N_TOLD = 7

_BY_TILT, _NOT_FINITE, _BY_LOSS = map(float, map(CRASH_CAUSES.index, ("tilt", "not finite", "lost")))
stage_cost_in_lanes = fused(stage_cost_parts)


class Flights(NamedTuple):
    """What n tracking flights consist of, packed for the kernels."""

    blocks: Annotated[Array, "B, S"]  # n / LANES + 1; the last one is for those that begin
    references: Annotated[Array, f"M, T, {N_TABLE}"]  # tables
    previews: Annotated[Previews, f"M, T, {N_PREVIEW}"]  # of these
    disturbances: Annotated[Array, "M, T, L, 6"]  # tables, L = 2 substeps + 1; no steps for none
    noises: Annotated[Array, "M, T, 12"]  # tables; no steps for none
    which: Annotated[IntArray, "3, n"]  # reference, disturbance and noise table of each vehicle
    draws: Draws
    task: Annotated[Array, "S"]  # task vector


class Told(NamedTuple):
    """The rows of what a step tells, see N_TOLD."""

    numbers: Array  # (COUNTS, n)
    counts: IntArray  # (FLAGS - COUNTS, n)
    flags: NDArray[np.uint8]  # (8 n,), of which 3 n are used
    values: Array  # (n, number of limits)


@inline_kernel
def _told(block: Array) -> Told:
    limits, n = block.shape[0] - N_TOLD, block.shape[1]
    return Told(
        block[:COUNTS],
        block[COUNTS:FLAGS].view(np.int64),
        block[FLAGS].view(np.uint8),
        block[N_TOLD:].reshape(n, limits),
    )


_flights = unpacker(Flights)


@inline_lane_kernel
def _clip(action: float) -> float:
    return min(max(action, -1.0), 1.0)


@inline_lane_kernel
def _beyond(action: float) -> float:
    return 1.0 if abs(action) > 1.0 else 0.0


@lane_kernel
def command(w: Array, task: Array) -> None:
    """Begin the control period of a block: its actions, clipped to [-1, 1] and counted, become commands."""
    hover, most = task[HOVER], task[ACTION_MAX]
    most_1, most_2, most_3, most_4 = most[0], most[1], most[2], most[3]
    for j in range(LANES):
        a, before = four(w, ACTION + j), four(w, COMMAND + j)
        u = (
            force_from_action(_clip(a[0]), hover, most_1),
            force_from_action(_clip(a[1]), hover, most_2),
            force_from_action(_clip(a[2]), hover, most_3),
            force_from_action(_clip(a[3]), hover, most_4),
        )
        put_four(w, COMMAND + j, u)
        put_four(w, CHANGE + j, (u[0] - before[0], u[1] - before[1], u[2] - before[2], u[3] - before[3]))
        w[CLIPPED + j] += _beyond(a[0]) + _beyond(a[1]) + _beyond(a[2]) + _beyond(a[3])
        w[STEP + j] += 1.0
        depart(w, j)


@lane_kernel
def compare(w: Array, task: Array) -> None:
    """Values of the limits, `constraints.constraint_values` compiled; in COST the sum of hinge / scale."""
    for j in range(LANES):
        w[COST + j] = 0.0
    for k in range(int(task[N_LIMITS])):
        value = VALUES + k * LANES
        for j in range(LANES):
            w[value + j] = -np.inf
        for i in range(int(task[FIRST + k]), int(task[STOP + k])):
            lower, upper = task[LOWER + i], task[UPPER + i]
            output = (PLANT + i * LANES) if i < N_STATE else (CHANGE + (i - N_STATE) * LANES)
            for j in range(LANES):
                y = w[output + j]
                w[value + j] = max(w[value + j], max(lower - y, y - upper))
        scale = task[SCALE + k]
        for j in range(LANES):
            w[COST + j] += w[value + j] / scale if w[value + j] > TOLERANCE else 0.0


@inline_lane_kernel
def score(w: Array, j: Int, loss: float, cause: float, task: tuple[float, float]) -> None:
    """Reward of the vehicle in lane j, see `quad_envs.reward`, and what belongs to it.

    Args:
        w: Block; COST holds the violation cost.
        j: Lane.
        loss: Stage cost.
        cause: Why it crashed, index in `tasks.CRASH_CAUSES`.
        task: Whether the reward is quadratic; control steps of an episode.
    """
    quadratic, steps = task
    cost = w[COST + j]
    v = min(1.0, cost)
    bounded = 0.0 if cause > 0.0 else (1.0 - v) / (1.0 + loss)
    w[REWARD + j] = -loss - v if quadratic > 0.0 else bounded
    w[STAGE_COST + j] = loss
    w[EPISODE_COST + j] += cost
    w[VIOLATED + j] = 1.0 if cost > 0.0 else 0.0
    w[CAUSE + j] = cause
    w[CRASHED + j] = 1.0 if cause > 0.0 else 0.0
    w[TRUNCATED + j] = 1.0 if (w[STEP + j] >= steps) & (cause == 0.0) else 0.0


@inline_kernel
def weights(task: Array) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """The diagonals Q and R."""
    q, r = task[WEIGHT_Q], task[WEIGHT_R]
    Q = q[0], q[1], q[2], q[3], q[4], q[5], q[6], q[7], q[8], q[9], q[10], q[11]
    return Q, (r[0], r[1], r[2], r[3])


@lane_kernel
def judge(w: Array, task: Array) -> None:
    """Stage cost, crash and reward of a block after its step; WANTED is of the new time."""
    compare(w, task)
    hover, lost, steep = task[HOVER], task[LOST], task[TILT_OF_CRASH]
    kind = task[QUADRATIC], task[EPISODE_STEPS]
    Q, R = weights(task)
    for j in range(LANES):
        sines = sincos_in_lanes(w[PHI + j]) + sincos_in_lanes(w[THETA + j]) + sincos_in_lanes(w[PSI + j])
        put_six(w, SINES + j, sines)
        x, u = twelve(w, PLANT + j), four(w, COMMAND + j)
        wanted = six(w, WANTED + j) + four(w, WANTED + 6 * LANES + j)
        parts = stage_cost_in_lanes(x, sines, wanted, u, hover, Q, R)
        off = (x[0] - wanted[0]) ** 2 + (x[1] - wanted[1]) ** 2 + (x[2] - wanted[2]) ** 2
        cause = _BY_LOSS if off > lost * lost else 0.0
        cause = _BY_TILT if max(abs(x[6]), abs(x[7])) >= steep else cause
        cause = _NOT_FINITE if w[FINITE + j] == 0.0 else cause
        score(w, j, parts[0] + parts[1] + parts[2] + parts[3] + parts[4], cause, kind)


@inline_kernel
def encode_vehicle(
    w: Array,
    j: Int,
    x: tuple[float, ...],
    yaw: tuple[float, float],
    disturbance: Array,
    task: Array,
    out: NDArray[np.float32],
) -> int:
    """Write own, position and disturbance of an observation; returns where they end.

    Args:
        w: Block.
        j: Lane.
        x: State as it is measured.
        yaw: Sine and cosine of the measured yaw.
        disturbance: Table, (n_steps, n_nodes, 6).
        task: Task vector.
        out: (>= 27,) float32.
    """
    encode_own(out, w, j, x, yaw)
    start = N_OWN
    if task[SEES_POSITION] > 0.0:
        out[start], out[start + 1], out[start + 2] = x[0], x[1], x[2]
        start += 3
    if task[SEES_DISTURBANCE] > 0.0:
        step = int(w[STEP + j])
        encode_disturbance(out, start, step if step < int(task[EPISODE_STEPS]) else -1, disturbance)
        start += 6
    return start


@inline_kernel
def observe(
    w: Array,
    j: Int,
    previews: Previews,
    disturbance: Array,
    noise: Array,
    task: Array,
    out: NDArray[np.float32],
) -> None:
    """Write the observation of the vehicle in lane j.

    Args:
        w: Block.
        j: Lane.
        previews: What is previewed of its reference, (n_steps, N_PREVIEW).
        disturbance: Its disturbance table, (n_steps, n_nodes, 6).
        noise: Its measurement errors, (n_steps, 12); no steps for none.
        task: Task vector.
        out: (layout.size,) float32.
    """
    x, yaw = measured(w, j, noise)
    start = encode_vehicle(w, j, x, yaw, disturbance, task, out)
    encode_preview(out, start, previews, int(w[STEP + j]), int(task[PREVIEW]) + 1, x)


@inline_kernel
def tell(w: Array, j: Int, i: int, flights: Flights, out: NDArray[np.float32], told: Told) -> None:
    """Write observation and scores of vehicle i, which is in lane j."""
    which, n = flights.which, told.numbers.shape[1]
    for k in range(COUNTS):
        told.numbers[k, i] = w[REWARD + k * LANES + j]
    told.counts[0, i], told.counts[1, i] = int(w[CLIPPED + j]), int(w[CAUSE + j])
    told.flags[i] = w[CRASHED + j] > 0.0
    told.flags[n + i] = w[TRUNCATED + j] > 0.0
    told.flags[2 * n + i] = w[VIOLATED + j] > 0.0
    for k in range(told.values.shape[1]):
        told.values[i, k] = w[VALUES + k * LANES + j]
    observe(
        w,
        j,
        flights.previews[which[0, i]],
        flights.disturbances[which[1, i]],
        flights.noises[which[2, i]],
        flights.task,
        out[i],
    )


@inline_kernel
def foresee(w: Array, j: Int, i: int, flights: Flights) -> None:
    """Draw what vehicle i, which is in lane j, meets after the present step."""
    if flights.draws.gusty or flights.draws.noisy:
        tables = flights.disturbances, flights.noises
        draw_ahead(flights.draws, i, i // LANES, int(w[STEP + j]), *tables, flights.which[1:, i])


@inline_kernel
def await_rows(w: Array, lanes: int, first: int, flights: Flights) -> None:
    """Ask for the rows of their own references that the vehicles of a block need after its step.

    Many tables are too large for the cache, and would be waited for one by one.

    Args:
        w: Block.
        lanes: Vehicles in it.
        first: The first of them.
        flights: The flights.
    """
    stages = int(flights.task[PREVIEW]) + 1
    if flights.references.shape[0] > 1:
        for j in range(lanes):
            table, step = flights.which[0, first + j], int(w[STEP + j])
            fetch(flights.references[table], min(step, flights.references.shape[1] - 1), 1)
            fetch(flights.previews[table], min(step, flights.previews.shape[1] - stages), stages)


@inline_kernel
def want(w: Array, j: Int, reference: Array) -> None:
    """Take over the row of the reference at the present step."""
    row = reference[min(int(w[STEP + j]), reference.shape[0] - 1)]
    for k in range(N_TABLE):
        w[WANTED + k * LANES + j] = row[k]


@inline_kernel
def substep(
    w: Array, s: int, lanes: int, first: int, disturbances: Array, which: IntArray, task: Array
) -> None:
    """Integrate a block over substep s; arguments as in `fly`."""
    h = task[DT] / task[SUBSTEPS]
    if disturbances.shape[1] == 0:
        calm_substep(w, h)
    else:
        for j in range(lanes):
            k = min(int(w[STEP + j]) - 1, disturbances.shape[1] - 1)
            load_air(w, j, disturbances[which[first + j], k], s)
        disturbed_substep(w, h)


@inline_kernel
def fly(w: Array, lanes: int, first: int, disturbances: Array, which: IntArray, task: Array) -> None:
    """Integrate a block over its control period.

    Args:
        w: Block.
        lanes: Vehicles in it.
        first: The first of them.
        disturbances: Tables (n_tables, n_steps, 2 substeps + 1, 6), of which the last row holds on.
        which: Table of each vehicle, (n,).
        task: Task vector.
    """
    for s in range(int(task[SUBSTEPS])):
        substep(w, s, lanes, first, disturbances, which, task)
    arrive(w)


@lane_kernel
def step_flights(
    words: IntArray,
    flat_actions: NDArray[np.float32],
    flat_out: NDArray[np.float32],
    told_block: Array,
    begin: int,
    end: int,
) -> int:
    """One control period of the vehicles in blocks begin..end-1.

    Args:
        words: The `Flights`, packed.
        flat_actions: Of all vehicles, (4 n,).
        flat_out: Observations of all, (n layout.size,).
        told_block: Scores of all, see N_TOLD.
        begin: First block.
        end: Block before which to stop.

    Returns:
        Number of episodes that ended; or -1 - a, if action a is not finite: then nothing was changed.
    """
    bad = first_unsound(flat_actions)
    if bad >= 0:
        return -1 - bad
    flights, told, n = _flights(words), _told(borrowed(told_block)), told_block.shape[1]
    actions, out = (
        borrowed(flat_actions).reshape(n, N_INPUT),
        borrowed(flat_out).reshape(n, flat_out.size // n),
    )
    task = flights.task
    ended = 0
    for b in range(begin, end):
        w, first = flights.blocks[b], b * LANES
        lanes = min(LANES, n - first)
        for j in range(lanes):
            for a in range(N_INPUT):
                w[ACTION + a * LANES + j] = actions[first + j, a]
        command(w, task)
        await_rows(w, lanes, first, flights)
        fly(w, lanes, first, flights.disturbances, flights.which[1], task)
        for j in range(lanes):
            want(w, j, flights.references[flights.which[0, first + j]])
        judge(w, task)
        for j in range(lanes):
            ended += int(w[CRASHED + j] + w[TRUNCATED + j])
            foresee(w, j, first + j, flights)
            tell(w, j, first + j, flights, out, told)
    return ended


@inline_kernel
def begin_lane(w: Array, j: Int, plant: Array, hover: float) -> None:
    """A vehicle at the start of an episode, in hover; which vehicle it is stays."""
    for i in range(N_PLANT):
        w[PLANT + i * LANES + j] = plant[i]
    for i in range(N_INPUT):
        w[COMMAND + i * LANES + j], w[CHANGE + i * LANES + j] = hover, 0.0
    w[STEP + j], w[CLIPPED + j], w[FINITE + j] = 0.0, 0.0, 1.0


@inline_kernel
def _is_lost(plant: Array, reference: Array, task: Array) -> bool:
    """Whether a plant is too far from the beginning of its reference."""
    off = 0.0
    for i in range(3):
        off += (plant[i] - reference[0, i]) ** 2
    return bool(off > task[LOST] * task[LOST])


@kernel
def begin_flights(
    words: IntArray, index: IntArray, plants: Array, flat_out: NDArray[np.float32], told_block: Array
) -> int:
    """Begin episodes, and tell what their vehicles see.

    Args:
        words: The `Flights`, packed.
        index: Vehicles, (m,).
        plants: Where they start, (m, 16).
        flat_out: As in `step_flights`.
        told_block: As in `step_flights`.

    Returns:
        -1, or the place in `index` of the first vehicle that starts lost: then nothing was changed.
    """
    flights, told, n = _flights(words), _told(borrowed(told_block)), told_block.shape[1]
    out, task = borrowed(flat_out).reshape(n, flat_out.size // n), flights.task
    blocks, w = flights.blocks, flights.blocks[flights.blocks.shape[0] - 1]
    for m in range(index.size):
        if _is_lost(plants[m], flights.references[flights.which[0, index[m]]], task):
            return m
    for first in range(0, index.size, LANES):
        lanes = min(LANES, index.size - first)
        for j in range(lanes):
            i = index[first + j]
            move_lane(blocks[i // LANES], i % LANES, w, j)
            begin_lane(w, j, plants[first + j], task[HOVER])
            want(w, j, flights.references[flights.which[0, i]])
        judge(w, task)
        for j in range(lanes):
            i = index[first + j]
            w[REWARD + j], w[EPISODE_COST + j] = 0.0, 0.0
            foresee(w, j, i, flights)
            tell(w, j, i, flights, out, told)
            move_lane(w, j, blocks[i // LANES], i % LANES)
    return -1


@kernel
def tell_flights(words: IntArray, index: IntArray, flat_out: NDArray[np.float32], told_block: Array) -> None:
    """Tell of the vehicles `index` as they are; arguments as in `step_flights`."""
    flights, told, n = _flights(words), _told(borrowed(told_block)), told_block.shape[1]
    out = borrowed(flat_out).reshape(n, flat_out.size // n)
    for m in range(index.size):
        i = index[m]
        tell(flights.blocks[i // LANES], i % LANES, i, flights, out, told)
