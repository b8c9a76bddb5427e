"""Many teams at once: the batched form of the multi-agent environments, for training and sweeps."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray

from ...arguments.checks import require_whole
from ...lanes import N_PLANT, PLANT
from ...plant import Array
from ...tasks import TeamTask
from ..shared.actions import real_numbers
from ..shared.vector_parts import Generators, autoreset_of, presence, seeded
from .batch import TeamBatch
from .options import TeamOptions
from .told import TeamScores

Observations = NDArray[np.float32]
Bools = NDArray[np.bool_]


class TeamVectorEnv(gymnasium.vector.VectorEnv[Observations, NDArray[np.float32], NDArray[Any]]):
    """n teams stepped in one compiled call, equal agent by agent to n parallel environments.

    Every agent is a row: vehicle i of team t is row t N + i, so that `num_envs` is n N and a policy that
    treats rows alike is shared by all agents. A team begins anew in the step after its episode ended
    (Gymnasium's NEXT_STEP), all of its rows at once; with `terminate="agent"` the rows of crashed vehicles
    say terminated, and nothing counts there, until their team ends: `info["alive"]` tells which those are.

    Args:
        options: Of the task.
        num_teams: Number of teams n.
        autoreset_mode: NEXT_STEP (default) or DISABLED.
        threads: Threads that share the teams of a step, at most one for each. Results do not depend on it;
            below a thousand vehicles one thread is the fastest, and more than there are cores are slow.

    Raises:
        ValueError: If num_teams or threads < 1, or the mode is SAME_STEP.
    """

    def __init__(
        self,
        options: TeamOptions,
        num_teams: int = 1,
        *,
        autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
        threads: int = 1,
    ) -> None:
        require_whole("num_teams", num_teams, 1)
        require_whole("threads", threads, 1)
        self.autoreset_mode = autoreset_of(autoreset_mode)
        if self.autoreset_mode is AutoresetMode.SAME_STEP:
            raise ValueError("autoreset_mode must be NEXT_STEP or DISABLED for teams")
        self._batch = TeamBatch(options, int(num_teams), int(threads))
        self.num_teams, self.num_envs = int(num_teams), int(num_teams) * options.vehicles
        self.render_mode = None
        self.metadata = {"render_modes": [], "render_fps": 20, "autoreset_mode": self.autoreset_mode}
        size = self.task.layout.size
        self.single_action_space = spaces.Box(-1.0, 1.0, (self.task.action_size,), np.float32)
        self.single_observation_space = spaces.Box(-np.inf, np.inf, (size,), np.float32)
        self.action_space = batch_space(self.single_action_space, self.num_envs)
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)
        self._masks: dict[str, Bools] = {}
        self._generators: Generators = []
        self._done: Bools = np.zeros(self.num_teams, dtype=np.bool_)
        # What was told last, for teams that a reset leaves alone.
        self._seen = np.zeros((self.num_envs, size), dtype=np.float32)
        self._told = np.zeros_like(self._batch.fresh_scores())

    @property
    def task(self) -> TeamTask:
        """What is known of the task before the flight."""
        return self._batch.task

    @property
    def options(self) -> TeamOptions:
        """The arguments of the environment as a value."""
        return self._batch.options

    @property
    def senders(self) -> NDArray[np.int64]:
        """Vehicle of the team behind each comm slot, -1 for none, (N, K)."""
        return self._batch.neighbours.copy()

    @property
    def plants(self) -> Array:
        """Copy of the plants [p, V_B, Theta, Omega, F], (n N, 16). For study and tests."""
        return self._batch.vehicles.read(PLANT, N_PLANT)

    @property
    def references(self) -> Array:
        """Where each vehicle should be in its team's episode, (n N, T+1, 8). For study and tests."""
        return np.concatenate([self._batch.wanted(t) for t in range(self.num_teams)])

    @property
    def targets(self) -> Array:
        """Rows r, v of each team's target, (n, T+1, 6); zero where there is none. For study and tests."""
        return np.stack([self._batch.target(t) for t in range(self.num_teams)])

    def state(self) -> Array:
        """The whole truth of each team, as the parallel environment's `state()`, (n, S), for central critics.

        `task.state_slices` names its parts. Of a team that is done it is the end, until the team begins anew.
        """
        return self._batch.state()

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observations, dict[str, Any]]:
        """Begin episodes: of every team, or of those in `options["reset_mask"]`.

        Args:
            seed: One number s (team t gets s + t), one per team, or None to draw on; a team that goes on
                keeps its generator.
            options: As in the parallel environment, the same for all teams; "reset_mask" is bool, one per
                team, or one per row with all rows of a team alike.

        Raises:
            ValueError: If the mask does not fit, or leaves out a team before the first reset.
        """
        given = dict(options or {})
        mask = self._team_mask(given.pop("reset_mask", None))
        self._generators = seeded(self._generators, seed, mask)
        observations, told = self._seen.copy(), self._told.copy()
        self._begin(np.flatnonzero(mask), observations, told, given)
        self._done[mask] = False
        self._seen, self._told = observations.copy(), told.copy()
        return observations, self._info(self._batch.scores(told))

    def _team_mask(self, mask: Any) -> Bools:
        """Which teams a reset begins anew, (n,)."""
        if mask is None:
            return np.ones(self.num_teams, dtype=np.bool_)
        given = np.asarray(mask, dtype=np.bool_)
        if given.shape == (self.num_envs,):
            rows = given.reshape(self.num_teams, -1)
            if (rows.any(axis=1) != rows.all(axis=1)).any():
                raise ValueError("reset_mask must be alike for all vehicles of a team: a team begins as one")
            given = np.asarray(rows.all(axis=1))
        if given.shape != (self.num_teams,):
            raise ValueError(
                f"reset_mask must have shape ({self.num_teams},) or ({self.num_envs},), got {given.shape}"
            )
        if not (given.all() or self._generators):
            raise ValueError("the first reset must begin all teams; reset_mask is for later ones")
        return given

    def step(self, actions: NDArray[np.float32]) -> tuple[Observations, Array, Bools, Bools, dict[str, Any]]:
        """Hold the rotor commands of all vehicles over one control period."""
        actions = real_numbers(actions, "actions must be numbers", self.action_space.shape)
        if actions.shape != self.action_space.shape:
            raise ValueError(f"actions must have shape {self.action_space.shape}, got {actions.shape}")
        if not self._generators:
            raise gymnasium.error.ResetNeeded("call reset() before step()")
        again = self.autoreset_mode is AutoresetMode.NEXT_STEP and bool(self._done.any())
        if again:
            begins = np.repeat(self._done, self.task.vehicles)
            actions = np.where(begins[:, None], np.float32(0.0), actions)
        observations, told = self._fresh_observations(), self._batch.fresh_scores()
        self._batch.step(actions.reshape(-1), observations.reshape(-1), told)
        if again:
            self._begin(np.flatnonzero(self._done), observations, told)
        scores = self._batch.scores(told)
        if again:
            scores.reward[begins] = 0.0
        truncated = scores.truncated & ~scores.terminated
        self._done = np.asarray((scores.terminated | truncated).reshape(self.num_teams, -1).all(axis=1))
        self._seen, self._told = observations, told
        return observations, scores.reward, scores.terminated.copy(), truncated, self._info(scores)

    def _begin(
        self,
        index: NDArray[np.int64],
        observations: Observations,
        told: Array,
        options: dict[str, Any] | None = None,
    ) -> None:
        generators = [self._generators[t] for t in index.tolist()]
        self._batch.begin(index, generators, observations.reshape(-1), told, options)

    def _fresh_observations(self) -> Observations:
        return np.empty((self.num_envs, self.task.layout.size), dtype=np.float32)

    def _info(self, scores: TeamScores) -> dict[str, Any]:
        info = {
            "cost": scores.cost,
            "episode_cost": scores.episode_cost,
            "constraint_violation": scores.violated,
            "constraint_values": scores.values,
            "stage_cost": scores.stage_cost,
            "crashed": scores.crashed,
            "crash_cause": scores.cause,
            "clipped_actions": scores.clipped,
            "formation_error": scores.slot_error,
            "min_separation": scores.nearest,
            "messages": scores.heard,
            "reward_terms": scores.terms,
            "alive": scores.alive,
        }
        if not self._masks:
            self._masks = presence(self.num_envs, info)
        return info | self._masks
