"""Episodes of a policy in a single, a vector or a multi-agent environment, as records of arrays.

Episode i starts with the environment seed `seed + i`, whatever the policy: policies fly from the same starts.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import islice
from time import perf_counter
from typing import Any, NamedTuple

import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv
from numpy.typing import NDArray

from quad_envs.constraints import forces_from_actions
from quad_envs.observations import N_REFERENCE
from quad_envs.parameters import Array
from quad_envs.tasks import BaseTask

from .environments import require_own_task
from .policy import N_FALLBACKS, Actions, Counts, Policy, PolicyState

_SCORES = ("stage_cost", "cost", "constraint_violation")
_INFO = (*_SCORES, "constraint_values", "crashed")
_WARM_UP_CALLS = 2  # the first compiles, the second takes the path with a state


class Episode(NamedTuple):
    """One flight of T control periods. Row k of what is per step belongs to the step from k to k + 1."""

    task: BaseTask  # as flown: with the time limit that Gymnasium set, where that one is shorter
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


class _Said(NamedTuple):
    """What the environment said of a step, for all vehicles."""

    rewards: NDArray[Any]  # (n,)
    terminated: NDArray[Any]
    truncated: NDArray[Any]
    info: Mapping[str, NDArray[Any]]  # the keys _INFO, vehicles first


class _Recorder:
    """What n vehicles do in one round, collected step by step as arrays over the vehicles."""

    def __init__(
        self, task: BaseTask, seeds: Sequence[int], references: Array, agents: Sequence[str] = ()
    ) -> None:
        self.task, self.seeds, self.references = task, seeds, references
        n = len(seeds)
        self.agents = agents or [""] * n
        self.live = np.ones(n, dtype=np.bool_)
        self.lengths = np.zeros(n, dtype=np.int64)
        self.ends = np.zeros((3, n), dtype=np.bool_)  # crashed, terminated, truncated
        self.fallbacks, self.worst = np.zeros((n, N_FALLBACKS), dtype=np.int64), np.zeros(n, dtype=np.int64)
        self.steps: list[tuple[NDArray[Any], Array, NDArray[Any]]] = []
        self.seconds: list[float] = []
        self.plants: list[Array] = []

    def add(self, state: Any, actions: Actions, said: _Said, seconds: float, plants: Array) -> None:
        """One step of all vehicles; of those that are done, nothing is kept."""
        live, info = self.live.copy(), said.info
        scores = np.stack([said.rewards, *(info[key] for key in _SCORES)], axis=1).astype(np.float64)
        self.steps.append((np.array(actions), scores, info["constraint_values"]))
        self.seconds.append(seconds)
        self.plants.append(plants)
        self.lengths[live] += 1
        self.ends[:, live] = np.stack([info["crashed"], said.terminated, said.truncated])[:, live]
        if isinstance(state, PolicyState):
            self.fallbacks[live], self.worst[live] = state.fallbacks[live], state.worst_iterations[live]
        self.live &= ~(self.ends[1] | self.ends[2])

    def episodes(self) -> Iterator[Episode]:
        """The flights as arrays."""
        actions, scores, values = (np.stack([step[i] for step in self.steps]) for i in range(3))
        seconds, plants = np.array(self.seconds), np.stack(self.plants)
        for j, steps in enumerate(self.lengths.tolist()):
            flown = scores[:steps, j].copy()
            yield Episode(
                task=self.task,
                seed=self.seeds[j],
                states=plants[: steps + 1, j].copy(),
                references=self.references[j, : steps + 1].copy(),
                commands=forces_from_actions(actions[:steps, j], self.task.hover_force, self.task.force_max),
                rewards=flown[:, 0],
                stage_costs=flown[:, 1],
                costs=flown[:, 2],
                violations=flown[:, 3] > 0.0,
                constraint_values=values[:steps, j].copy(),
                decision_times=seconds[:steps].copy(),
                fallbacks=self.fallbacks[j].copy(),
                worst_iterations=int(self.worst[j]),
                crashed=bool(self.ends[0, j]),
                terminated=bool(self.ends[1, j]),
                truncated=bool(self.ends[2, j]),
                agent=self.agents[j],
            )


def run_episodes(policy: Policy, env: Any, episodes: int, seed: int = 0) -> Iterator[Episode]:
    """Fly episodes one after the other, and yield each as soon as it is complete.

    Args:
        policy: Decides from observations alone.
        env: A Gymnasium environment (each decision is timed), a vector environment (fast, not timed), or a
            PettingZoo ParallelEnv (one episode per agent, agents are rows of the observation).
        episodes: Number of episodes, >= 1.
        seed: Seed of the first one, >= 0.

    Raises:
        ValueError: If episodes < 1, the seed < 0, the environment is not of this suite, or a vector
            environment resets in the same step.
    """
    if isinstance(episodes, bool) or not isinstance(episodes, int | np.integer) or episodes < 1:
        raise ValueError(f"episodes must be a whole number >= 1, got {episodes!r}")
    if isinstance(seed, bool) or not isinstance(seed, int | np.integer) or seed < 0:
        raise ValueError(f"seed must be a whole number >= 0, got {seed!r}")
    require_own_task(env)
    if isinstance(env, VectorEnv):
        if env.metadata.get("autoreset_mode") == AutoresetMode.SAME_STEP:
            raise ValueError("autoreset_mode SAME_STEP hides the last state; use NEXT_STEP or DISABLED")
        return _vector_episodes(policy, env, int(episodes), seed)
    if hasattr(env, "possible_agents"):
        return _parallel_episodes(policy, env, int(episodes), seed)
    return _single_episodes(policy, env, int(episodes), seed)


def _single_episodes(policy: Policy, env: Any, episodes: int, seed: int) -> Iterator[Episode]:
    plain, task = env.unwrapped, _flown_task(env)
    for i in range(episodes):
        observation, _ = env.reset(seed=seed + i)
        recorder = _Recorder(task, [seed + i], plain.reference[None])
        recorder.plants.append(plain.state[None])
        if i == 0:
            _warm_up(policy, observation[None])
        state, start = None, np.ones(1, dtype=np.bool_)
        while recorder.live[0]:
            begin = perf_counter()
            actions, state = policy.predict(observation[None], state, start, deterministic=True)
            seconds = perf_counter() - begin
            observation, reward, terminated, truncated, said = env.step(actions[0])
            info = {key: np.asarray(said[key])[None] for key in _INFO}
            told = _Said(np.array([reward]), np.array([terminated]), np.array([truncated]), info)
            recorder.add(state, actions, told, seconds, plain.state[None])
            start = np.zeros(1, dtype=np.bool_)
        yield from recorder.episodes()


def _flown_task(env: Any) -> BaseTask:
    """The Task with the time limit of `gymnasium.make(..., max_episode_steps=n)`, as `make_vec` has it."""
    task: BaseTask = env.unwrapped.task
    limit = getattr(getattr(env, "spec", None), "max_episode_steps", None) or 0
    return replace(task, episode_steps=limit) if 0 < limit < task.episode_steps else task


def _vector_episodes(policy: Policy, env: Any, episodes: int, seed: int) -> Iterator[Episode]:
    """Rounds of `num_envs` episodes; a row that is done waits with its last live observation."""
    plain, n = env.unwrapped, env.num_envs
    for first in range(0, episodes, n):
        seeds = [seed + first + j for j in range(n)]
        observations, _ = env.reset(seed=seeds)
        recorder = _Recorder(plain.task, seeds, plain.reference)
        recorder.plants.append(plain.state)
        wanted = min(n, episodes - first)
        state, start = None, np.ones(n, dtype=np.bool_)
        while recorder.live[:wanted].any():
            live = recorder.live[:, None].copy()
            actions, state = policy.predict(observations, state, start, deterministic=True)
            seen, *told = env.step(np.where(live, actions, np.float32(0.0)))
            recorder.add(state, actions, _Said(*told), np.nan, plain.state)
            observations = np.where(recorder.live[:, None], seen, observations)
            start = np.zeros(n, dtype=np.bool_)
        yield from islice(recorder.episodes(), wanted)


def _parallel_episodes(policy: Policy, env: Any, episodes: int, seed: int) -> Iterator[Episode]:
    """Agents are rows, in the order of `possible_agents`; one that left keeps its last observation.

    Plants and references are what the environment offers as `plants` (n, 16), `references` (n, steps, 8).
    """
    plain, names = env.unwrapped, list(env.possible_agents)
    n = len(names)
    for i in range(episodes):
        seen, _ = env.reset(seed=seed + i)
        observations = np.stack([seen[name] for name in names])
        tables = np.array(getattr(plain, "references", np.zeros((n, 0, N_REFERENCE))))
        recorder = _Recorder(plain.task, [seed + i] * n, tables, names)
        recorder.plants.append(_plants(plain, n))
        if i == 0:
            _warm_up(policy, observations)
        state, start, last = None, np.ones(n, dtype=np.bool_), None
        while env.agents:
            begin = perf_counter()
            actions, state = policy.predict(observations, state, start, deterministic=True)
            seconds = (perf_counter() - begin) / n
            step = env.step({name: actions[j] for j, name in enumerate(names) if name in env.agents})
            last = _stack_step(names, step[1:], last)
            recorder.add(state, actions, last, seconds, _plants(plain, n))
            rows = [step[0].get(name, row) for name, row in zip(names, observations, strict=True)]
            observations = np.stack(rows)
            start = np.zeros(n, dtype=np.bool_)
        yield from recorder.episodes()


def _stack_step(names: Sequence[str], parts: Sequence[Mapping[str, Any]], last: _Said | None) -> _Said:
    """Rewards, ends and infos of all agents as arrays; of agents that left, what they had last."""
    rewards, terminated, truncated, infos = parts
    told = []
    for j, name in enumerate(names):
        if name in rewards:
            info = {key: infos[name][key] for key in _INFO}
            told.append((rewards[name], terminated[name], truncated[name], info))
        elif last is not None:
            info = {key: last.info[key][j] for key in _INFO}
            told.append((last.rewards[j], last.terminated[j], last.truncated[j], info))
        else:
            raise ValueError(
                f"agent {name!r} of possible_agents takes no part in the first step; all have to"
            )
    first, second, third, last_infos = zip(*told, strict=True)
    info = {key: np.array([entry[key] for entry in last_infos]) for key in _INFO}
    return _Said(np.array(first), np.array(second), np.array(third), info)


def _plants(plain: Any, n: int) -> Array:
    return np.array(getattr(plain, "plants", np.zeros((n, 0))), dtype=np.float64)


def _warm_up(policy: Policy, observations: NDArray[Any]) -> None:
    """Compile before the clock runs; the result is dropped."""
    state, start = None, np.ones(len(observations), dtype=np.bool_)
    for _ in range(_WARM_UP_CALLS):
        _, state = policy.predict(observations, state, start, deterministic=True)
        start = np.zeros(len(observations), dtype=np.bool_)
