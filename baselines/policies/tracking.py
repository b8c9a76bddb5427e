"""The controllers as policies: observation rows in, controller, actions out."""

from __future__ import annotations

import zlib
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from controllers.controller import TURNING_ROWS, Controller, Decision
from quad_envs.arguments.checks import require_whole
from quad_envs.compilation.decorators import kernel
from quad_envs.constraints import action_from_force, forces_from_actions
from quad_envs.observations.tracking import N_OWN, N_REFERENCE, decode_own
from quad_envs.parameters import Array
from quad_envs.tasks import Task

from .protocol import N_FALLBACKS, Actions, Counts, PolicyState
from .row_policy import Flags, RowPolicy
from .rows import first_not_finite, not_finite, times_left

_PLANT_SIZE, _N_DISTURBANCE = 16, 6


@kernel
def _decode(
    obs: Actions,
    start: NDArray[np.bool_],
    sees_position: bool,
    sees_disturbance: bool,
    plants: Array,
    windows: Array,
    lasts: Array,
    disturbances: Array,
) -> int:
    """Split observations into the arguments of a controller.

    The position is the observed one, else zero: then the window is relative to the vehicle.

    Args:
        obs: (n, d) float32, see `quad_envs.observations.tracking`.
        start: (n,) bool, rows that begin an episode.
        sees_position: Whether the observation has `position`.
        sees_disturbance: Whether it has `disturbance`.
        plants: Output, (n, 16).
        windows: Output, (n, stages, 8).
        lasts: Output, (n, 4).
        disturbances: Output, (n, 6).

    Returns:
        Flat index of the first entry that is not finite, or -1 - the number of rows that begin an episode.
    """
    n, size = obs.shape
    stages = windows.shape[1]
    starting = 0
    for j in range(n):
        row, plant, window = obs[j], plants[j], windows[j].reshape(-1)
        bad = first_not_finite(row)
        if bad >= 0:
            return int(j * size + bad)
        decode_own(row, plant, lasts[j])
        at = N_OWN
        for i in range(3):
            plant[i] = row[at + i] if sees_position else 0.0
        at += 3 if sees_position else 0
        for i in range(6):
            disturbances[j, i] = row[at + i] if sees_disturbance else 0.0
        at += 6 if sees_disturbance else 0
        for i in range(window.size):
            window[i] = row[at + i]
        for q in range(stages):
            for i in range(3):
                windows[j, q, i] += plant[i]
        starting += 1 if start[j] else 0
    return -1 - starting


@kernel
def encode_commands(
    commands: Array,
    fallback: Counts,
    iterations: Counts,
    left: Counts,
    start: NDArray[np.bool_],
    counts: Counts,
    worst: Counts,
    times_left: Counts,
    hover: float,
    force_max: Array,
    actions: Actions,
    new_counts: Counts,
    new_worst: Counts,
    new_left: Counts,
) -> None:
    """Commands to actions, and the episode's statistics brought up to date.

    Args:
        commands: (n, 4), N.
        fallback: (n,), how each was found.
        iterations: (n,).
        left: (n,), 1 where it left the validity of its model.
        start: (n,) bool, rows whose statistics begin anew.
        counts: Statistics so far, (n, 5).
        worst: Statistics so far, (n,).
        times_left: Statistics so far, (n,).
        hover: Force of action 0, N.
        force_max: Force of action 1 of each rotor, (4,), N.
        actions: Output, (n, 4) float32.
        new_counts: Output, (n, 5).
        new_worst: Output, (n,).
        new_left: Output, (n,).
    """
    for j in range(commands.shape[0]):
        for i in range(4):
            actions[j, i] = action_from_force(commands[j, i], hover, force_max[i])
        for i in range(N_FALLBACKS):
            new_counts[j, i] = 0 if start[j] else counts[j, i]
        new_counts[j, fallback[j]] += 1
        new_worst[j] = iterations[j] if start[j] else max(iterations[j], worst[j])
        new_left[j] = left[j] + (0 if start[j] else times_left[j])


class Seen(NamedTuple):
    """What a policy was given, decoded."""

    obs: Actions  # (n, d)
    start: NDArray[np.bool_]  # (n,)
    state: PolicyState
    arguments: tuple[Array, Array, Array, Array, Array]  # of `Controller.decide`


