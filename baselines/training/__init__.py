"""Learned policies: training, checkpoints, and inference without torch. Names load at first use.

Torch is needed by `policy_gradient` and `imitation`, once they train, and by `tanh`, `learner`, `lagrangian`,
`vec_env` and `sb3`, which derive from its classes or those of stable-baselines3 and load them when they are
imported. Only the generators of `algorithms` import those; runs, plans, hyperparameters and networks do not.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from ..policies.checkpoints import load_checkpoint, save_checkpoint
    from ..policies.network import Features, Network, NetworkPolicy

# Public name -> module; loaded at first use, so that evaluating a network loads no torch.
_PUBLIC = {
    "Features": "baselines.policies.network",
    "Network": "baselines.policies.network",
    "NetworkPolicy": "baselines.policies.network",
    "load_checkpoint": "baselines.policies.checkpoints",
    "save_checkpoint": "baselines.policies.checkpoints",
}

__all__ = ["Features", "Network", "NetworkPolicy", "load_checkpoint", "save_checkpoint"]


def __getattr__(name: str) -> Any:
    if name in _PUBLIC:
        return getattr(import_module(_PUBLIC[name]), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
