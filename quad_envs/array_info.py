"""A wrapper for libraries that make tensors of infos, as TorchRL."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
from gymnasium.utils import RecordConstructorArgs

_Info = dict[str, Any]


class ArrayInfo(gymnasium.Wrapper[Any, Any, Any, Any], RecordConstructorArgs):
    """Infos of a single environment as arrays, those of one number with shape ().

    By default they are Python's numbers: the quickest to make (arrays cost a sixth of a step) and to copy,
    which Stable-Baselines3 does in each step, and Gymnasium's `SyncVectorEnv` makes typed arrays of them.
    TorchRL's reader of infos asks each value for its dtype, which Python's numbers lack:
    `GymWrapper(ArrayInfo(gym.make(id))).auto_register_info_dict()`. Vector environments have arrays anyway.

    Args:
        env: A single environment.
    """

    def __init__(self, env: gymnasium.Env[Any, Any]) -> None:
        RecordConstructorArgs.__init__(self)
        gymnasium.Wrapper.__init__(self, env)

    def reset(self, *, seed: int | None = None, options: _Info | None = None) -> tuple[Any, _Info]:
        """Begin an episode."""
        observation, info = self.env.reset(seed=seed, options=options)
        return observation, _as_arrays(info)

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, _Info]:
        """A step of the environment."""
        observation, reward, terminated, truncated, info = self.env.step(action)
        return observation, reward, terminated, truncated, _as_arrays(info)


def _as_arrays(info: _Info) -> _Info:
    return {name: np.asarray(value) for name, value in info.items()}
