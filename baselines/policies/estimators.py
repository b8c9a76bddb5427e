"""What the estimators of a network append to observations: of a target, of the disturbance, or of both."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from quad_envs.arguments.names import shown
from quad_envs.observations.features import Features
from quad_envs.parameters import Array
from quad_envs.tasks import BaseTask, Task, TeamTask

from .disturbance_estimate import DisturbanceEstimator, sees_estimate
from .protocol import Actions, Estimates
from .row_policy import Flags
from .target_estimate import TargetBelief, sees_target_estimate


class Extended(NamedTuple):
    """Observations after a step of the estimators."""

    seen: Actions  # (n, size), what came and the estimates
    memory: Array  # (n, memory_size)
    targets: Estimates | None  # what a filter of the target believes


def asks_for_estimates(features: Features, task: BaseTask) -> bool:
    """Whether a network with these features sees what observations of the task do not show."""
    return sees_estimate(features) or sees_target_estimate(features, task)


class Estimators:
    """The estimators that a network asks for, one of each kind per row of observations.

    What they know stands in the memory that the caller keeps, (n, `memory_size`), zeros at first.

    Args:
        features: Of the network.
        task: Where observations come from.

    Raises:
        ValueError: If there is nothing of the kind to estimate in the task.
    """

    def __init__(self, features: Features, task: BaseTask) -> None:
        if not isinstance(task, Task | TeamTask):
            raise ValueError(f"estimates need a Task or a TeamTask, got {shown(task)}")
        self.given: Task | TeamTask = task
        self.task: Task | TeamTask = task
        self._belief, self._disturbance = None, None
        if isinstance(task, TeamTask) and sees_target_estimate(features, task):
            self._belief = TargetBelief(task)
            self.task = self._belief.task
        if sees_estimate(features):
            self._disturbance = DisturbanceEstimator(self.task)
            self.task = self._disturbance.task
        self._split = 0 if self._belief is None else self._belief.memory_size
        own = 0 if self._disturbance is None else self._disturbance.memory_size
        self.memory_size = self._split + own

    def extend(self, observations: Actions, memory: Array, start: Flags) -> Extended:
        """Observations as the network sees them, before its scaling.

        Args:
            observations: (n, d), float32, finite.
            memory: What the previous call returned; it is left as it is.
            start: (n,), rows that begin an episode.
        """
        seen, targets, kept = observations, None, [memory[:, : self._split], memory[:, self._split :]]
        if self._belief is not None:
            seen, kept[0], targets = self._belief.believe(seen, kept[0], start)
        if self._disturbance is not None:
            seen, kept[1] = self._disturbance.extend(seen, kept[1], start)
        return Extended(seen, np.concatenate(kept, axis=1), targets)
