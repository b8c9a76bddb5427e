"""True vehicles whose parameters are drawn around those of the nominal one."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from ...compilation.decorators import entry_of, kernel
from ...compilation.packed import IntArray
from ...dynamics import place_vehicle
from ...lanes import LANES, Blocks
from ...parameters import N_COEFFICIENTS
from ...plant import N_INPUT, Array
from ...tasks import BaseTask
from .vehicle_options import varied

# The numbers of a vehicle that may vary, and those that do not.
_NUMBERS = {"mass": slice(0, 1), "inertia": slice(1, 4), "arm": slice(4, 5), "kappa": slice(5, 6)}
_NUMBERS |= {"rotor_rate": slice(6, 7), "drag": slice(7, 8)}
_MASS, _JX, _JY, _JZ, _ARM, _KAPPA, _ROTOR_RATE, _DRAG, _N_VARIED = range(9)
_GRAVITY, _YAW_MOMENT, _ALONG, _ACROSS = range(4)
_N_WORK = _N_VARIED + N_COEFFICIENTS + N_INPUT


class RandomVehicles(NamedTuple):
    """How vehicles vary about the nominal one."""

    columns: IntArray  # the number that each uniform number varies, (k,)
    spreads: Array  # its largest relative change, (k,)
    nominal: Array  # those that may vary, kappa as a factor, (8,)
    fixed: Array  # gravity, yaw moment, and where rotor 1 is, in arm lengths, (4,)
    force_max: Array  # largest force of each rotor, (4,), N

    def place(self, uniform: Array, index: IntArray, vehicles: Blocks, h: float) -> None:
        """Let vehicles (m,) be those of uniform numbers (m, k) in [0, 1); h is a substep, s."""
        work = np.empty(_N_WORK)
        _place_random(np.ascontiguousarray(uniform), *self, h, index, vehicles.group, vehicles.array, work)


def random_vehicles(task: BaseTask, randomization: Mapping[str, float]) -> RandomVehicles:
    """What is drawn of the vehicles of a task.

    Args:
        task: With the nominal vehicle.
        randomization: Parameter -> largest relative change, in the order in which they are drawn.
    """
    places = {name: range(_NUMBERS[name].start, _NUMBERS[name].stop) for name in randomization}
    params, nominal = task.params, np.ones(_N_VARIED)
    for name, where in _NUMBERS.items():
        if name != "kappa":
            nominal[where] = getattr(params, name)
    along, across = params.arm_shares()
    return RandomVehicles(
        columns=np.array([k for where in places.values() for k in where], dtype=np.int64),
        spreads=np.array([randomization[name] for name, where in places.items() for _ in where]),
        nominal=nominal,
        fixed=np.array([params.gravity, params.yaw_moment, along, across]),
        force_max=np.array(task.force_max, dtype=np.float64),
    )


def drawn_vehicles(task: BaseTask, randomization: Mapping[str, float], uniform: Array) -> tuple[Array, Array]:
    """Coefficients (m, N_COEFFICIENTS) and rotor limits (m, 4), the readable twin of `place_random`."""
    factors, at = {}, 0
    for name, spread in randomization.items():
        size = _NUMBERS[name].stop - _NUMBERS[name].start
        share = uniform[:, at] if size == 1 else uniform[:, at : at + size]
        factors[name] = 1.0 + spread * (2.0 * share - 1.0)
        at += size
    strength = factors.get("kappa", np.ones(len(uniform)))
    return task.params.coefficients(**varied(task.params, factors)), strength[:, None] * task.force_max


@kernel
def place_random(
    uniform: Array,
    columns: IntArray,
    spreads: Array,
    nominal: Array,
    fixed: Array,
    force_max: Array,
    h: float,
    index: IntArray,
    group: int,
    blocks: Array,
    work: Array,
) -> None:
    """Write vehicles into their blocks; `QuadrotorParams.coefficients` and `varied`, compiled.

    Args:
        uniform: Numbers in [0, 1), (m, k).
        columns: As the next ones, see `RandomVehicles`.
        spreads: (k,).
        nominal: (8,).
        fixed: (4,).
        force_max: (4,), N.
        h: Substep, s.
        index: Vehicles, (m,).
        group: Vehicles that begin with a block of their own.
        blocks: All blocks.
        work: Overwritten, (_N_WORK,).
    """
    v, c, most = work[:_N_VARIED], work[_N_VARIED : _N_WORK - N_INPUT], work[_N_WORK - N_INPUT :]
    each = -(-group // LANES)
    for m in range(index.size):
        for k in range(v.size):
            v[k] = nominal[k]
        for k in range(columns.size):
            v[columns[k]] *= 1.0 + spreads[k] * (2.0 * uniform[m, k] - 1.0)
        total = v[_JX] + v[_JY] + v[_JZ]
        Jx, Jy, Jz = (
            min(v[_JX], total - v[_JX]),
            min(v[_JY], total - v[_JY]),
            min(v[_JZ], total - v[_JZ]),
        )
        along, across = v[_ARM] * fixed[_ALONG], v[_ARM] * fixed[_ACROSS]
        c[0], c[1], c[2] = fixed[_GRAVITY], 1.0 / v[_MASS], v[_DRAG] / v[_MASS]
        c[3], c[4], c[5] = (Jy - Jz) / Jx, (Jz - Jx) / Jy, (Jx - Jy) / Jz
        c[6], c[7], c[8] = along / Jx, along / Jy, fixed[_YAW_MOMENT] / Jz
        c[9], c[10], c[11] = 1.0 / Jx, 1.0 / Jy, 1.0 / Jz
        c[12], c[13], c[14] = across / Jx, across / Jy, v[_ROTOR_RATE]
        c[15] = v[_MASS] * fixed[_GRAVITY] / 4.0
        for i in range(N_INPUT):
            most[i] = v[_KAPPA] * force_max[i]
        place = index[m] % group
        block = index[m] // group * each + place // LANES
        place_vehicle(blocks[block], place % LANES, c, most, h)


_place_random = entry_of(place_random)
