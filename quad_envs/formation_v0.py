"""`quad/Formation-v0` as a module, as PettingZoo's own environments have one."""

from .envs.team.formation import FormationEnv as raw_env
from .envs.team.makers import Makers

__all__ = ["env", "parallel_env", "raw_env", "vector_env"]

_makers = Makers(raw_env)
env, parallel_env, vector_env = _makers.env, _makers.parallel_env, _makers.vector_env
