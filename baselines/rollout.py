"""Episodes of a policy in a single, a vector or a multi-agent environment, as records of arrays.

Episode i starts with the environment seed `seed + i`, whatever the policy: policies fly from the same starts.
"""

from __future__ import annotations

from collections.abc import Iterator
from time import perf_counter
from typing import Any, NamedTuple

import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv
from numpy.typing import NDArray

from quad_envs.constraints import forces_from_actions
from quad_envs.observations import N_REFERENCE
from quad_envs.parameters import Array
from quad_envs.tasks import Task

from .policy import N_FALLBACKS, Counts, Policy, PolicyState

_WARM_UP_CALLS = 2  # the first compiles, the second takes the path with a state


class Episode(NamedTuple):
    """One flight of T control periods. Row k of what is per step belongs to the step from k to k + 1."""

    task: Task
    seed: int
    states: Array  # (T+1, 16), true plant [p, V_B, Theta, Omega, F]
    references: Array  # (T+1, 8), p_ref, v_ref, sin psi_ref, cos psi_ref
    commands: Array  # (T, 4), commanded rotor forces, N
    rewards: Array  # (T,)
    stage_costs: Array  # (T,), l of the reward: state at k + 1, command at k
    costs: Array  # (T,), sum of hinge / scale over the limits
    violations: NDArray[np.bool_]  # (T,), whether any limit was exceeded
    constraint_values: Array  # (T, number of rows), value minus limit, SI
    decision_times: Array  # (T,), s of wall time in predict; nan where it was not measured
    fallbacks: Counts  # (5,), decisions by controllers.fallback.Fallback
    worst_iterations: int  # most solver iterations of a decision
    crashed: bool
    terminated: bool
    truncated: bool
    agent: str = ""  # in a multi-agent environment


class _Row:
    """What one vehicle does, collected step by step."""

    def __init__(self, task: Task, seed: int, references: Array, agent: str = "") -> None:
        self.task, self.seed, self.references, self.agent = task, seed, references, agent
        self.states: list[Array] = []
        self.actions: list[NDArray[np.floating[Any]]] = []
        self.scores: list[tuple[float, float, float, bool, float]] = []
        self.values: list[Array] = []
        self.crashed = self.terminated = self.truncated = False
        self.fallbacks, self.worst_iterations = np.zeros(N_FALLBACKS, dtype=np.int64), 0

    @property
    def done(self) -> bool:
        return self.terminated or self.truncated

    def add(
        self,
        action: NDArray[Any],
        reward: float,
        info: dict[str, Any],
        seconds: float,
        ended: tuple[bool, bool],
    ) -> None:
        """One step: what was done and what the environment said of it."""
        self.actions.append(np.array(action))
        self.scores.append((reward, info["stage_cost"], info["cost"], info["constraint_violation"], seconds))
        self.values.append(info["constraint_values"])
        self.crashed = bool(info["crashed"])
        self.terminated, self.truncated = bool(ended[0]), bool(ended[1])

    def note(self, state: Any, j: int) -> None:
        """Statistics of the solver, which a `PolicyState` brings along."""
        if isinstance(state, PolicyState):
            self.fallbacks = state.fallbacks[j].copy()
            self.worst_iterations = int(state.worst_iterations[j])

    def episode(self) -> Episode:
        """The flight as arrays."""
        steps = len(self.actions)
        scores = np.array(self.scores, dtype=np.float64).reshape(steps, 5)
        actions = np.array(self.actions).reshape(steps, -1)
        return Episode(
            task=self.task,
            seed=self.seed,
            states=np.array(self.states),
            references=self.references[: steps + 1],
            commands=forces_from_actions(actions, self.task.hover_force, self.task.force_max),
            rewards=scores[:, 0],
            stage_costs=scores[:, 1],
            costs=scores[:, 2],
            violations=scores[:, 3] > 0.0,
            constraint_values=np.array(self.values, dtype=np.float64).reshape(steps, -1),
            decision_times=scores[:, 4],
            fallbacks=self.fallbacks,
            worst_iterations=self.worst_iterations,
            crashed=self.crashed,
            terminated=self.terminated,
            truncated=self.truncated,
            agent=self.agent,
        )


def run_episodes(policy: Policy, env: Any, episodes: int, seed: int = 0) -> Iterator[Episode]:
    """Fly episodes one after the other, and yield each as soon as it is complete.

    Args:
        policy: Decides from observations alone.
        env: A Gymnasium environment (each decision is timed), a vector environment (fast, not timed), or a
            PettingZoo ParallelEnv (one episode per agent, agents are rows of the observation).
        episodes: Number of episodes, >= 1.
        seed: Seed of the first one.

    Raises:
        ValueError: If episodes < 1, or a vector environment resets in the same step.
    """
    if isinstance(episodes, bool) or not isinstance(episodes, int | np.integer) or episodes < 1:
        raise ValueError(f"episodes must be a whole number >= 1, got {episodes!r}")
    if isinstance(env, VectorEnv):
        if env.metadata.get("autoreset_mode") == AutoresetMode.SAME_STEP:
            raise ValueError("autoreset_mode SAME_STEP hides the last state; use NEXT_STEP or DISABLED")
        return _vector_episodes(policy, env, int(episodes), seed)
    if hasattr(env, "possible_agents"):
        return _parallel_episodes(policy, env, int(episodes), seed)
    return _single_episodes(policy, env, int(episodes), seed)


