"""What the policies of teams share, and the two that look at nothing."""

from __future__ import annotations

import zlib

import numpy as np
from numpy.typing import NDArray

from quad_envs.arguments.checks import require_whole
from quad_envs.tasks import TeamTask

from .protocol import N_FALLBACKS, Actions, PolicyState
from .row_policy import Flags, RowPolicy
from .rows import not_finite


class TeamPolicy(RowPolicy):
    """A policy whose rows are the observations of agents; arguments as of `RowPolicy`."""

    privileged = False
    task: TeamTask


def require_finite(obs: Actions, task: TeamTask) -> None:
    """Check observations.

    Raises:
        ValueError: If one is not finite; it names the part.
    """
    if not np.isfinite(obs).all():
        raise not_finite(obs, int(np.argmin(np.isfinite(obs))), task.layout.slices)


def plain_state(state: PolicyState, start: Flags, memory: NDArray[np.float64]) -> PolicyState:
    """The state after decisions that nothing can keep from succeeding."""
    n = len(start)
    fallbacks: NDArray[np.int64] = np.where(start[:, None], 0, state.fallbacks)
    fallbacks[:, 0] += 1
    assert fallbacks.shape == (n, N_FALLBACKS)
    count = np.zeros(n, dtype=np.int64)
    return PolicyState(memory, fallbacks, count, count)


class TeamHover(TeamPolicy):
    """Hover thrust, whatever happens: the least that a policy must beat.

    On rails it estimates the target at the vehicle, at rest.

    Args:
        task: What is known of the flight.
    """

    def __init__(self, task: TeamTask) -> None:
        super().__init__(task, "hover", 0)

    def _decide(self, obs: Actions, state: PolicyState, start: Flags) -> tuple[Actions, PolicyState]:
        require_finite(obs, self.task)
        actions = np.zeros((len(obs), self.task.action_size), dtype=np.float32)
        return actions, plain_state(state, start, state.memory)


class TeamRandom(TeamPolicy):
    """Uniform random actions, a pure function of seed, first observation of the agent's episode and step.

    Args:
        task: What is known of the flight.
        seed: Of all draws, >= 0.

    Raises:
        ValueError: If the seed is not a whole number >= 0.
    """

    def __init__(self, task: TeamTask, seed: int = 0) -> None:
        require_whole("seed", seed, 0)
        super().__init__(task, "random", 2)  # stream of the episode, step
        self._seed = int(seed)

    def _decide(self, obs: Actions, state: PolicyState, start: Flags) -> tuple[Actions, PolicyState]:
        require_finite(obs, self.task)
        memory = np.where(start[:, None], 0.0, state.memory)
        actions = np.empty((len(obs), self.task.action_size), dtype=np.float32)
        for j, (stream, step) in enumerate(memory.tolist()):
            if step == 0.0:
                stream = zlib.crc32(obs[j].tobytes())
            bits = np.random.Philox(key=[self._seed, int(stream)], counter=[int(step), 0, 0, 0])
            actions[j] = np.random.Generator(bits).uniform(-1.0, 1.0, actions.shape[1])
            memory[j] = stream, step + 1.0
        return actions, plain_state(state, start, memory)
