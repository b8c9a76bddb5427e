"""Disturbances: what cancels them, and an estimator where they are not revealed (offset-free MPC).

A disturbance is six numbers, torque in body axes (N m) and force in inertial axes (N). The rotors cancel the
torques and the vertical force directly ("feedforward cancellation", section 4.7 of the dissertation); a
lateral force needs a trim attitude, which becomes part of the reference.
"""

from __future__ import annotations

import math

import numpy as np

from quad_envs.compilation.decorators import kernel
from quad_envs.dynamics import arrive, disturbed_substep, place_vehicle, rotor_shares, set_out
from quad_envs.lanes import AIR_FIRST, AIR_LAST, AIR_MIDDLE, COMMAND, FINITE, LANES, N_FLIGHT, PLANT
from quad_envs.parameters import (
    GRAVITY,
    HOVER_FORCE,
    INV_JX,
    INV_JY,
    INV_JZ,
    INV_MASS,
    N_INPUT,
    ROLL_CROSS,
    ROLL_GAIN,
    YAW_GAIN,
    Array,
)
from quad_envs.rotations import sincos

N_DISTURBANCE = 6
PLANT_SIZE = 16
ESTIMATOR_GAIN = 0.5  # per sample: less is too slow for the dissertation's torque pulse, more passes noise on
ESTIMATOR_SIZE = 1 + 2 * N_DISTURBANCE + PLANT_SIZE + N_INPUT  # see `update_estimate`
_PLANT = 1 + 2 * N_DISTURBANCE
_COMMAND = _PLANT + PLANT_SIZE
_SUBSTEPS = 2  # of the prediction: 3e-5 from the limit
ESTIMATOR_SCRATCH = PLANT_SIZE + N_DISTURBANCE + N_FLIGHT
_TORQUE_SHARE = 0.25  # of L m g / 2, the roll torque available in hover, that an estimate may reach
_FORCE_SHARE = 0.5  # of the weight, likewise
_SMALLEST_LIFT = 0.1  # of the weight, that the thrust carries when a force lifts the vehicle
_YAW_SHARE = 0.5  # of the rotor force range around hover that may go into cancelling a yaw torque


@kernel
def feed_forward(d: Array, psi: float, c: Array, force_max: Array, offset: Array, trim: Array) -> None:
    """Rotor forces and attitude at which the vehicle stands still under a constant disturbance.

    With f = d_force / m in axes turned by psi, thrust and attitude satisfy T/m R_BI'e3 = g e3 + f. The yaw
    torque of the rotors is weak (hover allows 0.017 N m), so its part is clipped, and the rest left to the
    feedback.

    Args:
        d: Disturbance, (6,).
        psi: Yaw, rad.
        c: QuadrotorParams.coefficients().
        force_max: Largest force of each rotor, (4,), N.
        offset: Result, rotor forces in equilibrium, (4,), N: u_T without disturbance. May leave the box.
        trim: Result, state in equilibrium, (12,): zero but for roll and pitch, rad.
    """
    hover = c[HOVER_FORCE]
    offset[:] = hover
    trim[:] = 0.0
    if d[3] != 0.0 or d[4] != 0.0 or d[5] != 0.0:
        sine, cosine = sincos(psi)
        forward = c[INV_MASS] * (cosine * d[3] + sine * d[4])
        side = c[INV_MASS] * (cosine * d[4] - sine * d[3])
        down = max(c[GRAVITY] + c[INV_MASS] * d[5], _SMALLEST_LIFT * c[GRAVITY])
        specific = math.sqrt(forward * forward + side * side + down * down)
        offset[:] = hover * specific / c[GRAVITY]
        trim[6] = -math.asin(side / specific)
        trim[7] = math.atan(forward / down)
    share = _YAW_SHARE * hover
    for i in range(N_INPUT):
        share = min(share, _YAW_SHARE * (force_max[i] - hover))
    most = 4.0 * share * c[YAW_GAIN]
    yaw = min(max(d[2] * c[INV_JZ], -most), most)
    shares = rotor_shares(d[0] * c[INV_JX], d[1] * c[INV_JY], yaw, c)
    for i in range(N_INPUT):
        offset[i] -= shares[i]


