"""Episodes of a policy in a single, a vector or a multi-agent environment, as records of arrays.

Episode i starts with the environment seed `seed + i`, whatever the policy: policies fly from the same starts.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import islice
from typing import Any

import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv
from numpy.typing import NDArray

from quad_envs.checks import require_whole
from quad_envs.names import shown
from quad_envs.observations.tracking import N_REFERENCE
from quad_envs.parameters import Array
from quad_envs.tasks import BaseTask, TeamTask

from ..policies.environments import is_parallel, require_own_task
from ..policies.pairing import require_pair
from ..policies.protocol import Policy
from .amounts import require_episodes
from .deciding import decide
from .episode import INFO, Episode, Recorder, Said
from .team_signals import TEAM_INFO, WRAPPER_INFO

__all__ = ["Episode", "is_privileged", "run_episodes"]

_KEPT = (*INFO, *TEAM_INFO, *WRAPPER_INFO)
_WARM_UP_CALLS = 2  # the first compiles, the second takes the path with a state


def is_privileged(policy: Any) -> bool:
    """Whether a policy decides from the whole truth (`env.state()`), as a yardstick for those that do not."""
    return bool(getattr(policy, "privileged", False))


def run_episodes(
    policy: Policy, env: Any, episodes: int, seed: int = 0, *, mismatch: bool = False
) -> Iterator[Episode]:
    """Fly episodes one after the other, and yield each as soon as it is complete.

    Args:
        policy: Decides from observations alone; a privileged one for a whole team from `env.state()`.
        env: A Gymnasium environment (each decision is timed), a vector environment (fast, not timed), or a
            PettingZoo ParallelEnv (one episode per agent, agents are rows of the observation). A vector of
            teams gives one episode per agent, too.
        episodes: Number of episodes, >= 1.
        seed: Seed of the first one, >= 0.
        mismatch: Whether the policy may be one of another task (vehicle, limits, weights) on purpose; the
            observations must have the same layout.

    Raises:
        ValueError: If episodes < 1, the seed < 0, the environment is not of this suite, the policy was made
            for another task, a wrapper changes the numbers that it reads or writes, a vector environment
            resets in the same step, or a privileged policy cannot see the truth. In flight if an observation
            or an action is not finite, with the row, its seed and the step.
    """
    require_episodes("episodes", episodes)
    require_whole("seed", seed, 0)
    require_own_task(env)
    require_pair(policy, env, mismatch)
    if is_privileged(policy) and not is_parallel(env):
        raise ValueError(
            f"{type(policy).__name__} decides from the truth about one team: fly it in a ParallelEnv, "
            f"got {shown(env)}"
        )
    if isinstance(env, VectorEnv):
        if env.metadata.get("autoreset_mode") == AutoresetMode.SAME_STEP:
            raise ValueError("autoreset_mode SAME_STEP hides the last state; use NEXT_STEP or DISABLED")
        return _vector_episodes(policy, env, int(episodes), seed)
    if is_parallel(env):
        return _parallel_episodes(policy, env, int(episodes), seed)
    return _single_episodes(policy, env, int(episodes), seed)


def _single_episodes(policy: Policy, env: Any, episodes: int, seed: int) -> Iterator[Episode]:
    plain, task = env.unwrapped, _flown_task(env)
    for i in range(episodes):
        observation, _ = env.reset(seed=seed + i)
        recorder = Recorder(task, [seed + i], plain.reference[None], plain.state[None])
        if i == 0:
            _warm_up(policy, observation[None], recorder)
        state, start = None, np.ones(1, dtype=np.bool_)
        while recorder.live[0]:
            actions, state, seconds = decide(policy, observation[None], state, start, recorder)
            seen = observation[None]
            observation, reward, terminated, truncated, said = env.step(actions[0])
            info = {key: np.asarray(said[key])[None] for key in INFO}
            told = Said(np.array([reward]), np.array([terminated]), np.array([truncated]), info)
            recorder.add(seen, state, actions, told, seconds, plain.state[None])
            start = np.zeros(1, dtype=np.bool_)
        yield from recorder.episodes()


def _flown_task(env: Any) -> BaseTask:
    """The Task with the time limit of `gymnasium.make(..., max_episode_steps=n)`, as `make_vec` has it."""
    task: BaseTask = env.unwrapped.task
    limit = getattr(getattr(env, "spec", None), "max_episode_steps", None) or 0
    return replace(task, episode_steps=limit) if 0 < limit < task.episode_steps else task


def _vector_episodes(policy: Policy, env: Any, episodes: int, seed: int) -> Iterator[Episode]:
    """Rounds of as many episodes as there are rows, or teams; a row that is done waits with what it saw last.

    A team's vehicles are consecutive rows.
    """
    plain, n = env.unwrapped, env.num_envs
    teams = getattr(plain, "num_teams", n)
    size = n // teams
    for first in range(0, episodes, teams):
        seeds = [seed + first + t for t in range(teams)]
        observations, _ = env.reset(seed=seeds)
        recorder = _vector_recorder(plain, np.repeat(seeds, size).tolist(), size)
        wanted = size * min(teams, episodes - first)
        state, start = None, np.ones(n, dtype=np.bool_)
        while recorder.live[:wanted].any():
            live = recorder.live[:, None].copy()
            actions, state, _ = decide(policy, observations, state, start, recorder)
            seen, *told = env.step(np.where(live, actions, np.float32(0.0)))
            recorder.add(observations, state, actions, Said(*told), np.nan, _plants(plain, n))
            observations = np.where(recorder.live[:, None], seen, observations)
            start = np.zeros(n, dtype=np.bool_)
        yield from islice(recorder.episodes(), wanted)


def _vector_recorder(plain: Any, seeds: Sequence[int], size: int) -> Recorder:
    """For the episodes that a vector environment has just begun."""
    if not isinstance(plain.task, TeamTask):
        return Recorder(plain.task, seeds, plain.reference, plain.state)
    names = [f"quad_{i % size}" for i in range(len(seeds))]
    targets = np.repeat(plain.targets, size, axis=0) if plain.task.layout.target else None
    return Recorder(
        plain.task, seeds, plain.references, plain.plants, agents=names, targets=targets, team_size=size
    )


def _parallel_episodes(policy: Policy, env: Any, episodes: int, seed: int) -> Iterator[Episode]:
    """Agents are rows, in the order of `possible_agents`; one that left keeps its last observation.

    Plants, references and the target are what the environment offers as `plants` (n, 16), `references`
    (n, steps, 8) and `target` (steps, 6).
    """
    names = list(env.possible_agents)
    for i in range(episodes):
        seen, _ = env.reset(seed=seed + i)
        observations = np.stack([seen[name] for name in names])
        recorder = _parallel_recorder(env, seed + i, names)
        if i == 0:
            _warm_up(policy, _shown(policy, env, observations), recorder)
        state, first, last = None, True, None
        while env.agents:
            shown = _shown(policy, env, observations)
            actions, state, taken = decide(policy, shown, state, np.full(len(shown), first), recorder)
            seconds = taken / len(names)
            actions = actions[0] if is_privileged(policy) else actions
            step = env.step({name: actions[j] for j, name in enumerate(names) if name in env.agents})
            last = _stack_step(names, step[1:], last)
            plants = _plants(env.unwrapped, len(names))
            recorder.add(observations, state, actions, last, seconds, plants)
            rows = [step[0].get(name, row) for name, row in zip(names, observations, strict=True)]
            observations, first = np.stack(rows), False
        yield from recorder.episodes()


def _parallel_recorder(env: Any, seed: int, names: Sequence[str]) -> Recorder:
    """For the episodes that a ParallelEnv has just begun."""
    plain, n = env.unwrapped, len(names)
    task = getattr(env, "task", plain.task)  # a wrapper that adds to the observation has its own
    tables = np.array(getattr(plain, "references", np.zeros((n, 0, N_REFERENCE))))
    known = isinstance(task, TeamTask) and task.layout.target
    targets = np.repeat(plain.target[None], n, axis=0) if known else None
    return Recorder(task, [seed] * n, tables, _plants(plain, n), agents=names, targets=targets, team_size=n)


def _shown(policy: Policy, env: Any, observations: NDArray[Any]) -> NDArray[Any]:
    """What a policy decides from: the agents' observations, or the truth as a single row."""
    return np.asarray(env.unwrapped.state())[None] if is_privileged(policy) else observations


