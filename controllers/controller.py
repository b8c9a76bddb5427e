"""What every controller offers, and the checks at its boundary."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import ArrayLike

from quad_envs.arguments.checks import array_bytes, require_whole
from quad_envs.compilation.decorators import kernel
from quad_envs.observations.tracking import N_REFERENCE
from quad_envs.parameters import N_INPUT, N_STATE, Array

from .disturbance import N_DISTURBANCE
from .qp.ocp import IntArray

PLANT_SIZE = N_STATE + N_INPUT
MOST_HORIZON = 1000  # samples; a solver fills matrices with the square of it
MOST_PASSES = 100  # through a problem in one decision
TURNING_ROWS = 3  # rows of a window from which a law without preview reads how the heading turns
_NAMES = ("plant", "window", "last_command", "disturbance", "memory")


class Decision(NamedTuple):
    """Commands for a batch of vehicles."""

    command: Array  # (n, 4), rotor commands F_cmd, N, finite and inside the box
    memory: Array  # (n, memory_size), opaque: pass it to the next decide
    fallback: IntArray  # (n,), Fallback: how each command was found
    iterations: IntArray  # (n,), active-set iterations
    left_model: IntArray | None = None  # (n,), 1 where its state or plan left where the model holds; None: 0


def require_horizon(horizon: Any) -> int:
    """The horizon N, samples.

    Raises:
        ValueError: If it is not a whole number that a solver's memory allows.
    """
    require_whole("horizon", horizon, 1, MOST_HORIZON, lambda N: array_bytes((2, N_INPUT * N, N_INPUT * N)))
    return int(horizon)


class Controller(Protocol):
    """A feedback law over a batch of vehicles; rows are independent, and only `memory` is remembered."""

    horizon: int  # stages of the reference window after the present one
    memory_size: int  # numbers that travel from sample to sample

    def decide(
        self,
        plant: ArrayLike,
        window: ArrayLike,
        last_command: ArrayLike,
        disturbance: ArrayLike,
        memory: ArrayLike,
    ) -> Decision:
        """One command per vehicle.

        Args:
            plant: Measured [p, V_B, Theta, Omega, F], (n, 16).
            window: Reference from now on, (n, >= horizon + 1, 8): p_ref, v_ref (inertial), sin and cos of
                psi_ref; positions in the frame of p.
            last_command: Last applied rotor commands, (n, 4), N.
            disturbance: Torque in body axes, N m, and force in inertial axes, N, as far as revealed, (n, 6).
            memory: Of the previous decision, (n, memory_size); zeros for a vehicle that starts.

        Returns:
            Commands, memory and how they were found.

        Raises:
            ValueError: If a shape is wrong or a number is not finite.
        """
        ...


def as_array(value: ArrayLike) -> Array:
    """Contiguous, float64 and writeable: of any other kind numba would compile the kernels anew."""
    array = np.ascontiguousarray(value, dtype=np.float64)
    return array if array.flags.writeable else array.copy()


def as_rows(
    plant: ArrayLike,
    window: ArrayLike,
    last_command: ArrayLike,
    disturbance: ArrayLike,
    memory: ArrayLike,
    stages: int,
    memory_size: int,
) -> tuple[Array, Array, Array, Array, Array]:
    """The arguments of `decide` as contiguous float64 arrays of matching shapes.

    Raises:
        ValueError: If a shape is wrong; it says which and what is expected.
    """
    plants = as_array(plant)
    windows = as_array(window)
    lasts = as_array(last_command)
    disturbances = as_array(disturbance)
    memories = as_array(memory)
    n = len(plants)
    shape = windows.shape
    if (
        plants.shape != (n, PLANT_SIZE)
        or len(shape) != 3
        or shape[0] != n
        or shape[1] < stages
        or shape[2] != N_REFERENCE
        or lasts.shape != (n, N_INPUT)
        or disturbances.shape != (n, N_DISTURBANCE)
        or memories.shape != (n, memory_size)
    ):
        wanted = (
            f"(n, {PLANT_SIZE})",
            f"(n, >= {stages}, {N_REFERENCE})",
            f"(n, {N_INPUT})",
            f"(n, {N_DISTURBANCE})",
            f"(n, {memory_size})",
        )
        got = (plants.shape, shape, lasts.shape, disturbances.shape, memories.shape)
        parts = (f"{name} {want}, got {have}" for name, want, have in zip(_NAMES, wanted, got, strict=True))
        raise ValueError("decide needs, for n vehicles: " + "; ".join(parts))
    return plants, windows, lasts, disturbances, memories


def as_one_row(
    plant: ArrayLike,
    window: ArrayLike,
    last_command: ArrayLike,
    disturbance: ArrayLike,
    memory: ArrayLike,
    stages: int,
    memory_size: int,
) -> tuple[Array, Array, Array, Array, Array]:
    """The arguments of `decide` for one vehicle, without the axis over vehicles.

    Raises:
        ValueError: If a shape is wrong or a number is not finite.
    """
    first, second, third, fourth, fifth = (
        np.asarray(value)[None] for value in (plant, window, last_command, disturbance, memory)
    )
    rows = as_rows(first, second, third, fourth, fifth, stages, memory_size)
    bad = first_non_finite(*rows, stages)
    if bad >= 0:
        raise_non_finite(bad)
    return rows[0][0], rows[1][0], rows[2][0], rows[3][0], rows[4][0]


@kernel
def all_finite(values: Array) -> bool:
    """Whether all numbers are finite; without a branch, so that it vectorises."""
    bad = 0
    for value in values:
        bad |= 0 if abs(value) < math.inf else 1
    return bad == 0


@kernel
def first_non_finite(
    plants: Array, windows: Array, lasts: Array, disturbances: Array, memories: Array, stages: int
) -> int:
    """-1 if all arguments of `decide` are finite, else 5 row + index of the argument."""
    for j in range(plants.shape[0]):
        if not all_finite(plants[j]):
            return 5 * j
        if not all_finite(windows[j, :stages].reshape(-1)):
            return 5 * j + 1
        if not all_finite(lasts[j]):
            return 5 * j + 2
        if not all_finite(disturbances[j]):
            return 5 * j + 3
        if not all_finite(memories[j]):
            return 5 * j + 4
    return -1


def code_of_row(row: int) -> int:
    """What the codes of `first_non_finite` are more where rows are counted from this one on."""
    return len(_NAMES) * row


def raise_non_finite(code: int) -> None:
    """Turn the result of `first_non_finite` into an error that names the argument and the row."""
    row, argument = divmod(code, len(_NAMES))
    remedy = "start from zeros and pass on what decide returned" if argument == 4 else "check the observation"
    raise ValueError(f"{_NAMES[argument]} of vehicle {row} is not finite; {remedy}")


class FeedbackLaw(ABC):
    """A controller without memory, decided in one compiled call; a window of one row will do."""

    memory_size = 0

    def decide(
        self,
        plant: ArrayLike,
        window: ArrayLike,
        last_command: ArrayLike,
        disturbance: ArrayLike,
        memory: ArrayLike,
    ) -> Decision:
        """One command per vehicle; see `Controller.decide`."""
        arrays = as_rows(plant, window, last_command, disturbance, memory, 1, 0)
        n = len(arrays[0])
        command, report = np.empty((n, N_INPUT)), np.empty((2, n), np.int64)
        bad = self._decide_rows(*arrays, command, report)
        if bad >= 0:
            raise_non_finite(bad)
        return Decision(command, np.empty((n, 0)), report[0], report[1])

    @abstractmethod
    def _decide_rows(self, *arrays: Any) -> int:
        """Fill commands and report; -1, or the code of the first argument that is not finite."""
