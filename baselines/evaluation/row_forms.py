"""The vector form of an environment, in whose rows the flights of an evaluation go side by side."""

from __future__ import annotations

import warnings
from dataclasses import fields
from typing import Any

from gymnasium.vector import VectorEnv
from gymnasium.wrappers import OrderEnforcing, PassiveEnvChecker, TimeLimit

from ..policies.independence import has_independent_rows
from ..policies.protocol import Policy

_MOST_ROWS = 64  # flights side by side: more are hardly faster
_ROW_STEPS = 25_600  # steps of all rows that are recorded at once, at most: some 10 MB
_CHECKING = (OrderEnforcing, PassiveEnvChecker)  # what `gymnasium.make` puts around, which changes nothing


def has_row_form(policy: Policy, env: Any) -> bool:
    """Whether flights may go side by side in the rows of a vector environment.

    Not where a wrapper or another class may do what no vector form knows of, where pictures are made, or
    where the rows of the policy are not known to be independent.

    Args:
        policy: It.
        env: An environment of whatever kind.
    """
    plain = _unchecked(env)
    module = type(plain).__module__
    ours = module.startswith("quad_envs.") and hasattr(plain, "options") and plain.render_mode is None
    return ours and has_independent_rows(policy)


def row_form(env: Any, episodes: int) -> VectorEnv[Any, Any, Any]:
    """A vector environment whose rows, or teams of rows, are as an environment that has such a form.

    Args:
        env: It.
        episodes: How many are to be flown.
    """
    options = _unchecked(env).options
    size = getattr(options, "vehicles", 1)
    rows = max(1, min(episodes, _MOST_ROWS // size, _ROW_STEPS // (size * options.episode_steps)))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # said when the environment was made
        return _vector(options, rows)


def _unchecked(env: Any) -> Any:
    """The environment without what `gymnasium.make` puts around it and ends no episode before its time."""
    while isinstance(env, _CHECKING) or (isinstance(env, TimeLimit) and _reaches_end(env)):
        env = env.env
    return env


def _reaches_end(env: Any) -> bool:
    return bool(env.spec.max_episode_steps >= env.unwrapped.task.episode_steps)


def _vector(options: Any, rows: int) -> VectorEnv[Any, Any, Any]:
    if hasattr(options, "vehicles"):
        from quad_envs.envs.team.vector import TeamVectorEnv

        return TeamVectorEnv(options, rows)
    from quad_envs.envs.tracking.vector import TrackingVectorEnv

    values = {entry.name: getattr(options, entry.name) for entry in fields(options) if entry.init}
    return TrackingVectorEnv(rows, **values)
