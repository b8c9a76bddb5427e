"""Vehicles by name: published parameters, each with its source.

The sources are models with more in them than here: a rotor speed with its own lag (here one rate of force),
arms that are not exactly square, drag that differs by axis. What was made of them is said with each.

Drag here is the same along all axes, as that of the Crazyflie nearly is. RotorS and PX4 have it in the plane
of the rotors only (in hover 0.146 kg/s for the Hummingbird, 0.556 kg/s for the Iris); it is left out, as it
would also brake climbs, which theirs does not. `drag=` puts it back.

Rotors 1 and 3 of a `QuadrotorParams` turn clockwise from above. Where those of a vehicle turn the other way,
it is the mirror image, with the same authority.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any

from .arguments.names import unknown_name
from .parameters import QuadrotorParams


@dataclass(frozen=True, slots=True)
class Vehicle:
    """A named vehicle: its parameters, how strong its rotors are, and who measured that."""

    params: QuadrotorParams
    kappa: float  # largest rotor force as a fraction of the weight
    about: str
    source: str

    @property
    def thrust_to_weight(self) -> float:
        """Largest total thrust over the weight."""
        return 4.0 * self.kappa

    def values(self) -> dict[str, Any]:
        """Keyword arguments of an environment."""
        return {entry.name: getattr(self.params, entry.name) for entry in fields(self.params)} | {
            "kappa": self.kappa
        }


def _vehicle(params: QuadrotorParams, force_max: float, about: str, source: str) -> Vehicle:
    """A vehicle with rotors of force_max, N, each."""
    return Vehicle(params, round(force_max / params.weight, 4), about, source)


VEHICLES: dict[str, Vehicle] = {
    "dissertation": Vehicle(
        QuadrotorParams(),
        1.0,
        "0.8 kg, plus frame; the default",
        "G. Ru, Nonlinear Model Predictive Control for Cooperative Control and Estimation, 2017, section 9.4",
    ),
    "crazyflie": _vehicle(
        QuadrotorParams(
            mass=0.027,  # with battery, without deck or markers
            gravity=9.81,
            inertia=(16.571710e-6, 16.655602e-6, 29.261652e-6),  # products below 11 % left out
            arm=0.046,
            yaw_moment=0.005964552,
            rotor_rate=15.5,  # pole 0.9695404 of the discrete model at 500 Hz
            drag=0.0071,  # mean of 9.18e-7 and 10.3e-7 kg/rad, times the rotor speeds in hover, 7450 rad/s
            frame="x",
        ),
        0.1597,  # the thrust curve at full command
        "27 g, x frame, Crazyflie 2.0",
        "J. Foerster, System Identification of the Crazyflie 2.0 Nano Quadrocopter, ETH Zurich, 2015; "
        "mass from the data sheet of Bitcraze",
    ),
    "iris": _vehicle(
        QuadrotorParams(
            mass=1.5,
            gravity=9.81,
            inertia=(0.029125, 0.029125, 0.055225),
            arm=0.247,  # mean of 0.256 in front and 0.239 behind; the real one is wider than long, no square
            yaw_moment=0.06,
            rotor_rate=53.3,  # mean of the time constants 12.5 ms up and 25 ms down
            frame="x",
        ),
        7.07,  # 5.84e-6 (1100 rad/s)^2
        "1.5 kg, x frame, 3DR Iris",
        "PX4 sitl_gazebo, models/iris; descended from RotorS, F. Furrer et al., 2016",
    ),
    "hummingbird": _vehicle(
        QuadrotorParams(
            mass=0.716,  # body 0.68 and four rotors of 9 g
            gravity=9.81,
            inertia=(0.007, 0.007, 0.012),
            arm=0.17,
            yaw_moment=0.016,
            rotor_rate=53.3,  # mean of the time constants 12.5 ms up and 25 ms down
        ),
        6.0,  # 8.55e-6 (838 rad/s)^2
        "0.72 kg, plus frame, AscTec Hummingbird",
        "RotorS, rotors_description/urdf/hummingbird.xacro; F. Furrer et al., RotorS - A Modular Gazebo MAV "
        "Simulator Framework, 2016, after J. Wang et al.",
    ),
}


def vehicle_values(name: object) -> dict[str, Any]:
    """Keyword arguments of a named vehicle, which single ones may override.

    Raises:
        ValueError: If there is no vehicle of that name.
    """
    if not isinstance(name, str) or name not in VEHICLES:
        many = "; how many there are is said by vehicles" if isinstance(name, int) else ""
        raise ValueError(unknown_name("vehicle", str(name)[:80], list(VEHICLES)) + many)
    return VEHICLES[name].values()
