"""Episodes of a policy in a single, a vector or a multi-agent environment, as records of arrays.

Episode i starts with the environment seed `seed + i`, whatever the policy: policies fly from the same starts.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv
from numpy.typing import NDArray

from quad_envs.arguments.checks import require_whole
from quad_envs.arguments.names import shown
from quad_envs.observations.tracking import N_REFERENCE
from quad_envs.parameters import Array
from quad_envs.tasks import BaseTask, TeamTask

from ..policies.environments import is_parallel, require_own_task
from ..policies.pairing import require_pair
from ..policies.protocol import Policy
from .amounts import require_episodes
from .deciding import decide
from .episode import Episode
from .recorder import INFO, Begun, Recorder, Said
from .rows import plants_of, row_episodes
from .team_signals import TEAM_INFO, WRAPPER_INFO

__all__ = ["Episode", "is_privileged", "run_episodes"]

_KEPT = (*INFO, *TEAM_INFO, *WRAPPER_INFO)
TIMED_STARTS, TIMED_STEPS = 20, 20  # flights in which decisions are timed, and of each the first ones
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
    check_flights(policy, env, episodes, seed, mismatch)
    return _episodes(policy, env, int(episodes), int(seed))


def check_flights(policy: Policy, env: Any, episodes: int, seed: int, mismatch: bool) -> None:
    """What `run_episodes` checks before the first flight.

    Raises:
        ValueError: As there.
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
    if isinstance(env, VectorEnv) and env.metadata.get("autoreset_mode") == AutoresetMode.SAME_STEP:
        raise ValueError("autoreset_mode SAME_STEP hides the last state; use NEXT_STEP or DISABLED")


def time_decisions(policy: Policy, env: Any, seed: int = 0) -> tuple[Array, ...]:
    """Wall times of decisions one at a time, in short flights that are there for nothing else.

    Args:
        policy: It.
        env: A Gymnasium environment or a ParallelEnv, which has been checked.
        seed: Of the first of TIMED_STARTS flights.

    Returns:
        Of each flight the times per vehicle, s, of its first TIMED_STEPS decisions, or to its end.
    """
    flights = _episodes(policy, env, TIMED_STARTS, seed, TIMED_STEPS)
    return tuple({episode.seed: episode.decision_times for episode in flights}.values())


def with_times(flights: Iterable[Episode], seed: int, timed: Sequence[Array]) -> Iterator[Episode]:
    """Flights that were not timed, with the times that `time_decisions` found from the same starts."""
    for episode in flights:
        found = timed[episode.seed - seed] if episode.seed - seed < len(timed) else np.zeros(0)
        found = found[: len(episode.rewards)]
        times = np.concatenate([found, np.full(len(episode.rewards) - len(found), np.nan)])
        yield episode._replace(decision_times=times)


def _episodes(
    policy: Policy, env: Any, episodes: int, seed: int, steps: int | None = None
) -> Iterator[Episode]:
    """Flights, cut after some steps if a number is given."""
    if isinstance(env, VectorEnv):
        return row_episodes(policy, env, episodes, seed)
    if is_parallel(env):
        return _parallel_episodes(policy, env, episodes, seed, steps)
    return _single_episodes(policy, env, episodes, seed, steps)


def _single_episodes(
    policy: Policy, env: Any, episodes: int, seed: int, steps: int | None
) -> Iterator[Episode]:
    plain, recorder = env.unwrapped, Recorder(_flown_task(env), 1)
    for i in range(episodes):
        observation, _ = env.reset(seed=seed + i)
        recorder.begin([0], [seed + i], Begun(plain.reference[None], plain.state[None]))
        if i == 0:
            _warm_up(policy, observation[None], recorder)
        state, start = None, np.ones(1, dtype=np.bool_)
        while recorder.live[0] and recorder.steps[0] != steps:
            actions, state, seconds = decide(policy, observation[None], state, start, recorder)
            seen = observation[None]
            observation, reward, terminated, truncated, said = env.step(actions[0])
            info = {key: np.asarray(said[key])[None] for key in INFO}
            told = Said(np.array([reward]), np.array([terminated]), np.array([truncated]), info)
            recorder.add(seen, state, actions, told, seconds, plain.state[None])
            start = np.zeros(1, dtype=np.bool_)
        yield from recorder.episodes([0])


def _flown_task(env: Any) -> BaseTask:
    """The Task with the time limit of `gymnasium.make(..., max_episode_steps=n)`, as `make_vec` has it."""
    task: BaseTask = env.unwrapped.task
    limit = getattr(getattr(env, "spec", None), "max_episode_steps", None) or 0
    return replace(task, episode_steps=limit) if 0 < limit < task.episode_steps else task


def _parallel_episodes(
    policy: Policy, env: Any, episodes: int, seed: int, steps: int | None
) -> Iterator[Episode]:
    """Agents are rows, in the order of `possible_agents`; one that left keeps its last observation.

    Plants, references and the target are what the environment offers as `plants` (n, 16), `references`
    (n, steps, 8) and `target` (steps, 6).
    """
    names = list(env.possible_agents)
    n, rows = len(names), range(len(names))
    task = getattr(env, "task", env.unwrapped.task)  # a wrapper that adds to the observation has its own
    recorder = Recorder(task, n, agents=names, team_size=n)
    for i in range(episodes):
        seen, _ = env.reset(seed=seed + i)
        observations = np.stack([seen[name] for name in names])
        recorder.begin(rows, [seed + i] * n, _begun_by_all(env.unwrapped, task, n))
        if i == 0:
            _warm_up(policy, _shown(policy, env, observations), recorder)
        state, first, last = None, True, None
        while env.agents and recorder.steps.max() != steps:
            shown = _shown(policy, env, observations)
            actions, state, taken = decide(policy, shown, state, np.full(len(shown), first), recorder)
            seconds = taken / n
            actions = actions[0] if is_privileged(policy) else actions
            step = env.step({name: actions[j] for j, name in enumerate(names) if name in env.agents})
            last = _stack_step(names, step[1:], last)
            plants = plants_of(env.unwrapped, n)
            recorder.add(observations, state, actions, last, seconds, plants)
            kept = [step[0].get(name, row) for name, row in zip(names, observations, strict=True)]
            observations, first = np.stack(kept), False
        yield from recorder.episodes(rows)


def _begun_by_all(plain: Any, task: BaseTask, n: int) -> Begun:
    """What a ParallelEnv shows of the episodes that it has just begun."""
    tables = np.array(getattr(plain, "references", np.zeros((n, 0, N_REFERENCE))))
    known = isinstance(task, TeamTask) and task.layout.target
    return Begun(tables, plants_of(plain, n), np.repeat(plain.target[None], n, axis=0) if known else None)


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


def _warm_up(policy: Policy, observations: NDArray[Any], recorder: Recorder) -> None:
    """Compile before the clock runs; the result is dropped."""
    state, start = None, np.ones(len(observations), dtype=np.bool_)
    for _ in range(_WARM_UP_CALLS):
        _, state, _ = decide(policy, observations, state, start, recorder)
        start = np.zeros(len(observations), dtype=np.bool_)
