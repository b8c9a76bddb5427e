"""The compiled step of the multi-agent tasks: actions in, observations and scores out, for many teams.

A team is blocks of four vehicles (`quad_envs.lanes`), the last of which may have empty lanes. The single
environment is a batch of one team, so that it and the batched form are the same computation.
"""

from __future__ import annotations

import math
from typing import Annotated, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...compilation.decorators import Int, inline_kernel, kernel, lane_kernel
from ...compilation.intrinsics import borrowed, take_nearest
from ...compilation.packed import IntArray, unpacker
from ...dynamics import arrive, set_out
from ...lanes import (
    ACTION,
    ALIVE,
    CAUSE,
    CLIPPED,
    CRASHED,
    EPISODE_COST,
    HEARD,
    LANES,
    LEFT,
    MEASURES,
    MOVED,
    N_PLANT,
    N_TEAM,
    NEAREST,
    PLANT,
    REWARD,
    SINES,
    SLOT_ERROR,
    STEP,
    TERMINATED,
    TERMS,
    TRUNCATED,
    VALUES,
    VIOLATED,
    six,
    twelve,
)
from ...observations.team import N_PLAN_STAGE
from ...plant import N_INPUT, Array
from ..shared.actions import first_unsound
from ..shared.draws import Draws, draw_ahead
from ..shared.task_vector import DT, HOVER, SUBSTEPS
from ..tracking.kernel import begin_lane, command, substep
from .exchange import (
    DISTURBANCE,
    DRAW,
    FAR,
    MEASUREMENT,
    N_MOTION,
    NOISE,
    ON_RAILS,
    PLAN,
    REFERENCE,
    SENSED_SLOTS,
    SENSOR_ROWS,
    TARGET,
    WEIGHT,
    Tables,
    hear,
    measure_target,
    motion,
    observe_agent,
    sense,
    told_motion,
)
from .scores import N_LOSS, judge_estimate, judge_team

PLAN_SCALE = 5.0  # m, and m/s: of the plan in an action, relative to the sender
ESTIMATE_REACH = 20.0  # m: of an estimated position in an action, relative to the vehicle
ESTIMATE_SPEED = 5.0  # m/s: of an estimated velocity in an action
_POINT = 4 * LANES  # numbers of four places and their smallest squared distances, see `take_nearest`

# Rows of what a step tells of n vehicles, (.., n) float64: numbers, counts as int64, flags as bytes, then the
# constraint values, (n, number of constraints), and terms of the reward, (n, N_LOSS + number of constraints).
SCORES = (
    4  # the block's rows from REWARD to EPISODE_COST; the slot error and the distance to the nearest follow
)
COUNTS = SCORES + 2  # clipped actions, cause of the crash, messages
FLAGS = COUNTS + 3  # crashed, truncated, violated, terminated, alive
N_TOLD = FLAGS + 1


class Teams(NamedTuple):
    """What many teams consist of, packed for the kernels."""

    blocks: Annotated[Array, "B, S"]  # those of one team after the other, and one more
    messages: Annotated[Array, "n, K, C"]  # what each vehicle heard, HEAD and content
    history: Annotated[Array, "M, D, N, C"]  # contents of the last steps of each team
    tables: Tables
    task: Annotated[Array, "S"]  # task vector
    team: Annotated[Array, "S"]  # team vector
    scratch: Annotated[Array, "K, S"]  # of each thread, (scratch_size,)
    draws: Draws


class Told(NamedTuple):
    """The rows of what a step tells, see N_TOLD."""

    numbers: Array  # (COUNTS, n)
    counts: IntArray  # (FLAGS - COUNTS, n)
    flags: NDArray[np.uint8]  # (8 n,), of which 5 n are used
    values: Array  # (n, number of constraints)
    terms: Array  # (n, N_LOSS + number of constraints)


