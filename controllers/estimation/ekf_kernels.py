"""Compiled steps of the target filter (`ekf.py`), for one vehicle, in place and without allocation."""

from __future__ import annotations

import math

from quad_envs.compilation.decorators import Int, kernel
from quad_envs.parameters import Array
from quad_envs.rotations import wrap_angle_scalar
from quad_envs.sensors import (
    AZIMUTH,
    ELEVATION,
    RANGE,
    direction_rows,
    direction_variances,
    first_row,
    is_overhead,
    jacobian_rows,
    measure,
    reads,
    row_count,
)

from .arguments import BoolArray
from .kalman import kalman_scratch, kalman_update_kernel
from .restart_kernels import (
    RESTART_SCRATCH,
    begin_anew,
    move_to_lines,
    restart_at_directions,
    restart_at_ranges,
)

N_TARGET = 6  # r_t, v_t
NIS_LIMIT = 50.0  # a row, of all measurements together: a lost filter, or a false measurement
ALONE_LIMIT = 16.0  # a row, of a measurement with angles by itself: 4 sigma in each row
AGREEMENT = 9.0  # a row, up to which a measurement by itself agrees with the prediction
_LARGEST = 1e9  # m, rad, s: what is beyond is a fault, and its square would overflow within steps
_SMALLEST_RANGE = 1e-3  # m, in divisions
_STATE = N_TARGET * (N_TARGET + 1)  # numbers in x and P


@kernel
def predict_kernel(x: Array, P: Array, dt: float, q: float) -> None:
    """Predict: x <- F x, P <- F P F' + Q in place, for one vehicle; twin of `constant_velocity_model`."""
    for i in range(3):
        x[i] += dt * x[3 + i]
        for j in range(6):
            P[i, j] += dt * P[3 + i, j]
    for i in range(6):
        for j in range(3):
            P[i, j] += dt * P[i, 3 + j]
    for i in range(3):
        P[i, i] += q * dt * dt * dt / 3.0
        P[i, 3 + i] += q * dt * dt / 2.0
        P[3 + i, i] += q * dt * dt / 2.0
        P[3 + i, 3 + i] += q * dt


def ekf_scratch(measurements: int, rows: int) -> int:
    """Numbers of scratch that `ekf_step_kernel` needs for that many measurements of that many rows."""
    M = measurements * row_count(rows)
    joint = kalman_scratch(N_TARGET, M) + (N_TARGET + 3 + 9 + M) * M
    return max(joint, RESTART_SCRATCH + 4 * measurements) + 2 * measurements + _STATE


@kernel
def _usable(z: Array, position: Array, age: float, rows: Int) -> bool:
    """Whether all numbers of a measurement are finite and of this world, and a range is positive."""
    good = abs(age) < _LARGEST and (z[RANGE] > 0.0 or not reads(rows, RANGE))
    for a in range(3):
        good = good and abs(position[a]) < _LARGEST
        good = good and (abs(z[a]) < _LARGEST or not reads(rows, a))
    return good


@kernel
def _linearise(
    x: Array, z: Array, position: Array, age: float, sigma: Array, rows: Int, nu: Array, H: Array, R: Array
) -> None:
    """Rows of one measurement into nu (count,), H (count, 6), variances R (count,).

    The target was at r - age v when it was measured. Overhead the rows of the angles hold the direction.
    """
    dx = x[0] - age * x[3] - position[0]
    dy = x[1] - age * x[4] - position[1]
    dz = x[2] - age * x[5] - position[2]
    predicted = measure(dx, dy, dz)
    derivatives = jacobian_rows(dx, dy, dz)
    first, count = first_row(rows), row_count(rows)
    for a in range(count):
        entry = first + a
        error = z[entry] - predicted[entry]
        nu[a] = wrap_angle_scalar(error) if entry == AZIMUTH else error
        R[a] = sigma[entry] * sigma[entry]
        for j in range(3):
            H[a, j] = derivatives[entry][j]
    # The direction does not tell above from below. A mirrored prediction is led back by the elevation alone.
    if reads(rows, ELEVATION) and z[ELEVATION] * dz <= 0.0 and is_overhead(dx, dy, dz, sigma[ELEVATION]):
        u, w, along, across = direction_rows(dx, dy, dz, z[AZIMUTH])
        azimuth, elevation = AZIMUTH - first, ELEVATION - first
        nu[azimuth], nu[elevation] = -w, math.cos(z[ELEVATION]) - u
        R[elevation], R[azimuth] = direction_variances(
            dx, dy, dz, z[ELEVATION], sigma[AZIMUTH], sigma[ELEVATION]
        )
        for j in range(3):
            H[azimuth, j], H[elevation, j] = across[j], along[j]
    for a in range(count):
        for j in range(3):
            H[a, 3 + j] = -age * H[a, j]


