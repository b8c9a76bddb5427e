"""Learned policies: training, checkpoints, and inference without torch. Names load at first use.

Torch is needed by `policy_gradient` and `imitation`, once they train, and by `tanh`, `learner`, `lagrangian`,
`vec_env` and `sb3`, which derive from its classes or those of stable-baselines3 and load them when they are
imported. Only the generators of `algorithms` import those; runs, plans, hyperparameters and networks do not.
"""

from importlib import import_module
from typing import Any

# Names that were here before they moved to the policies.
_FORMER = {
    "Features": "network",
    "Network": "network",
    "NetworkPolicy": "network",
    "load_checkpoint": "checkpoints",
    "save_checkpoint": "checkpoints",
}


def __getattr__(name: str) -> Any:
    if name in _FORMER:
        return getattr(import_module(f"baselines.policies.{_FORMER[name]}"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
