"""Four vehicles side by side in one block: a row of four numbers for each quantity, and the name of each row.

A block is one flat float64 array, in which entry `PHI + j` is the roll of the vehicle in lane j. What kernels
need for an instant has its rows in the block, too: with a second array in a loop over lanes, or with rows
unknown at compile time, LLVM cannot prove that nothing overlaps and takes one lane at a time.
"""

from __future__ import annotations

import numpy as np

from .compilation.decorators import Int, inline_kernel, inline_lane_kernel
from .limits import LIMITS
from .parameters import N_COEFFICIENTS
from .plant import N_INPUT, N_STATE, Array
from .references.table_row import N_TABLE
from .reward import LOSS_PARTS

LANES = 4  # one vector register of doubles

N_PLANT = N_STATE + N_INPUT
MOST_VALUES = len(LIMITS) + 1  # constraint values; a team's last one is the distance between vehicles

# The plant [p, V_B, Theta, Omega, F].
PLANT = 0
X, Y, Z, U, V, W, PHI, THETA, PSI, P, Q, R = range(PLANT, N_STATE * LANES, LANES)
FORCES = PLANT + N_STATE * LANES
COMMAND = PLANT + N_PLANT * LANES  # last rotor commands, N
CHANGE = COMMAND + N_INPUT * LANES  # of the rotor commands in the last step, N
SINES = CHANGE + N_INPUT * LANES  # sine and cosine of roll, pitch and yaw
SIN_PSI, COS_PSI = SINES + 4 * LANES, SINES + 5 * LANES
COEFFICIENTS = SINES + 6 * LANES  # of the true vehicle, QuadrotorParams.coefficients()
DECAY = COEFFICIENTS + N_COEFFICIENTS * LANES  # what is left after half a substep of what the rotors lack
FORCE_MAX = DECAY + LANES  # largest force of each rotor of the true vehicle, N
# Of the integrator.
MOVED = FORCE_MAX + N_INPUT * LANES  # the plant as it moves, before it is known to be finite
MOVED_FORCES = MOVED + N_STATE * LANES
TARGET = MOVED + N_PLANT * LANES  # forces to which the rotors tend, N
# Torque and force of the air at the stage times of a substep, 6 rows each.
AIR_FIRST = TARGET + N_INPUT * LANES
AIR_MIDDLE = AIR_FIRST + 6 * LANES
AIR_LAST = AIR_MIDDLE + 6 * LANES
FINITE = AIR_LAST + 6 * LANES  # whether the plant after the step is finite
N_FLIGHT = FINITE + LANES  # numbers of a block that only flies
# Of the task.
STEP = N_FLIGHT  # control steps since the reset
REWARD, STAGE_COST, COST, EPISODE_COST, CRASHED, TRUNCATED, VIOLATED, CLIPPED, CAUSE = range(
    STEP + LANES, STEP + 10 * LANES, LANES
)
VALUES = STEP + 10 * LANES  # constraint values, one per limit that is set
ACTION = VALUES + MOST_VALUES * LANES  # as it was asked for
WANTED = ACTION + N_INPUT * LANES  # row of the reference at the new time
N_TRACKING = WANTED + N_TABLE * LANES  # numbers of a block that follows a reference
# Of a team.
TERMS = N_TRACKING  # parts of the stage cost, then the scaled violation of each named constraint
FORMATION = TERMS + (len(LOSS_PARTS) - 1) * LANES  # the last part
VIOLATIONS = TERMS + len(LOSS_PARTS) * LANES
(
    SLOT_ERROR,  # m, distance to the wanted position
    NEAREST,  # m, distance to the nearest vehicle, smallest over the substeps
    TERMINATED,
    ALIVE,
    HEARD,  # messages received in this step
    MEASURES,  # whether it has the sensor
    LEFT,  # whether it crashed in an earlier step
    N_TEAM,  # numbers of a block of a team
) = range(VIOLATIONS + MOST_VALUES * LANES, VIOLATIONS + (MOST_VALUES + 8) * LANES, LANES)


