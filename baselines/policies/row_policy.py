"""A policy whose rows are the observations of vehicles, each decided alone."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from quad_envs.tasks import Task, TeamTask

from .protocol import Actions, PolicyState
from .rows import as_rows, as_starts, state_of

Flags = NDArray[np.bool_]


class RowPolicy(ABC):
    """What such policies share: the checks of `predict`, and one row in, one action out.

    Args:
        task: What is known of the flight; nothing else is, but the rows.
        name: For tables and messages.
        memory_size: Numbers that a vehicle carries from step to step.
    """

    task: Task | TeamTask

    def __init__(self, task: Task | TeamTask, name: str, memory_size: int) -> None:
        self.task, self.name, self.memory_size = task, name, memory_size
        self._size = task.layout.size

    def __repr__(self) -> str:
        return f"{type(self).__name__}({self.name!r}, {self.task.env_id!r})"

    def predict(
        self,
        observation: NDArray[Any],
        state: PolicyState | None = None,
        episode_start: ArrayLike | None = None,
        deterministic: bool = True,
    ) -> tuple[Actions, PolicyState]:
        """Choose actions; see `Policy`.

        Raises:
            ValueError: If a shape is wrong or an observation is not finite; it names the part.
        """
        obs, one = as_rows(observation, self._size)
        start = as_starts(episode_start, len(obs))
        actions, kept = self._decide(obs, state_of(state, len(obs), self.memory_size), start)
        return actions[0] if one else actions, kept

    @abstractmethod
    def _decide(self, obs: Actions, state: PolicyState, start: Flags) -> tuple[Actions, PolicyState]:
        """Actions (n, a) and the state of n rows; `start` flags those that begin an episode."""
