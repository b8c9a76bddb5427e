"""`FilterAndRescale` of a vector environment."""

from __future__ import annotations

from typing import Any

import numpy as np
from gymnasium import spaces
from gymnasium.vector import VectorEnv, VectorWrapper
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray

from .encoded_space import COMMAND_RANGE, EncodedBox, make_encoder

__all__ = ["FilterAndRescale"]


class FilterAndRescale(VectorWrapper):
    """`quad_envs.wrappers.FilterAndRescale` of all rows of a vector environment, row by row the same numbers.

    With the autoreset mode SAME_STEP, `final_obs` has features, too.

    Args:
        env: What `gymnasium.make_vec` makes of a tracking id.
        stages: Preview stages to keep.
        command_range: Largest change of a rotor force, as a share of its force in hover; at most 1.

    Raises:
        ValueError: As the wrapper of a single environment.
    """

    def __init__(
        self, env: VectorEnv, stages: tuple[int, ...] | None = None, command_range: float = COMMAND_RANGE
    ) -> None:
        encoder = make_encoder(env, stages, command_range)
        super().__init__(env)
        self.encoder = encoder
        self.single_observation_space = EncodedBox(self.encoder)
        self.single_action_space = spaces.Box(-1.0, 1.0, (4,), np.float32)
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)
        self.action_space = batch_space(self.single_action_space, self.num_envs)

    def reset(self, *, seed: Any = None, options: dict[str, Any] | None = None) -> Any:
        """Begin episodes."""
        observations, infos = self.env.reset(seed=seed, options=options)
        return self.encoder.see(observations), infos

    def step(self, actions: NDArray[np.float32]) -> Any:
        """A step of the environments."""
        observations, rewards, terminated, truncated, infos = self.env.step(self.encoder.act(actions))
        if "final_obs" in infos:
            seen = np.full(self.num_envs, None, dtype=object)
            for i in np.flatnonzero(infos["_final_obs"]).tolist():
                seen[i] = self.encoder.see(infos["final_obs"][i])
            infos = {**infos, "final_obs": seen}
        return self.encoder.see(observations), rewards, terminated, truncated, infos
