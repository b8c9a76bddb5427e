"""Feedback linearisation with a PD law in each loop, Eqs. (4.12) to (4.21) corrected."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from quad_envs.compilation.decorators import kernel
from quad_envs.dynamics import rotor_shares
from quad_envs.parameters import (
    GRAVITY,
    GYRO_X,
    GYRO_Y,
    GYRO_Z,
    INV_JX,
    INV_JY,
    INV_JZ,
    INV_MASS,
    N_INPUT,
    Array,
)
from quad_envs.references.turning import turn_rate
from quad_envs.rotations import sincos, wrap_angle_scalar
from quad_envs.tasks import Task

from ..controller import TURNING_ROWS, FeedbackLaw, first_non_finite
from ..fallback import HOVER, NONE, limit_command, yield_yaw
from ..frame import governed
from ..mpc.options import chosen
from ..qp.ocp import IntArray
from .options import FeedbackLinearizationOptions

KP, KD, KA, KAD = range(4)  # entries of the gains
_YAW_STIFFNESS, _YAW_DAMPING = 1.0, 2.0  # 1/s^2, 1/s
_LARGEST_DESCENT = 0.99  # of g: the attitude law holds for u_3 < g


@kernel
def _inertial_velocity(plant: Array, out: Array) -> None:
    """Inertial velocity R_BI' V_B."""
    sf, cf = sincos(plant[6])
    st, ct = sincos(plant[7])
    ss, cs = sincos(plant[8])
    side = cf * plant[4] - sf * plant[5]
    under = sf * plant[4] + cf * plant[5]
    forward = ct * plant[3] + st * under
    out[0], out[1], out[2] = cs * forward - ss * side, ss * forward + cs * side, ct * under - st * plant[3]


@kernel
def _wanted_acceleration(
    plant: Array,
    window: Array,
    d: Array,
    gains: Array,
    c: Array,
    dt: float,
    preview: bool,
    heading: bool,
    out: Array,
) -> None:
    """u_i = a_ref - kp e - kd (v - v_ref) - d_force / m, in inertial axes."""
    _inertial_velocity(plant, out)
    share = 1.0
    if heading:
        share = governed(plant[0] - window[0, 0], plant[1] - window[0, 1], plant[2] - window[0, 2])
    for i in range(3):
        a_ref = (window[1, 3 + i] - window[0, 3 + i]) / dt if preview else 0.0
        error, rate = share * (plant[i] - window[0, i]), out[i] - window[0, 3 + i]
        out[i] = a_ref - gains[KP] * error - gains[KD] * rate - c[INV_MASS] * d[3 + i]
    out[2] = min(out[2], _LARGEST_DESCENT * c[GRAVITY])


@kernel
def _wanted_rates(plant: Array, psi_dot: float, heading: bool) -> tuple[float, float, float]:
    """E(Theta) [0, 0, psi_dot]; with Euler rates for body rates, as in the text, [0, 0, psi_dot]."""
    if not heading:
        return 0.0, 0.0, psi_dot
    sf, cf = sincos(plant[6])
    st, ct = sincos(plant[7])
    return -psi_dot * st, psi_dot * sf * ct, psi_dot * cf * ct


