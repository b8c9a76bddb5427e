"""`quad/CooperativeEstimation-v0` as a module, as PettingZoo's own environments have one."""

from __future__ import annotations

from typing import Any

from pettingzoo import AECEnv
from pettingzoo.utils import parallel_to_aec

from .envs.team.options import EstimationOptions
from .envs.team.target_tracking import CooperativeEstimationEnv as raw_env
from .envs.team.vector import TeamVectorEnv

__all__ = ["env", "parallel_env", "raw_env", "vector_env"]


def parallel_env(**kwargs: Any) -> raw_env:
    """The parallel environment; arguments as documented there."""
    return raw_env(**kwargs)


def env(**kwargs: Any) -> AECEnv[str, Any, Any]:
    """The same, one agent after the other."""
    return parallel_to_aec(parallel_env(**kwargs))


def vector_env(
    num_teams: int = 1, *, autoreset_mode: str = "NextStep", threads: int = 1, **kwargs: Any
) -> TeamVectorEnv:
    """Many teams in one compiled call, on several threads if you like; every agent is a row."""
    options = EstimationOptions.from_kwargs(kwargs)
    return TeamVectorEnv(options, num_teams, autoreset_mode=autoreset_mode, threads=threads)
