"""Derivatives of the step by its adjoint, for policy gradients through the dynamics.

Reverse mode by hand: `step_vjp` takes the sensitivity of any scalar to the plant after a control period back
to the plant before it and to the rotor commands, for about four times the cost of the step. A disturbance is
given: it does not depend on the plant, but its force, in inertial axes, acts on velocities in body axes
through the attitude, as the weight does. The plain step is `dynamics.simulate`; the tests compare with
central differences.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike

from ...arguments.names import shown
from ...compilation.decorators import inline_kernel, kernel
from ...dynamics import rigid_body, rotor_limits
from ...parameters import (
    DRAG_RATE,
    GRAVITY,
    GYRO_X,
    GYRO_Y,
    GYRO_Z,
    INV_MASS,
    N_INPUT,
    N_STATE,
    PITCH_CROSS,
    PITCH_GAIN,
    ROLL_CROSS,
    ROLL_GAIN,
    ROTOR_RATE,
    YAW_GAIN,
    Array,
    QuadrotorParams,
)
from ...rotations import sincos

_PLANT = N_STATE + N_INPUT
_MOST_SUBSTEPS = 64
STAGE_ROWS = 13  # of scratch: stages of a substep and their sensitivities
_N_DISTURBANCE = 6  # torque in body axes, force in inertial ones


@inline_kernel
def _dot(a: Array, x: float, y: float, z: float) -> float:
    return float(a[0] * x + a[1] * y + a[2] * z)


@inline_kernel
def _rotors_vjp(b2: float, g0: float, g1: float, g2: float, c: Array, bar_F: Array) -> None:
    """Sensitivity to the rotor forces, from b2 to the velocity along z_B and from g to the body rates."""
    thrust, yaw = -c[INV_MASS] * b2, c[YAW_GAIN] * g2
    ahead = c[PITCH_GAIN] * g1 - c[ROLL_CROSS] * g0  # of rotor 1, opposite to rotor 3
    left = c[ROLL_GAIN] * g0 + c[PITCH_CROSS] * g1  # of rotor 4, opposite to rotor 2
    bar_F[0] = thrust + ahead - yaw
    bar_F[1] = thrust - left + yaw
    bar_F[2] = thrust - ahead - yaw
    bar_F[3] = thrust + left + yaw


@kernel
def rigid_body_vjp(x: Array, F: Array, d: Array, c: Array, bar: Array, bar_x: Array, bar_F: Array) -> None:
    """Adjoint of `dynamics.rigid_body`: bar_x = (df/dx)' bar, bar_F = (df/dF)' bar.

    Args:
        x: State, (12,).
        F: Rotor forces, (4,), N.
        d: Disturbance, (6,): torque in body axes, force in inertial axes.
        c: QuadrotorParams.coefficients().
        bar: Sensitivity to the derivative of the state, (12,).
        bar_x: Result, (12,).
        bar_F: Result, (4,).
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
    a, b0, b1, b2, e0, e1, e2 = bar[:3], bar[3], bar[4], bar[5], bar[6], bar[7], bar[8]
    g0, g1, g2 = bar[9], bar[10], bar[11]
    turn, kin = (sf * q + cf * r) / ct, e0 * st + e2
    a1, a2, a3 = _dot(a, r11, r12, r13), _dot(a, r21, r22, r23), _dot(a, r31, r32, r33)
    f1, f2, f3 = (
        r11 * fx + r12 * fy + r13 * fz,
        r21 * fx + r22 * fy + r23 * fz,
        r31 * fx + r32 * fy + r33 * fz,
    )
    bar_x[0], bar_x[1], bar_x[2] = 0.0, 0.0, 0.0
    bar_x[3] = a1 - r * b1 + q * b2 - c[DRAG_RATE] * b0
    bar_x[4] = a2 + r * b0 - p * b2 - c[DRAG_RATE] * b1
    bar_x[5] = a3 - q * b0 + p * b1 - c[DRAG_RATE] * b2
    # dR/dphi turns row 2 into row 3 and row 3 into -row 2.
    bar_x[6] = v * a3 - w * a2 + b1 * f3 - b2 * f2 + kin * (cf * q - sf * r) / ct - e1 * (sf * q + cf * r)
    # dR/dtheta: row 1 becomes (-st cs, -st ss, -ct), rows 2 and 3 sf and cf times row 1.
    t1, t2, t3 = -st * cs, -st * ss, -ct
    bar_x[7] = (
        u * _dot(a, t1, t2, t3)
        + (v * sf + w * cf) * a1
        + b0 * (t1 * fx + t2 * fy + t3 * fz)
        + (b1 * sf + b2 * cf) * f1
        + turn * (e0 + e2 * st) / ct
    )
    # dR/dpsi: (x, y, z) becomes (-y, x, 0) in each row.
    bar_x[8] = (
        u * (r11 * a[1] - r12 * a[0])
        + v * (r21 * a[1] - r22 * a[0])
        + w * (r31 * a[1] - r32 * a[0])
        + b0 * (r11 * fy - r12 * fx)
        + b1 * (r21 * fy - r22 * fx)
        + b2 * (r31 * fy - r32 * fx)
    )
    bar_x[9] = b1 * w - b2 * v + e0 + g1 * c[GYRO_Y] * r + g2 * c[GYRO_Z] * q
    bar_x[10] = b2 * u - b0 * w + kin * sf / ct + e1 * cf + g0 * c[GYRO_X] * r + g2 * c[GYRO_Z] * p
    bar_x[11] = b0 * v - b1 * u + kin * cf / ct - e1 * sf + g0 * c[GYRO_X] * q + g1 * c[GYRO_Y] * p
    _rotors_vjp(b2, g0, g1, g2, c, bar_F)


