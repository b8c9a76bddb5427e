"""`EstimateWrapper` for vectors of teams: filters of all agents in rows, and what they tell each other."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from gymnasium import spaces
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray

from controllers.estimation.consistency import nees
from quad_envs.arguments.names import shown
from quad_envs.envs.shared.vector_parts import presence
from quad_envs.envs.team.vector import TeamVectorEnv
from quad_envs.parameters import Array
from quad_envs.tasks import TeamTask

from .estimation_kernels import P, X
from .shared_filters import Fusion, Known, SharedFilters

Observations = NDArray[np.float32]
Bools = NDArray[np.bool_]


class EstimateVectorWrapper(VectorEnv[Observations, NDArray[np.float32], NDArray[Any]]):
    """n teams with a target whose agents filter, exchange and fuse estimates, and observe them.

    Row by row it is n parallel environments in an `EstimateWrapper`, with the same infos but `mode`.

    Args:
        env: The `vector_env` of a task with a target.
        fusion: See `EstimateWrapper`, as the rest.
        q: Of the target's motion in the filters.
        estimator: Name of one, or an object of the user's.

    Raises:
        ValueError: If the environment has no target, or an option is not allowed.
    """

    def __init__(
        self, env: TeamVectorEnv, fusion: Fusion = "trace", q: Any = None, estimator: Any = "ekf"
    ) -> None:
        if not isinstance(env, TeamVectorEnv):
            raise ValueError(
                f"EstimateVectorWrapper needs the vector_env of quad_envs.target_tracking_v0 or "
                f"cooperative_estimation_v0, got {shown(env)}"
            )
        self.env, self.num_teams, self.num_envs = env, env.num_teams, env.num_envs
        self.filters = SharedFilters(
            env.task, env.senders, env.options.message_lifetime, env.num_teams, fusion, q, estimator
        )
        self.task: TeamTask = replace(env.task, layout=replace(env.task.layout, estimate=True))
        self.metadata, self.render_mode = env.metadata, env.render_mode
        size = self.task.layout.size
        self.single_action_space, self.action_space = env.single_action_space, env.action_space
        self.single_observation_space = spaces.Box(-np.inf, np.inf, (size,), np.float32)
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)
        self._seen: Observations = np.zeros((self.num_envs, size), dtype=np.float32)
        self._done: Bools = np.zeros(self.num_teams, dtype=np.bool_)

    @property
    def plants(self) -> Array:
        """As of the teams."""
        return self.env.plants

    @property
    def references(self) -> Array:
        """As of the teams."""
        return self.env.references

    @property
    def targets(self) -> Array:
        """As of the teams."""
        return self.env.targets

    def reset(
        self, *, seed: Any = None, options: dict[str, Any] | None = None
    ) -> tuple[Observations, dict[str, Any]]:
        """Begin episodes, see `TeamVectorEnv.reset`."""
        observations, infos = self.env.reset(seed=seed, options=options)
        mask = np.asarray((options or {}).get("reset_mask", np.ones(self.num_teams, dtype=np.bool_)))
        begun = mask if len(mask) == self.num_envs else np.repeat(mask, self.task.vehicles)
        self._done[begun.reshape(self.num_teams, -1).all(axis=1)] = False
        rows = np.flatnonzero(begun)
        self.filters.begin(rows)
        known = self.filters.step(rows, observations[rows])
        seen = self._seen.copy()
        seen[rows] = np.concatenate([observations[rows], known.block], axis=1)
        self._seen = seen
        return seen.copy(), infos | self._said(rows, known)

    def step(self, actions: NDArray[np.float32]) -> tuple[Observations, Array, Bools, Bools, dict[str, Any]]:
        """A step of the teams, then one of the filters."""
        observations, rewards, terminated, truncated, infos = self.env.step(actions)
        rows = np.arange(self.num_envs)
        if self.env.autoreset_mode is AutoresetMode.NEXT_STEP:
            self.filters.begin(rows[np.repeat(self._done, self.task.vehicles)])
        self._done = np.asarray((terminated | truncated).reshape(self.num_teams, -1).all(axis=1))
        known = self.filters.step(rows, observations)
        self._seen = np.concatenate([observations, known.block], axis=1)
        return self._seen.copy(), rewards, terminated, truncated, infos | self._said(rows, known)

    def _said(self, rows: NDArray[np.int64], known: Known) -> dict[str, Any]:
        """What infos say of the filters."""
        team, step = rows // self.task.vehicles, self.filters.steps[rows]
        targets = self.env.targets
        truth = targets[team, np.minimum(step, targets.shape[1] - 1), :3]
        error = known.filters[:, X][:, :3] + self.env.plants[rows, :3] - truth
        values = {
            "nees": nees(error, known.filters[:, P].reshape(-1, 6, 6)[:, :3, :3]),
            "nis": known.reports[:, 0],
            "nis_rows": known.reports[:, 1].astype(np.int64),
        }
        out: dict[str, Any] = {}
        for name, value in values.items():
            out[name] = np.zeros(self.num_envs, dtype=value.dtype)
            out[name][rows] = value
        return out | presence(self.num_envs, values)
