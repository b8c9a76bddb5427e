"""Equations of motion of one quadrotor, Eqs. (2.32) to (2.38) corrected, and their integrator.

`rigid_body` is the one compiled statement of the derivative. The single environment, the vector environment
and the exact NMPC all call it; `derivative_reference` is its readable twin on numpy arrays.

The integrator is RK4 on the 12 rigid-body states with the rotor lag in closed form (RK4 on all 16 states is
unstable for one substep of 0.05 s, since lambda_F h > 1). It works on columns ("lanes") of a flat scratch
array, so that the same code runs one vehicle (stride 1) or a block of vehicles whose loop LLVM vectorises
(stride LANES).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ._numba import Int, inline_kernel, kernel
from .parameters import (
    ATTITUDE,
    DRAG_RATE,
    GRAVITY,
    GYRO_X,
    GYRO_Y,
    GYRO_Z,
    INV_JX,
    INV_JY,
    INV_JZ,
    INV_MASS,
    N_INPUT,
    N_MOTION_COEFFICIENTS,
    N_STATE,
    PITCH_CROSS,
    PITCH_GAIN,
    POSITION,
    RATES,
    ROLL_CROSS,
    ROLL_GAIN,
    ROTOR_RATE,
    VELOCITY,
    YAW_GAIN,
    Array,
    QuadrotorParams,
)
from .rotations import euler_rate_matrix, rotation_body_from_inertial, sincos

LARGEST = 1e30  # sum of a plant's |entries| from which it is lost: float32 observations must hold it
LANES = 32  # vehicles in one vectorised block: its scratch stays in the first-level cache

# Rows of the integrator's scratch; entry i of lane j is w[i * stride + j].
_X = 0  # state at the start of the substep
_F = 12  # rotor forces there
_CMD = 16  # saturated rotor commands
_Y = 20  # state at the present stage
_ACC = 32  # weighted sum of the stage derivatives
_TORQUE = 44  # disturbance torque at the present stage, body axes
_FORCE = 47  # disturbance force at the present stage, inertial axes
_COEFFICIENTS = 50  # the first N_MOTION_COEFFICIENTS of QuadrotorParams.coefficients()
_DECAY = 64  # rotor decay at the present stage
_DECAY_NONE, _DECAY_HALF, _DECAY_WHOLE = 65, 66, 67  # after no, half and a whole substep
SCRATCH_ROWS = 68


@inline_kernel
def rigid_body(
    x: Sequence[float], F: Sequence[float], d: Sequence[float], c: Sequence[float]
) -> tuple[float, ...]:
    """Derivative of the 12 states, Eq. (2.32) with T = sum F > 0 along -z_B.

    Args:
        x: State [p, V_B, Theta, Omega], 12 numbers (array or tuple).
        F: Rotor forces, 4 numbers, N.
        d: Disturbance, 6 numbers: torque in body axes, N m, then force in inertial axes, N.
        c: QuadrotorParams.coefficients().

    Returns:
        Tuple of 12.
    """
    u, v, w = x[3], x[4], x[5]
    p, q, r = x[9], x[10], x[11]
    sf, cf = sincos(x[6])
    st, ct = sincos(x[7])
    ss, cs = sincos(x[8])
    r11, r12, r13 = ct * cs, ct * ss, -st
    r21, r22, r23 = st * cs * sf - ss * cf, st * ss * sf + cs * cf, ct * sf
    r31, r32, r33 = st * cs * cf + ss * sf, st * ss * cf - cs * sf, ct * cf
    fx, fy, fz = d[3] * c[INV_MASS], d[4] * c[INV_MASS], d[5] * c[INV_MASS] + c[GRAVITY]
    turn = (sf * q + cf * r) / ct  # psi'
    return (
        r11 * u + r21 * v + r31 * w,
        r12 * u + r22 * v + r32 * w,
        r13 * u + r23 * v + r33 * w,
        r * v - q * w + (r11 * fx + r12 * fy + r13 * fz) - c[DRAG_RATE] * u,
        p * w - r * u + (r21 * fx + r22 * fy + r23 * fz) - c[DRAG_RATE] * v,
        q * u
        - p * v
        + (r31 * fx + r32 * fy + r33 * fz)
        - c[DRAG_RATE] * w
        - (F[0] + F[1] + F[2] + F[3]) * c[INV_MASS],
        p + st * turn,
        cf * q - sf * r,
        turn,
        c[GYRO_X] * q * r + c[ROLL_GAIN] * (F[3] - F[1]) + c[ROLL_CROSS] * (F[2] - F[0]) + c[INV_JX] * d[0],
        c[GYRO_Y] * p * r + c[PITCH_GAIN] * (F[0] - F[2]) + c[PITCH_CROSS] * (F[3] - F[1]) + c[INV_JY] * d[1],
        c[GYRO_Z] * p * q + c[YAW_GAIN] * (F[1] - F[0] + F[3] - F[2]) + c[INV_JZ] * d[2],
    )


@inline_kernel
def rotor_shares(
    alpha_x: float, alpha_y: float, alpha_z: float, c: Array
) -> tuple[float, float, float, float]:
    """Rotor forces, N, that turn the body with these angular accelerations, rad/s^2: M^-1 [0; J alpha].

    The rows of the mixer are orthogonal, so that a torque is shared in proportion to its row.
    """
    t = c[ROLL_CROSS] / c[ROLL_GAIN]  # tan(delta), the same for pitch
    roll = 0.5 * alpha_x / c[ROLL_GAIN] / (1.0 + t * t)
    pitch = 0.5 * alpha_y / c[PITCH_GAIN] / (1.0 + t * t)
    yaw = 0.25 * alpha_z / c[YAW_GAIN]
    return (
        pitch - t * roll - yaw,
        yaw - roll - t * pitch,
        t * roll - pitch - yaw,
        roll + t * pitch + yaw,
    )


def derivative_reference(
    x: ArrayLike, F: ArrayLike, params: QuadrotorParams, torque: ArrayLike = 0.0, force: ArrayLike = 0.0
) -> Array:
    """Readable twin of `rigid_body` in vector notation, Eqs. (2.32) and (2.34).

    Args:
        x: States [p, V_B, Theta, Omega], (..., 12).
        F: Rotor forces, (..., 4), N.
        params: The vehicle.
        torque: Disturbance torque in body axes, (..., 3), N m.
        force: Disturbance force in inertial axes, (..., 3), N.

    Returns:
        dx/dt, (..., 12).
    """
    x, F = np.asarray(x, dtype=np.float64), np.asarray(F, dtype=np.float64)
    V_B, Theta, Omega = x[..., VELOCITY], x[..., ATTITUDE], x[..., RATES]
    R_BI = rotation_body_from_inertial(Theta)
    J = np.array(params.inertia)
    T_tau = F @ params.mixer().T
    specific_force = np.array([0.0, 0.0, params.gravity]) + np.asarray(force, dtype=np.float64) / params.mass
    thrust = np.zeros_like(V_B)
    thrust[..., 2] = T_tau[..., 0] / params.mass
    out = np.empty(np.broadcast_shapes(x.shape, (*F.shape[:-1], N_STATE)))
    out[..., POSITION] = np.einsum("...ji,...j->...i", R_BI, V_B)
    out[..., VELOCITY] = (
        np.cross(V_B, Omega)
        + np.einsum("...ij,...j->...i", R_BI, np.broadcast_to(specific_force, V_B.shape))
        - thrust
        - params.drag / params.mass * V_B
    )
    out[..., ATTITUDE] = np.einsum("...ij,...j->...i", euler_rate_matrix(Theta), Omega)
    out[..., RATES] = (
        -np.cross(Omega, J * Omega) + T_tau[..., 1:] + np.asarray(torque, dtype=np.float64)
    ) / J
    return out


# In these helpers `o` is the place of an entry in the scratch array. Places and strides are passed as int64
# expressions, never as literals: numba would compile the helper anew for each literal.
@inline_kernel
def _four(w: Array, o: Int, stride: Int) -> tuple[float, float, float, float]:
    """Four entries of one lane."""
    return w[o], w[o + stride], w[o + 2 * stride], w[o + 3 * stride]


@inline_kernel
def _twelve(w: Array, o: Int, stride: Int) -> tuple[float, ...]:
    """Twelve entries of one lane."""
    return _four(w, o, stride) + _four(w, o + 4 * stride, stride) + _four(w, o + 8 * stride, stride)


@inline_kernel
def _lagged(force: float, command: float, decay: float) -> float:
    """Rotor force after the decay, Eq. (2.38) in closed form."""
    return command + (force - command) * decay


@inline_kernel
def _accumulate(w: Array, o: Int, stride: Int, slope: float, weight: float, ahead: float) -> None:
    """Take one component's stage derivative into the weighted sum; move the component to the next stage."""
    w[o + _ACC * stride] += weight * slope
    w[o + _Y * stride] = w[o + _X * stride] + ahead * slope


