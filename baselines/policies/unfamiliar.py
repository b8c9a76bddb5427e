"""What a flight has that the training of a policy, or its safety filter, did not have."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from quad_envs.arguments.names import shown

from .checkpoints import load_checkpoint
from .registry import behind_filter, is_trained
from .trained import checkpoint_folder
from .tuned import names_tuned

# Options of environments that a filter does not know.
_UNFORESEEN = ("disturbance", "sensor_noise", "randomize")
_MOST = 32  # characters of a value


def unfamiliar(name: str, env_id: str, env_kwargs: Mapping[str, Any]) -> list[str]:
    """What to tell who flies a policy elsewhere than where it was made, in sentences; most often nothing.

    Args:
        name: Of the policy, as for `make_policy`.
        env_id: Where it flies.
        env_kwargs: Of the environment.
    """
    told, behind = [], behind_filter(name)
    if is_trained(behind) and not names_tuned(behind):
        _, said = load_checkpoint(checkpoint_folder(behind))
        there, here = _described(said.get("env_id"), said.get("env_kwargs")), _described(env_id, env_kwargs)
        if "env_id" in said and there != here:
            told.append(f"{behind} was trained on {there}; here it flies {here}")
    unforeseen = [option for option in _UNFORESEEN if env_kwargs.get(option)]
    if behind != name and unforeseen:
        told.append(
            f"the filter of {name} predicts without {' and '.join(unforeseen)}: limits may be broken "
            "in spite of it"
        )
    return told


def _described(env_id: object, kwargs: object) -> str:
    """An environment in words, alike for options as they are given and as JSON keeps them."""
    options = dict(sorted(kwargs.items())) if isinstance(kwargs, Mapping) else {}
    plain = {key: list(value) if isinstance(value, tuple) else value for key, value in options.items()}
    said = (f"{key}={shown(value, _MOST)}" for key, value in plain.items())
    return " with ".join(filter(None, (str(env_id), ", ".join(said))))
