"""From what a user has at hand, an id or an environment of whatever kind, to the environment and its task."""

from __future__ import annotations

import warnings
from importlib import import_module
from typing import Any

import gymnasium
import numpy as np

import quad_envs  # noqa: F401  registers the ids
from quad_envs.arguments.names import shown, unknown_name
from quad_envs.registration import TEAMS, TRACKING
from quad_envs.tasks import BaseTask

from .outside import import_named

_RESERVED = {"id", "env_id", "self"}  # what makers of environments call what is theirs


def make_env(env_id: str, /, **kwargs: Any) -> Any:
    """`gymnasium.make`, or the ParallelEnv of a multi-agent id; an unknown id gets the nearest one suggested.

    Args:
        env_id: The id; `module:id` imports the module first, which registers it, as Gymnasium has it.
        kwargs: Of the environment.

    Raises:
        ValueError: If the id or an argument is unknown or not allowed.
    """
    reserved = sorted(_RESERVED & set(kwargs))
    if reserved:
        raise ValueError(f"{reserved[0]!r} is no argument of an environment that can be chosen: leave it out")
    module, _, name = env_id.rpartition(":")
    if module:
        import_named(module, f"environment {env_id!r}")
    if name in TEAMS:  # not through PettingZoo's registry, which it has from 1.27 on
        try:
            return import_module(TEAMS[name]).parallel_env(**kwargs)
        except TypeError as error:
            raise ValueError(str(error)) from error
    if name not in gymnasium.registry:
        others = [known for known in gymnasium.registry if module and known.startswith(name.split("/")[0])]
        raise ValueError(unknown_name("environment id", env_id, [*TRACKING, *TEAMS, *others]))
    try:
        with warnings.catch_warnings():
            if name in TRACKING:  # which refuse such a mode themselves
                warnings.filterwarnings("ignore", ".*not in the possible render_modes", UserWarning)
            return gymnasium.make(name, **kwargs)
    except TypeError as error:  # Gymnasium repeats all arguments behind the environment's own message
        raise ValueError(str(error.__cause__ or error)) from error


def is_parallel(env: Any) -> bool:
    """Whether an environment is a PettingZoo ParallelEnv, wrapped or not."""
    return hasattr(env, "possible_agents") and not hasattr(env, "agent_iter")


def environment_of(source: Any) -> Any:
    """The environment of an id, or the environment itself.

    Raises:
        ValueError: If it is neither.
    """
    if isinstance(source, BaseTask):
        raise ValueError(
            f"this policy is made from an environment, got the task of {source.env_id}: give the environment"
        )
    return make_env(source) if isinstance(source, str) else source


def task_of(source: Any) -> BaseTask:
    """The task of an environment (wrapped or not), a vector of them, a ParallelEnv, an id, or a task itself.

    Raises:
        ValueError: If there is none, or if a wrapper changed the observations or actions that it describes.
    """
    if isinstance(source, BaseTask):
        return source
    if isinstance(source, str):
        env = make_env(source)
        try:
            return task_of(env)
        finally:
            env.close()
    task = find_task(source)
    if not isinstance(task, BaseTask):
        raise _no_task(source)
    _check_spaces(source, task)
    return task


def require_own_task(env: Any) -> None:
    """Check that an environment can be flown and measured: that it, and not a part of it, has the task.

    Raises:
        ValueError: If not; it says what to use instead.
    """
    if hasattr(env, "agent_iter"):
        raise ValueError(
            f"{env!r} moves one agent after the other; all have to decide at once: use parallel_env of its "
            "module, or pettingzoo.make with the kind 'parallel'"
        )
    if isinstance(getattr(getattr(env, "unwrapped", env), "task", None), BaseTask):
        return
    if isinstance(find_task(env), BaseTask):
        raise ValueError(
            f"a {type(env).__name__} hides the plants of its environments: use gymnasium.make_vec(..., "
            'vectorization_mode="vector_entry_point"), its default for the ids of this suite, or a single '
            "environment"
        )
    raise _no_task(env)


def _no_task(source: Any) -> ValueError:
    return ValueError(
        f"cannot find the task of {shown(source)}: give an environment of this suite (gymnasium.make, "
        f"make_vec, pettingzoo.make), one of the ids {', '.join([*TRACKING, *TEAMS])}, or a quad_envs.Task"
    )


def find_task(source: Any) -> Any:
    """What is called `task` of an environment of whatever kind; None where nothing is."""
    if is_parallel(source):  # a wrapper that adds to the observation brings a task that says so
        return getattr(source, "task", None)
    task = getattr(getattr(source, "unwrapped", source), "task", None)
    if task is None and hasattr(source, "get_attr"):  # SyncVectorEnv, AsyncVectorEnv, and SB3's VecEnv
        try:
            found = source.get_attr("task")
        except AttributeError:
            return None
        task = found[0] if len(found) else None
    return task


def _spaces(env: Any) -> tuple[Any, Any]:
    """Observation and action space of one vehicle; None where there is none."""
    if is_parallel(env):
        first = env.possible_agents[0]
        return env.observation_space(first), env.action_space(first)
    observations = getattr(env, "single_observation_space", getattr(env, "observation_space", None))
    return observations, getattr(env, "single_action_space", getattr(env, "action_space", None))


def _check_spaces(env: Any, task: Any) -> None:
    """A policy reads the task's own layout and commands its own action box."""
    observations, actions = _spaces(env)
    shape = getattr(observations, "shape", None)
    if shape is not None and shape[-1:] != (task.layout.size,):
        raise ValueError(
            f"a wrapper changed the observation to shape {shape}; the task's layout has "
            f"{task.layout.size} entries. Build the policy from env.unwrapped, for its observations"
        )
    low, high = getattr(actions, "low", None), getattr(actions, "high", None)
    if low is not None and high is not None and not (np.all(low == -1.0) and np.all(high == 1.0)):
        raise ValueError(f"a wrapper changed the action box to {actions}; policies command a Box(-1, 1)")
