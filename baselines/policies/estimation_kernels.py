"""One step of an agent's target filter from its decoded row, compiled; `estimation.py` says what it is."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from controllers.controller import all_finite
from controllers.estimation.ekf_kernels import NIS_LIMIT, ekf_scratch, ekf_update_kernel, predict_kernel
from controllers.estimation.kalman import kalman_scratch, kalman_update_kernel
from controllers.estimation.restart_kernels import begin_anew, move_to_lines
from controllers.estimation.trilateration_kernels import (
    ACCEPTED,
    TRILATERATION_SCRATCH,
    trilaterate_kernel,
)
from controllers.team.consensus_kernels import inertial_velocity, turn_to_inertial
from quad_envs.compilation.decorators import Int, kernel
from quad_envs.observations.team import COMM_AGE, N_MEASURED
from quad_envs.parameters import DRAG_RATE, GRAVITY, INV_MASS, Array
from quad_envs.sensors import AZIMUTH, RANGE, reads

from .decoding import decode_rows, split_memory
from .protocol import Actions, Counts

# An agent's memory: 0 before the first observation, 1 with the prior alone, 2 since angles; x; P; own motion.
STAGE = 0
X = slice(1, 7)
P = slice(7, 43)
_VELOCITY, _ACCELERATION = 43, 46
FILTER_SIZE = 49
N_REPORT = 4  # NIS, rows, measurements held, whether they entered as a trilaterated position
_POSITION = 2  # of p_j(sent) in a comm slot
_POINT = 3  # numbers in a position
_FIX = 3 + 9 + 18 + 3 + 3  # of `_update_by_fix` besides the ranges


class FilterData(NamedTuple):
    """What the kernels know of the filter."""

    q: float  # m^2/s^3
    dt: float  # s
    message: int  # numbers in a comm slot
    max_ratio: float  # of the geometry test of a trilateration


def filter_scratch(measurements: int, rows: int) -> int:
    """Numbers of scratch that `filter_row` needs."""
    fix = 5 * measurements + _FIX + max(TRILATERATION_SCRATCH, kalman_scratch(6, 3))
    return 7 * measurements + 6 + max(ekf_scratch(measurements, rows), fix)


@kernel
def _own_motion(plant: Array, disturbance: Array, coefficients: Array, out: Array) -> None:
    """Inertial velocity and the acceleration that the model gives it, (6,)."""
    out[0], out[1], out[2] = inertial_velocity(plant)
    thrust = plant[12] + plant[13] + plant[14] + plant[15]
    out[3], out[4], out[5] = 0.0, 0.0, -thrust * coefficients[INV_MASS]
    out[3], out[4], out[5] = turn_to_inertial(out[3:6], plant)
    for a in range(3):
        out[3 + a] += disturbance[3 + a] * coefficients[INV_MASS] - coefficients[DRAG_RATE] * out[a]
    out[5] += coefficients[GRAVITY]


@kernel
def _begin(slot: Array, prior: Array, x: Array, covariance: Array) -> None:
    """The prior of an episode: the target where the slot says, at the task's guess of its velocity."""
    for a in range(3):
        x[a], x[3 + a] = -slot[a], prior[a]
    for a in range(6):
        for b in range(6):
            covariance[a, b] = prior[3 + a] if a == b else 0.0


@kernel
def _way(motion: Array, memory: Array, dt: float, a: int) -> float:
    """Component a of the vehicle's way in one period, by the corrected trapezoid of its velocity."""
    mean = 0.5 * (memory[_VELOCITY + a] + motion[a])
    turn = (memory[_ACCELERATION + a] - motion[3 + a]) / 12.0
    return float(dt * (mean + dt * turn))


@kernel
def _follow(motion: Array, memory: Array, data: FilterData, x: Array, covariance: Array) -> None:
    """Predict by one period, then follow the vehicle."""
    predict_kernel(x, covariance, data.dt, data.q)
    for a in range(3):
        x[a] -= _way(motion, memory, data.dt, a)


@kernel
def _gather(
    comm: Array,
    measured: Array,
    z: Array,
    place: Array,
    age: Array,
    valid: NDArray[np.bool_],
) -> int:
    """Measurements held with the places, relative to the vehicle, where they were made; how many there are.

    Sender of measurement s > 0 is the one of comm slot s - 1, and its position there is that of the sending.
    """
    held = 0
    for s in range(measured.shape[0]):
        valid[s] = measured[s, 0] > 0.0
        held += 1 if valid[s] else 0
        z[s, 0] = measured[s, 1]
        z[s, 1] = math.atan2(measured[s, 2], measured[s, 3])
        z[s, 2] = measured[s, 4]
        age[s] = comm[s - 1, COMM_AGE] if s > 0 else 0.0
        for a in range(_POINT):
            place[s, a] = comm[s - 1, _POSITION + a] if s > 0 else 0.0
    return held


