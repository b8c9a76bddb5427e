"""Hyperparameters under other names: those of earlier versions, and of other libraries.

The names of today are Stable-Baselines3's, where it has the thing. Other names are refused with the one of
today; what an earlier version recorded is read by the same table.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from typing import Any

# Name -> names of today, of which an algorithm has at most one; none where there is no such thing.
_TODAY = {
    # of earlier versions
    "rows": ("n_envs",),
    "flights": ("n_envs",),
    "horizon": ("n_steps", "progress_steps"),
    "final_horizon": ("final_n_steps",),
    "window": ("n_steps",),
    "batch": ("batch_size",),
    "epochs": ("n_epochs",),
    "discount": ("gamma",),
    "trace": ("gae_lambda",),
    "clip": ("clip_range",),
    "entropy": ("ent_coef",),
    "gradient_norm": ("max_grad_norm",),
    "log_std": ("log_std_init",),
    "hidden": ("net_arch",),
    "fits": ("gradient_steps",),
    "final_fits": ("final_gradient_steps",),
    "memory": ("buffer_size",),
    "warm_up": ("learning_starts",),
    "smoothing": ("tau",),
    # of other libraries
    "lr": ("learning_rate",),
    "lam": ("gae_lambda",),
    "lambda": ("gae_lambda",),
    "num_envs": ("n_envs",),
    "num_steps": ("n_steps",),
    "update_epochs": ("n_epochs",),
    "clip_coef": ("clip_range",),
    "hidden_sizes": ("net_arch",),
    "policy_kwargs": ("net_arch",),
    "n_timesteps": (),
    "clip_range_vf": (),
}


def name_of_today(name: str, known: Collection[str]) -> str | None:
    """What a hyperparameter is called today; None where `known` has no such thing.

    Args:
        name: Of an earlier version, or of another library.
        known: Hyperparameters of the algorithm.
    """
    return next((new for new in _TODAY.get(name, ()) if new in known), None)


def may_be_slip(name: str) -> bool:
    """Whether a name is none of those: then a name like it may be what was meant."""
    return name not in _TODAY


def in_names_of_today(values: Mapping[str, Any], known: Collection[str]) -> dict[str, Any]:
    """Recorded hyperparameters under the names of today; what is known already, or not at all, stays.

    Args:
        values: As a run or a checkpoint recorded them.
        known: Hyperparameters of the algorithm.
    """
    return {
        name if name in known else name_of_today(name, known) or name: value for name, value in values.items()
    }
