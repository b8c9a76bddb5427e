"""Equations of motion of one quadrotor, Eqs. (2.32) to (2.38) corrected, and their integrator.

`derivative` is the one compiled statement of them. The environments and, through `rigid_body`, the exact NMPC
call it; `derivative_reference` is its readable twin on numpy arrays.

The integrator is RK4 on the 12 rigid-body states with the rotor lag in closed form (RK4 on all 16 states is
unstable for one substep of 0.05 s, since lambda_F h > 1). It flies four vehicles at a time, the lanes of a
block (`quad_envs.lanes`); sines and cosines are turned with the attitude from stage to stage.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import ArrayLike

from .compilation.decorators import Int, fused, inline_kernel, inline_lane_kernel, kernel, lane_kernel
from .lanes import (
    AIR_FIRST,
    AIR_LAST,
    AIR_MIDDLE,
    COEFFICIENTS,
    COMMAND,
    DECAY,
    FINITE,
    FORCE_MAX,
    FORCES,
    LANES,
    MOVED,
    MOVED_FORCES,
    N_FLIGHT,
    N_PLANT,
    PHI,
    PLANT,
    PSI,
    SINES,
    TARGET,
    THETA,
    four,
    plus,
    put_four,
    put_six,
    put_twelve,
    six,
    twelve,
)
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
    N_COEFFICIENTS,
    N_INPUT,
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


@inline_kernel
def derivative(
    x: Sequence[float],
    sines: Sequence[float],
    F: Sequence[float],
    d: Sequence[float] | None,
    c: Sequence[float],
) -> tuple[float, ...]:
    """Derivative of the 12 states, Eq. (2.32) with T = sum F > 0 along -z_B, rotations axis by axis.

    Args:
        x: State [p, V_B, Theta, Omega], 12 numbers (array or tuple).
        sines: Sine and cosine of roll, pitch and yaw, 6 numbers.
        F: Rotor forces, 4 numbers, N.
        d: Disturbance, 6 numbers: torque in body axes, N m, then force in inertial axes, N. None in calm air.
        c: QuadrotorParams.coefficients().

    Returns:
        Tuple of 12.
    """
    u, v, w = x[3], x[4], x[5]
    p, q, r = x[9], x[10], x[11]
    sf, cf, st, ct, ss, cs = sines
    # V_B in axes without roll, then without pitch; the yaw makes p' of it.
    right, down = cf * v - sf * w, sf * v + cf * w
    forward = ct * u + st * down
    turn = (sf * q + cf * r) / ct  # psi'
    alpha_x = c[GYRO_X] * q * r + c[ROLL_GAIN] * (F[3] - F[1]) + c[ROLL_CROSS] * (F[2] - F[0])
    alpha_y = c[GYRO_Y] * p * r + c[PITCH_GAIN] * (F[0] - F[2]) + c[PITCH_CROSS] * (F[3] - F[1])
    alpha_z = c[GYRO_Z] * p * q + c[YAW_GAIN] * (F[1] - F[0] + F[3] - F[2])
    # Gravity and the disturbance per mass go the other way, from inertial to body axes.
    if d is None:
        along = ct * c[GRAVITY]
        gx, gy, gz = -st * c[GRAVITY], sf * along, cf * along
    else:
        fx, fy, fz = d[3] * c[INV_MASS], d[4] * c[INV_MASS], d[5] * c[INV_MASS] + c[GRAVITY]
        ahead, aside = cs * fx + ss * fy, cs * fy - ss * fx
        along = st * ahead + ct * fz
        gx, gy, gz = ct * ahead - st * fz, cf * aside + sf * along, cf * along - sf * aside
        alpha_x += c[INV_JX] * d[0]
        alpha_y += c[INV_JY] * d[1]
        alpha_z += c[INV_JZ] * d[2]
    return (
        cs * forward - ss * right,
        ss * forward + cs * right,
        ct * down - st * u,
        r * v - q * w + gx - c[DRAG_RATE] * u,
        p * w - r * u + gy - c[DRAG_RATE] * v,
        q * u - p * v + gz - c[DRAG_RATE] * w - (F[0] + F[1] + F[2] + F[3]) * c[INV_MASS],
        p + st * turn,
        cf * q - sf * r,
        turn,
        alpha_x,
        alpha_y,
        alpha_z,
    )


@inline_kernel
def rigid_body(
    x: Sequence[float], F: Sequence[float], d: Sequence[float], c: Sequence[float]
) -> tuple[float, ...]:
    """Derivative of the 12 states, Eq. (2.32).

    Args:
        x: State [p, V_B, Theta, Omega], 12 numbers (array or tuple).
        F: Rotor forces, 4 numbers, N.
        d: Disturbance, 6 numbers: torque in body axes, N m, then force in inertial axes, N.
        c: QuadrotorParams.coefficients().

    Returns:
        Tuple of 12.
    """
    return derivative(x, sincos(x[6]) + sincos(x[7]) + sincos(x[8]), F, d, c)


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


# Coefficients of the series of sine and cosine.
_S3, _S5, _S7, _S9, _S11 = ((-1.0) ** (k // 2) / math.factorial(k) for k in (3, 5, 7, 9, 11))
_C2, _C4, _C6, _C8, _C10, _C12 = ((-1.0) ** (k // 2) / math.factorial(k) for k in (2, 4, 6, 8, 10, 12))
derivative_in_lanes, sincos_in_lanes = fused(derivative), fused(sincos)


@inline_lane_kernel
def lagged(F: tuple[float, ...], target: tuple[float, ...], decay: float) -> tuple[float, ...]:
    """Rotor forces after a while, Eq. (2.38) in closed form; `decay` is left of what they lack."""
    return (
        target[0] + (F[0] - target[0]) * decay,
        target[1] + (F[1] - target[1]) * decay,
        target[2] + (F[2] - target[2]) * decay,
        target[3] + (F[3] - target[3]) * decay,
    )


@inline_lane_kernel
def _turned(s: float, c: float, d: float) -> tuple[float, float]:
    """Sine and cosine of an angle + d from those of the angle, by the addition theorem.

    The series of sin d and cos d - 1 end with d^11 / 11! and d^12 / 12!: for 0.5 rad in a substep the error
    is 2e-14, far below that of RK4, whose terms end with the fourth power.
    """
    z = d * d
    sine = d + d * z * (_S3 + z * (_S5 + z * (_S7 + z * (_S9 + z * _S11))))
    less = z * (_C2 + z * (_C4 + z * (_C6 + z * (_C8 + z * (_C10 + z * _C12)))))
    return s + (s * less + c * sine), c + (c * less - s * sine)


@inline_lane_kernel
def turned(sines: tuple[float, ...], k: tuple[float, ...], h: float) -> tuple[float, ...]:
    """Sines and cosines of an attitude after h times its rate in the derivative k."""
    return (
        _turned(sines[0], sines[1], h * k[6])
        + _turned(sines[2], sines[3], h * k[7])
        + _turned(sines[4], sines[5], h * k[8])
    )


def _make_substep(disturbed: bool) -> Callable[[Array, float], None]:
    """The kernel of a substep with disturbances or without, since LLVM may not leave out 0 x by itself."""

    @lane_kernel
    def substep(w: Array, h: float) -> None:
        """One RK4 step of a block; the rotors lag in closed form."""
        for j in range(LANES):
            x, target = twelve(w, MOVED + j), four(w, TARGET + j)
            F_0 = four(w, MOVED_FORCES + j)
            sines, decay = six(w, SINES + j), w[DECAY + j]
            c = twelve(w, COEFFICIENTS + j) + four(w, COEFFICIENTS + 12 * LANES + j)
            d_1 = six(w, AIR_FIRST + j) if disturbed else None
            d_2 = six(w, AIR_MIDDLE + j) if disturbed else None
            d_3 = six(w, AIR_LAST + j) if disturbed else None
            F_1 = lagged(F_0, target, decay)
            F_2 = lagged(F_1, target, decay)
            k_1 = derivative_in_lanes(x, sines, F_0, d_1, c)
            k_2 = derivative_in_lanes(plus(x, k_1, 0.5 * h), turned(sines, k_1, 0.5 * h), F_1, d_2, c)
            k_3 = derivative_in_lanes(plus(x, k_2, 0.5 * h), turned(sines, k_2, 0.5 * h), F_1, d_2, c)
            k_4 = derivative_in_lanes(plus(x, k_3, h), turned(sines, k_3, h), F_2, d_3, c)
            slope = plus(plus(plus(k_1, k_2, 2.0), k_3, 2.0), k_4, 1.0)
            put_twelve(w, MOVED + j, plus(x, slope, h / 6.0))
            put_six(w, SINES + j, turned(sines, slope, h / 6.0))
            put_four(w, MOVED_FORCES + j, F_2)

    return substep


calm_substep, disturbed_substep = _make_substep(False), _make_substep(True)


@inline_kernel
def place_vehicle(w: Array, j: Int, c: Array, force_max: Array, h: float) -> None:
    """Which vehicle flies in lane j.

    Args:
        w: Block.
        j: Lane.
        c: QuadrotorParams.coefficients().
        force_max: Largest force of each rotor, (4,), N.
        h: Substep, s.
    """
    for i in range(N_COEFFICIENTS):
        w[COEFFICIENTS + i * LANES + j] = c[i]
    for i in range(N_INPUT):
        w[FORCE_MAX + i * LANES + j] = force_max[i]
    w[DECAY + j] = math.exp(-0.5 * c[ROTOR_RATE] * h)


@inline_lane_kernel
def depart(w: Array, j: Int) -> None:
    """Begin a control period in lane j: rotors tend to the commands within [0, FORCE_MAX], Eq. (2.39)."""
    put_twelve(w, MOVED + j, twelve(w, PLANT + j))
    put_four(w, MOVED_FORCES + j, four(w, FORCES + j))
    command, most = four(w, COMMAND + j), four(w, FORCE_MAX + j)
    w[TARGET + j] = min(max(command[0], 0.0), most[0])
    w[TARGET + LANES + j] = min(max(command[1], 0.0), most[1])
    w[TARGET + 2 * LANES + j] = min(max(command[2], 0.0), most[2])
    w[TARGET + 3 * LANES + j] = min(max(command[3], 0.0), most[3])


@lane_kernel
def set_out(w: Array) -> None:
    """Begin a control period of a block whose plants and commands were set."""
    for j in range(LANES):
        depart(w, j)
        sines = sincos_in_lanes(w[PHI + j]) + sincos_in_lanes(w[THETA + j]) + sincos_in_lanes(w[PSI + j])
        put_six(w, SINES + j, sines)


@inline_kernel
def load_air(w: Array, j: Int, nodes: Array, s: Int) -> None:
    """The disturbance of lane j in substep s, from its values at the stage times, (>= 2 s + 3, 6)."""
    for i in range(6):
        w[AIR_FIRST + i * LANES + j] = nodes[2 * s, i]
        w[AIR_MIDDLE + i * LANES + j] = nodes[2 * s + 1, i]
        w[AIR_LAST + i * LANES + j] = nodes[2 * s + 2, i]


@inline_lane_kernel
def _size(a: tuple[float, ...]) -> float:
    return abs(a[0]) + abs(a[1]) + abs(a[2]) + abs(a[3])


@inline_lane_kernel
def _either(first: bool, a: tuple[float, ...], b: tuple[float, ...]) -> tuple[float, ...]:
    """The one or the other four numbers, without a branch."""
    return (
        a[0] if first else b[0],
        a[1] if first else b[1],
        a[2] if first else b[2],
        a[3] if first else b[3],
    )


@lane_kernel
def arrive(w: Array) -> None:
    """End a control period of a block: plants whose numbers are below LARGEST have moved, others stay."""
    for j in range(LANES):
        moved, forces = twelve(w, MOVED + j), four(w, MOVED_FORCES + j)
        before, forces_before = twelve(w, PLANT + j), four(w, FORCES + j)
        finite = _size(moved[:4]) + _size(moved[4:8]) + _size(moved[8:]) + _size(forces) < LARGEST
        w[FINITE + j] = 1.0 if finite else 0.0
        put_four(w, PLANT + j, _either(finite, moved[:4], before[:4]))
        put_four(w, PLANT + 4 * LANES + j, _either(finite, moved[4:8], before[4:8]))
        put_four(w, PLANT + 8 * LANES + j, _either(finite, moved[8:], before[8:]))
        put_four(w, FORCES + j, _either(finite, forces, forces_before))


@kernel
def _simulate(
    plants: Array, commands: Array, force_max: Array, coefficients: Array, substeps: int, h: float, w: Array
) -> None:
    for first in range(0, plants.shape[0], LANES):
        lanes = min(LANES, plants.shape[0] - first)
        for j in range(lanes):
            place_vehicle(w, j, coefficients, force_max, h)
            for i in range(N_PLANT):
                w[PLANT + i * LANES + j] = plants[first + j, i]
            for i in range(N_INPUT):
                w[COMMAND + i * LANES + j] = commands[first + j, i]
        set_out(w)
        for _ in range(substeps):
            calm_substep(w, h)
        arrive(w)
        for j in range(lanes):
            for i in range(N_PLANT):
                plants[first + j, i] = w[PLANT + i * LANES + j]


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
        np.zeros(N_FLIGHT),
    )
    return plants.reshape(start.shape)