@kernel
def _start_at_measurement(
    z: Array,
    place: Array,
    age: Array,
    valid: NDArray[np.bool_],
    sigma: Array,
    x: Array,
    covariance: Array,
) -> None:
    """With the first angles, move a vague mean to the first measured position; its covariance stays.

    Vague is a prior whose spread s bends the angles by more than their noise: s^2 / (2 rho) beyond the noise
    of the position. There the derivatives at the prior mean would be those of another place.
    """
    for s in range(valid.shape[0]):
        if valid[s]:
            rho = max(z[s, 0], sigma[0])
            spread = (covariance[0, 0] + covariance[1, 1] + covariance[2, 2]) / 3.0
            if spread > 2.0 * rho * max(sigma[0], rho * max(sigma[1], sigma[2])):
                level = rho * math.cos(z[s, 2])
                x[0] = place[s, 0] + level * math.cos(z[s, 1]) + age[s] * x[3]
                x[1] = place[s, 1] + level * math.sin(z[s, 1]) + age[s] * x[4]
                x[2] = place[s, 2] - rho * math.sin(z[s, 2]) + age[s] * x[5]
            return


@kernel
def _start_at_lines(
    z: Array,
    place: Array,
    age: Array,
    valid: NDArray[np.bool_],
    sigma: Array,
    x: Array,
    covariance: Array,
    scratch: Array,
) -> bool:
    """With the first lines of sight that meet, move a vague mean there, as above; whether they did."""
    kept, rest = scratch[:3], scratch[3:]
    for a in range(3):
        kept[a] = x[a]
    if not move_to_lines(z, place, age, valid, x, rest):
        return False
    square = x[0] * x[0] + x[1] * x[1] + x[2] * x[2]  # of the distance from the vehicle
    spread = (covariance[0, 0] + covariance[1, 1] + covariance[2, 2]) / 3.0
    if spread <= 2.0 * square * max(sigma[1], sigma[2]):
        for a in range(3):
            x[a] = kept[a]
    return True


@kernel
def _update_by_fix(
    z: Array,
    place: Array,
    age: Array,
    valid: NDArray[np.bool_],
    sigma: Array,
    limits: Array,
    data: FilterData,
    prior: Array,
    x: Array,
    covariance: Array,
    scratch: Array,
) -> tuple[float, bool]:
    """Trilaterate the ranges and take the position over; NIS and whether it was done.

    A range made `age` ago at p counts as one made now at p + age v, which is as far from the target. A filter
    that is lost (NIS_LIMIT) begins anew at the fix.
    """
    m = z.shape[0]
    distance, moved, scratch = scratch[:m], scratch[m : 4 * m].reshape(m, 3), scratch[4 * m :]
    fix, C, H = scratch[:3], scratch[3:12].reshape(3, 3), scratch[12:30].reshape(3, 6)
    nu, start, scratch = scratch[30:33], scratch[33:36], scratch[36:]
    for s in range(m):
        distance[s] = z[s, 0]
        for a in range(3):
            moved[s, a] = place[s, a] + age[s] * x[3 + a]
    for a in range(3):
        start[a] = x[a]
        for b in range(6):
            H[a, b] = 1.0 if a == b else 0.0
    reason, _, _ = trilaterate_kernel(
        moved, distance, valid, sigma[0], start, data.max_ratio, limits, fix, C, scratch
    )
    if reason != ACCEPTED:
        return math.nan, False
    for a in range(3):
        nu[a] = fix[a] - x[a]
    nis, failed = kalman_update_kernel(x, covariance, nu, H, C, scratch)
    if nis > NIS_LIMIT * _POINT:
        begin_anew(x, covariance, prior)
        for a in range(3):
            x[a] = fix[a]
            for b in range(3):
                covariance[a, b] = C[a, b]
    return nis, failed < 0


@kernel
def _enter(
    z: Array,
    place: Array,
    age: Array,
    valid: NDArray[np.bool_],
    sigma: Array,
    rows: Int,
    limits: Array | None,
    data: FilterData,
    prior: Array,
    x: Array,
    covariance: Array,
    report: Array,
    rest: Array,
) -> None:
    """Let the measurements that are held enter, as a trilaterated position or as they are."""
    if limits is not None:
        nis, done = _update_by_fix(z, place, age, valid, sigma, limits, data, prior, x, covariance, rest)
        if done:
            report[0], report[1], report[3] = nis, 3.0, 1.0
            return
    nis, used, _, _ = ekf_update_kernel(x, covariance, z, place, age, valid, sigma, rows, prior, True, rest)
    report[0], report[1] = nis if used > 0 else math.nan, float(used)