@inline_kernel
def _lane_stage(w: Array, j: Int, stride: Int, weight: float, ahead: float) -> None:
    """One stage of RK4 for lane j."""
    decay = w[_DECAY * stride + j]
    F = _four(w, _F * stride + j, stride)
    command = _four(w, _CMD * stride + j, stride)
    F = (
        _lagged(F[0], command[0], decay),
        _lagged(F[1], command[1], decay),
        _lagged(F[2], command[2], decay),
        _lagged(F[3], command[3], decay),
    )
    d = (*_four(w, _TORQUE * stride + j, stride)[:3], *_four(w, _FORCE * stride + j, stride)[:3])
    o = (_COEFFICIENTS + 12) * stride + j
    c = (*_twelve(w, _COEFFICIENTS * stride + j, stride), w[o], w[o + stride])
    k = rigid_body(_twelve(w, _Y * stride + j, stride), F, d, c)
    _accumulate(w, j, stride, k[0], weight, ahead)
    _accumulate(w, j + stride, stride, k[1], weight, ahead)
    _accumulate(w, j + 2 * stride, stride, k[2], weight, ahead)
    _accumulate(w, j + 3 * stride, stride, k[3], weight, ahead)
    _accumulate(w, j + 4 * stride, stride, k[4], weight, ahead)
    _accumulate(w, j + 5 * stride, stride, k[5], weight, ahead)
    _accumulate(w, j + 6 * stride, stride, k[6], weight, ahead)
    _accumulate(w, j + 7 * stride, stride, k[7], weight, ahead)
    _accumulate(w, j + 8 * stride, stride, k[8], weight, ahead)
    _accumulate(w, j + 9 * stride, stride, k[9], weight, ahead)
    _accumulate(w, j + 10 * stride, stride, k[10], weight, ahead)
    _accumulate(w, j + 11 * stride, stride, k[11], weight, ahead)


