"""From what a user has at hand, an id, an environment, a vector of them, to the environment and its Task."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np

import quad_envs  # noqa: F401  registers the ids
from quad_envs.names import unknown_name
from quad_envs.registration import TRACKING
from quad_envs.tasks import Task


def make_env(env_id: str, **kwargs: Any) -> gymnasium.Env[Any, Any]:
    """`gymnasium.make` with an error that suggests the nearest id of this suite.

    Raises:
        ValueError: If the id or an argument is unknown or not allowed.
    """
    name = env_id.removeprefix("quad_envs:")
    if name not in gymnasium.registry:
        raise ValueError(unknown_name("environment id", env_id, TRACKING))
    try:
        return gymnasium.make(name, **kwargs)
    except TypeError as error:  # Gymnasium repeats all arguments behind the environment's own message
        raise ValueError(str(error.__cause__ or error)) from error


def task_of(source: Any) -> Task:
    """The Task of an environment (wrapped or not), a vector environment, an id or a Task.

    Raises:
        ValueError: If there is none, or if a wrapper changed the observations or actions that it describes.
    """
    if isinstance(source, Task):
        return source
    if isinstance(source, str):
        env = make_env(source)
        try:
            return task_of(env)
        finally:
            env.close()
    task = _find_task(source)
    if not isinstance(task, Task):
        raise _no_task(source)
    _check_spaces(source, task)
    return task


def require_own_task(env: Any) -> None:
    """Check that an environment can be flown and measured: that it, and not a part of it, has the Task.

    Raises:
        ValueError: If not; it says what to use instead.
    """
    if isinstance(getattr(getattr(env, "unwrapped", env), "task", None), Task):
        return
    if isinstance(_find_task(env), Task):
        raise ValueError(
            f"a {type(env).__name__} hides the plants of its environments: use gymnasium.make_vec(..., "
            'vectorization_mode="vector_entry_point"), its default for the ids of this suite, or a single '
            "environment"
        )
    raise _no_task(env)


def _no_task(source: Any) -> ValueError:
    return ValueError(
        f"cannot find the task of {source!r}: give an environment of this suite (gymnasium.make, "
        f"make_vec), one of the ids {', '.join(TRACKING)}, or a quad_envs.Task"
    )


def _find_task(source: Any) -> Any:
    task = getattr(getattr(source, "unwrapped", source), "task", None)
    if task is None and hasattr(source, "get_attr"):  # SyncVectorEnv, AsyncVectorEnv, and SB3's VecEnv
        try:
            found = source.get_attr("task")
        except AttributeError:
            return None
        task = found[0] if len(found) else None
    return task


def _check_spaces(env: Any, task: Task) -> None:
    """A policy reads the task's own layout and commands its own action box."""
    observations = getattr(env, "single_observation_space", getattr(env, "observation_space", None))
    actions = getattr(env, "single_action_space", getattr(env, "action_space", None))
    shape = getattr(observations, "shape", None)
    if shape is not None and shape[-1:] != (task.layout.size,):
        raise ValueError(
            f"a wrapper changed the observation to shape {shape}; the task's layout has "
            f"{task.layout.size} entries. Build the policy from env.unwrapped, for its observations"
        )
    low, high = getattr(actions, "low", None), getattr(actions, "high", None)
    if low is not None and high is not None and not (np.all(low == -1.0) and np.all(high == 1.0)):
        raise ValueError(f"a wrapper changed the action box to {actions}; policies command Box(-1, 1, (4,))")