@kernel
def _add_curvature(
    x: Array, P: Array, position: Array, age: Array, owner: Array, nu: Array, R: Array, bent: Array
) -> None:
    """Second order of ranges: nu_a -= tr(D_a P) / 2 and R_ab += tr(D_a P D_b P) / 2, P of the position.

    D = (I - u u') / rho, u the line of sight. Where P is wide beside the distance, the sphere on which a
    range puts the target leaves its tangent plane by more than the noise; without this the filter takes the
    plane for the sphere, and is sure of a wrong place.
    """
    used = nu.shape[0]
    for a in range(used):
        j = int(owner[a])
        dx = x[0] - age[j] * x[3] - position[j, 0]
        dy = x[1] - age[j] * x[4] - position[j, 1]
        dz = x[2] - age[j] * x[5] - position[j, 2]
        u = jacobian_rows(dx, dy, dz)[RANGE]
        rho = max(math.sqrt(dx * dx + dy * dy + dz * dz), _SMALLEST_RANGE)
        for k in range(3):
            along = u[0] * P[0, k] + u[1] * P[1, k] + u[2] * P[2, k]
            for i in range(3):
                bent[a, 3 * i + k] = (P[i, k] - u[i] * along) / rho
        nu[a] -= 0.5 * (bent[a, 0] + bent[a, 4] + bent[a, 8])
        for b in range(a + 1):
            total = 0.0
            for i in range(3):
                for k in range(3):
                    total += 0.5 * bent[a, 3 * i + k] * bent[b, 3 * k + i]
            R[a, b] += total
            if a != b:
                R[b, a] += total


@kernel
def _joint_update(
    x: Array,
    P: Array,
    z: Array,
    position: Array,
    age: Array,
    sigma: Array,
    rows: Int,
    curved: bool,
    use: Array,
    scratch: Array,
) -> tuple[float, int]:
    """One update in place with the measurements that use (m,) marks; NIS and rows.

    A measurement that makes S indefinite is unmarked. With `curved` ranges count to the second order.
    """
    m, count = z.shape[0], row_count(rows)
    M = m * count
    nu, variance, owner = scratch[:M], scratch[M : 2 * M], scratch[2 * M : 3 * M]
    bent, scratch = scratch[3 * M : 12 * M].reshape(M, 9), scratch[12 * M :]
    H = scratch[: 6 * M].reshape(M, 6)
    R_flat, scratch = scratch[6 * M : (6 + M) * M], scratch[(6 + M) * M :]
    while True:
        used = 0
        for j in range(m):
            if use[j] != 0.0:
                _linearise(x, z[j], position[j], age[j], sigma, rows, nu[used:], H[used:], variance[used:])
                for _ in range(count):
                    owner[used] = j
                    used += 1
        if used == 0:
            return 0.0, 0
        R = R_flat[: used * used].reshape(used, used)
        for a in range(used):
            for b in range(used):
                R[a, b] = variance[a] if a == b else 0.0
        if curved and not reads(rows, AZIMUTH):
            _add_curvature(x, P, position, age, owner, nu[:used], R, bent)
        nis, failed = kalman_update_kernel(x, P, nu[:used], H[:used], R, scratch)
        if failed < 0:
            return nis, used
        use[int(owner[failed])] = 0.0


@kernel
def _keep(x: Array, P: Array, kept: Array) -> None:
    """Store x and P in kept (42,)."""
    for i in range(N_TARGET):
        kept[i] = x[i]
        for j in range(N_TARGET):
            kept[N_TARGET * (i + 1) + j] = P[i, j]


@kernel
def _undo(kept: Array, x: Array, P: Array) -> None:
    """Make x and P what they were when kept."""
    for i in range(N_TARGET):
        x[i] = kept[i]
        for j in range(N_TARGET):
            P[i, j] = kept[N_TARGET * (i + 1) + j]


@kernel
def _outliers(
    x: Array,
    P: Array,
    z: Array,
    position: Array,
    age: Array,
    sigma: Array,
    rows: Int,
    curved: bool,
    use: Array,
    limit: float,
    alone: Array,
    kept: Array,
    scratch: Array,
) -> int:
    """Marks in alone (m,) the measurements whose own NIS is above the limit a row; how many there are."""
    m = z.shape[0]
    count = 0
    for j in range(m):
        alone[j] = 0.0
        if use[j] != 0.0:
            nis, used = _joint_update(
                x, P, z[j : j + 1], position[j : j + 1], age[j : j + 1], sigma, rows, curved, use[j : j + 1],
                scratch,
            )  # fmt: skip
            _undo(kept, x, P)
            if nis > limit * used:
                alone[j] = 1.0
                count += 1
    return count