def scratch_size(vehicles: int, sensed: int) -> int:
    """Numbers of a `Scratch`; behind its places: motions, what is told, places again, who is near."""
    return N_TEAM + -(-vehicles // LANES) * _POINT + (2 * N_MOTION + 4) * vehicles + 2 * sensed + 6


_teams = unpacker(Teams)


class Scratch(NamedTuple):
    """Memory of a thread while it moves a team."""

    aside: Array  # a block for vehicles that left
    places: Array  # a _POINT for each block of the team
    rest: Array


@inline_kernel
def _scratch(teams: Teams, thread: int, each: int) -> Scratch:
    """The scratch of a thread for teams of so many blocks."""
    memory, places = teams.scratch[thread], N_TEAM + each * _POINT
    return Scratch(memory[:N_TEAM], memory[N_TEAM:places], memory[places:])


@inline_kernel
def _told(block: Array, constraints: int) -> Told:
    n, end = block.shape[1], N_TOLD + constraints
    return Told(
        block[:COUNTS],
        block[COUNTS:FLAGS].view(np.int64),
        block[FLAGS].view(np.uint8),
        block[N_TOLD:end].reshape(n, constraints),
        block[end:].reshape(n, N_LOSS + constraints),
    )


@inline_kernel
def _gather(blocks: Array, row: Int, n: int, places: Array) -> None:
    """Positions of a team, three rows of its blocks, into places; who crashed is far from everybody."""
    for b in range(blocks.shape[0]):
        w, at = blocks[b], b * _POINT
        for j in range(LANES):
            flies = (b * LANES + j < n) & (w[ALIVE + j] > 0.0)
            for c in range(3):
                places[at + c * LANES + j] = w[row + c * LANES + j] if flies else FAR * (b * LANES + j + 1)


@kernel
def _take_nearest(places: Array, n: int) -> None:
    """Take the squared distances between the places of n vehicles into the smallest ones so far."""
    for b in range(places.size // _POINT):
        take_nearest(places, b * _POINT, min(LANES, n - b * LANES))


@inline_kernel
def _forget_nearest(places: Array) -> None:
    for at in range(3 * LANES, places.size, _POINT):
        for j in range(LANES):
            places[at + j] = math.inf


@inline_kernel
def _tell_nearest(blocks: Array, places: Array) -> None:
    """NEAREST of a team from the squared distances in `places`."""
    for b in range(blocks.shape[0]):
        for j in range(LANES):
            blocks[b, NEAREST + j] = math.sqrt(places[b * _POINT + 3 * LANES + j])


@kernel
def _fly(blocks: Array, first: int, tables: Tables, task: Array, places: Array) -> None:
    """Integrate a team over a control period, and note the smallest distances at the substep ends.

    Args:
        blocks: Of the team.
        first: Its first vehicle.
        tables: The tables.
        task: Task vector.
        places: Scratch, a _POINT per block.
    """
    n = tables.neighbours.shape[0]
    _forget_nearest(places)
    for s in range(int(task[SUBSTEPS])):
        for b in range(blocks.shape[0]):
            lanes, which = min(LANES, n - b * LANES), tables.which[DISTURBANCE]
            substep(blocks[b], s, lanes, first + b * LANES, tables.disturbances, which, task)
        _gather(blocks, np.int64(MOVED), n, places)
        _take_nearest(places, n)
    for b in range(blocks.shape[0]):
        w = blocks[b]
        for j in range(LANES):
            if w[ALIVE + j] == 0.0:  # it lies where it crashed
                for i in range(N_PLANT):
                    w[MOVED + i * LANES + j] = w[PLANT + i * LANES + j]
        arrive(w)
    _tell_nearest(blocks, places)


@inline_kernel
def _foresee(blocks: Array, t: int, teams: Teams) -> None:
    """Draw what the vehicles of team t meet after the present step."""
    tables, n = teams.tables, teams.tables.neighbours.shape[0]
    for i in range(n):
        b, which = i // LANES, tables.which[DISTURBANCE : NOISE + 1, t * n + i]
        step, block = int(blocks[b, STEP + i % LANES]), t * blocks.shape[0] + b
        draw_ahead(teams.draws, t * n + i, block, step, tables.disturbances, tables.noises, which)


@kernel
def _inform(
    blocks: Array,
    t: int,
    teams: Teams,
    scratch: Array,
    out: NDArray[np.float32],
) -> None:
    """Measurements, messages and observations of a team at its present step.

    Args:
        blocks: Of the team.
        t: Which it is.
        teams: All teams.
        scratch: ((2 N_MOTION + 4) N + 2 K_s,).
        out: Observations of all vehicles, (n, layout.size) float32.
    """
    tables, task, team, history = teams.tables, teams.task, teams.team, teams.history[t]
    n, sensed = tables.neighbours.shape[0], int(team[SENSED_SLOTS])
    first = t * n
    motions = scratch[: N_MOTION * n].reshape(n, N_MOTION)
    told = motions
    if tables.noises.shape[1] > 0:
        told = scratch[N_MOTION * n : 2 * N_MOTION * n].reshape(n, N_MOTION)
    places = scratch[2 * N_MOTION * n : (2 * N_MOTION + 3) * n].reshape(3, n)
    squares, rest = (
        scratch[(2 * N_MOTION + 3) * n : (2 * N_MOTION + 4) * n],
        scratch[(2 * N_MOTION + 4) * n :],
    )
    key, near = rest[:sensed], rest[sensed : 2 * sensed]
    k = int(blocks[0, STEP])
    now = history[k % history.shape[0]]
    previews = tables.previews[tables.which[REFERENCE, first]]
    target, draws = tables.targets[tables.which[TARGET, first]], tables.draws[tables.which[DRAW, first]]
    for i in range(n):
        w, j = blocks[i // LANES], i % LANES
        motion(twelve(w, PLANT + j), six(w, SINES + j), motions[i])
        if tables.noises.shape[1] > 0:
            told_motion(w, j, tables.noises[tables.which[NOISE, first + i]], told[i])
        for c in range(N_MOTION):
            now[i, c] = told[i, c]
        for c in range(3):
            places[c, i] = motions[i, c] if w[ALIVE + j] > 0.0 else FAR
        if team[SENSOR_ROWS] > 0.0:
            aim = target[min(k, target.shape[0] - 1)]
            measure_target(motions[i], aim, draws, k, i, w[MEASURES + j], team, now[i, MEASUREMENT:])
    for i in range(n):
        w, j = blocks[i // LANES], i % LANES
        messages = teams.messages[first + i]
        if w[LEFT + j] == 0.0:  # who crashes in this step still sees where
            hear(k, i, blocks, first, history, tables, team, messages)
            count = sense(i, motions, places, squares, team, key, near)
            observe_agent(
                i, w, told[i], now[i, MEASUREMENT:], messages, motions, tables.offsets[i], previews,
                tables.disturbances[tables.which[DISTURBANCE, first + i]],
                tables.noises[tables.which[NOISE, first + i]], count, near, task, team, out[first + i],
            )  # fmt: skip
        else:
            w[HEARD + j] = 0.0
            for c in range(out.shape[1]):
                out[first + i, c] = 0.0


@inline_kernel
def _tell(w: Array, j: Int, i: int, told: Told) -> None:
    """Write the scores of vehicle i, which is in lane j."""
    n = told.numbers.shape[1]
    for k in range(SCORES):
        told.numbers[k, i] = w[REWARD + k * LANES + j]
    told.numbers[SCORES, i], told.numbers[SCORES + 1, i] = w[SLOT_ERROR + j], w[NEAREST + j]
    told.counts[0, i], told.counts[1, i] = int(w[CLIPPED + j]), int(w[CAUSE + j])
    told.counts[2, i] = int(w[HEARD + j])
    told.flags[i] = w[CRASHED + j] > 0.0
    told.flags[n + i] = w[TRUNCATED + j] > 0.0
    told.flags[2 * n + i] = w[VIOLATED + j] > 0.0
    told.flags[3 * n + i] = w[TERMINATED + j] > 0.0
    told.flags[4 * n + i] = w[ALIVE + j] > 0.0
    for k in range(told.values.shape[1]):
        told.values[i, k] = w[VALUES + k * LANES + j]
    for k in range(told.terms.shape[1]):
        told.terms[i, k] = w[TERMS + k * LANES + j]


@inline_kernel
def _plan_of_action(w: Array, j: Int, action: NDArray[np.floating], content: Array) -> None:
    """The plan in the tail of an action, absolute, into the content of the coming message."""
    for c in range(action.shape[0] - N_INPUT):
        part = c % N_PLAN_STAGE
        at = w[PLANT + part * LANES + j] if part < 3 else 0.0
        content[PLAN + c] = at + PLAN_SCALE * min(max(float(action[N_INPUT + c]), -1.0), 1.0)


@inline_kernel
def _ride(
    blocks: Array, first: int, tables: Tables, actions: NDArray[np.floating], task: Array, estimate: Array
) -> None:
    """A step of vehicles on rails, which fly straight on; their actions are estimates of the target now."""
    target = tables.targets[tables.which[TARGET, first]]
    for i in range(tables.neighbours.shape[0]):
        w, j = blocks[i // LANES], i % LANES
        _count_clipped(w, j, actions[first + i], 0)
        for c in range(3):
            place = w[PLANT + c * LANES + j]
            estimate[c] = place + ESTIMATE_REACH * min(max(float(actions[first + i, c]), -1.0), 1.0)
            estimate[3 + c] = ESTIMATE_SPEED * min(max(float(actions[first + i, 3 + c]), -1.0), 1.0)
        k = min(int(w[STEP + j]), target.shape[0] - 1)
        w[STEP + j] += 1.0
        judge_estimate(w, j, target[k], estimate, task)
        for c in range(3):  # level and at heading 0, so that V_B is the inertial velocity
            w[PLANT + c * LANES + j] += task[DT] * w[PLANT + (3 + c) * LANES + j]


@inline_kernel
def _count_clipped(w: Array, j: Int, action: NDArray[np.floating], start: int) -> None:
    """Count the entries of an action outside [-1, 1] from `start` on."""
    for a in range(start, action.shape[0]):
        if abs(action[a]) > 1.0:
            w[CLIPPED + j] += 1.0


@inline_kernel
def _command_team(
    blocks: Array, first: int, n: int, actions: NDArray[np.floating], history: Array, task: Array
) -> None:
    """Take over the actions of a team: rotor commands and plans."""
    for i in range(n):
        w, j, action = blocks[i // LANES], i % LANES, actions[first + i]
        for a in range(N_INPUT):
            w[ACTION + a * LANES + j] = action[a]
        _count_clipped(w, j, action, N_INPUT)
        coming = (int(w[STEP + j]) + 1) % history.shape[0]
        _plan_of_action(w, j, action, history[coming, i])
    for b in range(blocks.shape[0]):
        command(blocks[b], task)


@lane_kernel
def step_teams(
    words: IntArray,
    flat_actions: NDArray[np.float32],
    flat_out: NDArray[np.float32],
    told_block: Array,
    constraints: int,
    thread: int,
    begin: int,
    end: int,
) -> int:
    """One control period of teams begin..end-1.

    Args:
        words: The `Teams`, packed.
        flat_actions: (n action_size,).
        flat_out: Observations, (n layout.size,).
        told_block: Scores of all, see N_TOLD.
        constraints: Number of named constraints.
        thread: Which thread this is.
        begin: First team.
        end: Team before which to stop.

    Returns:
        -1, or the flat index of the first non-finite action; then nothing was changed.
    """
    bad = first_unsound(flat_actions)
    if bad >= 0:
        return bad
    teams, told, all_ = _teams(words), _told(borrowed(told_block), constraints), told_block.shape[1]
    actions = borrowed(flat_actions).reshape(all_, flat_actions.size // all_)
    out = borrowed(flat_out).reshape(all_, flat_out.size // all_)
    tables, task, team = teams.tables, teams.task, teams.team
    n = tables.neighbours.shape[0]
    each = (teams.blocks.shape[0] - 1) // (all_ // n)
    aside, places, rest = _scratch(teams, thread, each)
    for t in range(begin, end):
        blocks, first = teams.blocks[t * each : (t + 1) * each], t * n
        if team[ON_RAILS] > 0.0:
            _ride(blocks, first, tables, actions, task, rest)
        else:
            _command_team(blocks, first, n, actions, teams.history[t], task)
            _fly(blocks, first, tables, task, places)
            judge_team(blocks, first, aside, tables, task, team)
        _foresee(blocks, t, teams)
        _inform(blocks, t, teams, rest, out)
        for i in range(n):
            _tell(blocks[i // LANES], i % LANES, first + i, told)
    return -1


@kernel
def begin_teams(
    words: IntArray,
    index: IntArray,
    plants: Array,
    flat_out: NDArray[np.float32],
    told_block: Array,
    constraints: int,
) -> None:
    """Begin episodes; until a vehicle has sent a plan, its neighbours are told that it goes straight on.

    Args:
        words: The `Teams`, packed.
        index: Teams, (m,).
        plants: Where their vehicles start, (m, N, 16).
        flat_out: As in `step_teams`.
        told_block: As in `step_teams`.
        constraints: As in `step_teams`.
    """
    teams, told, all_ = _teams(words), _told(borrowed(told_block), constraints), told_block.shape[1]
    out = borrowed(flat_out).reshape(all_, flat_out.size // all_)
    tables, task, team = teams.tables, teams.task, teams.team
    n = tables.neighbours.shape[0]
    each = (teams.blocks.shape[0] - 1) // (all_ // n)
    aside, places, rest = _scratch(teams, 0, each)
    for m in range(index.size):
        t = index[m]
        blocks, first = teams.blocks[t * each : (t + 1) * each], t * n
        for i in range(n):
            w, j = blocks[i // LANES], i % LANES
            _clear(w, j)
            begin_lane(w, j, plants[m, i], task[HOVER])
            for s in range(teams.messages.shape[1]):
                teams.messages[first + i, s, WEIGHT] = 0.0
        _forget_nearest(places)
        _gather(blocks, np.int64(PLANT), n, places)
        _take_nearest(places, n)
        _tell_nearest(blocks, places)
        for b in range(each):
            set_out(blocks[b])
        if team[ON_RAILS] == 0.0:
            judge_team(blocks, first, aside, tables, task, team)
        for i in range(n):
            blocks[i // LANES, EPISODE_COST + i % LANES] = 0.0
            _promise(blocks[i // LANES], i % LANES, task[DT], teams.history[t, 0, i])
        _foresee(blocks, t, teams)
        _inform(blocks, t, teams, rest, out)
        for i in range(n):
            _tell(blocks[i // LANES], i % LANES, first + i, told)


@inline_kernel
def _clear(w: Array, j: Int) -> None:
    """Forget the scores of an episode; which vehicle it is, and whether it has the sensor, stays."""
    for row in range(REWARD, ACTION, LANES):
        w[row + j] = 0.0
    for row in range(TERMS, LEFT + LANES, LANES):
        if row != MEASURES:
            w[row + j] = 0.0
    w[ALIVE + j] = 1.0


@inline_kernel
def _promise(w: Array, j: Int, dt: float, content: Array) -> None:
    """The plan before any was sent: on at the present velocity."""
    motion(twelve(w, PLANT + j), six(w, SINES + j), content)
    for c in range(content.shape[0] - PLAN):
        stage, part = c // N_PLAN_STAGE, c % N_PLAN_STAGE
        ahead = stage * dt * content[3 + part] if part < 3 else 0.0
        content[PLAN + c] = content[part] + ahead
