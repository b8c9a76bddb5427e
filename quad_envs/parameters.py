"""What a person chooses about a vehicle: parameters, limits and weights. SI units, validated, frozen."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from .arguments.checks import Bound, require_number
from .arguments.kinds import is_number, require_kinds
from .arguments.names import shown
from .limits import Limits as Limits
from .plant import ATTITUDE as ATTITUDE
from .plant import FORCES as FORCES
from .plant import N_INPUT as N_INPUT
from .plant import N_STATE as N_STATE
from .plant import POSITION as POSITION
from .plant import RATES as RATES
from .plant import VELOCITY as VELOCITY
from .plant import Array as Array

# Entries of QuadrotorParams.coefficients(), the form in which compiled kernels read a vehicle.
(
    GRAVITY,  # m/s^2
    INV_MASS,  # 1/kg
    DRAG_RATE,  # 1/s, drag / mass
    GYRO_X,  # (Jy - Jz) / Jx
    GYRO_Y,  # (Jz - Jx) / Jy
    GYRO_Z,  # (Jx - Jy) / Jz
    ROLL_GAIN,  # L cos(delta) / Jx, rad/s^2 per N
    PITCH_GAIN,  # L cos(delta) / Jy, rad/s^2 per N
    YAW_GAIN,  # c / Jz, rad/s^2 per N
    INV_JX,  # 1/(kg m^2)
    INV_JY,
    INV_JZ,
    ROLL_CROSS,  # L sin(delta) / Jx, rad/s^2 per N, 0 with the arms along the axes
    PITCH_CROSS,  # L sin(delta) / Jy, rad/s^2 per N
    ROTOR_RATE,  # lambda_F, 1/s
    HOVER_FORCE,  # u_T, N
) = range(16)
N_COEFFICIENTS = 16
N_MOTION_COEFFICIENTS = 14  # the first ones, of the rigid body
FRAMES = {"plus": 0.0, "x": math.pi / 4.0}  # delta, rad: from the x axis to the arm of rotor 1


_FLYING = "no multicopter, from the smallest robot insects to air taxis on any planet, is beyond"
# What a parameter may be; beyond, numbers overflow or vanish in the equations of motion.
_BOUNDS = {
    "mass": Bound(1e-5, 1e5, "kg", _FLYING),
    "gravity": Bound(1e-3, 1e3, "m/s^2", _FLYING),
    "arm": Bound(1e-4, 1e2, "m", _FLYING),
    "yaw_moment": Bound(1e-7, 1e1, "m", _FLYING),
    "rotor_rate": Bound(1e-2, 1e5, "1/s", "a rotor answers within microseconds to minutes"),
    "drag": Bound(0.0, 1e5, "kg/s", _FLYING),
}
_MOMENT = Bound(1e-12, 1e6, "kg m^2", _FLYING)
_ROUNDING = 1e-9  # relative, of principal moments that are given as decimals
MOST_WEIGHT = 1e15  # of Q and R; beyond, the cost of a flight leaves the numbers
_LEAST_WEIGHT = 1e-15  # of R


def require_inertia(inertia: tuple[float, float, float]) -> None:
    """Check that a body can have these principal moments (Jx, Jy, Jz), kg m^2.

    They are integrals of y^2 + z^2, x^2 + z^2 and x^2 + y^2: none exceeds the sum of the others.

    Raises:
        ValueError: If no body can.
    """
    total = sum(inertia)
    for axis, moment in zip("xyz", inertia, strict=True):
        others = total - moment
        if moment > others * (1.0 + _ROUNDING):
            a, b = (name for name in "xyz" if name != axis)
            raise ValueError(
                f"inertia {tuple(inertia)!r} kg m^2 is that of no body: J{axis} = {moment:g} exceeds J{a} + "
                f"J{b} = {others:g} (a flat plate has equality); look at the order (Jx, Jy, Jz) and the units"
            )


@dataclass(frozen=True, slots=True)
class QuadrotorParams:
    """Physical parameters of a quadrotor, section 9.4 of the dissertation.

    Seen from above, rotors 1 to 4 follow each other clockwise. With the plus frame rotor 1 is in front, on
    the x axis; the x frame is turned clockwise by 45 degrees: front right, back right, back left, front left.
    Rotors 1 and 3 turn clockwise, and their drag turns the body the other way.

    Raises:
        ValueError: If a parameter is no number, or beyond every vehicle (drag may be zero), no body can have
            the inertia, or the frame is unknown.
    """

    mass: float = 0.8  # kg
    gravity: float = 9.8  # m/s^2
    inertia: tuple[float, float, float] = (0.0224, 0.0224, 0.0436)  # kg m^2, principal moments
    arm: float = 0.165  # m, centre to rotor
    yaw_moment: float = 0.002167  # m, yaw torque per rotor force
    rotor_rate: float = 50.0  # 1/s, lambda_F of Eq. (2.38), a rate and not a time constant
    drag: float = 0.0  # kg/s, linear drag on the body velocity (0 in the dissertation)
    frame: str = "plus"  # or "x"

    def __post_init__(self) -> None:
        for name, bound in _BOUNDS.items():
            require_number(name, getattr(self, name), bound)
        given = self.inertia if isinstance(self.inertia, tuple | list) else ()
        if len(given) != 3 or not all(map(is_number, given)):
            raise ValueError(f"inertia must be three numbers (Jx, Jy, Jz), kg m^2, got {shown(self.inertia)}")
        for axis, moment in zip("xyz", self.inertia, strict=True):
            require_number(f"inertia J{axis}", moment, _MOMENT)
        require_inertia(self.inertia)
        if not isinstance(self.frame, str) or self.frame not in FRAMES:
            raise ValueError(f"frame must be one of {', '.join(map(repr, FRAMES))}, got {shown(self.frame)}")

    @property
    def weight(self) -> float:
        """M g, N."""
        return self.mass * self.gravity

    @property
    def hover_force(self) -> float:
        """u_T = m g / 4, the force of each rotor in hover, N."""
        return self.weight / 4.0

    @property
    def arm_lengths(self) -> tuple[float, float]:
        """L cos(delta) and L sin(delta): the place of rotor 1, m."""
        along, across = self.arm_shares()
        return self.arm * along, self.arm * across

    def rotor_positions(self) -> Array:
        """Rotors 1 to 4 in body axes (forward, right), (4, 2), m."""
        a, b = self.arm_lengths
        return np.array([[a, b], [-b, a], [-a, -b], [b, -a]])

    def mixer(self) -> Array:
        """M with [T; tau] = M F, (4, 4): total thrust (N) and torques (N m) of the rotor forces."""
        x, y = self.rotor_positions().T
        spin = self.yaw_moment * np.array([-1.0, 1.0, -1.0, 1.0])
        return np.stack([np.ones(N_INPUT), -y, x, spin])

    def input_matrix(self) -> Array:
        """B_c of Eq. (2.35) with its missing thrust row restored, (12, 4)."""
        M = self.mixer()
        B = np.zeros((N_STATE, N_INPUT))
        B[5] = -M[0] / self.mass
        B[RATES] = M[1:] / np.array(self.inertia)[:, None]
        return B

    def coefficients(self, **varied: Array) -> Array:
        """What the equations of motion use of the parameters, in kernel order, (..., N_COEFFICIENTS).

        Args:
            varied: Of many vehicles: parameters that are not those of this one, (...), the inertia (..., 3).
        """
        mass, arm, yaw_moment, rotor_rate, drag = (
            varied.get(name, getattr(self, name))
            for name in ("mass", "arm", "yaw_moment", "rotor_rate", "drag")
        )
        Jx, Jy, Jz = np.moveaxis(np.asarray(varied.get("inertia", self.inertia)), -1, 0)
        along, across = (arm * share for share in self.arm_shares())
        parts = (
            self.gravity,
            1.0 / mass,
            drag / mass,
            (Jy - Jz) / Jx,
            (Jz - Jx) / Jy,
            (Jx - Jy) / Jz,
            along / Jx,
            along / Jy,
            yaw_moment / Jz,
            1.0 / Jx,
            1.0 / Jy,
            1.0 / Jz,
            across / Jx,
            across / Jy,
            rotor_rate,
            mass * self.gravity / 4.0,
        )
        return np.stack(np.broadcast_arrays(*parts), axis=-1)

    def arm_shares(self) -> tuple[float, float]:
        """Place of rotor 1, forward and right, in arm lengths."""
        delta = FRAMES[self.frame]
        return math.cos(delta), math.sin(delta)


@dataclass(frozen=True, slots=True)
class Weights:
    """Diagonals of Q and R of the stage cost |x - x_ref|_Q^2 + |u - u_T|_R^2, per sample.

    Raises:
        ValueError: If Q has a negative or R a non-positive entry, or a length is wrong.
    """

    Q: tuple[float, ...] = (1.0,) * N_STATE
    R: tuple[float, ...] = (1.0,) * N_INPUT

    def __post_init__(self) -> None:
        require_kinds(self)
        if len(self.Q) != N_STATE or len(self.R) != N_INPUT:
            raise ValueError(
                f"weights need {N_STATE} entries in Q and {N_INPUT} in R, got {len(self.Q)} and {len(self.R)}"
            )
        if not all(is_number(q) and 0.0 <= q <= MOST_WEIGHT for q in self.Q):
            raise ValueError(
                f"weights Q must be finite, >= 0 and at most {MOST_WEIGHT:g}, got {shown(self.Q)}"
            )
        if not all(is_number(r) and _LEAST_WEIGHT <= r <= MOST_WEIGHT for r in self.R):
            raise ValueError(
                f"weights R must be finite and > 0, from {_LEAST_WEIGHT:g} to {MOST_WEIGHT:g}, "
                f"got {shown(self.R)}"
            )

    def Q_matrix(self) -> Array:
        """Q, (12, 12)."""
        return np.diag(np.asarray(self.Q, dtype=np.float64))

    def R_matrix(self) -> Array:
        """R, (4, 4)."""
        return np.diag(np.asarray(self.R, dtype=np.float64))