@kernel
def _stage(w: Array, stride: Int, decay_row: int, weight: float, ahead: float) -> None:
    """One stage of RK4 for all lanes; rotor forces decay by scratch row `decay_row`.

    Strides, rows and trip counts in the loop are constants: only so can LLVM prove the lanes independent.
    """
    for j in range(stride):
        w[_DECAY * stride + j] = w[decay_row * stride + j]
    if stride == 1:
        _lane_stage(w, np.int64(0), np.int64(1), weight, ahead)
    else:
        for j in range(LANES):
            _lane_stage(w, j, np.int64(LANES), weight, ahead)


@kernel
def _finish_substep(w: Array, stride: Int, sixth: float) -> None:
    """X <- x + h/6 (k1 + 2 k2 + 2 k3 + k4); the rotor forces move on by a whole substep."""
    for i in range(N_STATE):
        for o in range(i * stride, (i + 1) * stride):
            moved = w[o + _X * stride] + sixth * w[o + _ACC * stride]
            w[o + _X * stride] = moved
            w[o + _Y * stride] = moved
            w[o + _ACC * stride] = 0.0
    for i in range(N_INPUT):
        for j in range(stride):
            k = i * stride + j
            w[k + _F * stride] = _lagged(
                w[k + _F * stride], w[k + _CMD * stride], w[_DECAY_WHOLE * stride + j]
            )


@kernel
def _load_disturbance(
    w: Array,
    stride: Int,
    lanes: int,
    disturbances: Array,
    which: NDArray[np.int64],
    step: NDArray[np.int64],
    node: int,
) -> None:
    """Read the disturbance of each lane at one stage time."""
    for j in range(lanes):
        row = min(step[j], disturbances.shape[1] - 1)
        for i in range(6):
            w[(_TORQUE + i) * stride + j] = disturbances[which[j], row, node, i]


@inline_kernel
def load_vehicle(
    w: Array,
    j: Int,
    stride: Int,
    plant: Array,
    command: Array,
    force_max: Array,
    coefficients: Array,
    h: float,
) -> None:
    """Put one vehicle into lane j.

    Args:
        w: Scratch, (SCRATCH_ROWS * stride,).
        j: Lane.
        stride: 1 or LANES.
        plant: [p, V_B, Theta, Omega, F], (16,).
        command: Rotor commands, (4,), N; the plant saturates them to [0, force_max], Eq. (2.39).
        force_max: Largest force of each rotor, (4,), N.
        coefficients: QuadrotorParams.coefficients().
        h: Substep, s.
    """
    for i in range(N_STATE):
        w[(_X + i) * stride + j] = plant[i]
        w[(_Y + i) * stride + j] = plant[i]
        w[(_ACC + i) * stride + j] = 0.0
    for i in range(N_INPUT):
        w[(_F + i) * stride + j] = plant[N_STATE + i]
        w[(_CMD + i) * stride + j] = min(max(command[i], 0.0), force_max[i])
    for i in range(6):
        w[(_TORQUE + i) * stride + j] = 0.0
    for i in range(N_MOTION_COEFFICIENTS):
        w[(_COEFFICIENTS + i) * stride + j] = coefficients[i]
    half = np.exp(-0.5 * coefficients[ROTOR_RATE] * h)
    w[_DECAY_NONE * stride + j] = 1.0
    w[_DECAY_HALF * stride + j] = half
    w[_DECAY_WHOLE * stride + j] = half * half