def _single_episodes(policy: Policy, env: Any, episodes: int, seed: int) -> Iterator[Episode]:
    plain = env.unwrapped
    for i in range(episodes):
        observation, _ = env.reset(seed=seed + i)
        row = _Row(plain.task, seed + i, plain.reference)
        row.states.append(plain.state)
        state, start = None, np.ones(1, dtype=np.bool_)
        if i == 0:
            _warm_up(policy, observation[None])
        while not row.done:
            begin = perf_counter()
            actions, state = policy.predict(observation[None], state, start, deterministic=True)
            seconds = perf_counter() - begin
            observation, reward, terminated, truncated, info = env.step(actions[0])
            row.add(actions[0], float(reward), info, seconds, (terminated, truncated))
            row.states.append(plain.state)
            start = np.zeros(1, dtype=np.bool_)
        row.note(state, 0)
        yield row.episode()


def _vector_episodes(policy: Policy, env: Any, episodes: int, seed: int) -> Iterator[Episode]:
    """Rounds of `num_envs` episodes; a row that is done waits with its last live observation."""
    plain, n = env.unwrapped, env.num_envs
    for first in range(0, episodes, n):
        observations, _ = env.reset(seed=[seed + first + j for j in range(n)])
        rows = [_Row(plain.task, seed + first + j, table) for j, table in enumerate(_references(plain))]
        for row, plant in zip(rows, plain.state, strict=True):
            row.states.append(plant)
        state, start = None, np.ones(n, dtype=np.bool_)
        live = np.ones(n, dtype=np.bool_)
        while live[: episodes - first].any():
            actions, state = policy.predict(observations, state, start, deterministic=True)
            applied = np.where(live[:, None], actions, np.float32(0.0))
            seen, rewards, terminated, truncated, info = env.step(applied)
            plants = plain.state
            for j in np.flatnonzero(live):
                said = {key: value[j] for key, value in info.items() if not key.startswith("_")}
                rows[j].add(actions[j], float(rewards[j]), said, np.nan, (terminated[j], truncated[j]))
                rows[j].states.append(plants[j])
                rows[j].note(state, int(j))
            live &= ~(terminated | truncated)
            observations = np.where(live[:, None], seen, observations)
            start = np.zeros(n, dtype=np.bool_)
        yield from (row.episode() for row in rows[: episodes - first])


def _parallel_episodes(policy: Policy, env: Any, episodes: int, seed: int) -> Iterator[Episode]:
    """Agents are rows, in the order of `possible_agents`; one that left keeps its last observation.

    Plants and references are what the environment offers as `plants` (n, 16), `references` (n, steps, 8).
    """
    plain, names = env.unwrapped, list(env.possible_agents)
    for i in range(episodes):
        seen, _ = env.reset(seed=seed + i)
        observations = np.stack([seen[name] for name in names])
        tables = getattr(plain, "references", np.zeros((len(names), 0, N_REFERENCE)))
        rows = [_Row(plain.task, seed + i, np.array(tables[j]), name) for j, name in enumerate(names)]
        _add_plants(rows, range(len(names)), plain)
        state, start = None, np.ones(len(names), dtype=np.bool_)
        if i == 0:
            _warm_up(policy, observations)
        while env.agents:
            begin = perf_counter()
            actions, state = policy.predict(observations, state, start, deterministic=True)
            seconds = (perf_counter() - begin) / len(names)
            acting = [j for j, name in enumerate(names) if name in env.agents]
            step = env.step({names[j]: actions[j] for j in acting})
            observations = observations.copy()
            for j in acting:
                reward, terminated, truncated, info = (part[names[j]] for part in step[1:])
                rows[j].add(actions[j], float(reward), info, seconds, (terminated, truncated))
                rows[j].note(state, j)
                observations[j] = step[0][names[j]]
            _add_plants(rows, acting, plain)
            start = np.zeros(len(names), dtype=np.bool_)
        yield from (row.episode() for row in rows)


def _add_plants(rows: list[_Row], which: Any, plain: Any) -> None:
    plants = getattr(plain, "plants", None)
    for j in which:
        rows[j].states.append(np.zeros(0) if plants is None else np.array(plants[j]))


def _warm_up(policy: Policy, observations: NDArray[Any]) -> None:
    """Compile before the clock runs; the result is dropped."""
    state, start = None, np.ones(len(observations), dtype=np.bool_)
    for _ in range(_WARM_UP_CALLS):
        _, state = policy.predict(observations, state, start, deterministic=True)
        start = np.zeros(len(observations), dtype=np.bool_)


def _references(plain: Any) -> list[Array]:
    """Copies of this round's reference tables, one per row."""
    if hasattr(plain, "reference"):
        return [np.array(table) for table in plain.reference]
    tables = plain._batch.references  # one for all rows where it is not random
    return [tables[j if len(tables) > 1 else 0].copy() for j in range(plain.num_envs)]
