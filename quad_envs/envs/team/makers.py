"""What makes the environments of an id, by the names of PettingZoo: env, parallel_env, vector_env."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Generic, TypeVar

from pettingzoo import AECEnv
from pettingzoo.utils import parallel_to_aec

from .env import TeamEnv
from .vector import TeamVectorEnv

Env = TypeVar("Env", bound=TeamEnv)


@dataclass(frozen=True)
class Makers(Generic[Env]):
    """The functions of a module; their keyword arguments are documented at the class."""

    raw_env: type[Env]

    def parallel_env(self, **kwargs: Any) -> Env:
        """The parallel environment."""
        return self.raw_env(**kwargs)

    def env(self, **kwargs: Any) -> AECEnv[str, Any, Any]:
        """The same, one agent after the other."""
        return parallel_to_aec(self.parallel_env(**kwargs))

    def vector_env(
        self, num_teams: int = 1, *, autoreset_mode: str = "NextStep", threads: int = 1, **kwargs: Any
    ) -> TeamVectorEnv:
        """Many teams in one compiled call, on several threads if you like; every agent is a row."""
        options = self.raw_env.options_type.from_kwargs(kwargs)
        return TeamVectorEnv(options, num_teams, autoreset_mode=autoreset_mode, threads=threads)