@kernel
def filter_row(
    plant: Array,
    disturbance: Array,
    comm: Array,
    measured: Array,
    slot: Array,
    memory: Array,
    report: Array,
    prior: Array,
    sigma: Array,
    rows: Int,
    coefficients: Array,
    limits: Array | None,
    data: FilterData,
    valid: NDArray[np.bool_],
    scratch: Array,
) -> None:
    """One step of one agent's filter.

    Args:
        plant: Decoded, (16,).
        disturbance: Decoded, (6,).
        comm: Comm slots, (K, 15 + 6 N_p).
        measured: Measurements, (1 + K, 5).
        slot: Wanted position relative to the target, (3,).
        memory: Of the agent, (FILTER_SIZE,), changed in place; zeros begin an episode.
        report: Output, (N_REPORT,).
        prior: `Restart.data` of the task's prior, (9,): how an episode and a lost filter begin.
        sigma: Of range, azimuth, elevation, (3,).
        rows: Which of these it reads, see `quad_envs.sensors.sensor_rows`.
        coefficients: QuadrotorParams.coefficients().
        limits: Of a trilateration's residual, see `acceptance_limits`; None: never trilaterate.
        data: The rest.
        valid: Overwritten, (1 + K,).
        scratch: Overwritten, (filter_scratch,).
    """
    x, covariance, m = memory[1:7], memory[7:43].reshape(6, 6), measured.shape[0]
    z, place = scratch[: 3 * m].reshape(m, 3), scratch[3 * m : 6 * m].reshape(m, 3)
    age, motion, rest = scratch[6 * m : 7 * m], scratch[7 * m : 7 * m + 6], scratch[7 * m + 6 :]
    _own_motion(plant, disturbance, coefficients, motion)
    if memory[STAGE] == 0.0:
        _begin(slot, prior, x, covariance)
        memory[STAGE] = 1.0
    else:
        _follow(motion, memory, data, x, covariance)
    for a in range(6):
        memory[_VELOCITY + a] = motion[a]
    held = _gather(comm, measured, z, place, age, valid)
    if memory[STAGE] == 1.0 and held > 0 and reads(rows, AZIMUTH):
        if reads(rows, RANGE):
            _start_at_measurement(z, place, age, valid, sigma, x, covariance)
            memory[STAGE] = 2.0
        elif _start_at_lines(z, place, age, valid, sigma, x, covariance, rest):
            memory[STAGE] = 2.0
    report[2], report[3] = float(held), 0.0
    _enter(z, place, age, valid, sigma, rows, limits, data, prior, x, covariance, report, rest)
    if not all_finite(memory[1:43]):  # after numbers that no sensor gives
        _begin(slot, prior, x, covariance)
        memory[STAGE] = 1.0
        report[0], report[1], report[3] = math.nan, 0.0, 0.0


@kernel
def decode_and_filter(
    obs: Actions,
    starts: Counts,
    start: NDArray[np.bool_],
    memory: Array,
    plants: Array,
    last_commands: Array,
    leaders: Array,
    previews: Array,
    comms: Array,
    sensed: Array,
    disturbances: Array,
    measured: Array,
    slots: Array,
    estimates: Array,
    first: Array,
    filters: Array,
    reports: Array,
    prior: Array,
    sigma: Array,
    rows: Int,
    coefficients: Array,
    limits: Array | None,
    data: FilterData,
    valid: NDArray[np.bool_],
    scratch: Array,
) -> int:
    """Split observations, and move the filters of all agents on by one step.

    `obs`, `starts` and the parts from `plants` to `estimates` are those of `decode_rows`, what follows
    `reports` is that of `filter_row`; a memory (n, a + FILTER_SIZE) is split into first (n, a) and filters.

    Returns:
        Flat index of the first entry that is not finite, or -1.
    """
    bad = decode_rows(
        obs, starts, plants, last_commands, leaders, previews, comms, sensed, disturbances, measured, slots,
        estimates,
    )  # fmt: skip
    if bad >= 0:
        return bad
    split_memory(memory, start, first, filters)
    m = measured.shape[1] // N_MEASURED
    for j in range(obs.shape[0]):
        comm = comms[j].reshape(comms.shape[1] // data.message, data.message)
        filter_row(
            plants[j], disturbances[j], comm, measured[j].reshape(m, N_MEASURED), slots[j], filters[j],
            reports[j], prior, sigma, rows, coefficients, limits, data, valid, scratch,
        )  # fmt: skip
    return bad


@kernel
def gather_rows(
    plants: Array,
    disturbances: Array,
    comms: Array,
    measured: Array,
    memory: Array,
    coefficients: Array,
    data: FilterData,
    way: Array,
    z: Array,
    place: Array,
    age: Array,
    valid: NDArray[np.bool_],
    held: Counts,
    motion: Array,
) -> None:
    """What a filter of the user's is given: ways (n, 3), and the measurements held with their places.

    Arguments up to `data` as in `filter_row`, for n rows; the own motion in the memory (n, >= FILTER_SIZE) is
    brought up to date, and the way is zero in rows that begin an episode; `motion` is overwritten, (6,).
    """
    n, m = valid.shape
    for j in range(n):
        comm = comms[j].reshape(comms.shape[1] // data.message, data.message)
        _own_motion(plants[j], disturbances[j], coefficients, motion)
        for a in range(3):
            way[j, a] = _way(motion, memory[j], data.dt, a) if memory[j, STAGE] > 0.0 else 0.0
        for a in range(6):
            memory[j, _VELOCITY + a] = motion[a]
        held[j] = _gather(comm, measured[j].reshape(m, N_MEASURED), z[j], place[j], age[j], valid[j])
