"""What vehicles learn of each other and of the target: sensing, messages, measurements, the observation.

A vehicle's message is its CONTENT at one control step. Contents of the last `delay + 1` steps are kept, and
of every neighbour the last message that was heard. A neighbour has the same slot for the whole episode.
"""

from __future__ import annotations

import math
from typing import Annotated, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...compilation.decorators import Int, inline_kernel, kernel
from ...compilation.packed import IntArray
from ...lanes import ALIVE, HEARD, LANES, MOST_VALUES, STEP
from ...observations.team import N_COMM, N_MEASURED, N_PLAN_STAGE, N_SENSED
from ...observations.tracking import Previews, encode_preview, measured
from ...plant import Array
from ...references.table_row import N_PREVIEW, N_REFERENCE, N_TABLE
from ...rotations import sincos
from ...sensors import AZIMUTH, RANGE, measure, reads
from ..shared.task_vector import DT, PREVIEW
from ..tracking.kernel import encode_vehicle

# Entries of a message's content, absolute.
N_MOTION = 10  # p 3, v 3 (inertial), phi, theta, sin psi, cos psi
MEASUREMENT = N_MOTION  # valid, range, sin and cos of azimuth, elevation
PLAN = MEASUREMENT + N_MEASURED  # (p, v) of each stage
# Before the content, a message that was heard has these.
WEIGHT, SENT, RECEIVED = 0, 1, 2  # G_ij (0: nothing heard); control steps at which it was sent, received
HEAD = 3
FAR = 1e9  # m, where those are who crashed, that nobody senses them

# Entries of the team vector.
(
    SEPARATION,  # m, d_s
    CRASH_DISTANCE,  # m, d_crash
    SENSING_RADIUS,  # m, R_s
    LIFETIME,  # control steps for which a message stays valid
    DROP_OUT,  # probability that a message is lost
    FORMATION_WEIGHT,
    ARENA,  # m
    WHOLE_TEAM,  # 1: a crash ends the episode of all
    HAS_LEADER,
    ON_RAILS,
    SENSOR_ROWS,  # 0: no target, else `sensors.sensor_rows`
    DETECTION,  # probability that a measurement succeeds
    PLAN_STAGES,
    N_VALUES,  # named constraint rows
    SENSED_SLOTS,  # K_s
) = range(15)
SIGMA = slice(15, 18)  # of range, azimuth, elevation
SCALES = 18  # of the named rows
TEAM_SIZE = SCALES + MOST_VALUES


class Tables(NamedTuple):
    """What a team's step reads: who hears whom, and what was tabulated at reset."""

    weights: Annotated[Array, "M, N, K"]  # G_ij per graph and slot
    neighbours: Annotated[IntArray, "N, K"]  # sender of each slot, -1 for none
    schedule: Annotated[IntArray, "T"]  # graph of each step
    offsets: Annotated[Array, "N, L, 3"]  # m, delta_ij per slot, then p_i* beside the leader or the target
    which: Annotated[IntArray, "5, n"]  # table of a vehicle: reference, disturbance, noise, target, draw
    references: Annotated[Array, f"M, T, {N_TABLE}"]  # tables, of the leader
    previews: Annotated[Previews, f"M, T, {N_PREVIEW}"]  # of these
    disturbances: Annotated[Array, "M, T, L, 6"]  # tables
    noises: Annotated[Array, "M, T, 12"]  # tables, of the vehicles' own state; no steps for none
    targets: Annotated[Array, "M, T, 6"]  # tables, r and v of the target; no steps for none
    # Tables: measurement noise 3, detection, drop-outs; no steps for none.
    draws: Annotated[Array, "M, T, N, L"]


# Rows of `which`.
REFERENCE, DISTURBANCE, NOISE, TARGET, DRAW = range(5)


@inline_kernel
def motion(x: tuple[float, ...], sines: tuple[float, ...], out: Array) -> None:
    """p, inertial v, phi, theta, sin psi, cos psi of a state (12,) with its sines (6,), into out (>= 10,)."""
    sf, cf, st, ct, ss, cs = sines
    down = sf * x[4] + cf * x[5]
    forward = ct * x[3] + st * down  # in the heading frame
    right = cf * x[4] - sf * x[5]
    out[0], out[1], out[2] = x[0], x[1], x[2]
    out[3], out[4] = cs * forward - ss * right, ss * forward + cs * right
    out[5] = ct * down - st * x[3]
    out[6], out[7], out[8], out[9] = x[6], x[7], ss, cs


@inline_kernel
def told_motion(w: Array, j: Int, noise: Array, out: Array) -> None:
    """Motion of the vehicle in lane j as its own sensors tell it, into out (>= 10,)."""
    x, _ = measured(w, j, noise)
    motion(x, sincos(x[6]) + sincos(x[7]) + sincos(x[8]), out)