def _stack_step(names: Sequence[str], parts: Sequence[Mapping[str, Any]], last: Said | None) -> Said:
    """Rewards, ends and infos of all agents as arrays; of agents that left, what they had last."""
    rewards, terminated, truncated, infos = parts
    told = []
    for j, name in enumerate(names):
        if name in rewards:
            info = {key: infos[name][key] for key in _KEPT if key in infos[name]}
            told.append((rewards[name], terminated[name], truncated[name], info))
        elif last is not None:
            info = {key: values[j] for key, values in last.info.items()}
            told.append((last.rewards[j], last.terminated[j], last.truncated[j], info))
        else:
            raise ValueError(
                f"agent {name!r} of possible_agents takes no part in the first step; all have to"
            )
    first, second, third, last_infos = zip(*told, strict=True)
    info = {key: np.array([entry[key] for entry in last_infos]) for key in last_infos[0]}
    return Said(np.array(first), np.array(second), np.array(third), info)


def _plants(plain: Any, n: int) -> Array:
    """Plants as a team shows them, or as a vector of single vehicles does."""
    found = getattr(plain, "plants", None)
    if found is None:
        found = getattr(plain, "state", None) if hasattr(plain, "num_envs") else np.zeros((n, 0))
    return np.array(found, dtype=np.float64)


def _warm_up(policy: Policy, observations: NDArray[Any], recorder: Recorder) -> None:
    """Compile before the clock runs; the result is dropped."""
    state, start = None, np.ones(len(observations), dtype=np.bool_)
    for _ in range(_WARM_UP_CALLS):
        _, state, _ = decide(policy, observations, state, start, recorder)
        start = np.zeros(len(observations), dtype=np.bool_)