class ControllerPolicy(RowPolicy):
    """A controller as a policy for tracking observations.

    Args:
        controller: The feedback law.
        task: From which it was built.
        name: For tables and messages.
    """

    task: Task

    def __init__(self, controller: Controller, task: Task, name: str) -> None:
        super().__init__(task, name, controller.memory_size)
        self.controller = controller
        self._stages = max(controller.horizon + 1, min(task.layout.preview + 1, TURNING_ROWS))
        self._hover, self._force_max = float(task.hover_force), task.force_max
        self._sees = bool(task.layout.position), bool(task.layout.disturbance)

    def _decide(self, obs: Actions, state: PolicyState, start: Flags) -> tuple[Actions, PolicyState]:
        seen = self._read(obs, state, start)
        return self._answer(seen, self.controller.decide(*seen.arguments))

    def _read(self, obs: Actions, state: PolicyState, start: Flags) -> Seen:
        """The arguments of `Controller.decide`."""
        n = obs.shape[0]
        plants, lasts = np.empty((n, _PLANT_SIZE)), np.empty((n, 4))
        windows, disturbances = np.empty((n, self._stages, N_REFERENCE)), np.empty((n, _N_DISTURBANCE))
        code = _decode(obs, start, *self._sees, plants, windows, lasts, disturbances)
        if code >= 0:
            raise not_finite(obs, code, self.task.layout.slices)
        memory = state.memory if code == -1 else np.where(start[:, None], 0.0, state.memory)
        return Seen(obs, start, state, (plants, windows, lasts, disturbances, memory))

    def _answer(self, seen: Seen, decision: Decision) -> tuple[Actions, PolicyState]:
        """Actions of a decision, (n, 4), and the state to pass on."""
        n = seen.obs.shape[0]
        actions = np.empty((n, 4), dtype=np.float32)
        counts, worst = np.empty((n, N_FALLBACKS), dtype=np.int64), np.empty(n, dtype=np.int64)
        left = np.empty(n, dtype=np.int64)
        encode_commands(
            decision.command,
            decision.fallback,
            decision.iterations,
            _zeros(n) if decision.left_model is None else decision.left_model,
            seen.start,
            seen.state.fallbacks,
            seen.state.worst_iterations,
            times_left(seen.state),
            self._hover,
            self._force_max,
            actions,
            counts,
            worst,
            left,
        )
        return actions, PolicyState(decision.memory, counts, decision.iterations, worst, left_model=left)


class Hover:
    """Hover thrust, whatever happens: the least that a policy must beat.

    Args:
        task: What is known of the flight.
    """

    horizon = 0
    memory_size = 0

    def __init__(self, task: Task) -> None:
        self._force = float(task.hover_force)

    def decide(
        self,
        plant: ArrayLike,
        window: ArrayLike,
        last_command: ArrayLike,
        disturbance: ArrayLike,
        memory: ArrayLike,
    ) -> Decision:
        """Hover commands; see `Controller.decide`."""
        n = len(np.asarray(plant))
        return Decision(np.full((n, 4), self._force), np.zeros((n, 0)), _zeros(n), _zeros(n))


class Random:
    """Uniform random actions, a pure function of seed, first observation of the episode and step.

    Args:
        task: What is known of the flight.
        seed: Of all draws, >= 0.

    Raises:
        ValueError: If the seed is not a whole number >= 0.
    """

    horizon = 0
    memory_size = 2  # stream of the episode, step

    def __init__(self, task: Task, seed: int = 0) -> None:
        require_whole("seed", seed, 0)
        self._seed, self._hover, self._force_max = int(seed), float(task.hover_force), task.force_max

    def decide(
        self,
        plant: ArrayLike,
        window: ArrayLike,
        last_command: ArrayLike,
        disturbance: ArrayLike,
        memory: ArrayLike,
    ) -> Decision:
        """Random commands; see `Controller.decide`."""
        plants, windows = np.asarray(plant), np.asarray(window)
        kept: Array = np.array(memory, dtype=np.float64)
        actions = np.empty((len(plants), 4))
        for j, (stream, step) in enumerate(kept.tolist()):
            if step == 0.0:
                stream = zlib.crc32(windows[j, 0].tobytes(), zlib.crc32(plants[j].tobytes()))
            bits = np.random.Philox(key=[self._seed, int(stream)], counter=[int(step), 0, 0, 0])
            actions[j] = np.random.Generator(bits).uniform(-1.0, 1.0, 4)
            kept[j] = stream, step + 1.0
        n, command = len(plants), forces_from_actions(actions, self._hover, self._force_max)
        return Decision(command, kept, _zeros(n), _zeros(n))


def _zeros(n: int) -> Counts:
    return np.zeros(n, dtype=np.int64)