@inline_kernel
def store_vehicle(w: Array, j: Int, stride: Int, plant: Array) -> bool:
    """Copy lane j to a plant row if its numbers are below LARGEST, else leave it; whether they are."""
    total = 0.0
    for i in range(N_STATE + N_INPUT):
        total += abs(w[(_X + i) * stride + j])
    finite = total < LARGEST
    if finite:
        for i in range(N_STATE + N_INPUT):
            plant[i] = w[(_X + i) * stride + j]
    return finite


@kernel
def advance(
    w: Array,
    stride: Int,
    lanes: int,
    first: int,
    end: int,
    h: float,
    disturbances: Array,
    which: NDArray[np.int64],
    step: NDArray[np.int64],
) -> None:
    """Integrate the loaded lanes over substeps first..end-1 of one control period.

    Args:
        w: Scratch with `lanes` loaded vehicles; the lanes up to `stride` must hold finite numbers.
        stride: 1 or LANES.
        lanes: Number of vehicles, <= stride.
        first: First RK4 step, 0 at the beginning of the control period.
        end: Number of the RK4 step to stop before.
        h: Length of one of them, s.
        disturbances: Tables (n_tables, n_steps, 2 substeps + 1, 6); n_steps = 0 means none.
        which: Table of each lane, (>= lanes,) int64.
        step: Control step of each lane, (>= lanes,) int64; the last row holds on.
    """
    disturbed = disturbances.shape[1] > 0
    for s in range(first, end):
        if disturbed:
            _load_disturbance(w, stride, lanes, disturbances, which, step, 2 * s)
        _stage(w, stride, _DECAY_NONE, 1.0, 0.5 * h)
        if disturbed:
            _load_disturbance(w, stride, lanes, disturbances, which, step, 2 * s + 1)
        _stage(w, stride, _DECAY_HALF, 2.0, 0.5 * h)
        _stage(w, stride, _DECAY_HALF, 2.0, h)
        if disturbed:
            _load_disturbance(w, stride, lanes, disturbances, which, step, 2 * s + 2)
        _stage(w, stride, _DECAY_WHOLE, 1.0, 0.0)
        _finish_substep(w, stride, h / 6.0)


@kernel
def _simulate(
    plants: Array,
    commands: Array,
    force_max: Array,
    coefficients: Array,
    substeps: int,
    h: float,
    w: Array,
    which: NDArray[np.int64],
    step: NDArray[np.int64],
    disturbances: Array,
) -> None:
    for j in range(plants.shape[0]):
        load_vehicle(w, 0, 1, plants[j], commands[j], force_max, coefficients, h)
        advance(w, 1, 1, 0, substeps, h, disturbances, which, step)
        store_vehicle(w, 0, 1, plants[j])


NO_DISTURBANCE = np.zeros((1, 0, 1, 6))


def rotor_limits(force_max: ArrayLike | None, params: QuadrotorParams) -> Array:
    """Upper saturation of each rotor force, (4,), N; None for the weight (kappa = 1)."""
    most = params.weight if force_max is None else np.asarray(force_max, dtype=np.float64)
    return np.array(np.broadcast_to(most, N_INPUT), dtype=np.float64)


def simulate(
    plant: ArrayLike,
    command: ArrayLike,
    params: QuadrotorParams,
    *,
    force_max: ArrayLike | None = None,
    duration: float = 0.05,
    substeps: int = 5,
) -> Array:
    """Hold rotor commands for a while, without disturbance: the environments' step as a plain function.

    Args:
        plant: [p, V_B, Theta, Omega, F], (..., 16).
        command: Rotor commands, (..., 4), N.
        params: The vehicle.
        force_max: Upper saturation of the rotor forces, N: one number or (4,); None for the weight.
        duration: s.
        substeps: RK4 steps.

    Returns:
        The plant afterwards, (..., 16). A vehicle whose state would not stay finite is returned as it was.
    """
    start = np.asarray(plant, dtype=np.float64)
    plants = np.array(start.reshape(-1, N_STATE + N_INPUT))
    commands = np.ascontiguousarray(
        np.broadcast_to(np.asarray(command, dtype=np.float64), (*start.shape[:-1], N_INPUT))
    )
    _simulate(
        plants,
        commands.reshape(-1, N_INPUT),
        rotor_limits(force_max, params),
        params.coefficients(),
        substeps,
        duration / substeps,
        np.zeros(SCRATCH_ROWS),
        np.zeros(1, dtype=np.int64),
        np.zeros(1, dtype=np.int64),
        NO_DISTURBANCE,
    )
    return plants.reshape(start.shape)