@inline_kernel
def _derivative(x: Array, F: Array, d: Array, c: Array, out: Array) -> None:
    """`dynamics.rigid_body` into an array."""
    k = rigid_body(x, F, d, c)  # type: ignore[arg-type]  # arrays index like sequences
    out[0], out[1], out[2], out[3], out[4], out[5] = k[0], k[1], k[2], k[3], k[4], k[5]
    out[6], out[7], out[8], out[9], out[10], out[11] = k[6], k[7], k[8], k[9], k[10], k[11]


@inline_kernel
def _lag(F: Array, command: Array, force_max: Array, decay: float, out: Array) -> None:
    """Rotor forces after the decay, toward the saturated commands."""
    for i in range(N_INPUT):
        target = min(max(command[i], 0.0), force_max[i])
        out[i] = target + (F[i] - target) * decay


@kernel
def _stages(
    x: Array,
    F: Array,
    command: Array,
    force_max: Array,
    c: Array,
    h: float,
    d: Array,
    w: Array,
    x_next: Array,
) -> None:
    """The four stages of one substep into w[:4] (states) and w[4:8] (forces), and the state after it.

    d has the disturbances at its beginning, middle and end, (3, 6).
    """
    half = math.exp(-0.5 * c[ROTOR_RATE] * h)
    k, ahead, decay, weight = w[8], 0.0, 1.0, 0.0
    for i in range(N_STATE):
        x_next[i] = x[i]
        k[i] = 0.0
    for s in range(4):
        if s == 1 or s == 2:
            ahead, decay = 0.5 * h, half
        elif s == 3:
            ahead, decay = h, half * half
        for i in range(N_STATE):
            w[s, i] = x[i] + ahead * k[i]
        _lag(F, command, force_max, decay, w[4 + s])
        _derivative(w[s], w[4 + s], d[(s + 1) // 2], c, k)
        weight = h / 3.0 if s == 1 or s == 2 else h / 6.0
        for i in range(N_STATE):
            x_next[i] += weight * k[i]


@kernel
def _substep_vjp(
    h: float, decay: float, c: Array, d: Array, w: Array, bar_x: Array, bar_F: Array, bar_command: Array
) -> None:
    """Take bar_x and bar_F back over the substep whose stages are in w; adds to bar_command. d as there."""
    weighted, back, gx, gF = w[9], w[10], w[11], w[12]
    for i in range(N_STATE):
        weighted[i] = bar_x[i]
        back[i] = 0.0
    half = decay
    bar_command_scale = 1.0 - half * half
    for i in range(N_INPUT):
        bar_command[i] += bar_command_scale * bar_F[i]
        bar_F[i] *= half * half
    for s in range(3, -1, -1):
        weight = h / 3.0 if s == 1 or s == 2 else h / 6.0
        ahead = h if s == 2 else 0.5 * h if s < 2 else 0.0  # how far this stage's slope carries the next one
        for i in range(N_STATE):
            back[i] = weight * weighted[i] + ahead * back[i]
        rigid_body_vjp(w[s], w[4 + s], d[(s + 1) // 2], c, back, gx, gF)
        lag = half if s == 1 or s == 2 else half * half if s == 3 else 1.0
        for i in range(N_STATE):
            bar_x[i] += gx[i]
            back[i] = gx[i]
        for i in range(N_INPUT):
            bar_F[i] += lag * gF[i]
            bar_command[i] += (1.0 - lag) * gF[i]


@kernel
def roll_out(
    plant: Array,
    command: Array,
    force_max: Array,
    c: Array,
    substeps: int,
    h: float,
    d: Array,
    past: Array,
    w: Array,
) -> None:
    """Fly a control period, as `step_vjp_kernel` takes it back.

    Args:
        plant: Before it, (16,).
        command: Rotor commands, (4,), N.
        force_max: Largest force of each rotor, (4,), N.
        c: QuadrotorParams.coefficients().
        substeps: RK4 steps.
        h: Length of one, s.
        d: Disturbances at the stage times, (2 substeps + 1, 6).
        past: Result: the plants before each substep and after the last, (substeps + 1, 16).
        w: Scratch, (STAGE_ROWS, 16).
    """
    half = math.exp(-0.5 * c[ROTOR_RATE] * h)
    for i in range(_PLANT):
        past[0, i] = plant[i]
    for s in range(substeps):
        x, following = past[s], past[s + 1]
        _stages(x[:N_STATE], x[N_STATE:], command, force_max, c, h, d[2 * s : 2 * s + 3], w, following)
        _lag(x[N_STATE:], command, force_max, half * half, following[N_STATE:])


@kernel
def roll_back(
    plant: Array,
    command: Array,
    force_max: Array,
    c: Array,
    h: float,
    d: Array,
    bar_plant: Array,
    bar_command: Array,
    w: Array,
) -> None:
    """Take bar_plant back over the substep that began at a plant; adds to bar_command.

    Saturated commands have their influence still, see `forget_saturated`. Arguments as in `roll_out`, but d
    has the disturbances of this substep, (3, 6).
    """
    half = math.exp(-0.5 * c[ROTOR_RATE] * h)
    _stages(plant[:N_STATE], plant[N_STATE:], command, force_max, c, h, d, w, w[12])
    _substep_vjp(h, half, c, d, w, bar_plant[:N_STATE], bar_plant[N_STATE:], bar_command)


@inline_kernel
def forget_saturated(command: Array, force_max: Array, bar_command: Array) -> None:
    """A command outside the rotor box has no influence."""
    for i in range(N_INPUT):
        if not 0.0 <= command[i] <= force_max[i]:
            bar_command[i] = 0.0


@kernel
def step_vjp_kernel(
    plant: Array,
    command: Array,
    force_max: Array,
    c: Array,
    substeps: int,
    h: float,
    d: Array,
    bar: Array,
    bar_plant: Array,
    bar_command: Array,
    w: Array,
) -> None:
    """Adjoint of a control period of one vehicle, see `step_vjp`.

    Args:
        plant: Before it, (16,).
        command: Rotor commands, (4,), N.
        force_max: Largest force of each rotor, (4,), N.
        c: QuadrotorParams.coefficients().
        substeps: RK4 steps, at most 64.
        h: Length of one, s.
        d: Disturbances at the stage times, (2 substeps + 1, 6).
        bar: Sensitivity to the plant after it, (16,).
        bar_plant: Result, (16,).
        bar_command: Result, (4,).
        w: Scratch, (SCRATCH_ROWS, 16).
    """
    past = w[STAGE_ROWS:]
    roll_out(plant, command, force_max, c, substeps, h, d, past, w)
    for i in range(_PLANT):
        bar_plant[i] = bar[i]
    for i in range(N_INPUT):
        bar_command[i] = 0.0
    for s in range(substeps - 1, -1, -1):
        roll_back(past[s], command, force_max, c, h, d[2 * s : 2 * s + 3], bar_plant, bar_command, w)
    forget_saturated(command, force_max, bar_command)


SCRATCH_ROWS = STAGE_ROWS + _MOST_SUBSTEPS + 1


@kernel
def _step_vjp_rows(
    plants: Array,
    commands: Array,
    force_max: Array,
    c: Array,
    substeps: int,
    h: float,
    d: Array,
    bars: Array,
    bar_plants: Array,
    bar_commands: Array,
    w: Array,
) -> None:
    for j in range(plants.shape[0]):
        step_vjp_kernel(
            plants[j], commands[j], force_max, c, substeps, h, d[j], bars[j],
            bar_plants[j], bar_commands[j], w,
        )  # fmt: skip


def step_vjp(
    plant: ArrayLike,
    command: ArrayLike,
    bar: ArrayLike,
    params: QuadrotorParams,
    *,
    force_max: ArrayLike | None = None,
    duration: float = 0.05,
    substeps: int = 5,
    disturbance: ArrayLike = 0.0,
) -> tuple[Array, Array]:
    """Adjoint of `dynamics.simulate`: sensitivities before a control period from those after it.

    Args:
        plant: Before the period, (..., 16).
        command: Rotor commands, (..., 4), N; one outside the rotor box has no influence.
        bar: Sensitivity of a scalar to the plant after the period, (..., 16).
        params: The vehicle.
        force_max: Upper saturation of the rotor forces, N: one number or (4,); None for the weight.
        duration: s.
        substeps: RK4 steps, 1 to 64.
        disturbance: Torque 3 (body axes, N m) and force 3 (inertial axes, N) at the stage times,
            (..., 2 substeps + 1, 6), or what broadcasts to that.

    Returns:
        Sensitivities to the plant, (..., 16), and to the command, (..., 4).

    Raises:
        ValueError: If substeps is out of range.
    """
    if not 1 <= substeps <= _MOST_SUBSTEPS:
        raise ValueError(f"substeps must be 1 to {_MOST_SUBSTEPS}, got {shown(substeps)}")
    plants = np.ascontiguousarray(plant, dtype=np.float64)
    shape, nodes = plants.shape[:-1], (2 * substeps + 1, _N_DISTURBANCE)
    commands, bars, d = (
        np.array(np.broadcast_to(np.asarray(value, dtype=np.float64), (*shape, *size))).reshape(-1, *size)
        for value, size in ((command, (N_INPUT,)), (bar, (_PLANT,)), (disturbance, nodes))
    )
    bar_plants, bar_commands = np.empty_like(bars), np.empty_like(commands)
    _step_vjp_rows(
        plants.reshape(-1, _PLANT),
        commands,
        rotor_limits(force_max, params),
        params.coefficients(),
        substeps,
        duration / substeps,
        d,
        bars,
        bar_plants,
        bar_commands,
        np.zeros((SCRATCH_ROWS, _PLANT)),
    )
    return bar_plants.reshape(*shape, _PLANT), bar_commands.reshape(*shape, N_INPUT)