@inline_kernel
def measure_target(
    own: Array, target: Array, draws: Array, k: int, i: int, measures: float, team: Array, out: Array
) -> None:
    """One vehicle's noisy measurement of the target.

    Args:
        own: Its true motion, (10,).
        target: r, v, (6,).
        draws: Of the team, (n_steps, N, 4 + K).
        k: Control step.
        i: Vehicle of the team.
        measures: 1 if it has the sensor.
        team: Team vector.
        out: Result: valid, range, sin and cos of azimuth, elevation, (5,); zero where nothing is measured.
    """
    for c in range(N_MEASURED):
        out[c] = 0.0
    draw = draws[min(k, draws.shape[0] - 1), i]
    if measures > 0.0 and draw[3] < team[DETECTION]:
        rho, azimuth, elevation = measure(target[0] - own[0], target[1] - own[1], target[2] - own[2])
        out[0] = 1.0
        rows = int(team[SENSOR_ROWS])
        if reads(rows, RANGE):
            out[1] = rho + team[SIGMA][0] * draw[0]
        if reads(rows, AZIMUTH):
            out[2], out[3] = sincos(azimuth + team[SIGMA][1] * draw[1])
            out[4] = elevation + team[SIGMA][2] * draw[2]


@kernel
def hear(
    k: int, i: int, blocks: Array, first: int, history: Array, tables: Tables, team: Array, messages: Array
) -> None:
    """Take over the messages that reach vehicle i at step k, and drop those of crashed senders.

    Args:
        k: Control step.
        i: Vehicle of the team.
        blocks: Of the team.
        first: Its first vehicle.
        history: Contents of the team's last steps, (depth, N, C).
        tables: The tables.
        team: Team vector.
        messages: Of vehicle i, (K, HEAD + C), changed in place.
    """
    depth = history.shape[0]
    sent = k - (depth - 1)
    graph = tables.weights[tables.schedule[min(max(sent, 0), tables.schedule.shape[0] - 1)], i]
    draws = tables.draws[tables.which[DRAW, first]]
    heard = 0
    for s in range(messages.shape[0]):
        j, message = tables.neighbours[i, s], messages[s]
        if j < 0:
            continue
        if blocks[j // LANES, ALIVE + j % LANES] == 0.0:
            message[WEIGHT] = 0.0
            continue
        if sent < 0 or graph[s] <= 0.0:
            continue
        if team[DROP_OUT] > 0.0 and draws[min(sent, draws.shape[0] - 1), i, 4 + s] < team[DROP_OUT]:
            continue
        message[WEIGHT], message[SENT], message[RECEIVED] = graph[s], float(sent), float(k)
        content = history[sent % depth, j]
        for c in range(content.shape[0]):
            message[HEAD + c] = content[c]
        heard += 1
    blocks[i // LANES, HEARD + i % LANES] = float(heard)


@kernel
def sense(
    i: int, motions: Array, places: Array, squares: Array, team: Array, key: Array, which: Array
) -> int:
    """The most urgent vehicles within the sensing radius of vehicle i, most urgent first.

    Approaching ones by the time to contact max(|d| - d_s, 0) / closing speed, then the others by distance.

    Args:
        i: Vehicle of the team.
        motions: True motions of the team, (N, 10).
        places: Positions, (3, N); those that crashed are far from everybody.
        squares: Scratch, (N,).
        team: Team vector.
        key: Scratch, (K_s,).
        which: Result, (K_s,).

    Returns:
        How many there are, at most K_s.
    """
    most, found = which.shape[0], 0
    reach = team[SENSING_RADIUS] * team[SENSING_RADIUS]
    own, x, y, z = motions[i], places[0], places[1], places[2]
    left = 0  # of those within reach, itself among them, whom the second loop has still to meet
    for j in range(squares.size):
        squares[j] = (x[j] - own[0]) ** 2 + (y[j] - own[1]) ** 2 + (z[j] - own[2]) ** 2
        left += 0 if squares[j] >= reach else 1
    for j in range(squares.size):
        if left == 0:
            break
        if squares[j] >= reach:
            continue
        left -= 1
        if j == i:
            continue
        dx, dy, dz = x[j] - own[0], y[j] - own[1], z[j] - own[2]
        distance = math.sqrt(squares[j])
        parting = (
            dx * (motions[j, 3] - own[3]) + dy * (motions[j, 4] - own[4]) + dz * (motions[j, 5] - own[5])
        )
        urgency = 1e6 + distance
        if parting < 0.0:
            urgency = max(distance - team[SEPARATION], 0.0) * distance / -parting
        at = found
        while at > 0 and key[at - 1] > urgency:
            if at < most:
                key[at], which[at] = key[at - 1], which[at - 1]
            at -= 1
        if at < most:
            key[at], which[at] = urgency, float(j)
            found = min(found + 1, most)
    return found


@inline_kernel
def _is_valid(message: Array, k: int, team: Array) -> bool:
    """Whether a message was heard and is not too old."""
    return bool(message[WEIGHT] > 0.0 and float(k) - message[SENT] <= team[LIFETIME])


@kernel
def _encode_messages(
    k: int,
    messages: Array,
    own: Array,
    offsets: Array,
    task: Array,
    team: Array,
    out: NDArray[np.float32],
    at: int,
) -> None:
    """All comm slots from out[at] on, relative to what vehicle i knows of its own motion."""
    tail = N_PLAN_STAGE * int(team[PLAN_STAGES])
    for s in range(messages.shape[0]):
        message = messages[s]
        if _is_valid(message, k, team):
            out[at] = message[WEIGHT]
            out[at + 1] = (float(k) - message[SENT]) * task[DT]
            for c in range(6):
                out[at + 2 + c] = message[HEAD + c] - own[c]
            for c in range(4):
                out[at + 8 + c] = message[HEAD + 6 + c]
            for c in range(3):
                out[at + 12 + c] = offsets[s, c]
            for c in range(tail):
                out[at + N_COMM + c] = message[HEAD + PLAN + c] - own[c % N_PLAN_STAGE]
        else:
            for c in range(N_COMM + tail):
                out[at + c] = 0.0
        at += N_COMM + tail


@kernel
def _encode_measurements(
    k: int, messages: Array, measurement: Array, team: Array, out: NDArray[np.float32], at: int
) -> None:
    """The own measurement, then those of the messages, each in the step in which its message arrives."""
    for c in range(N_MEASURED):
        out[at + c] = measurement[c]
    for s in range(messages.shape[0]):
        message = messages[s]
        at += N_MEASURED
        arrives = _is_valid(message, k, team) and int(message[RECEIVED]) == k
        for c in range(N_MEASURED):
            out[at + c] = message[HEAD + MEASUREMENT + c] if arrives else 0.0


@kernel
def _encode_sensed(
    i: int, motions: Array, sensed: int, which: Array, out: NDArray[np.float32], at: int
) -> None:
    """Positions and velocities of the vehicles that vehicle i senses, relative to its own."""
    for s in range(which.shape[0]):
        other = int(which[s]) if s < sensed else i  # relative to itself an empty slot is zero
        out[at] = 1.0 if s < sensed else 0.0
        for c in range(6):
            out[at + 1 + c] = motions[other, c] - motions[i, c]
        at += N_SENSED


@kernel
def observe_agent(
    i: int,
    w: Array,
    own: Array,
    measurement: Array,
    messages: Array,
    motions: Array,
    offsets: Array,
    previews: Previews,
    disturbance: Array,
    noise: Array,
    sensed: int,
    which: Array,
    task: Array,
    team: Array,
    out: NDArray[np.float32],
) -> None:
    """Write the observation of vehicle i, `observations.team.AgentLayout`.

    Args:
        i: Vehicle of the team.
        w: Its block.
        own: Its motion as it measures it, (10,).
        measurement: Of the target, (5,).
        messages: What it heard, (K, HEAD + C).
        motions: True motions of the team, (N, 10).
        offsets: delta_ij per slot, then its slot, (K + 1, 3).
        previews: What is previewed of the leader's reference, (n_steps, N_PREVIEW).
        disturbance: Its own, (n_steps, n_nodes, 6).
        noise: Its measurement errors, (n_steps, 12); no steps for none.
        sensed: How many vehicles it senses.
        which: Those, (K_s,).
        task: Task vector.
        team: Team vector.
        out: (layout.size,) float32.
    """
    j = i % LANES
    k = int(w[STEP + j])
    x, yaw = measured(w, j, noise)
    at = encode_vehicle(w, j, x, yaw, disturbance, task, out)
    leads = i == 0 and team[HAS_LEADER] > 0.0
    out[at] = 1.0 if leads else 0.0
    at += 1
    stages = int(task[PREVIEW]) + 1
    if leads:
        encode_preview(out, at, previews, k, stages, own)
    else:
        for c in range(N_REFERENCE * stages):
            out[at + c] = 0.0
    at += N_REFERENCE * stages
    _encode_messages(k, messages, own, offsets, task, team, out, at)
    K = messages.shape[0]
    at += K * (N_COMM + N_PLAN_STAGE * int(team[PLAN_STAGES]))
    _encode_sensed(i, motions, sensed, which, out, at)
    at += N_SENSED * which.shape[0]
    if team[SENSOR_ROWS] > 0.0:
        _encode_measurements(k, messages, measurement, team, out, at)
        at += N_MEASURED * (1 + K)
        for c in range(3):
            out[at + c] = offsets[K, c]