@kernel
def _rotor_forces(
    plant: Array,
    u: Array,
    psi_ref: float,
    psi_dot: float,
    d: Array,
    gains: Array,
    c: Array,
    heading: bool,
    F: Array,
) -> None:
    """Thrust and attitude for the acceleration u, torques for the attitude, rotor forces for both."""
    phi, theta, psi = plant[6], plant[7], plant[8]
    p, q, r = plant[9], plant[10], plant[11]
    p_d, q_d, r_d = _wanted_rates(plant, psi_dot, heading)
    sine, cosine = sincos(psi if heading else 0.0)
    ahead, aside = cosine * u[0] + sine * u[1], cosine * u[1] - sine * u[0]
    lift = c[GRAVITY] - u[2]
    specific = math.sqrt(ahead * ahead + aside * aside + lift * lift)
    theta_d = -math.atan(ahead / lift)
    phi_d = math.asin(aside / specific)
    yaw_error = wrap_angle_scalar(psi - psi_ref) if heading else psi - psi_ref
    # Torques over the moments of inertia, then split among the rotors: M^-1 [T; tau].
    alpha_x = -c[GYRO_X] * q * r - gains[KA] * (phi - phi_d) - gains[KAD] * (p - p_d) - c[INV_JX] * d[0]
    alpha_y = -c[GYRO_Y] * p * r - gains[KA] * (theta - theta_d) - gains[KAD] * (q - q_d) - c[INV_JY] * d[1]
    alpha_z = -c[GYRO_Z] * p * q - _YAW_STIFFNESS * yaw_error - _YAW_DAMPING * (r - r_d) - c[INV_JZ] * d[2]
    lift_part = 0.25 * specific / c[INV_MASS]
    shares = rotor_shares(alpha_x, alpha_y, alpha_z, c)
    for i in range(N_INPUT):
        F[i] = lift_part + shares[i]


@kernel
def _decide_rows(
    plants: Array,
    windows: Array,
    lasts: Array,
    disturbances: Array,
    memories: Array,
    commands: Array,
    report: IntArray,
    gains: Array,
    preview: bool,
    c: Array,
    heading: bool,
    dt: float,
    force_max: Array,
    rate_step: float,
    scratch: Array,
) -> int:
    """One decision per row; -1, or the code of the first argument that is not finite."""
    stages = min(windows.shape[1], TURNING_ROWS)
    bad = first_non_finite(plants, windows, lasts, disturbances, memories, stages)
    if bad >= 0:
        return bad
    u, F = scratch[0, :3], scratch[1]
    for j in range(plants.shape[0]):
        _wanted_acceleration(plants[j], windows[j], disturbances[j], gains, c, dt, preview, heading, u)
        psi_ref = math.atan2(windows[j, 0, 6], windows[j, 0, 7])
        psi_dot = turn_rate(windows[j], stages, 0, dt)
        _rotor_forces(plants[j], u, psi_ref, psi_dot, disturbances[j], gains, c, heading, F)
        level = NONE
        if not math.isfinite(F[0] + F[1] + F[2] + F[3]):
            level = HOVER
            F[:] = 0.25 * c[GRAVITY] / c[INV_MASS]
        if heading:
            yield_yaw(F, lasts[j], rate_step, force_max)
        limit_command(F, lasts[j], rate_step, force_max, commands[j])
        report[0, j], report[1, j] = level, 0
    return bad


class FeedbackLinearization(FeedbackLaw):
    """PD laws on position and attitude after cancelling the nonlinear terms.

    Deviation:
        The printed law has T without m, products of angles where body rates belong, no acceleration of the
        reference and psi = 0; here they are corrected, (u_1, u_2) are turned by the yaw, and u_3 is kept
        below 0.99 g, beyond which the attitude law changes sign.

    Args:
        task: What is known of the flight.
        options: See `FeedbackLinearizationOptions`; None for the defaults.
        changes: Fields of it by name, which replace those of `options`.

    Raises:
        TypeError: If there is no such option.
        ValueError: If an option is not allowed.
    """

    options_type = FeedbackLinearizationOptions

    def __init__(
        self, task: Task, options: FeedbackLinearizationOptions | None = None, **changes: Any
    ) -> None:
        options = chosen(FeedbackLinearizationOptions, options, changes)
        self.options = options
        self.task = task
        self.horizon = 1 if options.acceleration_feed_forward else 0
        self._gains = np.array([options.kp, options.kd, options.ka, options.kad], dtype=np.float64)
        self._constants = (
            task.params.coefficients(),
            options.frame == "heading",
            float(task.dt),
            task.force_max,
            float(task.limits.rate * task.dt),
        )
        self._scratch = np.empty((2, N_INPUT))

    def _decide_rows(self, *arrays: Any) -> int:
        preview = self.horizon > 0 and arrays[1].shape[1] > 1
        arguments: tuple[Any, ...] = (*arrays, self._gains, preview, *self._constants, self._scratch)
        return _decide_rows(*arguments)
