"""Observations with an estimate of the disturbance behind them, as the MPCs' own estimator finds it.

What a one-step prediction of the nominal vehicle does not explain, low-passed: wind, and whatever else
differs from the nominal model. Networks cannot remember; this is what they are given of the past.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from controllers.disturbance import (
    ESTIMATOR_SCRATCH,
    ESTIMATOR_SIZE,
    N_DISTURBANCE,
    PLANT_SIZE,
    remember,
    update_estimate,
)
from controllers.mpc.estimator_gain import estimator_gains
from quad_envs.compilation.decorators import entry_of, kernel
from quad_envs.observations.features import Features
from quad_envs.observations.tracking import decode_own
from quad_envs.parameters import N_INPUT, Array
from quad_envs.tasks import BaseTask, Task, TeamTask

Bools = NDArray[np.bool_]
Floats = NDArray[np.float32]
AnyTask = TypeVar("AnyTask", bound=Task | TeamTask)
_PART = "disturbance_estimate"  # of a layout, and of the names of features
_COMMAND = slice(ESTIMATOR_SIZE - N_INPUT, ESTIMATOR_SIZE)  # in the estimator's memory
_SCRATCH = PLANT_SIZE + N_INPUT + 2 * N_DISTURBANCE + ESTIMATOR_SCRATCH


@kernel
def append_estimates(
    obs: Floats,
    start: Bools,
    revealed_at: int,
    gain: Array,
    c: Array,
    dt: float,
    force_max: Array,
    memory: Array,
    out: Floats,
    scratch: Array,
) -> None:
    """Write observations with the estimates behind them.

    Args:
        obs: (n, d).
        start: (n,), rows that begin an episode: nothing is known of the disturbance.
        revealed_at: Where a revealed disturbance stands in an observation; -1 for none.
        gain: Of the estimator, (6,).
        c: QuadrotorParams.coefficients().
        dt: Control period, s.
        force_max: Largest force of each rotor, (4,), N.
        memory: Of the estimators, (n, ESTIMATOR_SIZE); brought up to date.
        out: Result, (n, d + 6).
        scratch: Overwritten, (_SCRATCH,).
    """
    d = obs.shape[1]
    plant, command = scratch[:PLANT_SIZE], scratch[PLANT_SIZE : PLANT_SIZE + N_INPUT]
    rest = scratch[PLANT_SIZE + N_INPUT :]
    estimate, revealed, work = (
        rest[:N_DISTURBANCE],
        rest[N_DISTURBANCE : 2 * N_DISTURBANCE],
        rest[2 * N_DISTURBANCE :],
    )
    for j in range(obs.shape[0]):
        kept = memory[j]
        plant[:3] = 0.0  # positions do not enter
        decode_own(obs[j], plant, command)
        if start[j]:
            kept[:] = 0.0
        before = kept[_COMMAND]
        for i in range(N_INPUT):
            before[i] = command[i]
        update_estimate(plant, kept, gain, c, dt, force_max, estimate, work)
        for i in range(N_DISTURBANCE):
            revealed[i] = obs[j, revealed_at + i] if revealed_at >= 0 else 0.0
        remember(plant, command, revealed, estimate, kept)
        for i in range(d):
            out[j, i] = obs[j, i]
        for i in range(N_DISTURBANCE):
            out[j, d + i] = estimate[i]


_append = entry_of(append_estimates)


def sees_estimate(features: Features) -> bool:
    """Whether a network with these features is to be given the estimate."""
    return any(name.startswith(_PART) for name in features.names)


def with_estimate(task: AnyTask) -> AnyTask:
    """The task as who is given the estimate sees it."""
    layout: Any = replace(task.layout, disturbance_estimate=True)
    return replace(task, layout=layout)


class DisturbanceEstimator:
    """Estimators of the disturbance, one per row of observations: of one vehicle, or of an agent of a team.

    Each knows its own row alone. Their gain follows from the `sensor_noise` of the task, as that of the MPCs.
    What they know stands in the memory that the caller keeps, (n, `memory_size`), zeros at first.

    Args:
        task: Where observations come from.

    Raises:
        ValueError: If it is one in which rotors command nothing.
    """

    memory_size = ESTIMATOR_SIZE

    def __init__(self, task: BaseTask) -> None:
        if not isinstance(task, Task | TeamTask) or task.mission == "estimation":
            raise ValueError(
                f"disturbances are estimated of vehicles that fly, and {task.env_id} is a task of "
                f"{task.mission}"
            )
        self.task = with_estimate(task)
        revealed = task.layout.slices.get("disturbance")
        self._revealed_at = -1 if revealed is None else revealed.start
        self._gain, self._coefficients = estimator_gains(task), task.params.coefficients()
        self._dt, self._force_max = float(task.dt), task.force_max
        self._scratch = np.empty(_SCRATCH)

    def extend(self, observations: NDArray[Any], memory: Array, start: Bools) -> tuple[Floats, Array]:
        """Observations of the extended task.

        Args:
            observations: (n, d), float32, finite.
            memory: What the previous call returned, (n, memory_size); it is left as it is.
            start: (n,), rows that begin an episode.

        Returns:
            Observations with torque (body axes, N m) and force (inertial axes, N) behind them, (n, d + 6),
            and the memory.
        """
        obs = np.ascontiguousarray(observations, dtype=np.float32)
        out = np.empty((len(obs), obs.shape[1] + N_DISTURBANCE), dtype=np.float32)
        kept: Array = np.array(memory, dtype=np.float64)
        _append(
            obs, start, self._revealed_at, self._gain, self._coefficients, self._dt, self._force_max,
            kept, out, self._scratch,
        )  # fmt: skip
        return out, kept
