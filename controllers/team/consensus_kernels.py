"""The references of one vehicle in compiled form, in axes and equations of `consensus.py`."""

from __future__ import annotations

import math
from typing import NamedTuple

from quad_envs.compilation.decorators import inline_kernel, kernel
from quad_envs.observations.team import COMM_AGE, COMM_WEIGHT, N_COMM, N_PLAN_STAGE
from quad_envs.parameters import Array
from quad_envs.rotations import sincos

from ..estimation.fusion import fuse_point

CV, FROZEN, CA, PLAN = range(4)  # the members of consensus.Neighbour
CONSENSUS_SCRATCH = 24
_SMALLEST_LIFT = 0.2  # of b3_z: a vehicle on its side is not in vertical balance
_SMALLEST_THRUST = 1.0  # m/s^2, of g - b_z
# Starts of the entries of a comm slot, for compiled code.
_POSITION, _VELOCITY, _ATTITUDE, _OFFSET = 2, 5, 8, 12


class ConsensusData(NamedTuple):
    """`ConsensusOptions` for compiled code."""

    neighbour: int
    feed_forward: bool
    attitude: bool
    reach: float
    speed: float
    P_f: float
    target_moves: bool
    dt: float
    gravity: float


@inline_kernel
def turn_to_inertial(V_B: Array, plant: Array) -> tuple[float, float, float]:
    """R_BI' V_B for a vector (3,) in body axes."""
    sf, cf = sincos(plant[6])
    st, ct = sincos(plant[7])
    ss, cs = sincos(plant[8])
    side = cf * V_B[1] - sf * V_B[2]
    under = sf * V_B[1] + cf * V_B[2]
    forward = ct * V_B[0] + st * under
    return cs * forward - ss * side, ss * forward + cs * side, ct * under - st * V_B[0]


@inline_kernel
def inertial_velocity(plant: Array) -> tuple[float, float, float]:
    """The velocity of a vehicle in inertial axes."""
    return turn_to_inertial(plant[3:6], plant)


@inline_kernel
def balanced_acceleration(
    phi: float, theta: float, sine: float, cosine: float, gravity: float
) -> tuple[float, float, float]:
    """Acceleration of a vehicle whose thrust carries its weight: g e3 - (g / b3_z) b3, b3 = R_BI' e3."""
    sf, cf = sincos(phi)
    st, ct = sincos(theta)
    thrust = gravity / max(ct * cf, _SMALLEST_LIFT)
    return (
        -thrust * (st * cosine * cf + sine * sf),
        -thrust * (st * sine * cf - cosine * sf),
        gravity - thrust * ct * cf,
    )


@inline_kernel
def balanced_attitude(
    x: float, y: float, z: float, sine: float, cosine: float, gravity: float
) -> tuple[float, float]:
    """Roll and pitch that give this acceleration at the heading: the inverse of `balanced_acceleration`."""
    lift = max(gravity - z, _SMALLEST_THRUST)
    theta = -math.atan((x * cosine + y * sine) / lift)
    return math.atan((y * cosine - x * sine) * math.cos(theta) / lift), theta


@kernel
def _extrapolate(slot: Array, v: Array, n: int, data: ConsensusData, out: Array) -> None:
    """A neighbour at stage n: p_j - p_i(now), v_j, acc_j into out, (9,).

    A plan is read n samples plus its age after its first stage; past its end, its last stage moves on. An
    empty plan (all zero: nothing was ever planned) counts as none: constant velocity.
    """
    t = slot[COMM_AGE] + n * data.dt
    for a in range(3):
        out[a], out[3 + a], out[6 + a] = slot[_POSITION + a], slot[_VELOCITY + a] + v[a], 0.0
    if data.neighbour == FROZEN:
        return
    if data.neighbour == PLAN:
        last = (slot.shape[0] - N_COMM) // N_PLAN_STAGE - 1
        size = 0.0
        for k in range(N_COMM, slot.shape[0]):
            size += abs(slot[k])
        if size > 0.0:
            ahead = math.floor(t / data.dt + 0.5)
            m = min(int(ahead), last)
            t = (ahead - m) * data.dt
            for a in range(3):
                out[a] = slot[N_COMM + N_PLAN_STAGE * m + a]
                out[3 + a] = slot[N_COMM + N_PLAN_STAGE * m + 3 + a] + v[a]
    if data.neighbour == CA:
        out[6], out[7], out[8] = balanced_acceleration(
            slot[_ATTITUDE], slot[_ATTITUDE + 1], slot[_ATTITUDE + 2], slot[_ATTITUDE + 3], data.gravity
        )
    for a in range(3):
        out[a] += t * (out[3 + a] + 0.5 * t * out[6 + a])
        out[3 + a] += t * out[6 + a]


