"""Observations with an estimate of the target behind them, as `cooperative-mpc` finds it.

A filter per agent takes the own measurement and those that neighbours send. Networks cannot remember; this is
what they are given of the past.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from quad_envs.observations.features import Features
from quad_envs.parameters import Array
from quad_envs.tasks import BaseTask, TeamTask

from .estimation import make_estimator
from .protocol import Actions, Estimates
from .row_policy import Flags
from .shared_filters import Heard, estimate_block

_PART = "estimate["  # how the names of its features begin


class Believed(NamedTuple):
    """Observations after a step of the filters."""

    seen: Actions  # (n, d + 13 (1 + K)), what came and the estimates
    memory: Array  # (n, memory_size)
    estimates: Estimates


def sees_target_estimate(features: Features, task: BaseTask) -> bool:
    """Whether a network with these features is to be given what a filter believes, as the task shows none."""
    known = isinstance(task, TeamTask) and task.layout.target and not task.layout.estimate
    return known and any(name.startswith(_PART) for name in features.names)


def with_target_estimate(task: TeamTask) -> TeamTask:
    """The task as who is given the estimate sees it."""
    return replace(task, layout=replace(task.layout, estimate=True))


class TargetBelief:
    """Filters of a target, one per row of observations.

    What they know stands in the memory that the caller keeps, (n, `memory_size`), zeros at first.

    Args:
        task: Where observations come from, with a target.

    Raises:
        ValueError: If it has none.
    """

    def __init__(self, task: TeamTask) -> None:
        self._filters = make_estimator(task)
        self.given, self.task, self.memory_size = task, with_target_estimate(task), self._filters.size

    def believe(self, obs: Actions, memory: Array, start: Flags) -> Believed:
        """Move the filters on.

        Args:
            obs: (n, d).
            memory: (n, memory_size).
            start: (n,), rows that begin an episode.

        Raises:
            ValueError: If an observation is not finite.
        """
        n, K = len(obs), self.given.layout.neighbours
        done = self._filters.step(obs, memory, start)
        nobody = Heard(np.zeros((n, K, 6)), np.zeros((n, K, 6, 6)), np.zeros((n, K), dtype=np.bool_))
        seen = np.concatenate([obs, estimate_block(done.filters, nobody)], axis=1)
        return Believed(seen, done.filters, done.estimates)
