"""What a vehicle's rotors can hold in hover: the measure of a disturbance that somebody can fly."""

from __future__ import annotations

import math

import numpy as np

from .limits import Limits
from .parameters import Array, QuadrotorParams


def hover_authority(params: QuadrotorParams, limits: Limits) -> Array:
    """Largest steady disturbance of each kind, alone, that the vehicle holds without moving.

    The rotor forces u_T + M^-1 w stay within [0, F_max]: the rotor nearest to its limit decides. A lateral
    force needs a tilt at which the thrust still carries the weight, and which the tilt limit permits.

    Returns:
        Torque about each body axis, N m, then force along each inertial axis, N, (6,).
    """
    u_T = params.hover_force
    room = np.minimum(u_T, np.array(limits.kappas) * params.weight - u_T)
    shares = np.abs(np.linalg.inv(params.mixer()))
    with np.errstate(divide="ignore"):  # a rotor without a share never meets its limit
        thrust, *torque = (room[:, None] / shares).min(axis=0)
    lateral = math.sqrt((params.weight + thrust) ** 2 - params.weight**2)
    if math.isfinite(limits.tilt):
        lateral = min(lateral, params.weight * math.tan(limits.tilt))
    return np.array([*torque, lateral, lateral, thrust])
