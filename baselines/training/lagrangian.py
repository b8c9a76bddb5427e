"""A bound on the share of violating steps: a Lagrange multiplier between two advantages.

Maximise E[sum r_t] such that the share of violating steps of the policy WITHOUT its noise is at most `limit`:

    A = (A_r - m A_c) / (1 + m),   c = 1 in a violating step, 1 / (1 - gamma) in a crash, else 0,   m >= 0.

A_c comes from a critic of its own. A crash counts as if it violated ever after: it must not be a way out.
The multiplier looks at flights without noise, because the noise of training alone breaks rate limits that
the policy itself keeps; c is counted with it, which leaves the policy a margin of about its noise.
"""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import numpy as np
import torch
from stable_baselines3.common.vec_env import VecEnvWrapper

from ..policies.network import Floats
from .learner import RowBuffer, Tanh
from .vec_env import Bools, TrainingVecEnv

_LAYERS = (64, 64)
_BATCH, _RATE = 4096, 1e-3


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
    """Flights that note what the steps of a rollout cost beside their rewards.

    Args:
        venv: The flights.
        gamma: Discount of later costs.
    """

    def __init__(self, venv: TrainingVecEnv, gamma: float) -> None:
        super().__init__(venv)
        self.flights, self.gamma = venv, gamma
        self.costs: list[Floats] = []  # of each step of the rollout, (rows,)
        self.truncations: list[tuple[int, int, Floats]] = []  # step, row and last features of what was cut
        self.last: Floats = np.zeros((0, 0), dtype=np.float32)  # features after the last step

    def reset(self) -> Floats:
        """Begin all episodes."""
        return self.flights.reset()

    def begin_rollout(self) -> None:
        """Forget the steps so far."""
        self.costs, self.truncations = [], []

    def step_wait(self) -> tuple[Floats, Floats, Bools, list[dict[str, Any]]]:
        """One control period; rewards stay what they are."""
        observations, rewards, dones, infos = self.flights.step_wait()
        self.truncations += [
            (len(self.costs), row, infos[row]["terminal_observation"])
            for row in np.flatnonzero(dones).tolist()
            if infos[row]["TimeLimit.truncated"]
        ]
        crash = 1.0 / (1.0 - self.gamma) if self.gamma < 1.0 else float(self.flights.task.episode_steps)
        self.costs.append(np.where(self.flights.crashed, crash, self.flights.violated).astype(np.float32))
        self.last = observations
        return observations, rewards, dones, infos


class CostCritic:
    """Discounted costs to come, from features; a network of its own."""

    def __init__(self, inputs: int) -> None:
        layers: list[torch.nn.Module] = []
        for a, b in pairwise((inputs, *_LAYERS)):
            layers += [torch.nn.Linear(a, b), Tanh()]
        self._network = torch.nn.Sequential(*layers, torch.nn.Linear(_LAYERS[-1], 1))
        self._optimizer = torch.optim.Adam(self._network.parameters(), lr=_RATE, fused=True)
        self.loss = 0.0

    def __call__(self, features: Floats) -> Floats:
        """Values of features (..., inputs), (...)."""
        with torch.no_grad():
            out: Floats = self._network(torch.from_numpy(features)).numpy()[..., 0]
        return out

    def fit(self, features: Floats, returns: Floats, n_epochs: int) -> None:
        """Learn returns (n,) of features (n, inputs)."""
        x, y = torch.from_numpy(features), torch.from_numpy(returns)
        for _ in range(n_epochs):
            order = torch.randperm(len(x))
            for first in range(0, len(x), _BATCH):
                rows = order[first : first + _BATCH]
                self._optimizer.zero_grad()
                loss = torch.nn.functional.mse_loss(self._network(x[rows])[:, 0], y[rows])
                loss.backward()  # type: ignore[no-untyped-call]
                torch.nn.utils.clip_grad_norm_(self._network.parameters(), 0.5)
                self._optimizer.step()
                self.loss = float(loss.detach())


class LagrangianBuffer(RowBuffer):
    """A rollout buffer whose advantages pay for what violations cost.

    Args:
        args: Of the rollout buffer.
        env: Has the costs of the rollout.
        multiplier: Read at the end of each rollout.
        n_epochs: Of the critic after each rollout.
        kwargs: Of the rollout buffer.
    """

    def __init__(
        self, *args: Any, env: LagrangianEnv, multiplier: Multiplier, n_epochs: int, **kwargs: Any
    ) -> None:
        super().__init__(*args, **kwargs)
        self._env, self._multiplier, self._n_epochs = env, multiplier, n_epochs
        self.critic = CostCritic(int(self.observations.shape[-1]))

    def reset(self) -> None:
        """Begin a rollout."""
        super().reset()
        if hasattr(self, "_env"):
            self._env.begin_rollout()

    def compute_returns_and_advantage(self, last_values: torch.Tensor, dones: Bools) -> None:
        """Advantages of the rewards and of the costs, and what the policy follows."""
        super().compute_returns_and_advantage(last_values, dones)
        m, gamma = self._multiplier.value, self._env.gamma
        costs = np.stack(self._env.costs)
        if self._env.truncations:
            steps, rows, last = zip(*self._env.truncations, strict=True)
            costs[list(steps), list(rows)] += gamma * self.critic(np.stack(last))
        values = self.critic(self.observations)
        advantages = cost_advantages(
            costs, values, self.critic(self._env.last), self.episode_starts, dones, gamma, self.gae_lambda
        )
        flat = self.observations.reshape(-1, self.observations.shape[-1])
        self.critic.fit(flat, (advantages + values).reshape(-1), self._n_epochs)
        self.advantages = (self.advantages - np.float32(m) * advantages) / np.float32(1.0 + m)


def cost_advantages(
    costs: Floats, values: Floats, last: Floats, starts: Floats, dones: Bools, gamma: float, gae_lambda: float
) -> Floats:
    """Generalised advantages, (T, rows), of costs and values (T, rows), as those of the rewards."""
    out, running = np.empty_like(costs), np.zeros_like(last)
    goes_on, following = 1.0 - dones.astype(np.float32), last
    for t in range(len(costs) - 1, -1, -1):
        running = costs[t] + gamma * goes_on * (following + gae_lambda * running) - values[t]
        out[t] = running
        goes_on, following = 1.0 - starts[t], values[t]
    return out


class Probe:
    """Flights of the policy without its noise, beside those of training.

    Args:
        flights: Their own.
        memory: Share of the running mean that stays in an update.
    """

    def __init__(self, flights: TrainingVecEnv, memory: float = 0.8) -> None:
        self._flights, self._memory = flights, memory
        self._observations = flights.reset()
        self._sum, self._weight = 0.0, 0.0

    def share(self, model: Any, steps: int) -> float:
        """Share of violating steps, a running mean, after flying on with `model`."""
        for _ in range(steps):
            actions = model.predict(self._observations, deterministic=True)[0]
            self._flights.step_async(actions)
            self._observations = self._flights.step_wait()[0]
        self._sum = self._memory * self._sum + self._flights.tally().violation_share
        self._weight = self._memory * self._weight + 1.0
        return self._sum / self._weight
