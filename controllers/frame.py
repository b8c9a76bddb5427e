"""What a vehicle measures and what it is to follow, in the frame in which a control law poses its problem.

With `heading` that frame stands at the vehicle's place and heading; without, it is the inertial one.
"""

from __future__ import annotations

import math

from quad_envs.compilation.decorators import kernel
from quad_envs.parameters import N_INPUT, N_STATE, Array
from quad_envs.references.turning import turn_rate
from quad_envs.rotations import sincos, wrap_angle_scalar
from quad_envs.tasks import BaseTask

from .qp.ocp import IntArray

GOVERNOR_REACH = 6.0  # m: beyond the starts of every id; a linear model asked for 15 m flips the vehicle


@kernel
def set_state(plant: Array, heading: bool, x_0: Array) -> None:
    """The measured state in the frame of the problem: with `heading`, p = 0 and psi = 0."""
    for i in range(N_STATE):
        x_0[i] = plant[i]
    if heading:
        x_0[0], x_0[1], x_0[2], x_0[8] = 0.0, 0.0, 0.0, 0.0


@kernel
def level_velocity(x_0: Array) -> None:
    """V_B of x_0 becomes the velocity in level axes, in place: what the hover model takes for p'.

    Near hover both axes are one, and the matrices are the same. But a vehicle that climbs at 3 m/s and rolls
    by 0.1 rad has 0.3 m/s of lateral V_B and does not move sideways: predicted from V_B, it would drift by
    that, the farther the longer the horizon.
    """
    sf, cf = sincos(x_0[6])
    st, ct = sincos(x_0[7])
    u, v, w = x_0[3], x_0[4], x_0[5]
    under = sf * v + cf * w
    x_0[3], x_0[4], x_0[5] = ct * u + st * under, cf * v - sf * w, ct * under - st * u


@kernel
def add_rotor_lag(plant: Array, offset: Array, B_c: Array, lag: float, x_0: Array) -> None:
    """What slow rotors will still do: x_0 + B_c (F - offset) / lambda_F.

    The models have no rotor lag. With it, x' = A x + B_c F and F' = lambda_F (u - F), so that
    z = x + B_c F / lambda_F moves by z' = A x + B_c u: seen from z, the rotors answer at once.

    Args:
        plant: [p, V_B, Theta, Omega, F], (16,).
        offset: Rotor forces in equilibrium, (4,), N.
        B_c: QuadrotorParams.input_matrix(), (12, 4).
        lag: 1 / lambda_F, s, or 0 for x_0 as it is; see `rotor_lag`.
        x_0: State of the problem, (12,), changed in place.
    """
    if lag > 0.0:
        for i in range(3, N_STATE):
            for a in range(N_INPUT):
                x_0[i] += lag * B_c[i, a] * (plant[N_STATE + a] - offset[a])


def rotor_lag(task: BaseTask) -> float:
    """1 / lambda_F, s, where that is longer than half a control period; else 0: the lag may be left out.

    The dissertation's rotors take 20 ms of 50 ms, and its controllers know nothing of it. Of a vehicle with
    65 ms (`vehicle="crazyflie"`), the ones on the hover model lose control.
    """
    rate = task.params.rotor_rate
    return 1.0 / rate if rate * task.dt < 2.0 else 0.0


@kernel
def governed(x: float, y: float, z: float) -> float:
    """Share of a position error (x, y, z), m, that a controller is shown: all of it up to GOVERNOR_REACH."""
    distance = math.sqrt(x * x + y * y + z * z)
    return 1.0 if distance <= GOVERNOR_REACH else GOVERNOR_REACH / distance


@kernel
def govern(r: Array) -> None:
    """Move references (n, 12) as a whole, in place, so that the first is within GOVERNOR_REACH of the origin.

    The dissertation's frame, without `heading`, has no such governor.
    """
    x, y, z = r[0, 0], r[0, 1], r[0, 2]
    rest = 1.0 - governed(x, y, z)
    if rest > 0.0:
        for i in range(r.shape[0]):
            r[i, 0] -= rest * x
            r[i, 1] -= rest * y
            r[i, 2] -= rest * z


@kernel
def yaw_reference(window: Array, i: int, before: float, psi: float, heading: bool) -> float:
    """psi_ref of row i of a window (n, 8), less psi with `heading`; see `set_references`.

    Args:
        window: (n, 8).
        i: Row.
        before: What this gave for the row before.
        psi: Of the vehicle.
        heading: Whether the frame is turned to the vehicle.
    """
    if i == 0:
        yaw = math.atan2(window[0, 6], window[0, 7])
        return wrap_angle_scalar(yaw - psi) if heading else yaw
    if window[i, 6] == window[i - 1, 6] and window[i, 7] == window[i - 1, 7]:
        return before
    if not heading:
        return math.atan2(window[i, 6], window[i, 7])
    turn_sine = window[i, 6] * window[i - 1, 7] - window[i, 7] * window[i - 1, 6]
    turn_cosine = window[i, 7] * window[i - 1, 7] + window[i, 6] * window[i - 1, 6]
    return before + math.atan2(turn_sine, turn_cosine)