@kernel
def _agree(comm: Array, v: Array, n: int, data: ConsensusData, state: Array, other: Array) -> None:
    """One stage of the weighted mean: state = (r, w, b) of stage n - 1 becomes that of stage n."""
    if data.feed_forward:
        for a in range(3):
            state[a] += data.dt * (state[3 + a] + 0.5 * data.dt * state[6 + a])
            state[3 + a] += data.dt * state[6 + a]
    total = 1.0
    for j in range(comm.shape[0]):
        G = comm[j, COMM_WEIGHT]
        if G > 0.0:
            total += G
            _extrapolate(comm[j], v, n, data, other)
            for a in range(3):
                state[a] += G * (other[a] + comm[j, _OFFSET + a])
                state[3 + a] += G * other[3 + a]
                state[6 + a] += G * other[6 + a]
    for a in range(9):
        state[a] /= total


@inline_kernel
def _govern(x: float, y: float, z: float, limit: float) -> float:
    """Factor that brings a vector to the length `limit` if it is longer."""
    length = math.sqrt(x * x + y * y + z * z)
    return limit / length if length > limit else 1.0


@kernel
def _write_stage(r: Array, w: Array, sine: float, cosine: float, data: ConsensusData, row: Array) -> None:
    """One governed row of the window."""
    near = _govern(r[0], r[1], r[2], data.reach)
    slow = _govern(w[0], w[1], w[2], data.speed)
    for a in range(3):
        row[a] = near * r[a]
        row[3 + a] = slow * w[a]
    row[6], row[7] = sine, cosine


@kernel
def _start(plant: Array, comm: Array, data: ConsensusData, v: Array, state: Array) -> None:
    """r_0 = 0, w_0 = v_i and b_0 = acc_i, or a hold (all zero) where nobody is heard."""
    v[0], v[1], v[2] = inertial_velocity(plant)
    heard = False
    for j in range(comm.shape[0]):
        heard = heard or comm[j, COMM_WEIGHT] > 0.0
    for a in range(3):
        state[a], state[3 + a], state[6 + a] = 0.0, v[a] if heard else 0.0, 0.0
    if heard and data.neighbour == CA:
        sine, cosine = sincos(plant[8])
        state[6], state[7], state[8] = balanced_acceleration(plant[6], plant[7], sine, cosine, data.gravity)


@kernel
def consensus_row(
    plant: Array,
    leads: bool,
    preview: Array,
    comm: Array,
    estimate_r: Array,
    estimate_v: Array,
    estimate_P: Array,
    slot: Array,
    data: ConsensusData,
    window: Array,
    attitude: Array,
    work: Array,
) -> None:
    """References of one vehicle.

    Args:
        plant: Measured, (16,); its position is not read.
        leads: Whether the preview, governed, is the reference.
        preview: The leader's reference relative to its position, (>= N+1, 8).
        comm: Messages, (K, 15 + 6 N_p), see `quad_envs.observations.team`.
        estimate_r: r^ - p_i, (3,); empty in a formation flight without target.
        estimate_v: v^, (3,).
        estimate_P: Covariance of r^, (9,).
        slot: Wanted position relative to the target, (3,).
        data: Options.
        window: Result, (N+1, 8).
        attitude: Result, (N+1, 2).
        work: Overwritten, (CONSENSUS_SCRATCH,).
    """
    v, state, other = work[:3], work[3:12], work[12:21]
    r, w, goal = state[:3], state[3:6], work[21:24]
    sine, cosine = sincos(plant[8])
    _start(plant, comm, data, v, state)
    for n in range(window.shape[0]):
        attitude[n, 0], attitude[n, 1] = 0.0, 0.0
        if leads:
            _write_stage(preview[n, :3], preview[n, 3:6], preview[n, 6], preview[n, 7], data, window[n])
            continue
        if n == 0:
            for a in range(3):
                window[0, a], window[0, 3 + a] = 0.0, v[a]
            window[0, 6], window[0, 7] = 0.0, 1.0
            continue
        _agree(comm, v, n, data, state, other)
        if estimate_r.shape[0] > 0:
            ahead = n * data.dt if data.target_moves else 0.0
            for a in range(3):
                goal[a] = estimate_r[a] + ahead * estimate_v[a] + slot[a]
            fuse_point(r, w, data.P_f, goal, estimate_v, estimate_P.reshape(3, 3), r, w)
        _write_stage(r, w, 0.0, 1.0, data, window[n])
        if data.attitude:
            attitude[n, 0], attitude[n, 1] = balanced_attitude(
                state[6], state[7], state[8], sine, cosine, data.gravity
            )
