"""Compiled steps of the target filter (`ekf.py`), for one vehicle, in place and without allocation."""

from __future__ import annotations

import math

from quad_envs._numba import Int, kernel
from quad_envs.parameters import Array
from quad_envs.rotations import wrap_angle_scalar
from quad_envs.sensors import (
    AZIMUTH,
    ELEVATION,
    N_MEASUREMENT,
    direction_rows,
    direction_variances,
    is_overhead,
    jacobian_rows,
    measure,
)

from .arguments import BoolArray
from .kalman import kalman_scratch, kalman_update_kernel

N_TARGET = 6  # r_t, v_t
_LARGEST = 1e9  # m, rad, s: what is beyond is a fault, and its square would overflow within steps


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
    M = measurements * rows
    return kalman_scratch(N_TARGET, M) + (N_TARGET + 3 + M) * M + measurements


@kernel
def _usable(z: Array, position: Array, age: float, rows: Int) -> bool:
    """Whether all numbers of a measurement are finite and of this world."""
    good = abs(age) < _LARGEST
    for a in range(3):
        good = good and abs(position[a]) < _LARGEST
    for a in range(rows):
        good = good and abs(z[a]) < _LARGEST
    return good


@kernel
def _linearise(
    x: Array, z: Array, position: Array, age: float, sigma: Array, rows: Int, nu: Array, H: Array, R: Array
) -> None:
    """Rows of one measurement into nu (rows,), H (rows, 6), variances R (rows,).

    The target was at r - age v when it was measured. Overhead the rows of the angles hold the direction.
    """
    dx = x[0] - age * x[3] - position[0]
    dy = x[1] - age * x[4] - position[1]
    dz = x[2] - age * x[5] - position[2]
    predicted = measure(dx, dy, dz)
    derivatives = jacobian_rows(dx, dy, dz)
    for a in range(rows):
        error = z[a] - predicted[a]
        nu[a] = wrap_angle_scalar(error) if a == AZIMUTH else error
        R[a] = sigma[a] * sigma[a]
        for j in range(3):
            H[a, j] = derivatives[a][j]
    # The direction does not tell above from below. A mirrored prediction is led back by the elevation alone.
    if rows == N_MEASUREMENT and z[ELEVATION] * dz <= 0.0 and is_overhead(dx, dy, dz, sigma[ELEVATION]):
        u, w, along, across = direction_rows(dx, dy, dz, z[AZIMUTH])
        nu[AZIMUTH], nu[ELEVATION] = -w, math.cos(z[ELEVATION]) - u
        R[ELEVATION], R[AZIMUTH] = direction_variances(
            dx, dy, dz, z[ELEVATION], sigma[AZIMUTH], sigma[ELEVATION]
        )
        for j in range(3):
            H[AZIMUTH, j], H[ELEVATION, j] = across[j], along[j]
    for a in range(rows):
        for j in range(3):
            H[a, 3 + j] = -age * H[a, j]


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
    scratch: Array,
) -> tuple[float, int, int]:
    """One joint update of one vehicle's x (6,), P (6, 6) in place; arguments as in `ekf_step_kernel`."""
    m = z.shape[0]
    M = m * rows
    use, scratch = scratch[:m], scratch[m:]
    nu, variance, owner = scratch[:M], scratch[M : 2 * M], scratch[2 * M : 3 * M]
    scratch = scratch[3 * M :]
    H = scratch[: 6 * M].reshape(M, 6)
    R_flat, scratch = scratch[6 * M : (6 + M) * M], scratch[(6 + M) * M :]
    rejected = 0
    for j in range(m):
        use[j] = 1.0 if valid[j] and _usable(z[j], position[j], age[j], rows) else 0.0
        rejected += 1 if valid[j] and use[j] == 0.0 else 0
    while True:
        used = 0
        for j in range(m):
            if use[j] != 0.0:
                _linearise(x, z[j], position[j], age[j], sigma, rows, nu[used:], H[used:], variance[used:])
                for _ in range(rows):
                    owner[used] = j
                    used += 1
        if used == 0:
            return 0.0, 0, rejected
        R = R_flat[: used * used].reshape(used, used)
        for a in range(used):
            for b in range(used):
                R[a, b] = variance[a] if a == b else 0.0
        nis, failed = kalman_update_kernel(x, P, nu[:used], H[:used], R, scratch)
        if failed < 0:
            return nis, used, rejected
        use[int(owner[failed])] = 0.0
        rejected += 1


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
    scratch: Array,
) -> tuple[float, int, int]:
    """A whole step of one vehicle's filter in place: predict, follow the origin, update.

    Args:
        x: State, (6,).
        P: Covariance, (6, 6).
        dt: Time since the last step, s.
        q: Density of the target's acceleration, m^2/s^3.
        displacement: Way of the origin since the last step, (3,), m.
        z: Range, azimuth, elevation, (m, 3), m, rad, rad; the first `rows` count.
        position: Where each was made, (m, 3), m, in the present frame.
        age: How long ago, (m,), s.
        valid: Which of them are there, (m,).
        sigma: Standard deviations of z, (3,).
        rows: 1 or 3, see `quad_envs.sensors.sensor_rows`.
        scratch: Overwritten, (>= ekf_scratch(m, rows),).

    Returns:
        nu' S^-1 nu, the rows used and the measurements rejected.
    """
    predict_kernel(x, P, dt, q)
    for a in range(3):
        x[a] -= displacement[a]
    return ekf_update_kernel(x, P, z, position, age, valid, sigma, rows, scratch)
