"""`evaluate`: one policy in one environment; its numbers, and with a folder its flights and its page."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

from quad_envs.arguments.checks import require_path
from quad_envs.arguments.names import shown
from quad_envs.tasks import BaseTask, TeamTask

from ..evaluation.episode import Episode
from ..evaluation.evaluate import Evaluation, fly_and_measure
from ..files import plain_json
from ..policies.environments import require_own_task
from ..policies.outside import name_of
from ..policies.protocol import Policy
from ..policies.registry import policy_name
from ..sweeps.choices import EnvChoice, PolicyChoice
from ..sweeps.suite import Suite
from ..sweeps.sweep import Order
from ..sweeps.units import Given
from .benchmark import fly_suite


def evaluate(
    policy: Policy | Any,
    env: Any,
    episodes: int = 20,
    seed: int = 0,
    on_episode: Callable[[Episode], None] | None = None,
    *,
    mismatch: bool = False,
    out: str | Path | None = None,
    fresh: bool = False,
) -> Evaluation:
    """Fly a policy from several starts and measure it.

    Flights go side by side in the rows of a vector environment made for them, with the same starts and the
    same numbers as one at a time (a network's in float32); decisions are then timed in 20 short flights of
    their own, one at a time. One flight at a time, with each decision timed, fly: policies from outside that
    do not say `independent_rows = True`, privileged ones, wrapped or foreign environments, those that draw.
    Only numbers are kept of each flight. A team gives one record per vehicle and flight; means and intervals
    are over flights.

    Args:
        policy: Anything with `predict`, or what `make_policy` takes: a name, `module:factory`, a factory.
        env: An id, a Gymnasium environment or a ParallelEnv, or a vector environment (decisions are not
            timed).
        episodes: Number of flights, >= 1.
        seed: Flight i starts with the environment seed `seed + i`.
        on_episode: Called with each flight, of a team with that of each vehicle, to save or plot it.
        mismatch: Whether the policy may be one of another task on purpose, see `run_episodes`. Conditions
            with `randomize` need it not: the task knows the nominal vehicle.
        out: Results folder with every flight, the tables and report.html, the leaderboard of one; as that of
            `run_benchmark`. Objects fly again when it is called again.
        fresh: Whether to discard what the folder holds of an earlier run.

    Raises:
        ValueError: If the id or the policy's name is unknown, episodes < 1, or as `run_episodes` says.
        PolicyError: If a policy from outside cannot be made or breaks off; the message names the line.
        ResultsError: If the folder is in use, holds another run, or cannot be written.
    """
    if out is None:
        return fly_and_measure(policy, env, episodes, seed, on_episode, mismatch=mismatch)
    require_path("out", out)
    policy = os.fspath(policy) if isinstance(policy, os.PathLike) else policy
    choice = PolicyChoice(policy) if isinstance(policy, str) else _choice_of(policy)
    suite = Suite("evaluate", (_env_choice(env),), (choice,), episodes, seed)
    given = Given(
        None if isinstance(policy, str) else policy,
        None if isinstance(env, str) else env,
        on_episode,
        mismatch,
    )
    return fly_suite(suite, {choice.title: given}, out, Order(save_episodes=True, fresh=fresh)).evaluations[0]


def _choice_of(policy: Any) -> PolicyChoice:
    return PolicyChoice(name_of(policy), label=policy_name(policy))


def _env_choice(env: Any) -> EnvChoice:
    """An environment as a suite names it: with the arguments of its spec, where it has one."""
    if isinstance(env, str):
        return EnvChoice(env)
    require_own_task(env)
    if hasattr(env, "num_envs") and isinstance(env.unwrapped.task, TeamTask):
        raise ValueError(f"out needs one team at a time: give parallel_env of its module, got {shown(env)}")
    task: BaseTask = env.unwrapped.task
    kwargs = dict(getattr(getattr(env, "spec", None), "kwargs", {}))
    kwargs.pop("env_id", None)
    return EnvChoice(task.env_id, plain_json(kwargs))
