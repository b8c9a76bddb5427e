"""What a controller does when its quadratic program has no answer.

A failure is a value, never an exception: each decision says how it was found, and its command is always
finite and inside the rotor box.
"""

from __future__ import annotations

from enum import IntEnum

from quad_envs.compilation.decorators import kernel
from quad_envs.parameters import N_INPUT, Array


class Fallback(IntEnum):
    """How a command was found, from best to worst."""

    NONE = 0  # the quadratic program as posed
    RELAXED = 1  # hard state rows contradicted each other and were made soft, with weight RELAXED_WEIGHT
    PREVIOUS_PLAN = 2  # the plan of the previous sample, shifted by one
    CLIPPED_SDRE = 3  # first input of the plan without constraints, clipped
    HOVER = 4  # u_T, clipped


NONE, RELAXED, PREVIOUS_PLAN, CLIPPED_SDRE, HOVER = range(5)  # the members of Fallback, for compiled code
RELAXED_WEIGHT = 1e4  # exact penalty per unit of a row that was hard


@kernel
def limit_command(F: Array, last: Array, rate_step: float, force_max: Array, out: Array) -> None:
    """Bring a command to within one rate step of the last one where the box allows it, always into the box.

    Args:
        F: Wanted rotor commands, (4,), N; an entry that is not finite becomes the last command.
        last: Last applied commands, (4,), N.
        rate_step: Largest change, N; inf for none.
        force_max: Upper face of the box, (4,), N.
        out: Result, (4,).
    """
    for a in range(N_INPUT):
        value = F[a] if abs(F[a]) < 1e300 else last[a]
        value = min(max(value, last[a] - rate_step), last[a] + rate_step)
        out[a] = min(max(value, 0.0), force_max[a])


@kernel
def yield_yaw(F: Array, last: Array, rate_step: float, force_max: Array) -> None:
    """Take back the yaw torque for which the rotors have no room beside thrust, roll and pitch; in place.

    Clipped rotor by rotor, a large yaw error would cost the roll and pitch that keep a vehicle in the air. A
    wish within the box stays as it is.

    Args:
        F: Wanted rotor commands, (4,), N.
        last: Last applied commands, (4,), N.
        rate_step: Largest change, N; inf for none.
        force_max: Upper face of the box, (4,), N.
    """
    yaw = 0.25 * (F[1] + F[3] - F[0] - F[2])  # the mixer's row of the yaw torque
    share = 1.0
    for a in range(N_INPUT):
        part = yaw if a % 2 == 1 else -yaw
        rest = F[a] - part
        low, high = max(0.0, last[a] - rate_step), min(force_max[a], last[a] + rate_step)
        room = max(high - rest if part > 0.0 else rest - low, 0.0)
        if abs(part) > room:
            share = min(share, room / abs(part))
    if share < 1.0:
        for a in range(N_INPUT):
            F[a] -= (1.0 - share) * (yaw if a % 2 == 1 else -yaw)
