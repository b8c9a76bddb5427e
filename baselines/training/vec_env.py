"""Many flights, or all vehicles of many teams, as one SB3 `VecEnv`: what a network in training sees.

Observations are the network's scaled features, actions its outputs. Nothing is done in Python per row and
step but where an episode ends.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np
from gymnasium import spaces
from gymnasium.utils import seeding
from numpy.typing import NDArray
from stable_baselines3.common.vec_env import VecEnv

from quad_envs.arguments.names import shown
from quad_envs.envs.team.batch import TeamBatch
from quad_envs.envs.team.options import TeamOptions, Terminate
from quad_envs.envs.tracking.batch import TrackingBatch
from quad_envs.envs.tracking.options import TrackingOptions
from quad_envs.observations.features import Features, default_features
from quad_envs.tasks import Task, TeamTask
from quad_envs.wrappers.encoding import Encoding

from ..policies.network import Floats
from .observer import Observer

Bools = NDArray[np.bool_]
TaskOptions = TrackingOptions | TeamOptions
# Apart from the seeds of environments, so that no training start is one from which policies are judged.
_STREAM = 0x51_AD
_NOTHING: Any = MappingProxyType({})  # shared by all rows where nothing ended; nobody can write into it


class Tally(NamedTuple):
    """Means over rows and steps."""

    reward: float
    violation_share: float


class TrainingVecEnv(VecEnv):
    """n flights, or the vehicles of n teams, that begin anew in the step in which they end.

    Row by row it is `TrackingVectorEnv` or `TeamVectorEnv`; vehicle i of team t is row t N + i. A team in
    which a vehicle crashes ends as a whole, so that no row is ever of a vehicle that is no more.

    Args:
        options: Of the task.
        n: Number of flights or teams.
        seed: One number, from which starts are drawn that no seed of an environment gives; or such a seed
            for each flight or team.
        encoding: What the network sees and commands; None for the default features and the full range.
        staggered: Whether the first episodes are cut at random, so that flights are at all times of the
            episode from then on. A cut counts as a truncation.
        episode_steps: After which an episode is cut, if the task's is longer: short ones see more starts.
        blame: Who a crash is told of: "team", all vehicles, as the task has it; or "agent", those that
            crashed alone: for the others the end is a truncation, as they could have flown on.

    Raises:
        ValueError: If n < 1, or actions of the task are no rotor commands.
    """

    render_mode = None

    def __init__(
        self,
        options: TaskOptions,
        n: int,
        seed: int | Sequence[int] = 0,
        *,
        encoding: Encoding | None = None,
        staggered: bool = True,
        episode_steps: int | None = None,
        blame: Terminate = "team",
    ) -> None:
        if n < 1:
            raise ValueError(f"the number of flights or teams must be >= 1, got {shown(n)}")
        self._batch: TrackingBatch | TeamBatch
        if isinstance(options, TeamOptions):
            self._batch = TeamBatch(replace(options, terminate=blame), n)
            self._size = options.vehicles
        else:
            self._batch, self._size = TrackingBatch(options, n), 1
        self._told = self._batch.fresh_scores()
        if isinstance(self.task, TeamTask) and self.task.mission == "estimation":
            raise ValueError(
                f"actions of {self.task.env_id} are estimates, and this trains networks that command rotors: "
                "choose quad/TargetTracking-v0 or a tracking task"
            )
        rows = n * self._size
        self._observer = Observer(encoding or Encoding(default_features(self.task.layout)), self.task, rows)
        self.encoder = self._observer.encoder
        self._out = np.empty((rows, self.task.layout.size), dtype=np.float32)
        self._actions = np.zeros((rows, self.action_size), dtype=np.float32)
        self._n, self._staggered = n, staggered
        self._steps_of_episode = min(episode_steps or self.task.episode_steps, self.task.episode_steps)
        self._left = np.zeros(n, dtype=np.int64)  # steps of each episode until it is cut
        self._infos = [_NOTHING] * rows
        self.costs = np.zeros(rows)  # of the last step, as the next two
        self.violated, self.crashed = np.zeros((2, rows), dtype=np.bool_)
        self._steps, self._reward, self._violations = 0, 0.0, 0
        super().__init__(
            rows,
            spaces.Box(-np.inf, np.inf, (self.encoder.size,), np.float32),
            spaces.Box(-1.0, 1.0, (self.action_size,), np.float32),
        )
        self.seed(seed)

    @property
    def task(self) -> Task | TeamTask:
        """What is known of the task before the flight."""
        return self._batch.task

    @property
    def features(self) -> Features:
        """What the network sees."""
        return self.encoder.encoding.features

    @property
    def action_size(self) -> int:
        """Numbers in an action of one row."""
        return self.task.action_size if isinstance(self.task, TeamTask) else 4

    def seed(self, seed: int | Sequence[int] | None = None) -> list[int | None]:
        """Set what the next `reset` draws from; see the class."""
        if isinstance(seed, Sequence):
            if len(seed) != self._n:
                raise ValueError(f"seed must be one number or {self._n} of them, got {len(seed)}")
            self._generators = [seeding.np_random(value)[0] for value in seed]
            self._stagger = np.random.default_rng([_STREAM, *seed])
        else:
            words = np.random.SeedSequence(None if seed is None else [_STREAM, int(seed)]).spawn(self._n + 1)
            self._stagger, *self._generators = map(np.random.default_rng, words)
        return [None] * self.num_envs

    def reset(self) -> Floats:
        """Begin all episodes."""
        self._begin(np.arange(self._n))
        if self._staggered:
            self._left[:] = self._stagger.integers(1, self._steps_of_episode + 1, self._n)
        self.costs = np.zeros(self.num_envs)
        self.violated, self.crashed = np.zeros((2, self.num_envs), dtype=np.bool_)
        return self._see(self._out, np.ones(self.num_envs, dtype=np.bool_))

    def step_async(self, actions: Floats) -> None:
        """Take the network's outputs, (rows, action size), in [-1, 1]."""
        self._actions = np.ascontiguousarray(self.encoder.act(actions))

    def step_wait(self) -> tuple[Floats, Floats, Bools, list[dict[str, Any]]]:
        """One control period of all rows.

        Returns:
            Features, rewards, where an episode ended, and infos: empty but where an episode ended. There are
            `terminal_observation` (features), `TimeLimit.truncated`.
        """
        truncated = self._step()
        rewards = self._rewards.astype(np.float32)
        self._steps += 1
        self._reward += float(rewards.sum())
        self._violations += int(np.count_nonzero(self.violated))
        self._left -= 1
        ended = (self.crashed | truncated).reshape(self._n, self._size).any(axis=1)
        ended |= self._left == 0
        seen, dones, infos = self._see(self._out), np.repeat(ended, self._size), self._infos[:]
        if not ended.any():
            return seen, rewards, dones, infos
        rows = np.flatnonzero(dones)
        for row, features in zip(rows.tolist(), seen[rows], strict=True):
            infos[row] = {
                "terminal_observation": features,
                "TimeLimit.truncated": not bool(self.crashed[row]),
            }
        self._begin(np.flatnonzero(ended))
        seen[rows] = self._see(self._out[rows], np.ones(len(rows), dtype=np.bool_), rows)
        return seen, rewards, dones, infos

    def _see(
        self, observations: Floats, begins: Bools | None = None, rows: NDArray[np.int64] | None = None
    ) -> Floats:
        """What the learner sees of them, see `Observer.see`."""
        return self._observer.see(observations, begins, rows)

    def _step(self) -> Bools:
        """Move all rows, and take over their scores; which rows are at the end of their time."""
        self._batch.step(self._actions.reshape(-1), self._out.reshape(-1), self._told)
        scores = self._batch.scores(self._told.copy())
        self._rewards, self.costs = scores.reward, scores.cost
        self.violated, self.crashed = scores.violated, scores.crashed
        return scores.truncated

    def tally(self) -> Tally:
        """Means since the last call."""
        n = max(self._steps, 1) * self.num_envs
        means = Tally(self._reward / n, self._violations / n)
        self._steps, self._reward, self._violations = 0, 0.0, 0
        return means

    def _begin(self, groups: NDArray[np.int64]) -> None:
        """New episodes of some flights or teams."""
        self._left[groups] = self._steps_of_episode
        generators = [self._generators[group] for group in groups.tolist()]
        self._batch.begin(groups, generators, self._out.reshape(-1), self._told)

    def close(self) -> None:
        """There is nothing to close."""

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        """An attribute, the same for all rows."""
        return [getattr(self, attr_name)] * len(self._rows_of(indices))

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        """Refused: rows have nothing of their own to set."""
        raise AttributeError(f"rows of {type(self).__name__} share everything: cannot set {attr_name!r}")

    def env_method(
        self, method_name: str, *method_args: Any, indices: Any = None, **method_kwargs: Any
    ) -> list[Any]:
        """Refused: rows have no methods of their own."""
        raise AttributeError(f"rows of {type(self).__name__} have no method {method_name!r} of their own")

    def env_is_wrapped(self, wrapper_class: Any, indices: Any = None) -> list[bool]:
        """No row is wrapped."""
        return [False] * len(self._rows_of(indices))

    def _rows_of(self, indices: Any) -> list[int]:
        return list(self._get_indices(indices))
