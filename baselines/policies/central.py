"""One MPC over the whole team, from the whole truth: a yardstick, not a policy among others."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from controllers.controller import Decision
from controllers.team.central import CentralMpc
from controllers.team.options import CentralOptions
from quad_envs.arguments.names import shown
from quad_envs.constraints import actions_from_forces
from quad_envs.observations.tracking import N_REFERENCE
from quad_envs.parameters import N_INPUT, Array
from quad_envs.tasks import TeamTask

from .protocol import Actions, PolicyState
from .rows import as_starts, require_finite, state_of, times_left


class CentralMpcPolicy:
    """`CentralMpc` on rows of the environment's `state()`: a row is a whole team, decided as one.

    Privileged: it knows the true states, the target's true motion, which it expects to go on at its velocity,
    and commands everybody. Plans in the actions are zero. Its memory is the controller's, whether the episode
    has begun, and the commands of the step before, N.

    Args:
        task: Of the mission "formation" or "target-tracking".
        options: See `CentralOptions`; None for the defaults.
        changes: Fields of it, such as horizon=10, which replace those of `options`.

    Raises:
        TypeError: If there is no such option.
        ValueError: If an option is not allowed, there are over 15 vehicles, or the task has no slots.
    """

    privileged = True
    name = "central-mpc"

    options_type = CentralOptions

    def __init__(self, task: TeamTask, options: CentralOptions | None = None, **changes: Any) -> None:
        self.task, self.controller = task, CentralMpc(task, options, **changes)
        self._slots = np.array(task.slots, dtype=np.float64)
        if self._slots.shape != (task.vehicles, 3):
            raise ValueError(f"central-mpc needs task.slots, one of each vehicle, got {shown(task.slots)}")
        self._slices = task.state_slices
        self._size = self._slices["time"].stop
        self.memory_size = self.controller.memory_size + 1 + N_INPUT * task.vehicles

    def __repr__(self) -> str:
        return f"{type(self).__name__}({self.name!r}, {self.task.env_id!r})"

    def predict(
        self,
        observation: NDArray[Any],
        state: PolicyState | None = None,
        episode_start: ArrayLike | None = None,
        deterministic: bool = True,
    ) -> tuple[Actions, PolicyState]:
        """Choose the actions of whole teams.

        Args:
            observation: `env.state()`, (n, S), or (S,) for one team.
            state: What the previous call returned; None at the beginning.
            episode_start: (n,) bool, rows that begin an episode; None for none (or all, when state is None).
            deterministic: Ignored.

        Returns:
            Actions (n, N, action_size) float32, or (N, action_size) for one team, and the state to pass on.

        Raises:
            ValueError: If a shape is wrong, or a number is not finite: it names the team's row and the part.
        """
        rows = np.asarray(observation, dtype=np.float64)
        one = rows.ndim == 1
        rows = rows[None] if one else rows
        if rows.ndim != 2 or rows.shape[1] != self._size:
            raise ValueError(
                f"{self.name} sees env.state(), (n, {self._size}) or ({self._size},), got shape "
                f"{np.shape(observation)}"
            )
        require_finite(rows, self._slices)
        n, start = len(rows), as_starts(episode_start, len(rows))
        state = state_of(state, n, self.memory_size)
        actions = np.zeros((n, self.task.vehicles, self.task.action_size), dtype=np.float32)
        memory = np.where(start[:, None], 0.0, state.memory)
        fallbacks = np.where(start[:, None], 0, state.fallbacks)
        left: NDArray[np.int64] = np.where(start, 0, times_left(state))
        iterations = np.zeros(n, dtype=np.int64)
        for j in range(n):
            actions[j, :, :N_INPUT], memory[j], decision = self._decide(rows[j], memory[j])
            iterations[j] = decision.iterations[0]
            fallbacks[j, decision.fallback[0]] += 1
            left[j] += np.any(decision.left_model)
        worst = np.maximum(iterations, np.where(start, 0, state.worst_iterations))
        kept = PolicyState(memory, fallbacks, iterations, worst, left_model=left)
        return actions[0] if one else actions, kept

    def _decide(self, row: Array, memory: Array) -> tuple[Actions, Array, Decision]:
        """Actions (N, 4) of one team, its memory, and how they were found."""
        task, size = self.task, self.controller.memory_size
        plants = row[self._slices["plants"]].reshape(task.vehicles, -1)
        last = np.full((task.vehicles, N_INPUT), task.hover_force)
        if memory[size] > 0.0:
            last = memory[size + 1 :].reshape(task.vehicles, N_INPUT)
        decision = self.controller.decide(plants, self._preview(row), self._slots, last, memory[:size])
        actions = actions_from_forces(decision.command, task.hover_force, task.force_max)
        kept = np.concatenate([decision.memory, [1.0], decision.command.ravel()])
        return actions, kept, decision

    def _preview(self, row: Array) -> Array:
        """Rows (stages, 8) that the slots are relative to: the leader's, or the target as it goes on."""
        if not self.task.layout.target:
            return row[self._slices["preview"]].reshape(-1, N_REFERENCE)
        r, v = np.split(row[self._slices["target"]], 2)
        ahead = self.task.dt * np.arange(self.controller.horizon + 1)
        out = np.zeros((len(ahead), N_REFERENCE))
        out[:, :3], out[:, 3:6], out[:, 7] = r + ahead[:, None] * v, v, 1.0
        return out
