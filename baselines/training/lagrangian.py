"""A bound on the share of violating steps as a Lagrange multiplier on the reward.

Maximise E[sum r_t] such that the share of violating steps is at most `limit`:

    (r - m c) / (1 + m),   c = 1 in a violating step or a crash, else 0,   m >= 0 the multiplier.

Near the limit c is rare, so that the mean stays positive and crashing early does not pay. None of four
variants has brought `CorridorTracking` under its limit yet; `hyperparameters/ppo-lagrangian.toml` has the
measurements.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from stable_baselines3.common.vec_env import VecEnvWrapper

from .networks import Floats
from .vec_env import Bools, TrainingVecEnv


class Multiplier:
    """Proportional-integral ascent on the multiplier (Stooke, Achiam and Abbeel, 2020).

    The excess is relative to the limit and at most one, so that the many violations of a beginner do not
    raise the multiplier until nothing is left of the reward.

    Args:
        limit: Of the share of violating steps, > 0.
        proportional: Multiplier per relative excess.
        integral: The same, per update.

    Raises:
        ValueError: If a number is not in its range.
    """

    def __init__(self, limit: float, proportional: float, integral: float) -> None:
        if not 0.0 < limit <= 1.0:
            raise ValueError(f"limit is a share of steps, above 0 and at most 1, got {limit!r}")
        if not (proportional >= 0.0 and integral > 0.0):
            raise ValueError(
                f"a multiplier needs proportional >= 0 and integral > 0, got {proportional!r}, {integral!r}"
            )
        self.limit, self.proportional, self.integral = limit, proportional, integral
        self.value, self._sum = 0.0, 0.0

    def update(self, share: float) -> None:
        """Rise where the share of violating steps is above the limit, fall where it is below."""
        excess = min(share / self.limit - 1.0, 1.0)
        self._sum = max(0.0, self._sum + self.integral * excess)
        self.value = max(0.0, self._sum + self.proportional * excess)


class LagrangianEnv(VecEnvWrapper):
    """Flights whose rewards pay for violations.

    Args:
        venv: The flights.
        multiplier: Read at every step.
    """

    def __init__(self, venv: TrainingVecEnv, multiplier: Multiplier) -> None:
        super().__init__(venv)
        self.flights, self.multiplier = venv, multiplier

    def reset(self) -> Floats:
        """Begin all episodes."""
        return self.flights.reset()

    def step_wait(self) -> tuple[Floats, Floats, Bools, list[dict[str, Any]]]:
        """One control period, with penalised rewards."""
        observations, rewards, dones, infos = self.flights.step_wait()
        m = self.multiplier.value
        cost = self.flights.violated | self.flights.crashed
        return observations, ((rewards - m * cost) / (1.0 + m)).astype(np.float32), dones, infos
