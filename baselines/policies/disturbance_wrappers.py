"""Wrappers that append an estimate of the disturbance to observations, for learners of the user's.

Our own learners have it by the hyperparameter `disturbance_estimate`. `FilterAndRescale` around such a
wrapper keeps the estimate; what is exported of a model that was trained under both flies the environment as
it is, with an estimator of its own.
"""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces
from gymnasium.utils import RecordConstructorArgs
from gymnasium.vector import VectorEnv, VectorWrapper
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray

from quad_envs.tasks import Task

from .disturbance_estimate import DisturbanceEstimator

_Floats = NDArray[np.float32]
_Info = dict[str, Any]


def _estimator_for(env: Any) -> DisturbanceEstimator:
    task = getattr(getattr(env, "unwrapped", env), "task", None)
    if not isinstance(task, Task):
        raise ValueError(
            f"a disturbance is estimated in a tracking environment of this suite, got {env!r}: take one of "
            "gymnasium.make or make_vec"
        )
    return DisturbanceEstimator(task)


def _extended(space: Any) -> spaces.Box:
    """The space of observations with six more numbers."""
    bound = np.full(6, np.inf, dtype=np.float32)
    return spaces.Box(np.r_[space.low, -bound], np.r_[space.high, bound], dtype=np.float32)


class DisturbanceEstimateWrapper(
    gymnasium.Wrapper[_Floats, _Floats, _Floats, _Floats], RecordConstructorArgs
):
    """Six numbers behind the observation: torque (body axes, N m) and force (inertial axes, N) as estimated.

    What a one-step prediction of the nominal vehicle does not explain, low-passed, by the estimator that the
    MPCs have with `reject_disturbance`; zeros at the beginning of an episode. `task.layout` names them
    `disturbance_estimate`.

    Args:
        env: A tracking environment of this suite, its observations as they are.

    Raises:
        ValueError: If it is another one.
    """

    def __init__(self, env: gymnasium.Env[_Floats, _Floats]) -> None:
        RecordConstructorArgs.__init__(self)
        gymnasium.Wrapper.__init__(self, env)
        self._estimator = _estimator_for(env)
        self.task = self._estimator.task
        self.observation_space: spaces.Space[Any] = _extended(env.observation_space)
        self._memory = np.zeros((1, self._estimator.memory_size))

    def reset(self, *, seed: int | None = None, options: _Info | None = None) -> tuple[_Floats, _Info]:
        """Begin an episode."""
        observation, info = self.env.reset(seed=seed, options=options)
        return self._see(observation, True), info

    def step(self, action: _Floats) -> tuple[_Floats, Any, bool, bool, _Info]:
        """A step of the environment, then one of the estimator."""
        observation, reward, terminated, truncated, info = self.env.step(action)
        return self._see(observation, False), reward, terminated, truncated, info

    def _see(self, observation: _Floats, start: bool) -> _Floats:
        rows, self._memory = self._estimator.extend(observation[None], self._memory, np.array([start]))
        extended: _Floats = rows[0]
        return extended


class VectorDisturbanceEstimateWrapper(VectorWrapper):
    """`DisturbanceEstimateWrapper` of all rows of a vector environment, row by row the same numbers.

    With the autoreset mode SAME_STEP, `final_obs` has the estimate, too.

    Args:
        env: What `gymnasium.make_vec` makes of a tracking id.

    Raises:
        ValueError: As the wrapper of a single environment.
    """

    def __init__(self, env: VectorEnv) -> None:
        super().__init__(env)
        self._estimator = _estimator_for(env)
        self.task = self._estimator.task
        self.single_observation_space = _extended(env.single_observation_space)
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)
        self._memory = np.zeros((self.num_envs, self._estimator.memory_size))
        self._ended = np.zeros(self.num_envs, dtype=np.bool_)  # rows whose next observation begins an episode

    def reset(self, *, seed: Any = None, options: _Info | None = None) -> tuple[_Floats, _Info]:
        """Begin episodes, of some rows where the options say so."""
        mask = None if options is None else options.get("reset_mask")
        observations, infos = self.env.reset(seed=seed, options=options)
        begun = np.ones(self.num_envs, dtype=np.bool_) if mask is None else np.asarray(mask, dtype=np.bool_)
        self._ended = self._ended & ~begun
        return self._see(observations, begun), infos

    def step(self, actions: _Floats) -> tuple[_Floats, Any, Any, Any, _Info]:
        """A step of the environments, then one of the estimators."""
        observations, rewards, terminated, truncated, infos = self.env.step(actions)
        begun = self._ended
        self._ended = terminated | truncated
        if "final_obs" in infos:
            ended = np.flatnonzero(infos["_final_obs"])
            last = np.full(self.num_envs, None, dtype=object)
            rows = np.stack(infos["final_obs"][ended].tolist())
            last[ended] = list(self._estimator.extend(rows, self._memory[ended], begun[ended])[0])
            infos, begun, self._ended = {**infos, "final_obs": last}, self._ended, np.zeros_like(begun)
        return self._see(observations, begun), rewards, terminated, truncated, infos

    def _see(self, observations: _Floats, begun: NDArray[np.bool_]) -> _Floats:
        rows, self._memory = self._estimator.extend(observations, self._memory, begun)
        return rows
