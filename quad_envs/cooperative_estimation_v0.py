"""`quad/CooperativeEstimation-v0` as a module, as PettingZoo's own environments have one."""

from .envs.team.makers import Makers
from .envs.team.target_tracking import CooperativeEstimationEnv as raw_env

__all__ = ["env", "parallel_env", "raw_env", "vector_env"]

_makers = Makers(raw_env)
env, parallel_env, vector_env = _makers.env, _makers.parallel_env, _makers.vector_env