@kernel
def _residual(plant: Array, predicted: Array, dt: float, c: Array, out: Array) -> bool:
    """The disturbance that explains measured minus predicted velocities, (6,); False if it is not finite."""
    out[0] = (plant[9] - predicted[9]) / (dt * c[INV_JX])
    out[1] = (plant[10] - predicted[10]) / (dt * c[INV_JY])
    out[2] = (plant[11] - predicted[11]) / (dt * c[INV_JZ])
    scale = 1.0 / (dt * c[INV_MASS])
    u, v, w = plant[3] - predicted[3], plant[4] - predicted[4], plant[5] - predicted[5]
    sf, cf = sincos(plant[6])
    st, ct = sincos(plant[7])
    ss, cs = sincos(plant[8])
    side = cf * v - sf * w
    under = sf * v + cf * w
    forward = ct * u + st * under
    out[3] = scale * (cs * forward - ss * side)
    out[4] = scale * (ss * forward + cs * side)
    out[5] = scale * (ct * under - st * u)
    total = 0.0
    for i in range(N_DISTURBANCE):
        total += abs(out[i])
    return total < math.inf


@kernel
def update_estimate(
    plant: Array,
    memory: Array,
    gain: Array,
    c: Array,
    dt: float,
    force_max: Array,
    estimate: Array,
    scratch: Array,
) -> None:
    """Correct the estimate by what a one-step prediction of the full model, with rotor lag, did not explain.

    The prediction is made under the disturbance that was assumed, so that a constant one is found exactly.
    Only velocities and rates are compared: positions may be relative. The estimate is limited to a share of
    what the rotors can cancel: a disturbance that turns faster than it can be estimated must not saturate
    them.

    Args:
        plant: Measured [p, V_B, Theta, Omega, F], (16,).
        memory: As `remember` left it, (ESTIMATOR_SIZE,): whether it holds a sample, the estimate, the
            disturbance revealed then, plant and command then.
        gain: Share of each correction, in (0, 1], (6,).
        c: QuadrotorParams.coefficients().
        dt: Control period, s.
        force_max: Largest force of each rotor, (4,), N.
        estimate: Result, (6,).
        scratch: Overwritten, (ESTIMATOR_SCRATCH,).
    """
    for i in range(N_DISTURBANCE):
        estimate[i] = memory[1 + i]
    if memory[0] == 0.0:
        return
    predicted, w = scratch[:PLANT_SIZE], scratch[PLANT_SIZE + N_DISTURBANCE :]
    correction = scratch[PLANT_SIZE : PLANT_SIZE + N_DISTURBANCE]
    h = dt / _SUBSTEPS
    place_vehicle(w, np.int64(0), c, force_max, h)
    for i in range(PLANT_SIZE):
        w[PLANT + i * LANES] = memory[_PLANT + i]
    for i in range(N_INPUT):
        w[COMMAND + i * LANES] = memory[_COMMAND + i]
    for i in range(N_DISTURBANCE):
        d = memory[1 + i] + memory[1 + N_DISTURBANCE + i]
        w[AIR_FIRST + i * LANES], w[AIR_MIDDLE + i * LANES], w[AIR_LAST + i * LANES] = d, d, d
    set_out(w)
    for _ in range(_SUBSTEPS):
        disturbed_substep(w, h)
    arrive(w)
    for i in range(PLANT_SIZE):
        predicted[i] = w[PLANT + i * LANES]
    if not (w[FINITE] > 0.0 and _residual(plant, predicted, dt, c, correction)):
        return
    weight = 4.0 * c[HOVER_FORCE]
    arm = math.hypot(c[ROLL_GAIN], c[ROLL_CROSS]) / c[INV_JX]
    for i in range(N_DISTURBANCE):
        limit = _FORCE_SHARE * weight if i >= 3 else _TORQUE_SHARE * 0.5 * arm * weight
        estimate[i] = min(max(estimate[i] + gain[i] * correction[i], -limit), limit)


@kernel
def remember(plant: Array, command: Array, revealed: Array, estimate: Array, memory: Array) -> None:
    """Keep what `update_estimate` needs at the next sample."""
    memory[0] = 1.0
    for i in range(N_DISTURBANCE):
        memory[1 + i] = estimate[i]
        memory[1 + N_DISTURBANCE + i] = revealed[i]
    for i in range(PLANT_SIZE):
        memory[_PLANT + i] = plant[i]
    for i in range(N_INPUT):
        memory[_COMMAND + i] = command[i]
