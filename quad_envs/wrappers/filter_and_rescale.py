"""`FilterAndRescale` of a single environment."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces
from gymnasium.utils import RecordConstructorArgs
from numpy.typing import NDArray

from .encoded_space import COMMAND_RANGE, EncodedBox, make_encoder

_Floats = NDArray[np.float32]
_Info = dict[str, Any]


class FilterAndRescale(gymnasium.ObservationWrapper[_Floats, _Floats, _Floats], RecordConstructorArgs):
    """Observations and actions as learners with default hyperparameters need them.

    `gymnasium.wrappers` would say `FilterObservation`, `RescaleObservation` and `RescaleAction`:

    - of the preview, 26 stages that say nearly the same, six are left: now, 2, 5, 10, 15, 25 periods ahead;
    - what is left is scaled to order one, (observation - mean) / scale with fixed numbers;
    - actions in [-1, 1] command rotor forces of u_T (1 +- 0.5), m g / 8 about hover, within the rotor's box.

    Rewards, ends and infos stay. The observation space says what was done (`EncodedBox.encoding`), and so
    does every model of Stable-Baselines3 that is trained here: `baselines.sb3(model)` and `quad-envs export`
    make a policy of it for the environment as it is, where all policies are compared.

    Args:
        env: A tracking environment of this suite.
        stages: Preview stages to keep.
        command_range: Largest change of a rotor force, as a share of its force in hover; at most 1.

    Raises:
        ValueError: If the environment is another one, the preview has not these stages, or the range is not
            allowed.
    """

    def __init__(
        self,
        env: gymnasium.Env[_Floats, _Floats],
        stages: tuple[int, ...] | None = None,
        command_range: float = COMMAND_RANGE,
    ) -> None:
        RecordConstructorArgs.__init__(self, stages=stages, command_range=command_range)
        encoder = make_encoder(env, stages, command_range)
        gymnasium.ObservationWrapper.__init__(self, env)
        self.encoder = encoder
        self.observation_space: spaces.Space[Any] = EncodedBox(self.encoder)
        self.action_space = spaces.Box(-1.0, 1.0, (4,), np.float32)

    def observation(self, observation: _Floats) -> _Floats:
        """Features of an observation."""
        return self.encoder.see(observation)

    def action(self, action: _Floats) -> _Floats:
        """The action of the environment for an output."""
        return self.encoder.act(action)

    def step(self, action: _Floats) -> tuple[_Floats, Any, bool, bool, _Info]:
        """A step of the environment."""
        observation, reward, terminated, truncated, info = self.env.step(self.action(action))
        return self.observation(observation), reward, terminated, truncated, info
