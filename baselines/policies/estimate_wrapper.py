"""Sharing estimates: wrappers that run a target filter per agent and let neighbours exchange them.

What is exchanged and how it is fused, `shared_filters` says. The block `estimate` at the end of the
observation has the own estimate and, of each comm slot, what came with the message.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray
from pettingzoo.utils import BaseParallelWrapper

from controllers.estimation.consistency import nees
from quad_envs.parameters import Array
from quad_envs.tasks import TeamTask

from .estimation_kernels import P, X
from .protocol import Actions
from .shared_filters import Fusion as Fusion
from .shared_filters import SharedFilters

_BOUND = 1e6

_Dict = dict[str, Any]


class EstimateWrapper(BaseParallelWrapper):  # type: ignore[misc]
    """A team with a target whose agents filter, exchange and fuse estimates, and observe them.

    Infos gain `nees` (e'P^-1 e of the own estimated position, chi^2 with 3 degrees of freedom), `nis` (of the
    agent's own measurements of this step, chi^2 with `nis_rows` degrees of freedom; nan without any), and
    `mode`, "EKF,m" with m measurements held. The estimates in `env.task.layout` have a name of their own, so
    that `make_policy(name, env)` reads them.

    Args:
        env: A ParallelEnv of this suite with a target.
        fusion: Weights of the covariance intersection: "trace" (1 / tr P), "equal", "determinant" (smallest
            determinant); "none": nobody tells anybody.
        q: Of the target's motion in the filters, see `estimation.make_estimator`; None: 0.02 for
            estimation, 0.05 m^2/s^3 for tracking.
        estimator: "ekf", "trilateration", "polar-ekf", "random-walk", or an object of the user's.

    Raises:
        ValueError: If the environment has no target, or estimates already, or an option is not allowed.
    """

    def __init__(self, env: Any, fusion: Fusion = "trace", q: Any = None, estimator: Any = "ekf") -> None:
        super().__init__(env)
        inner = getattr(env, "task", None)
        if not isinstance(inner, TeamTask) or inner.layout.estimate:
            raise ValueError(
                f"EstimateWrapper needs a ParallelEnv of this suite without estimates, got {env!r}; take "
                "quad_envs.target_tracking_v0 or cooperative_estimation_v0"
            )
        self._inner, self.fusion, options = inner, fusion, env.unwrapped.options
        self._shared = SharedFilters(
            inner, env.unwrapped.senders, options.message_lifetime, 1, fusion, q, estimator
        )
        self.estimator = self._shared.estimator
        self.task = replace(inner, layout=replace(inner.layout, estimate=True))
        size = self.task.layout.size
        self.observation_spaces = {
            name: spaces.Box(-_BOUND, _BOUND, (size,), np.float32) for name in env.possible_agents
        }
        self._begin()

    def _begin(self) -> None:
        self._step = 0
        self._shared.begin(np.arange(self._inner.vehicles))

    def __getstate__(self) -> _Dict:
        """Everything: attributes that begin with an underscore are those of this wrapper."""
        return self.__dict__

    def __setstate__(self, state: Mapping[str, Any]) -> None:
        """The attributes."""
        self.__dict__.update(state)

    def observation_space(self, agent: str) -> spaces.Box:
        """Of one agent, with the block of estimates; always the same object."""
        return self.observation_spaces[agent]

    def reset(self, seed: int | None = None, options: _Dict | None = None) -> tuple[_Dict, _Dict]:
        """Begin an episode with filters that know the prior and the first measurements."""
        observations, infos = self.env.reset(seed=seed, options=options)
        self._begin()
        self._truth: Array = self.env.unwrapped.target
        return self._share(observations, infos), infos

    def step(self, actions: Mapping[str, Any]) -> tuple[_Dict, _Dict, _Dict, _Dict, _Dict]:
        """A step of the environment, then one of the filters."""
        observations, rewards, terminated, truncated, infos = self.env.step(actions)
        self._step += 1
        return self._share(observations, infos), rewards, terminated, truncated, infos

    def _share(self, observations: Mapping[str, Actions], infos: _Dict) -> _Dict:
        """Filter, exchange, fuse; observations with estimates. Adds to the infos."""
        names = list(observations)
        if not names:
            return {}
        agents = np.array([self.env.possible_agents.index(name) for name in names])
        rows = np.stack([observations[name] for name in names])
        known = self._shared.step(agents, rows)
        consistency = self._consistency(agents, known.filters)
        for i, name in enumerate(names):
            infos[name]["nees"] = float(consistency[i])
            infos[name]["nis"] = float(known.reports[i, 0])
            infos[name]["nis_rows"] = int(known.reports[i, 1])
            infos[name]["mode"] = f"EKF,{int(known.reports[i, 2])}"
        return {
            name: np.concatenate([row, more])
            for name, row, more in zip(names, rows, known.block, strict=True)
        }

    def _consistency(self, agents: NDArray[np.int64], filters: Array) -> Array:
        """Normalised error squared of the positions, from the truth."""
        truth = self._truth[min(self._step, len(self._truth) - 1), :3]
        error = filters[:, X][:, :3] + self.env.unwrapped.plants[agents, :3] - truth
        return nees(error, filters[:, P].reshape(-1, 6, 6)[:, :3, :3])