@kernel
def rates_of_turning(plant: Array) -> tuple[float, float, float]:
    """Body rates of a vehicle that turns about the vertical at 1 rad/s: third column of E(Theta)."""
    roll_sine, roll_cosine = sincos(plant[6])
    pitch_sine, pitch_cosine = sincos(plant[7])
    return -pitch_sine, roll_sine * pitch_cosine, roll_cosine * pitch_cosine


@kernel
def set_references(
    plant: Array,
    window: Array,
    trim: Array,
    heading: bool,
    attitude: bool,
    kinematics: bool,
    stages: int,
    dt: float,
    r: Array,
) -> None:
    """Rows r_i = [p_ref; v_ref; trim phi, theta; psi_ref; Omega_ref] in the frame of the problem.

    The slot of V_B holds v_ref turned by the present heading, or by the whole present attitude, or (frame
    "hover", as in the dissertation) as it stands in inertial axes. psi_ref goes on continuously from row to
    row; the first is the one nearest to psi with `heading`, and in (-pi, pi] without. Omega_ref is [0, 0,
    psi_dot], or (`kinematics`) E(Theta) [0, 0, psi_dot] at the present attitude: what the model, at hover or
    frozen, needs to turn with the heading.

    With `heading`, a window that begins far from the vehicle is moved towards it, see `govern`.

    Args:
        plant: Measured, (16,).
        window: (>= n, 8).
        trim: Attitude in equilibrium, (12,).
        heading: Whether the frame is turned and shifted to the vehicle.
        attitude: Whether v_ref is turned into the present body axes.
        kinematics: Whether Omega_ref is.
        stages: Rows of the window that may be read, for psi_dot.
        dt: Control period, s.
        r: Result, (n, 12).
    """
    psi = plant[8]
    sine, cosine = sincos(psi if heading else 0.0)
    sf, cf, st, ct = 0.0, 1.0, 0.0, 1.0
    sv, cv = sine, cosine
    if attitude:
        sf, cf = sincos(plant[6])
        st, ct = sincos(plant[7])
        sv, cv = sincos(psi)
    e9, e10, e11 = 0.0, 0.0, 1.0
    if kinematics:
        e9, e10, e11 = rates_of_turning(plant)
    yaw = 0.0
    for i in range(r.shape[0]):
        yaw = yaw_reference(window, i, yaw, psi, heading)
        x, y, z = window[i, 0], window[i, 1], window[i, 2]
        if heading:
            x, y, z = x - plant[0], y - plant[1], z - plant[2]
        u = cv * window[i, 3] + sv * window[i, 4]
        v = cv * window[i, 4] - sv * window[i, 3]
        w = window[i, 5]
        down = st * u + ct * w
        r[i, 0], r[i, 1], r[i, 2] = cosine * x + sine * y, cosine * y - sine * x, z
        r[i, 3], r[i, 4], r[i, 5] = ct * u - st * w, sf * down + cf * v, cf * down - sf * v
        r[i, 6], r[i, 7], r[i, 8] = trim[6], trim[7], trim[8] + yaw
        psi_dot = turn_rate(window, stages, i, dt)
        r[i, 9], r[i, 10], r[i, 11] = e9 * psi_dot, e10 * psi_dot, e11 * psi_dot
    if heading:
        govern(r)


@kernel
def turn_rows(
    plant: Array, axis: IntArray, normal: IntArray, normals: Array, lower: Array, upper: Array
) -> None:
    """Turn and shift the limits on the position with the frame, in place.

    Args:
        plant: Measured, (16,).
        axis: Coordinate of the position that each output is, or -1, (H,).
        normal: Output of each row, (K,).
        normals: Outputs, (H, 12).
        lower: Bounds, (K,).
        upper: Bounds, (K,).
    """
    sine, cosine = sincos(plant[8])
    for h in range(axis.shape[0]):
        if axis[h] == 0:
            normals[h, 0], normals[h, 1] = cosine, -sine
        elif axis[h] == 1:
            normals[h, 0], normals[h, 1] = sine, cosine
    for k in range(normal.shape[0]):
        if axis[normal[k]] >= 0:
            lower[k] -= plant[axis[normal[k]]]
            upper[k] -= plant[axis[normal[k]]]