@kernel
def _restart(
    x: Array,
    P: Array,
    z: Array,
    position: Array,
    age: Array,
    sigma: Array,
    rows: Int,
    restart: Array,
    use: Array,
    kept: Array,
    scratch: Array,
) -> None:
    """A new filter where the measurements are; those that contradict it even there are unmarked."""
    if not (reads(rows, RANGE) and reads(rows, AZIMUTH)):
        if reads(rows, RANGE):
            restart_at_ranges(x, P, z, position, age, restart, use, scratch)
        else:
            begin_anew(x, P, restart)
            move_to_lines(z, position, age, use, x, scratch)
        _joint_update(x, P, z, position, age, sigma, rows, False, use, scratch)
        return
    best = restart_at_directions(x, P, z, position, age, sigma, restart, use)
    _keep(x, P, kept)
    use[best] = 0.0
    nis, used = _joint_update(x, P, z, position, age, sigma, rows, True, use, scratch)
    if nis > NIS_LIMIT * used:
        _undo(kept, x, P)
        for j in range(use.shape[0]):
            use[j] = 0.0
    use[best] = 1.0


@kernel
def ekf_update_kernel(
    x: Array,
    P: Array,
    z: Array,
    position: Array,
    age: Array,
    valid: BoolArray,
    sigma: Array,
    rows: Int,
    restart: Array,
    curved: bool,
    scratch: Array,
) -> tuple[float, int, int, bool]:
    """One joint update of one vehicle's x (6,), P (6, 6) in place; arguments as in `ekf_step_kernel`.

    A NIS above NIS_LIMIT a row says that the filter or a measurement is at fault. If more than half of the
    measurements agree with the prediction, each by itself, the others are left out; else the filter restarts.
    So it does if half of the measurements with angles are beyond ALONE_LIMIT, each by itself: together they
    are no such evidence, because lines of sight from several places bend a wide prior by more than 4 sigma.
    """
    m = z.shape[0]
    use, alone, kept = scratch[:m], scratch[m : 2 * m], scratch[2 * m : 2 * m + _STATE]
    scratch = scratch[2 * m + _STATE :]
    given, count = 0, 0
    for j in range(m):
        use[j] = 1.0 if valid[j] and _usable(z[j], position[j], age[j], rows) else 0.0
        given += 1 if valid[j] else 0
    watch = restart.shape[0] > 0
    if watch:
        _keep(x, P, kept)
    nis, used = _joint_update(x, P, z, position, age, sigma, rows, curved, use, scratch)
    far = nis > NIS_LIMIT * used
    lost = watch and (far or (reads(rows, AZIMUTH) and nis > ALONE_LIMIT * used))
    if lost:
        _undo(kept, x, P)
        limit = AGREEMENT if far else ALONE_LIMIT
        outlying = _outliers(x, P, z, position, age, sigma, rows, curved, use, limit, alone, kept, scratch)
        lost = 2 * outlying * row_count(rows) >= used or (far and outlying == 0)
        if lost:
            _restart(x, P, z, position, age, sigma, rows, restart, use, kept, scratch)
        else:
            for j in range(m):
                use[j] -= alone[j] if far else 0.0
            nis, used = _joint_update(x, P, z, position, age, sigma, rows, curved, use, scratch)
    for j in range(m):
        count += 1 if use[j] != 0.0 else 0
    return nis, used, given - count, bool(lost)


@kernel
def ekf_step_kernel(
    x: Array,
    P: Array,
    dt: float,
    q: float,
    displacement: Array,
    z: Array,
    position: Array,
    age: Array,
    valid: BoolArray,
    sigma: Array,
    rows: Int,
    restart: Array,
    curved: bool,
    scratch: Array,
) -> tuple[float, int, int, bool]:
    """A whole step of one vehicle's filter in place: predict, follow the origin, update.

    Args:
        x: State, (6,).
        P: Covariance, (6, 6).
        dt: Time since the last step, s.
        q: Density of the target's acceleration, m^2/s^3.
        displacement: Way of the origin since the last step, (3,), m.
        z: Range, azimuth, elevation, (m, 3), m, rad, rad; of which `rows` count.
        position: Where each was made, (m, 3), m, in the present frame.
        age: How long ago, (m,), s.
        valid: Which of them are there, (m,).
        sigma: Standard deviations of z, (3,).
        rows: Which entries of z count, see `quad_envs.sensors.sensor_rows`.
        restart: What a lost filter restarts with, see `ekf.Restart`, (9,); (0,): it never does.
        curved: Whether ranges without angles count to the second order.
        scratch: Overwritten, (>= ekf_scratch(m, rows),).

    Returns:
        nu' S^-1 nu, the rows used, the measurements rejected, and whether the filter restarted; then the
        first two are of the update that said so.
    """
    predict_kernel(x, P, dt, q)
    for a in range(3):
        x[a] -= displacement[a]
    return ekf_update_kernel(x, P, z, position, age, valid, sigma, rows, restart, curved, scratch)
