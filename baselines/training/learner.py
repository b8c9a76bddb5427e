"""Parts of stable-baselines3 that are slow on small networks, made fast; what they compute stays the same."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from stable_baselines3 import PPO
from stable_baselines3.common.buffers import RolloutBuffer
from stable_baselines3.common.type_aliases import RolloutBufferSamples

from .tanh import fast_tanh_


class Tanh(torch.nn.Module):
    """A layer of hyperbolic tangents, on the CPU."""

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """Apply it."""
        return fast_tanh_(x)


class RowPPO(PPO):
    """PPO that asks no row of a step for its finished episode: `TrainingVecEnv` tallies all rows at once."""

    def _update_info_buffer(self, infos: list[dict[str, Any]], dones: Any = None) -> None:
        """Nothing to update."""


class RowBuffer(RolloutBuffer):
    """A rollout buffer that copies the rows of a minibatch once."""

    def _get_samples(self, batch_inds: NDArray[np.int64], env: Any = None) -> RolloutBufferSamples:
        def rows(array: Any) -> torch.Tensor:
            return torch.from_numpy(np.take(array, batch_inds, axis=0))

        return RolloutBufferSamples(
            rows(self.observations),
            rows(self.actions),
            rows(self.values).flatten(),
            rows(self.log_probs).flatten(),
            rows(self.advantages).flatten(),
            rows(self.returns).flatten(),
        )