# In these helpers `o` is the place of an entry in the block.
@inline_kernel
def four(w: Array, o: Int) -> tuple[float, float, float, float]:
    """Four quantities of one lane."""
    return w[o], w[o + LANES], w[o + 2 * LANES], w[o + 3 * LANES]


@inline_kernel
def six(w: Array, o: Int) -> tuple[float, ...]:
    """Six quantities of one lane."""
    return w[o], w[o + LANES], w[o + 2 * LANES], w[o + 3 * LANES], w[o + 4 * LANES], w[o + 5 * LANES]


@inline_kernel
def twelve(w: Array, o: Int) -> tuple[float, ...]:
    """Twelve quantities of one lane."""
    return six(w, o) + six(w, o + 6 * LANES)


@inline_kernel
def put_four(w: Array, o: Int, values: tuple[float, ...]) -> None:
    """Write four quantities of one lane."""
    w[o], w[o + LANES], w[o + 2 * LANES], w[o + 3 * LANES] = values


@inline_kernel
def put_six(w: Array, o: Int, values: tuple[float, ...]) -> None:
    """Write six quantities of one lane."""
    w[o], w[o + LANES], w[o + 2 * LANES] = values[0], values[1], values[2]
    w[o + 3 * LANES], w[o + 4 * LANES], w[o + 5 * LANES] = values[3], values[4], values[5]


@inline_kernel
def put_twelve(w: Array, o: Int, values: tuple[float, ...]) -> None:
    """Write twelve quantities of one lane."""
    put_six(w, o, values[:6])
    put_six(w, o + 6 * LANES, values[6:])


@inline_lane_kernel
def plus(x: tuple[float, ...], k: tuple[float, ...], h: float) -> tuple[float, ...]:
    """X + h k, twelve numbers."""
    return (
        x[0] + h * k[0],
        x[1] + h * k[1],
        x[2] + h * k[2],
        x[3] + h * k[3],
        x[4] + h * k[4],
        x[5] + h * k[5],
        x[6] + h * k[6],
        x[7] + h * k[7],
        x[8] + h * k[8],
        x[9] + h * k[9],
        x[10] + h * k[10],
        x[11] + h * k[11],
    )


@inline_kernel
def move_lane(source: Array, j: Int, target: Array, k: Int) -> None:
    """Copy all quantities of lane j to lane k of another block."""
    for row in range(0, source.size, LANES):
        target[row + k] = source[row + j]


class Blocks:
    """Vehicles in blocks, and one block more in which kernels may set some of them aside.

    Args:
        n: Number of vehicles.
        size: Numbers of a block.
        group: Vehicles that begin with a block of their own, as those of a team; None for all.
    """

    def __init__(self, n: int, size: int, group: int | None = None) -> None:
        self.n, self.group = n, group or n
        self.each = -(-self.group // LANES)  # blocks of a group
        self.array: Array = np.zeros((n // self.group * self.each + 1, size))

    @property
    def count(self) -> int:
        """Blocks that have vehicles."""
        return len(self.array) - 1

    def read(self, row: int, count: int = 1) -> Array:
        """Copy of one quantity of all vehicles, (n,), or of `count` that follow each other, (n, count)."""
        lanes = self._rows()[:-1, row // LANES : row // LANES + count].transpose(0, 2, 1)
        groups = np.ascontiguousarray(lanes).reshape(-1, self.each * LANES, count)[:, : self.group]
        found = groups.reshape(self.n, count)
        return found[:, 0] if count == 1 else found

    def write(self, row: int, values: Array, i: int | None = None) -> None:
        """Set quantities that follow each other: of vehicle i, or of all."""
        rows = slice(row // LANES, row // LANES + len(values))
        if i is None:
            self._rows()[:, rows] = values[:, None]
        else:
            group, place = divmod(i, self.group)
            self._rows()[group * self.each + place // LANES, rows, place % LANES] = values

    def _rows(self) -> Array:
        return self.array.reshape(len(self.array), -1, LANES)
